"""The environment: its interface, its reproducibility, what counts as success, and invalid input."""

import gc
import os
import pickle
import re
import tempfile
import warnings

import gymnasium as gym
import numpy as np
import pybullet
import pytest
from fresh_python import run_python
from gymnasium.utils.env_checker import check_env

from gym_deltaco import ENV_ID
from gym_deltaco.env import ACTION_NAMES, STATE_NAMES, PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.scene_config import AMBIGUITIES, SceneConfig

STAY_OPEN = np.array([0, 0, 0, 1], np.float32)
STAY_CLOSED = np.array([0, 0, 0, -1], np.float32)
SMALL = SceneConfig(image_size=8)
TRAINING_OBJECTS = SceneConfig(objects="scenario_a_train", image_size=8)


@pytest.fixture
def env():
    env = PickPlaceEnv(4, render_mode="rgb_array")
    env.reset(seed=0)
    yield env
    env.close()


def connected_clients():
    """Returns the ids of the PyBullet clients of this process."""
    return {i for i in range(64) if pybullet.getConnectionInfo(i)["isConnected"]}


def test_gymnasiums_checker_has_no_warnings():
    for ambiguity in AMBIGUITIES:
        scene = SceneConfig(ambiguity=ambiguity)
        env = gym.make(f"gym_deltaco:{ENV_ID}", task_id=4, scene=scene, render_mode="rgb_array")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env.unwrapped)
        env.close()


def documented_tables():
    """Returns the docstring's tables by section, as rows of cells."""
    tables = {}
    for section in PickPlaceEnv.__doc__.split("## ")[1:]:
        lines = [line.strip() for line in section.splitlines() if line.strip().startswith("|")]
        rows = [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines]
        tables[section.split()[0]] = rows[2:]  # without the heading and the rule
    return tables


def test_observations_and_actions_are_as_documented():
    env = PickPlaceEnv(scene=SceneConfig(image_size=31), render_mode="rgb_array", render_size=62)
    documented = {
        key: (tuple(int(n) for n in re.findall(r"\d+", re.sub("[HW]", "31", shape))), dtype)
        for key, shape, dtype, _ in documented_tables()["Observation"]
    }
    spaces = {key: (space.shape, space.dtype.name) for key, space in env.observation_space.items()}
    observation, _ = env.reset(seed=0)
    found = {key: (value.shape, value.dtype.name) for key, value in observation.items()}
    assert documented == spaces == found
    assert observation in env.observation_space
    assert documented["agent_pos"][0] == (len(STATE_NAMES),)
    assert env.render().shape == (62, 62, 3)
    assert [limits for _, limits, _ in documented_tables()["Action"]] == ["-1 .. 1"] * 2
    space = env.action_space
    assert (space.low.tolist(), space.high.tolist()) == ([-1] * len(ACTION_NAMES), [1] * len(ACTION_NAMES))
    env.close()


def test_info_is_as_documented(env):
    documented = dict(documented_tables()["Info"])
    for info in (env.reset(seed=0)[1], env.step(STAY_OPEN)[-1]):
        assert set(info) == set(documented)
        for key, text in documented.items():
            if match := re.match(r"\(([\d, ]+)\) (\w+):", text):
                shape = tuple(int(size) for size in match[1].split(",") if size.strip())
                assert (info[key].shape, info[key].dtype.name) == (shape, match[2])
            else:
                assert type(info[key]) is (bool if text.startswith("whether") else int)


def test_state_is_joints_position_and_gripper(env):
    for action, gripper in ((STAY_OPEN, 1), (STAY_CLOSED, 0), (np.array([0.3, -0.2, 0.4, -1]), 0)):
        state = env.step(action)[0]["agent_pos"]
        np.testing.assert_array_equal(state[:6], env.scene.arm.joints.astype(np.float32))
        np.testing.assert_array_equal(state[6:9], env.scene.arm.position.astype(np.float32))
        assert state[9] == gripper


def test_state_stays_in_its_space_while_the_arm_circles_its_base():
    env = PickPlaceEnv(4, SceneConfig(image_size=8, episode_length=60))
    env.reset(seed=0)
    turn = np.linspace(0, 6 * np.pi, 60)
    for goal in np.stack([0.6 + 0.15 * np.sin(turn), 0.15 * np.cos(turn), np.full(60, -0.16)], axis=-1):
        motion = np.clip((goal - env.scene.arm.position) / 0.1, -1, 1)
        assert env.step(np.array([*motion, 1]))[0] in env.observation_space
    env.close()


def test_rendered_image_shows_the_observed_scene(env):
    rows = np.rint((np.arange(48) + 0.5) * 256 / 48 - 0.5).astype(int)
    pixels = [env.reset(seed=seed)[0]["pixels"].astype(float) for seed in (4, 3)]
    rendered = env.render()
    assert (rendered.shape, rendered.dtype) == ((256, 256, 3), np.uint8)
    other, same = (np.abs(rendered[np.ix_(rows, rows)] - seen).mean() for seen in pixels)
    assert same < 12 < other
    assert PickPlaceEnv().render() is None


def test_containers_appear_where_their_words_say():
    # The camera looks back at the robot: front is at the bottom of the image, right is on the right.
    env = PickPlaceEnv(4, render_mode="rgb_array", render_size=128)
    for seed in range(8):
        env.reset(seed=seed)
        red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
        masks = (green - np.maximum(red, blue) > 40, red - np.maximum(green, blue) > 90)
        rows, columns = zip(*(np.argwhere(mask).mean(axis=0) for mask in masks), strict=True)
        first, second = (container.quadrant for container in env.scene.layout.containers)
        if first.i != second.i:
            assert (columns[0] > columns[1]) == (first.i == 0)
        if first.j != second.j:
            assert (rows[0] > rows[1]) == (first.j == 1)
    env.close()


def test_episode_is_truncated_at_its_length_and_never_terminates():
    for length in (30, 3):
        env = gym.make(ENV_ID, task_id=4, scene=SceneConfig(image_size=8, episode_length=length))
        assert env.get_wrapper_attr("_max_episode_steps") == length
        for _ in range(2):
            env.reset(seed=0)
            ends = [env.step(STAY_OPEN)[2:4] for _ in range(length + 2)]
            assert ends == [(False, False)] * (length - 1) + [(False, True)] * 3
        assert len(list(expert_episode(env.unwrapped, 4, 0))) == length
        env.close()


def test_reward_is_1_from_the_first_success_on(env):
    steps = list(expert_episode(env, 4, seed=0))
    rewards = [step.reward for step in steps]
    assert rewards == [float(step.info["is_success"]) for step in steps] == sorted(rewards)
    assert (rewards[0], rewards[-1]) == (0, 1)


def test_reset_changes_the_task_from_then_on(env):
    assert env.reset(seed=0)[1]["task_id"] == 4
    observation, info = env.reset(seed=9, options={"task_id": 295})
    assert info["task_id"] == env.step(STAY_OPEN)[-1]["task_id"] == 295
    assert env.task_description == "Put cup shaped object in right bin."
    fresh = PickPlaceEnv(295)
    np.testing.assert_array_equal(observation["pixels"], fresh.reset(seed=9)[0]["pixels"])
    assert env.reset(seed=0, options={"something": "else"})[1]["task_id"] == 295


def test_reset_without_a_seed_continues_the_random_stream(env):
    seeds = (1, None, None, None, None)
    runs = [[tuple(env.reset(seed=seed)[1]["objects"]) for seed in seeds] for _ in range(2)]
    assert runs[0] == runs[1]
    assert len(set(runs[0])) > 1


def test_instructions_are_drawn_by_the_seed_and_leave_the_scene_alone():
    sentences = {4: tuple(f"sentence {n}" for n in range(5)), 90: ["only one"]}
    env, plain = PickPlaceEnv(4, SMALL, instructions=sentences), PickPlaceEnv(4, SMALL)
    drawn = []
    for seed in [*range(12), *range(12)]:
        env.reset(seed=seed)
        drawn.append(env.task_description)
    assert drawn[:12] == drawn[12:]
    assert set(drawn) == set(sentences[4])
    for seed in (0, None, None):
        observation, expected = env.reset(seed=seed)[0], plain.reset(seed=seed)[0]
        np.testing.assert_array_equal(observation["pixels"], expected["pixels"])
        assert plain.task_description == plain.task.instruction
    with pytest.raises(ValueError, match="no sentence for task 5"):
        env.reset(options={"task_id": 5})
    assert env.task.index == 4
    env.reset(seed=0, options={"task_id": 90})
    assert env.task_description == "only one"
    env.close()
    plain.close()


def test_invalid_arguments_are_errors_that_say_what_is_valid():
    for arguments, message in [
        ({"task_id": 300}, r"`task_id` must be an integer from 0 to 299, .*\. Got 300"),
        ({"task_id": 4.0}, r"Got 4\.0"),
        ({"task_id": True}, r"Got True"),
        ({"task_id": "4"}, r"Got '4'"),
        ({"task_id": 24, "scene": TRAINING_OBJECTS}, "Task 24 asks for a gray .* bathtub"),
        ({"render_size": 7}, r"`render_size` must be an integer from 8 to 4096\. Got 7"),
        ({"render_size": 100.5}, r"Got 100\.5"),
        ({"render_size": 10**6}, r"Got 1000000"),
        ({"render_mode": "human"}, r"`render_mode` must be 'rgb_array' or None\. Got 'human'"),
    ]:
        before = connected_clients()
        with pytest.raises(ValueError, match=message):
            PickPlaceEnv(**arguments)
        assert connected_clients() == before


def test_invalid_reset_leaves_the_scene():
    env = PickPlaceEnv(4, TRAINING_OBJECTS)
    env.reset(seed=7)
    state, scene = env.np_random.bit_generator.state, env.scene
    with pytest.raises(ValueError, match="Task 39 asks for a yellow colored object"):
        env.reset(seed=8, options={"task_id": 39})
    for task_id in (300, -1, 4.5, "4", None):
        with pytest.raises(ValueError, match="`task_id` must be an integer from 0 to 299"):
            env.reset(seed=8, options={"task_id": task_id})
    assert env.scene is scene
    assert env.task.index == 4
    assert env.np_random.bit_generator.state == state
    env.close()


def test_invalid_action_is_an_error_and_leaves_the_scene(env):
    env.reset(seed=7)
    for action in ([0, 0, 0], [[0, 0, 0, 1]], 0.0, None):
        with pytest.raises(ValueError, match=r"must have shape \(4,\): x, y, z and gripper\. Got"):
            env.step(action)
    for action in ([0, 0, np.nan, 1], [0, -np.inf, 0, 1], [0j, 0, 0, 1], ["0", "0", "0", "1"], [True] * 4):
        with pytest.raises(ValueError, match="must consist of real, finite numbers"):
            env.step(action)
    observation, *_ = env.step(STAY_OPEN)
    env.reset(seed=7)
    np.testing.assert_array_equal(observation["agent_pos"], env.step(STAY_OPEN)[0]["agent_pos"])


def test_action_out_of_range_is_clipped_and_not_modified(env):
    action = np.array([0.5, -7.0, 3.0, 9.0], np.float32)
    observations = []
    for taken in (action, np.clip(action, -1, 1)):
        env.reset(seed=7)
        observations.append(env.step(taken)[0]["agent_pos"])
    np.testing.assert_array_equal(*observations)
    assert action.tolist() == [0.5, -7.0, 3.0, 9.0]


def test_use_before_reset_or_after_close_is_an_error():
    env = PickPlaceEnv(scene=SMALL, render_mode="rgb_array")
    for _ in range(2):
        for use in (lambda: env.step(STAY_OPEN), env.render, lambda: env.scene):
            with pytest.raises(gym.error.ResetNeeded, match="Call `reset` before"):
                use()
        env.reset(seed=0)
        env.close()
        env.close()


@pytest.fixture
def temporary_files(tmp_path, monkeypatch):
    """Lists the files of environments, in a folder of this test's own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return lambda: [path.name for path in tmp_path.glob("gym_deltaco_*")]


def test_closed_or_forgotten_environments_leave_no_clients_and_files(temporary_files):
    gc.collect()
    before = connected_clients()
    envs = [PickPlaceEnv(scene=SMALL) for _ in range(3)]
    assert connected_clients() == before, "clients are connected at the first reset"
    for env in envs * 2:
        env.reset(seed=0)
    assert len(connected_clients() - before) == 3
    assert temporary_files()
    envs.pop().close()
    env = envs.pop()
    env.itself = env  # a reference cycle
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs.clear()
        del env
        gc.collect()
    assert connected_clients() == before
    assert temporary_files() == []


def test_process_ends_without_warnings_and_leaves_no_files(tmp_path):
    script = """
import multiprocessing
from gym_deltaco.env import PickPlaceEnv
env = PickPlaceEnv(); env.reset(seed=0)
env.itself = env
fork = multiprocessing.get_context("fork").Process
process = fork(target=env.close); process.start(); process.join()
env.reset(seed=1, options={"task_id": 1})  # the child has closed its copy, and no files of the parent
process = fork(target=lambda: PickPlaceEnv().reset(seed=0)); process.start(); process.join()
other = PickPlaceEnv()
process = fork(target=lambda: other.reset(seed=0)); process.start(); process.join()
"""
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONWARNINGS": "always::ResourceWarning"}
    result = run_python(script, env=environment)
    assert (result.returncode, result.stdout) == (0, "")
    assert all(line.startswith("pybullet build time") for line in result.stderr.splitlines())
    assert list(tmp_path.glob("gym_deltaco_*")) == []


def test_environment_can_be_pickled_before_its_first_reset_but_not_after(env):
    other = pickle.loads(pickle.dumps(PickPlaceEnv(4, SceneConfig("object", image_size=8))))
    assert (other.task.index, other.scene_config.ambiguity) == (4, "object")
    with pytest.raises(TypeError, match="cannot be copied or pickled"):
        pickle.dumps(env)
