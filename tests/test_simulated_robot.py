"""`examples/simulated_robot.py`: a scripted operator performs its task, scene by scene."""

from types import SimpleNamespace

import numpy as np
import pytest
import simulated_robot
from lerobot.scripts import lerobot_record
from small_policies import LeRobotDataset, as_options

from gym_deltaco.tasks import get_task
from lerobot_deltaco.data.grasps import Grasp, find_grasps
from lerobot_deltaco.data.gripper import Gripper

TASK_ID = 4


def test_the_operator_performs_the_task_once_in_each_scene(tmp_path, caplog, monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(simulated_robot.time, "perf_counter", lambda: clock.now)
    config = simulated_robot.SimulatedWidowxConfig(
        task_id=TASK_ID, image_size=16, calibration_dir=tmp_path, objects="scenario_a_train"
    )
    robot = simulated_robot.SimulatedWidowx(config)
    operator = simulated_robot.ScriptedOperator(
        simulated_robot.ScriptedOperatorConfig(calibration_dir=tmp_path)
    )
    robot.connect()
    operator.connect()
    first_images = []
    for _ in range(2):
        for frame in range(240):
            clock.now += 1 / 30
            observation = robot.get_observation()
            if frame == 0:
                first_images.append(observation["front"])
            action = operator.get_action()
            robot.send_action(action)
        assert operator.get_action() == action  # it rests
        clock.now += 0.1  # in which LeRobot stores the episode
    sizes = {name: np.shape(value) or float for name, value in observation.items()}
    assert sizes == robot.observation_features
    assert robot.n_scenes == 2
    assert (first_images[0] != first_images[1]).any()
    robot.disconnect()
    assert f"{get_task(TASK_ID).instruction} It was done." in caplog.text


@pytest.mark.slow
def test_lerobot_records_it(tmp_path, monkeypatch):
    options = {
        "robot.type": "simulated_widowx",
        "robot.discover_packages_path": "simulated_robot",
        "robot.calibration_dir": tmp_path,
        "robot.image_size": 32,
        "robot.task_id": TASK_ID,
        "teleop.type": "scripted_operator",
        "dataset.repo_id": "me/tasks",
        "dataset.root": tmp_path / "tasks",
        "dataset.fps": 30,
        "dataset.episode_time_s": 8,
        "dataset.reset_time_s": 0,
        "dataset.num_episodes": 2,
        "dataset.no_stamp": True,
        "dataset.push_to_hub": False,
        "play_sounds": False,
        "dataset.single_task": "Put it in the bin.",
    }
    monkeypatch.setattr("sys.argv", ["lerobot-record", *as_options(options)])
    lerobot_record.main()
    dataset = LeRobotDataset("me/tasks", tmp_path / "tasks")
    assert dataset.meta.video_keys
    assert dataset.num_episodes == 2
    column = dataset.hf_dataset.with_format("torch")
    actions, states = column["action"][:], column["observation.state"][:]
    spans = [(row["dataset_from_index"], row["dataset_to_index"] - 1) for row in dataset.meta.episodes]
    assert all(last - first > 200 for first, last in spans)
    gripper = Gripper(actions.shape[1] - 1)
    assert all(
        isinstance(found, Grasp) for found in find_grasps(gripper.opening(actions), spans, states=states)
    )
