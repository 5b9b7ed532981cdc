"""What counts as success, and what the info tells about an episode."""

import itertools

import numpy as np
import pybullet
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Expert, Stage
from gym_deltaco.scene_config import AMBIGUITIES, SceneConfig

STAY_OPEN = np.array([0, 0, 0, 1], np.float32)
STAY_CLOSED = np.array([0, 0, 0, -1], np.float32)
TRAY_FLOOR, CONTAINER_HALF_EXTENTS = -0.37, np.array([0.075, 0.0525])  # m
# A name, a color and a shape; colors and positions
SOME_TASKS = (4, 82, 146, 295)


@pytest.fixture(scope="module")
def small_envs():
    """An environment with small images for each ambiguity scheme, to be reset by the test."""
    scenes = [SceneConfig(ambiguity=ambiguity, image_size=8) for ambiguity in AMBIGUITIES]
    envs = {scene.ambiguity: PickPlaceEnv(scene=scene) for scene in scenes}
    yield envs
    for env in envs.values():
        env.close()


def put(env, number, container, offset=(0.0, 0.0), height=0.002):
    """Drops an object from just above a container's floor; returns the info of a step without motion."""
    half_height = env.scene.layout.objects[number].model.half_extents[2]
    center = env.scene.layout.containers[container].quadrant.container_center
    position = (*(center + offset), TRAY_FLOOR + 0.003 + half_height + height)
    body, client = env.scene.bodies[number], env.scene._simulation._client
    pybullet.resetBasePositionAndOrientation(body, position, (0, 0, 0, 1), physicsClientId=client)
    env.scene._settle()
    return env.step(STAY_OPEN)[-1]


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_only_the_target_in_the_target_container_is_a_success(small_envs, ambiguity):
    env = small_envs[ambiguity]
    for task_id, number, container in itertools.product(SOME_TASKS, range(3), range(2)):
        _, info = env.reset(seed=task_id, options={"task_id": task_id})
        assert not info["is_success"]
        assert not info["right_container"]
        assert info["object_containers"].tolist() == [-1, -1, -1]
        quadrants = [list(container.quadrant) for container in env.scene.layout.containers]
        assert info["container_quadrants"].tolist() == quadrants
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


def test_success_is_remembered_until_the_reset(small_envs):
    env = small_envs["container"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    assert put(env, target, container)["right_container"]
    assert not put(env, (target + 1) % 3, 1 - container)["right_container"], "both containers are in use"
    info = put(env, target, 1 - container)
    assert (info["is_success"], info["right_container"]) == (True, False)
    assert not env.reset(seed=0)[1]["is_success"]
    assert env.step(STAY_OPEN)[1] == 0


def test_object_outside_or_on_the_rim_is_no_success(small_envs):
    env = small_envs["container"]
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1)):
        for distance in (0.9, 1.0, 1.1, 1.3):  # in half extents
            _, info = env.reset(seed=0, options={"task_id": 4})
            target, container = info["target_object"], info["target_container"]
            info = put(env, target, container, offset=distance * np.array(direction) * CONTAINER_HALF_EXTENTS)
            position = env.scene.object_pose(target).position
            center = env.scene.layout.containers[container].quadrant.container_center
            bottom, _ = env.scene.object_span(target)
            is_inside = (np.abs(position[:2] - center) < CONTAINER_HALF_EXTENTS).all()
            # It may fall into the container, or hang on its wall.
            assert info["is_success"] == (is_inside and bottom < TRAY_FLOOR + 0.015)
        assert not info["is_success"], "the last position is outside"


def test_falling_object_is_no_success_yet(small_envs, monkeypatch):
    env = small_envs["container"]
    _, info = env.reset(seed=0, options={"task_id": 4})
    monkeypatch.setattr(env.scene, "_settle", env.scene._read)
    assert not put(env, info["target_object"], info["target_container"], height=0.0115)["is_success"]
    assert any(env.step(STAY_OPEN)[-1]["is_success"] for _ in range(10))


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_held_object_is_no_success(small_envs, ambiguity):
    env = small_envs[ambiguity]
    _, info = env.reset(seed=0, options={"task_id": 4})
    target, container = info["target_object"], info["target_container"]
    expert = Expert(env, np.random.default_rng(0), noise=0.0)
    for _ in range(30):
        action = expert.act()
        if expert.stage is Stage.RELEASE:
            break
        info = env.step(action)[-1]
    # Lower it to the container's floor, and wait.
    floor = TRAY_FLOOR + 0.003
    for _ in range(8):
        lowering = np.clip((floor - env.scene.object_span(target)[0]) / 0.1, -0.1, 0.1)
        info = env.step(np.array([0, 0, lowering, -1]))[-1]
        assert not info["is_success"]
        assert info["object_containers"][target] == -1
    assert env.scene.object_span(target)[0] == pytest.approx(floor, abs=0.004)
    assert env.scene.container_around(target) == container
    assert any(env.step(np.array([0, 0, 0.1, 1]))[-1]["is_success"] for _ in range(4))


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_info_tells_the_grasped_object_and_its_container(small_envs, ambiguity):
    env = small_envs[ambiguity]
    for is_right_object, is_right_container in itertools.product([True, False], repeat=2):
        _, info = env.reset(seed=3, options={"task_id": 4})
        number = (info["target_object"] + (not is_right_object)) % 3
        container = info["target_container"] if is_right_container else 1 - info["target_container"]
        layout = env.scene.layout
        env.scene.layout = layout._replace(target_object=number, target_container=container)
        expert = Expert(env, np.random.default_rng(0), 0.0)
        env.scene.layout = layout
        infos, stages = [info], [Stage.REACH]
        for _ in range(30):
            infos.append(env.step(expert.act())[-1])
            stages.append(expert.stage)
        for info in infos[: stages.index(Stage.GRASP)]:
            assert (info["grasped_object"], info["right_object"]) == (-1, False)
        for info in infos[stages.index(Stage.CARRY) :]:
            assert (info["grasped_object"], info["right_object"]) == (number, is_right_object)
        for info in infos[: stages.index(Stage.RELEASE)]:
            assert info["object_containers"].tolist() == [-1, -1, -1]
            assert not info["right_container"]
        info = infos[-1]
        assert info["object_containers"].tolist() == [container if n == number else -1 for n in range(3)]
        assert info["right_container"] == is_right_container
        assert info["is_success"] == (is_right_object and is_right_container)


def test_touching_an_object_with_closed_fingers_is_not_grasping(small_envs):
    env = small_envs["container"]
    for seed in range(4):
        _, info = env.reset(seed=seed, options={"task_id": 20})  # a bottle with a flat top
        target = info["target_object"]
        env.step(STAY_CLOSED)
        for height in (0.04, 0.04, 0.04, 0.01, *np.arange(0.008, -0.003, -0.002)):
            top = np.array([*env.scene.object_pose(target).position[:2], env.scene.object_span(target)[1]])
            tips = env.scene.arm.position - [0, 0, 0.05]
            motion = np.clip((top + [0, 0, height] - tips) / 0.1, -1, 1)
            assert env.step(np.array([*motion, -1]))[-1]["grasped_object"] == -1
        assert env.scene._simulation.touch(env.scene.bodies[target], env.scene.arm.body)
