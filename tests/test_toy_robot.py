"""The toy robot: its kinematics, its objects, and its dataset."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_deltaco.deltaco_match.keyframes import grasp_frames
from lerobot_deltaco.demonstrations import read_robot_data
from lerobot_deltaco.toy_robot.record import teleoperated, write_toy_dataset
from lerobot_deltaco.toy_robot.world import HEIGHT, NEW_TASKS, TASKS, WIDTH, ToyWorld, joints_at, pose_of


def test_the_inverse_kinematics_lead_to_the_point():
    rng = np.random.default_rng(0)
    for x, y, z in rng.uniform((0.14, -0.2, 0.0), (0.2, 0.2, 0.1), (20, 3)):
        points, across, _ = pose_of(joints_at(x, y, z, 50))
        assert points[-1] == pytest.approx((x, y, z), abs=1e-6)
        assert (points[-2] - points[-1])[:2] == pytest.approx(0, abs=1e-6)  # the hand points down
        assert across @ (points[-1] - points[-2]) == pytest.approx(0, abs=1e-9)


def test_a_person_puts_the_object_into_the_box_in_two_to_five_seconds():
    lengths, n_right = [], 0
    for seed, (name, color) in enumerate([*TASKS.values(), *NEW_TASKS.values()] * 4):
        world = ToyWorld(seed, name == "orange bar")
        before = {other: place.copy() for other, place in world.objects.items() if other != name}
        lengths.append(len(list(teleoperated(world, name, color, np.random.default_rng(seed)))))
        n_right += world.in_boxes() == {name: color}
        assert all((world.objects[other] == place).all() for other, place in before.items())
    assert n_right >= 0.9 * len(lengths)
    assert 60 <= min(lengths) < max(lengths) <= 150


def test_an_object_that_is_not_reached_stays():
    world = ToyWorld(0)
    (x, y), name = world.objects["red cube"][:2], "red cube"
    for gripper in (90.0, 5.0):
        for _ in range(20):
            world.step(joints_at(x, y, 0.08, gripper))
    assert not world.held
    assert world.objects[name][:2].tolist() == [x, y]


def test_the_dataset_has_a_grasp_in_every_episode(tmp_path):
    n_frames = write_toy_dataset(tmp_path / "toy", 1, new_object=True, seed=0)
    dataset = LeRobotDataset("toy", root=tmp_path / "toy")
    assert len(dataset) == n_frames
    assert list(dataset.meta.tasks.index) == list(NEW_TASKS)
    assert dataset[0]["observation.images.front"].shape == (3, HEIGHT, WIDTH)
    data = read_robot_data(dataset, range(2))
    assert None not in grasp_frames(data.actions[:, 5], data.spans)
