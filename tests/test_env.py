"""The environment: its interface, its repeatability, what counts as success, and what it refuses."""

import copy
import functools
import gc
import hashlib
import itertools
import math
import multiprocessing
import os
import pickle
import re
import subprocess
import sys
import tempfile
import warnings

import gymnasium as gym
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Expert, Stage, expert_episode
from gym_deltaco.layout import AMBIGUITIES

ENV_ID = "gym_deltaco/PickPlace-v0"
STAY_OPEN = np.array([0, 0, 0, 1], np.float32)
STAY_CLOSED = np.array([0, 0, 0, -1], np.float32)
TRAY_FLOOR, CONTAINER_HALF_EXTENTS = -0.37, np.array([0.075, 0.0525])  # m
# A name, a color and a shape; a color and a position each.
SOME_TASKS = (4, 82, 146, 295)


@pytest.fixture
def env():
    env = PickPlaceEnv(4, render_mode="rgb_array")
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def small_envs():
    """An environment with small images for each ambiguity scheme; tests have to reset it."""
    envs = {ambiguity: PickPlaceEnv(ambiguity=ambiguity, image_size=8) for ambiguity in AMBIGUITIES}
    yield envs
    for env in envs.values():
        env.close()


def connected_clients():
    """Ids of PyBullet's running simulators in this process."""
    return {i for i in range(64) if pybullet.getConnectionInfo(i)["isConnected"]}


def run_script(script, **environment):
    """Runs a Python script, which must succeed; returns (stdout, stderr)."""
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, **environment}
    )
    assert result.returncode == 0, result.stderr
    return result.stdout, result.stderr


# Interface


def check_env_of_stable_baselines(env):
    # It loads torch, which the worker processes of other tests here do without.
    from stable_baselines3.common.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def check_env_of_gymnasium(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
@pytest.mark.parametrize("check", [check_env_of_gymnasium, check_env_of_stable_baselines])
def test_the_checkers_have_no_warning(ambiguity, check):
    env = gym.make(ENV_ID, task_id=4, ambiguity=ambiguity, render_mode="rgb_array")
    check(env.unwrapped)
    env.close()


def documented_tables():
    """The markdown tables of the docstring, by their section's first word: lists of rows of cells."""
    tables = {}
    for section in PickPlaceEnv.__doc__.split("## ")[1:]:
        lines = [line.strip() for line in section.splitlines() if line.strip().startswith("|")]
        rows = [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines]
        tables[section.split()[0]] = rows[2:]  # without the heading and its rule
    return tables


@pytest.mark.parametrize("image_size", [48, 31])
def test_the_observation_space_is_the_documented_one(image_size):
    env = PickPlaceEnv(image_size=image_size)
    documented = {
        key: (tuple(int(n) for n in re.findall(r"\d+", re.sub("[HW]", str(image_size), shape))), dtype)
        for key, shape, dtype, _ in documented_tables()["Observation"]
    }
    spaces = {key: (space.shape, space.dtype.name) for key, space in env.observation_space.items()}
    assert spaces == documented
    assert set(documented) == {"pixels", "agent_pos"}
    observation, _ = env.reset(seed=0)
    assert {key: (value.shape, value.dtype.name) for key, value in observation.items()} == documented
    assert observation in env.observation_space
    env.close()


def test_the_action_space_is_the_documented_one():
    numbers = []
    for number, limits, _ in documented_tables()["Action"]:
        first, _, last = number.partition("..")
        numbers += range(int(first), int(last or first) + 1)
        assert [float(limit) for limit in limits.split("..")] == [-1, 1]
    assert numbers == [0, 1, 2, 3]
    space = PickPlaceEnv().action_space
    assert space.shape == (4,)
    assert (space.low == -1).all()
    assert (space.high == 1).all()


def test_the_info_is_the_documented_one(env):
    documented = dict(documented_tables()["Info"])
    for info in (env.reset(seed=0)[1], env.step(STAY_OPEN)[-1]):
        assert set(info) == set(documented)
        for key, text in documented.items():
            if match := re.match(r"\(([\d, ]+)\) (\w+):", text):
                shape = tuple(int(size) for size in match[1].split(",") if size.strip())
                assert (info[key].shape, info[key].dtype.name) == (shape, match[2])
            elif text.startswith("whether"):
                assert type(info[key]) is bool
            else:
                assert type(info[key]) is int


def test_the_constructor_has_the_documented_defaults():
    env = gym.make(ENV_ID).unwrapped
    assert (env.task.index, env.ambiguity, env.image_size, env.render_size) == (0, "container", 48, 256)
    assert (env.objects, env.adversarial_probability, env.adversarial_draw) == ("all", 0.6, "each")
    assert (env.render_mode, env.instructions) == (None, None)
    assert env.metadata["render_fps"] == 24
    assert env.metadata["render_modes"] == ["rgb_array"]


@pytest.mark.parametrize("task_id", SOME_TASKS)
def test_the_task_description_is_the_instruction(task_id):
    env = gym.make(ENV_ID, task_id=task_id)
    assert env.unwrapped.task_description == env.unwrapped.task.instruction
    assert env.unwrapped.task.index == task_id


def test_the_state_is_joints_position_and_gripper(env):
    for action, gripper in ((STAY_OPEN, 1), (STAY_CLOSED, 0), (np.array([0.3, -0.2, 0.4, -1]), 0)):
        state = env.step(action)[0]["agent_pos"]
        np.testing.assert_array_equal(state[:6], env.scene.arm.joints.astype(np.float32))
        np.testing.assert_array_equal(state[6:9], env.scene.arm.position.astype(np.float32))
        assert state[9] == gripper


def test_observations_stay_in_their_space_when_the_arm_goes_around_its_base():
    env = PickPlaceEnv(4, image_size=8)
    env.reset(seed=0)
    turn = np.linspace(0, 6 * np.pi, 60)
    for goal in np.stack([0.6 + 0.15 * np.sin(turn), 0.15 * np.cos(turn), np.full(60, -0.16)], axis=-1):
        motion = np.clip((goal - env.scene.arm.position) / 0.1, -1, 1)
        observation, *_ = env.step(np.array([*motion, 1]))
        assert observation in env.observation_space
    env.close()


@pytest.mark.parametrize("size", [8, 33, 96])
def test_images_have_the_size_that_is_asked_for(size):
    env = PickPlaceEnv(image_size=size, render_mode="rgb_array", render_size=2 * size)
    observation, _ = env.reset(seed=0)
    assert observation["pixels"].shape == (size, size, 3)
    assert env.render().shape == (2 * size, 2 * size, 3)
    assert env.render().dtype == np.uint8
    env.close()


def test_people_see_the_same_scene_as_the_policy(env):
    pixels = env.reset(seed=3)[0]["pixels"].astype(float)
    rendered = env.render()
    assert rendered.shape == (256, 256, 3)
    rows = np.rint((np.arange(48) + 0.5) * 256 / 48 - 0.5).astype(int)
    assert np.abs(rendered[np.ix_(rows, rows)] - pixels).mean() < 12
    other = env.reset(seed=4)[0]["pixels"].astype(float)
    assert np.abs(rendered[np.ix_(rows, rows)] - other).mean() > 12


def test_without_a_render_mode_nothing_is_rendered():
    env = PickPlaceEnv(image_size=8)
    env.reset(seed=0)
    assert env.render() is None
    env.close()


def test_rendering_changes_nothing(env):
    seen = []
    for n_renders in (0, 2):
        observations = [env.reset(seed=5)[0]]
        for action in np.random.default_rng(0).uniform(-1, 1, (4, 4)):
            for _ in range(n_renders):
                env.render()
            observations.append(env.step(action)[0])
        seen.append(np.concatenate([observation["agent_pos"] for observation in observations]))
    np.testing.assert_array_equal(*seen)


def test_containers_are_seen_where_their_words_say():
    # The camera looks back at the robot: the front is below in the image, the right is on the right.
    env = PickPlaceEnv(4, render_mode="rgb_array", render_size=128)
    for seed in range(8):
        env.reset(seed=seed)
        red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
        colored = {"green": green - np.maximum(red, blue) > 40, "red": red - np.maximum(green, blue) > 90}
        (first, second) = env.scene.layout.containers
        rows, columns = zip(
            *(np.argwhere(colored[container.color]).mean(axis=0) for container in (first, second)),
            strict=True,
        )
        if first.quadrant.i != second.quadrant.i:
            assert (columns[0] > columns[1]) == (first.quadrant.i == 0)
        if first.quadrant.j != second.quadrant.j:
            assert (rows[0] > rows[1]) == (first.quadrant.j == 1)
    env.close()


# Episodes


def test_an_episode_is_truncated_after_30_steps_and_never_terminates():
    env = gym.make(ENV_ID, task_id=4, image_size=8)
    env.reset(seed=0)
    expert = Expert(env.unwrapped, np.random.default_rng(0))
    ends, rewards = [], []
    for _ in range(30):
        _, reward, terminated, truncated, info = env.step(expert.act())
        assert reward == float(info["is_success"])
        ends.append((terminated, truncated))
        rewards.append(reward)
    assert ends == [(False, False)] * 29 + [(False, True)]
    assert rewards[-1] == 1
    assert rewards == sorted(rewards), "success is not lost"
    env.close()


def test_reset_changes_the_task_from_then_on(env):
    assert env.reset(seed=0)[1]["task_id"] == 4
    _, info = env.reset(seed=0, options={"task_id": 295})
    assert info["task_id"] == 295
    assert env.task_description == "Put cup shaped object in right bin."
    assert env.step(STAY_OPEN)[-1]["task_id"] == 295
    assert env.reset(seed=0)[1]["task_id"] == 295
    assert env.reset(seed=0, options={"something": "else"})[1]["task_id"] == 295


def test_a_reset_to_a_task_equals_an_environment_made_for_it(env):
    observation, info = env.reset(seed=9, options={"task_id": 146})
    fresh = PickPlaceEnv(146)
    fresh_observation, fresh_info = fresh.reset(seed=9)
    fresh.close()
    np.testing.assert_array_equal(observation["pixels"], fresh_observation["pixels"])
    np.testing.assert_array_equal(observation["agent_pos"], fresh_observation["agent_pos"])
    np.testing.assert_array_equal(info["objects"], fresh_info["objects"])


def test_reset_without_a_seed_goes_on_with_the_draws(env):
    first = [
        env.reset(seed=1)[1]["objects"].tolist(),
        *(env.reset()[1]["objects"].tolist() for _ in range(4)),
    ]
    second = [
        env.reset(seed=1)[1]["objects"].tolist(),
        *(env.reset()[1]["objects"].tolist() for _ in range(4)),
    ]
    assert first == second
    assert len({tuple(objects) for objects in first}) > 1


# Repeatability


def absorb(digest, *values):
    """Adds numbers, arrays and dictionaries of them to a hash, to the last bit."""
    for value in values:
        if isinstance(value, dict):
            for key in sorted(value):
                digest.update(key.encode())
                absorb(digest, value[key])
        else:
            array = np.asarray(value)
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())


def fingerprints(env, task_id, seed):
    """Hashes of an expert episode so far, step by step: observations, rewards and infos."""
    digest = hashlib.sha256()
    absorb(digest, *env.reset(seed=seed, options={"task_id": task_id}))
    for step in expert_episode(env, task_id, seed):
        absorb(digest, step.observation, step.action, step.reward, step.info)
        yield digest.hexdigest()


def actions_fingerprint(env, seed, actions):
    """Hash of an episode with given actions."""
    digest = hashlib.sha256()
    absorb(digest, *env.reset(seed=seed))
    for action in actions:
        absorb(digest, *env.step(action))
    return digest.hexdigest()


def last(iterable):
    *_, value = iterable
    return value


def episode_fingerprint(ambiguity, task_id, seed):
    """The hash of an episode in an environment of its own."""
    env = PickPlaceEnv(ambiguity=ambiguity)
    value = last(fingerprints(env, task_id, seed))
    env.close()
    return value


EPISODES = [(task_id, seed) for seed, task_id in enumerate(SOME_TASKS)]


@pytest.fixture(scope="module")
def expected_fingerprints():
    return {
        (ambiguity, *episode): episode_fingerprint(ambiguity, *episode)
        for ambiguity in AMBIGUITIES
        for episode in EPISODES
    }


def test_different_episodes_have_different_fingerprints(expected_fingerprints):
    assert len(set(expected_fingerprints.values())) == len(expected_fingerprints)


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_an_episode_repeats_to_the_last_bit_after_any_others(expected_fingerprints, ambiguity):
    env = PickPlaceEnv(ambiguity=ambiguity)
    for task_id, seed in [*EPISODES[::-1], *EPISODES]:
        assert last(fingerprints(env, task_id, seed)) == expected_fingerprints[ambiguity, task_id, seed]
        # An episode that ends in the middle, with the gripper closed and things in motion.
        env.reset(seed=100 + seed)
        for action in np.random.default_rng(seed).choice([-1.0, 1.0], (7, 4)):
            env.step(action)
    env.close()


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_interleaved_environments_repeat_to_the_last_bit(expected_fingerprints, ambiguity):
    envs = [PickPlaceEnv(ambiguity=ambiguity) for _ in EPISODES]
    runs = [fingerprints(env, *episode) for env, episode in zip(envs, EPISODES, strict=True)]
    *_, values = zip(*runs, strict=True)
    assert list(values) == [expected_fingerprints[ambiguity, *episode] for episode in EPISODES]
    for env in envs:
        env.close()


def test_episodes_repeat_to_the_last_bit_in_another_process(expected_fingerprints, monkeypatch):
    monkeypatch.setenv("PYTHONHASHSEED", "7")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        values = pool.starmap(episode_fingerprint, expected_fingerprints)
    assert values == list(expected_fingerprints.values())


def test_extreme_actions_repeat_to_the_last_bit(env):
    actions = np.random.default_rng(3).choice([-1.0, 1.0], (30, 4))
    first = actions_fingerprint(env, 11, actions)
    other = PickPlaceEnv(4)
    other.reset(seed=2)
    assert actions_fingerprint(other, 11, actions) == first
    assert actions_fingerprint(other, 12, actions) != first
    other.close()
    assert actions_fingerprint(env, 11, actions) == first


def test_the_global_random_state_is_neither_read_nor_changed(env):
    actions = np.random.default_rng(3).uniform(-1, 1, (3, 4))
    values = []
    for seed in (0, 1):
        np.random.seed(seed)  # noqa: NPY002
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        values.append(actions_fingerprint(env, 5, actions))
        np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    assert values[0] == values[1]


# Success


def put(env, number, container, offset=(0.0, 0.0), height=0.002):
    """Lets an object fall from just above a container's floor; returns the info of a step without motion."""
    half_height = env.scene.layout.objects[number].model.half_extents[2]
    middle = env.scene.layout.containers[container].quadrant.container_center
    env.scene.place(number, (*(middle + offset), TRAY_FLOOR + 0.003 + half_height + height))
    return env.step(STAY_OPEN)[-1]


@pytest.mark.parametrize("task_id", SOME_TASKS)
@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_only_the_target_in_the_target_container_is_a_success(small_envs, ambiguity, task_id):
    env = small_envs[ambiguity]
    for number, container in itertools.product(range(3), range(2)):
        _, info = env.reset(seed=task_id, options={"task_id": task_id})
        assert not info["is_success"]
        assert not info["right_container"]
        assert info["object_containers"].tolist() == [-1, -1, -1]
        quadrants = [tuple(container.quadrant) for container in env.unwrapped.scene.layout.containers]
        assert [tuple(row) for row in info["container_quadrants"].tolist()] == quadrants
        is_right = (number, container) == (info["target_object"], info["target_container"])
        info = put(env, number, container)
        assert info["is_success"] == is_right
        assert info["right_container"] == (container == info["target_container"])
        assert info["object_containers"].tolist() == [container if n == number else -1 for n in range(3)]
        assert info["grasped_object"] == -1
        assert not info["right_object"]


def test_every_object_can_stand_in_a_container(small_envs):
    env = small_envs["container"]
    for index in range(32):
        _, info = env.reset(seed=index, options={"task_id": index})
        assert info["objects"][info["target_object"]] == index
        assert put(env, info["target_object"], info["target_container"], height=0.01)["is_success"], index


def test_the_twin_in_the_target_container_is_no_success(small_envs):
    env = small_envs["object"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    objects, target = info["objects"].tolist(), info["target_object"]
    (twin,) = (n for n in range(3) if n != target and objects[n] == objects[target])
    info = put(env, twin, info["target_container"])
    assert info["object_containers"][twin] == info["target_container"]
    assert not info["is_success"]


def test_success_at_any_step_is_remembered_until_the_reset(small_envs):
    env = small_envs["container"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    assert put(env, target, container)["is_success"]
    info = put(env, target, 1 - container)
    assert info["is_success"]
    assert not info["right_container"]
    _, info = env.reset(seed=0)
    assert not info["is_success"]
    _, reward, *_ = env.step(STAY_OPEN)
    assert reward == 0


def test_both_containers_in_use_is_not_the_right_container(small_envs):
    env = small_envs["container"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    assert put(env, target, container)["right_container"]
    assert not put(env, (target + 1) % 3, 1 - container)["right_container"]


# To each side of a container, and beyond a corner: in units of its half extents.
@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1)])
def test_beside_the_container_or_on_its_rim_is_no_success(small_envs, direction):
    env = small_envs["container"]
    for share in (0.9, 1.0, 1.1, 1.3):
        _, info = env.reset(seed=0, options={"task_id": 4})
        target, container = info["target_object"], info["target_container"]
        info = put(env, target, container, offset=share * np.array(direction) * CONTAINER_HALF_EXTENTS)
        position = env.scene.object_pose(target).position
        middle = env.scene.layout.containers[container].quadrant.container_center
        bottom, _ = env.scene.object_span(target)
        is_inside = (np.abs(position[:2] - middle) < CONTAINER_HALF_EXTENTS).all()
        # It may fall into the container. Where it hangs on the wall, it does not stand on the floor.
        assert info["is_success"] == (is_inside and bottom < TRAY_FLOOR + 0.015)
    assert not info["is_success"], "the last one lies outside"


def test_what_falls_or_slides_is_not_yet_a_success(small_envs, monkeypatch):
    env = small_envs["container"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    monkeypatch.setattr(env.scene, "_settle", env.scene._read)
    assert not put(env, info["target_object"], info["target_container"], height=0.0115)["is_success"]
    assert any(env.step(STAY_OPEN)[-1]["is_success"] for _ in range(10))


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
@pytest.mark.parametrize("seed", range(2))
def test_an_object_that_is_still_held_is_no_success(small_envs, ambiguity, seed):
    env = small_envs[ambiguity]
    _, info = env.reset(seed=seed, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    expert = Expert(env, np.random.default_rng(seed), noise=0.0)
    for _ in range(30):
        action = expert.act()
        if expert.stage is Stage.RELEASE:
            break
        info = env.step(action)[-1]
    assert expert.stage is Stage.RELEASE
    # Down to the container's floor, where it would stand, and wait.
    floor = TRAY_FLOOR + 0.003
    for _ in range(8):
        lowering = np.clip((floor - env.scene.object_span(target)[0]) / 0.1, -0.1, 0.1)
        info = env.step(np.array([0, 0, lowering, -1]))[-1]
        assert not info["is_success"]
        assert info["object_containers"][target] == -1
    assert env.scene.object_span(target)[0] == pytest.approx(floor, abs=0.004)
    offset = (
        env.scene.object_pose(target).position[:2]
        - env.scene.layout.containers[container].quadrant.container_center
    )
    assert (np.abs(offset) < CONTAINER_HALF_EXTENTS).all()
    assert any(env.step(np.array([0, 0, 0.1, 1]))[-1]["is_success"] for _ in range(4))


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
@pytest.mark.parametrize(
    ("is_right_object", "is_right_container"), list(itertools.product([True, False], repeat=2))
)
def test_the_info_tells_what_the_run_did(small_envs, ambiguity, is_right_object, is_right_container):
    env = small_envs[ambiguity]
    _, info = env.reset(seed=3, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    number = target if is_right_object else (target + 1) % 3
    place = container if is_right_container else 1 - container
    expert = Expert(env, np.random.default_rng(0), 0.0, target_object=number, target_container=place)
    infos, stages = [info], [Stage.REACH]
    for _ in range(30):
        infos.append(env.step(expert.act())[-1])
        stages.append(expert.stage)
    lifted = stages.index(Stage.CARRY)
    for info in infos[: stages.index(Stage.GRASP)]:
        assert (info["grasped_object"], info["right_object"]) == (-1, False)
    for info in infos[lifted:]:
        assert (info["grasped_object"], info["right_object"]) == (number, is_right_object)
    for info in infos[: stages.index(Stage.RELEASE)]:
        assert info["object_containers"].tolist() == [-1, -1, -1]
        assert not info["right_container"]
        assert not info["is_success"]
    assert infos[-1]["object_containers"].tolist() == [place if n == number else -1 for n in range(3)]
    assert infos[-1]["right_container"] == is_right_container
    assert infos[-1]["is_success"] == (is_right_object and is_right_container)


@pytest.mark.parametrize("seed", range(4))
def test_to_touch_an_object_with_closed_fingers_is_not_to_grasp_it(small_envs, seed):
    env = small_envs["container"]
    _, info = env.reset(seed=seed, options={"task_id": 20})  # a bottle; its top is flat
    target = info["target_object"]
    env.step(STAY_CLOSED)
    for height in (0.04, 0.04, 0.04, 0.01, *np.arange(0.008, -0.003, -0.002)):
        top = np.array([*env.scene.object_pose(target).position[:2], env.scene.object_span(target)[1]])
        tips = env.scene.arm.position - [0, 0, 0.05]
        motion = np.clip((top + [0, 0, height] - tips) / 0.1, -1, 1)
        assert env.step(np.array([*motion, -1]))[-1]["grasped_object"] == -1
    simulation = env.scene._simulation
    assert simulation.touch(env.scene.bodies[target], env.scene.arm.body), "the test reaches the object"


# Chance


def blind_successes(seeds):
    """Successes of an expert that picks a random object and a random container."""
    env = PickPlaceEnv(image_size=8)
    successes = []
    for seed in seeds:
        rng = np.random.default_rng((seed, 2))
        env.reset(seed=seed, options={"task_id": int(rng.integers(300))})
        expert = Expert(env, rng, target_object=int(rng.integers(3)), target_container=int(rng.integers(2)))
        for _ in range(30):
            info = env.step(expert.act())[-1]
        successes.append(info["is_success"])
    env.close()
    return successes


def binomial_interval(n, p, miss):
    """The fewest and the most successes that lie within the tails of `miss / 2` each."""
    cumulative = np.cumsum([math.comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(n + 1)])
    return int(np.searchsorted(cumulative, miss / 2)), int(np.searchsorted(cumulative, 1 - miss / 2))


@pytest.mark.slow
def test_a_policy_that_picks_at_random_succeeds_in_1_of_6():
    n = 240
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        successes = sum(pool.map(blind_successes, [range(n // 2), range(n // 2, n)], chunksize=1), [])
    low, high = binomial_interval(n, 1 / 6, miss=1e-3)
    assert (low, high) == (22, 60)
    assert low <= sum(successes) <= high


# Bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task_id": 300}, r"`task_id` must be an integer from 0 to 299\. Got 300"),
        ({"task_id": -1}, r"from 0 to 299\. Got -1"),
        ({"task_id": 4.5}, r"from 0 to 299\. Got 4\.5"),
        ({"task_id": "4"}, r"from 0 to 299\. Got '4'"),
        ({"task_id": None}, r"from 0 to 299\. Got None"),
        ({"ambiguity": "both"}, r"`ambiguity` must be one of container, object\. Got 'both'"),
        ({"ambiguity": None}, r"`ambiguity` must be one of container, object\. Got None"),
        ({"image_size": 7}, r"`image_size` must be at least 8\. Got 7"),
        ({"image_size": 0}, r"`image_size` must be at least 8\. Got 0"),
        ({"image_size": -48}, r"`image_size` must be at least 8\. Got -48"),
        ({"image_size": 48.5}, r"`image_size` must be .*\. Got 48\.5"),
        ({"image_size": "48"}, r"`image_size` must be .*\. Got '?48'?"),
        ({"render_size": 7}, r"`render_size` must be at least 8\. Got 7"),
        ({"render_size": 100.5}, r"`render_size` must be .*\. Got 100\.5"),
        ({"objects": "some"}, r"`objects` must be one of all, scenario_a_train, random:N\. Got 'some'"),
        ({"objects": ["all"]}, r"`objects` must be one of all, scenario_a_train, random:N\. Got \['all'\]"),
        ({"task_id": 24, "objects": "scenario_a_train"}, r"Task 24 asks for a gray .* bathtub, of which"),
        ({"adversarial_probability": 1.1}, r"`adversarial_probability` must be between 0 and 1\. Got 1\.1"),
        ({"adversarial_probability": -0.1}, r"between 0 and 1\. Got -0\.1"),
        ({"adversarial_probability": float("nan")}, r"between 0 and 1\. Got nan"),
        ({"adversarial_probability": "0.6"}, r"between 0 and 1\. Got '0\.6'"),
        ({"adversarial_probability": None}, r"between 0 and 1\. Got None"),
        ({"adversarial_draw": "both"}, r"`adversarial_draw` must be one of each, scene\. Got 'both'"),
        ({"adversarial_draw": None}, r"`adversarial_draw` must be one of each, scene\. Got None"),
        ({"render_mode": "human"}, r"`render_mode` must be 'rgb_array' or None\. Got 'human'"),
        ({"instructions": "put it there"}, r"`instructions` must be a dictionary.*\. Got 'put it there'"),
        ({"instructions": ["put it there"]}, r"a dictionary of lists .*\. Got \['put it there'\]"),
        ({"instructions": {4: "put it there"}}, r"lists of sentences .*\. Got 'put it there' for task 4"),
        ({"instructions": {4: {"put it there"}}}, r"\. Got \{'put it there'\} for task 4"),
        ({"instructions": {4: []}}, r"\. Got \[\] for task 4"),
        ({"instructions": {4: ["put it there", " "]}}, r"\. Got \['put it there', ' '\] for task 4"),
        ({"instructions": {4: [None]}}, r"\. Got \[None\] for task 4"),
        ({"instructions": {"4": ["put it there"]}}, r"no task: `task_id` must be an integer .*\. Got '4'"),
    ],
    ids=str,
)
def test_bad_arguments_say_what_is_valid(arguments, message):
    before = connected_clients()
    with pytest.raises(ValueError, match=message):
        PickPlaceEnv(**arguments)
    assert connected_clients() == before


@pytest.mark.parametrize("options", [["a"], "task_id", 4, []])
def test_options_that_are_no_dictionary_are_refused_and_leave_the_scene(env, options):
    with pytest.raises(ValueError, match=r"`options` must be a dictionary, such as .*, or None\. Got "):
        env.reset(options=options)
    env.step(STAY_OPEN)


def test_a_reset_to_a_task_that_the_objects_do_not_allow_leaves_the_scene():
    env = PickPlaceEnv(4, image_size=8, objects="scenario_a_train")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="Task 39 asks for a yellow colored object, of which"):
        env.reset(options={"task_id": 39})
    assert env.task.index == 4
    env.step(STAY_OPEN)
    env.close()


BAD_ACTIONS = {
    "nan": [0, 0, np.nan, 1],
    "infinite": [0, -np.inf, 0, 1],
    "nan gripper": [0, 0, 0, np.nan],
    "too short": [0, 0, 0],
    "too long": [0, 0, 0, 0, 1],
    "a batch": [[0, 0, 0, 1]],
    "a number": 0.0,
    "empty": [],
    "none": None,
    "words": ["left", "right", "up", "open"],
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
def test_a_bad_action_is_refused_and_leaves_the_scene_as_it_was(env, name):
    good = np.random.default_rng(0).uniform(-1, 1, (4, 4))
    expected = actions_fingerprint(env, 7, good)
    digest = hashlib.sha256()
    absorb(digest, *env.reset(seed=7))
    for action in good:
        with pytest.raises(ValueError, match=r"action must|could not convert"):
            env.step(BAD_ACTIONS[name])
        absorb(digest, *env.step(action))
    assert digest.hexdigest() == expected


def test_messages_about_actions_name_what_is_wrong(env):
    with pytest.raises(ValueError, match=r"shape \(4,\): x, y, z and the gripper\. Got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"must be finite\. Got .*nan"):
        env.step(np.array([0, np.nan, 0, 0]))


def test_an_action_beyond_its_range_is_clipped_and_not_changed(env):
    action = np.array([0.5, -7.0, 3.0, 9.0], np.float32)
    expected = actions_fingerprint(env, 7, [np.clip(action, -1, 1)])
    assert actions_fingerprint(env, 7, [action]) == expected
    assert action.tolist() == [0.5, -7.0, 3.0, 9.0]


@pytest.mark.parametrize("task_id", [300, -1, 4.5, "4", None])
def test_a_reset_to_an_unknown_task_changes_nothing(env, task_id):
    env.reset(seed=7)
    state = env.np_random.bit_generator.state
    before = env.step(STAY_OPEN)[0]
    with pytest.raises(ValueError, match=r"`task_id` must be an integer from 0 to 299"):
        env.reset(seed=8, options={"task_id": task_id})
    assert env.task.index == 4
    assert env.np_random.bit_generator.state == state
    after, _, _, _, info = env.step(STAY_OPEN)
    assert info["task_id"] == 4
    np.testing.assert_allclose(after["agent_pos"], before["agent_pos"], atol=1e-3)


USES = {
    "step": lambda env: env.step(STAY_OPEN),
    "render": lambda env: env.render(),
    "scene": lambda env: env.scene,
}


@pytest.mark.parametrize("name", USES)
def test_use_before_reset_is_refused(name):
    env = PickPlaceEnv(image_size=8, render_mode="rgb_array")
    before = connected_clients()
    with pytest.raises(gym.error.ResetNeeded, match="Call `reset` before"):
        USES[name](env)
    assert connected_clients() == before
    env.reset(seed=0)
    USES[name](env)
    env.close()


@pytest.mark.parametrize("is_reset", [True, False])
@pytest.mark.parametrize("name", [*USES, "reset"])
def test_use_after_close_is_refused(name, is_reset):
    env = PickPlaceEnv(image_size=8, render_mode="rgb_array")
    before = connected_clients()
    if is_reset:
        env.reset(seed=0)
    env.close()
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError, match="environment is closed"):
        {**USES, "reset": lambda env: env.reset(seed=0)}[name](env)
    assert connected_clients() == before


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_a_reset_that_is_interrupted_leaves_an_environment_that_needs_a_reset(env, monkeypatch, error):
    def fail():
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("gym_deltaco.scene.tray_mesh", fail)
        with pytest.raises(error):
            env.reset(seed=1)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(STAY_OPEN)
    env.reset(seed=1)
    env.step(STAY_OPEN)


# Resources


@pytest.fixture
def temporary_files(tmp_path, monkeypatch):
    """Makes the environment's temporary files lie where no other process has its own; lists them."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return lambda: [path.name for path in tmp_path.glob("gym_deltaco_*")]


def test_the_simulator_is_connected_at_the_first_reset_and_only_once():
    before = connected_clients()
    env = PickPlaceEnv(image_size=8)
    assert connected_clients() == before
    for seed in range(3):
        env.reset(seed=seed)
        assert len(connected_clients() - before) == 1
    env.close()
    assert connected_clients() == before


def test_close_leaves_neither_a_client_nor_files(temporary_files):
    before = connected_clients()
    envs = [PickPlaceEnv(image_size=8) for _ in range(3)]
    for env in envs:
        env.reset(seed=0)
    assert len(connected_clients() - before) == 3
    assert temporary_files()
    for env in envs:
        env.close()
    assert connected_clients() == before
    assert temporary_files() == []


@pytest.mark.parametrize("has_cycle", [False, True])
def test_a_forgotten_environment_leaves_neither_a_client_nor_files(temporary_files, has_cycle):
    gc.collect()
    before = connected_clients()
    env = gym.make(ENV_ID, image_size=8)
    env.reset(seed=0)
    if has_cycle:
        env.unwrapped.itself = env
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        del env
        gc.collect()
    assert connected_clients() == before
    assert temporary_files() == []


@pytest.mark.parametrize("what", ["tempfile.mkdtemp", "_color_texture", "pybullet.connect"])
@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()], ids=repr)
def test_a_simulator_that_cannot_be_made_leaves_neither_a_client_nor_files(
    temporary_files, monkeypatch, what, error
):
    def fail(*_, **__):
        raise error

    before = connected_clients()
    env = PickPlaceEnv(image_size=8)
    with monkeypatch.context() as patch:
        patch.setattr(f"gym_deltaco.simulation.{what}", fail)
        with pytest.raises(type(error)) as raised:
            env.reset(seed=0)
    assert connected_clients() == before
    assert temporary_files() == []
    del raised
    env.reset(seed=0)
    env.close()


def test_without_a_free_client_no_files_are_left(temporary_files, monkeypatch):
    monkeypatch.setattr("gym_deltaco.simulation.pybullet.connect", lambda _: -1)
    with pytest.raises(RuntimeError, match="no free client left"):
        PickPlaceEnv(image_size=8).reset(seed=0)
    assert temporary_files() == []


@pytest.mark.parametrize("after", ["", "env.close()", "env.itself = env", "raise SystemExit(0)"])
def test_a_process_ends_silently_and_leaves_no_files(tmp_path, after):
    script = (
        "import gym_deltaco.env as e\n"
        "env = e.PickPlaceEnv(image_size=8); env.reset(seed=0)\n"
        "def keep(env=env, kept=[]): kept.append((keep, env))\n"
        f"keep()\n{after}\n"
    )
    _, errors = run_script(script, TMPDIR=str(tmp_path), PYTHONWARNINGS="always::ResourceWarning")
    assert re.sub("pybullet build time: .*\n", "", errors) == ""
    assert list(tmp_path.glob("gym_deltaco_*")) == []


def test_a_forked_process_that_closes_its_copy_leaves_the_original_alone(tmp_path):
    script = (
        "import multiprocessing\n"
        "from gym_deltaco.env import PickPlaceEnv\n"
        "env = PickPlaceEnv(image_size=8); env.reset(seed=0)\n"
        "process = multiprocessing.get_context('fork').Process(target=env.close)\n"
        "process.start(); process.join()\n"
        "env.reset(seed=1, options={'task_id': 1}); env.close()\n"
    )
    run_script(script, TMPDIR=str(tmp_path))
    assert list(tmp_path.glob("gym_deltaco_*")) == []


def test_an_environment_can_be_sent_to_another_process_before_its_first_reset():
    env = pickle.loads(pickle.dumps(PickPlaceEnv(4, "object", image_size=8)))
    assert (env.task.index, env.ambiguity) == (4, "object")
    env.reset(seed=0)
    env.step(STAY_OPEN)
    env.close()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_does_not_share_the_simulator(env, duplicate):
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 4))
    expected = actions_fingerprint(env, 7, actions)
    try:
        duplicated = duplicate(env)
    except TypeError as error:
        assert "cop" in str(error)  # to refuse clearly is as good  # noqa: PT017
    else:
        assert actions_fingerprint(duplicated, 7, actions) == expected
        duplicated.close()
        del duplicated
    gc.collect()
    env.step(STAY_OPEN)
    assert actions_fingerprint(env, 7, actions) == expected


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_vector_environments_agree_with_one_process(context):
    # The name of the module before the id makes workers import it, and with it the registration.
    make_env = functools.partial(gym.make, f"gym_deltaco:{ENV_ID}", task_id=4, image_size=8)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 2, 4)).astype(np.float32)
    results = []
    for envs in (
        gym.vector.SyncVectorEnv([make_env] * 2),
        gym.vector.AsyncVectorEnv([make_env] * 2, context=context),
    ):
        digest = hashlib.sha256()
        absorb(digest, *envs.reset(seed=5))
        for action in actions:
            absorb(digest, *envs.step(action))
        envs.close()
        results.append(digest.hexdigest())
    assert results[0] == results[1]


def test_temporary_files_of_workers_are_removed(tmp_path):
    script = (
        "import gymnasium as gym, gym_deltaco\n"
        "if __name__ == '__main__':\n"
        "    fork = {'context': 'fork'}\n"
        f"    envs = gym.make_vec('{ENV_ID}', 2, 'async', vector_kwargs=fork, image_size=8)\n"
        "    envs.reset(seed=0); envs.close()\n"
    )
    run_script(script, TMPDIR=str(tmp_path))
    assert list(tmp_path.glob("gym_deltaco_*")) == []


def test_wrappers_find_what_they_need():
    env = gym.wrappers.FlattenObservation(gym.make(ENV_ID, image_size=8))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (8 * 8 * 3 + 10,)
    env.close()
    env = gym.wrappers.RecordEpisodeStatistics(gym.make(ENV_ID, image_size=8), buffer_length=1)
    env.reset(seed=0)
    for _ in range(30):
        *_, info = env.step(STAY_OPEN)
    assert info["episode"]["l"] == 30
    env.close()
