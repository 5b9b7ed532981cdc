"""Joint control: the interface, times and speeds of a robot, in the scenes of the benchmark."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.envs import env_to_policy_features
from lerobot.envs.utils import preprocess_observation

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Stage, expert_episode
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.collection.dataset_card import dataset_card
from lerobot_deltaco.evaluation.episodes import EpisodeSpec
from lerobot_deltaco.evaluation.evaluate import run_episodes
from lerobot_deltaco.evaluation.lerobot_env import DeltacoEnv

SCENE = SceneConfig(control="joints", image_size=16)
REST = [1.57, -0.6, -0.6, 0.0, -1.57, 0.0]
NAMES = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper"]


@pytest.fixture
def env():
    with closing(PickPlaceEnv(4, SCENE)) as env:
        env.reset(seed=0)
        yield env


@pytest.fixture(scope="module")
def episodes():
    """Episodes of the expert in tasks of all kinds, by task."""
    with closing(PickPlaceEnv(4, SCENE)) as env:
        return {task_id: list(expert_episode(env, task_id, seed=task_id)) for task_id in range(4, 300, 60)}


def test_scenes_are_those_of_position_control(env):
    with closing(PickPlaceEnv(4, SceneConfig(image_size=16))) as other:
        for seed in range(3):
            (first, info), (expected, expected_info) = (each.reset(seed=seed) for each in (env, other))
            np.testing.assert_array_equal(first["pixels"]["front"], expected["pixels"])
            np.testing.assert_array_equal(first["agent_pos"][:6], expected["agent_pos"][:6])
            for name, value in expected_info.items():
                np.testing.assert_array_equal(info[name], value)


def test_a_step_lasts_a_thirtieth_of_a_second_and_keeps_the_limits_of_speed(env, spy):
    rng, times = np.random.default_rng(0), []
    spy(env.scene._simulation, "step", lambda: times.append(1))
    states = [env._observation()["agent_pos"]]
    for n in range(1, 40):
        observation, *_ = env.step(env.action_space.low if n < 20 else rng.uniform(-9, 9, 7))
        assert len(times) == 8 * n
        assert observation in env.observation_space
        states.append(observation["agent_pos"])
    speeds = 30 * np.abs(np.diff(states, axis=0))
    assert env.metadata["render_fps"] == 30
    assert 2.5 < speeds[:, :6].max() < 3.3
    assert 2.0 < speeds[:, 6].max() < 3.0


def test_joints_reach_their_targets(env):
    target = np.array([*REST, 0.3]) + [0.3, -0.2, 0.2, 0.4, 0.3, -0.5, 0]
    for _ in range(30):
        state = env.step(target)[0]["agent_pos"]
    np.testing.assert_allclose(state, target, atol=0.01)
    np.testing.assert_allclose(env.step([9] * 6 + [0.3])[0]["agent_pos"][0], target[0] + 0.1, atol=0.03)
    with pytest.raises(ValueError, match=r"must have shape \(7,\): 6 joints and gripper. Got \(4,\)"):
        env.step(np.zeros(4))


def test_expert_succeeds_at_its_own_speed_in_every_episode(episodes):
    lengths = [len(steps) for steps in episodes.values()]
    assert sum(steps[-1].info["is_success"] for steps in episodes.values()) >= len(episodes) - 1
    assert len(set(lengths)) > len(episodes) // 2
    assert 100 < np.median(lengths) < 200
    for steps in episodes.values():
        actions = np.stack([step.action for step in steps])
        states = np.stack([step.observation["agent_pos"] for step in steps])
        assert 30 * np.abs(np.diff(states[:, :6], axis=0)).max() < 3
        assert 0.02 < 30 * np.abs(np.diff(actions[:, 6])).max() < 2.6
        # The object keeps the gripper open.
        lifted = [n for n, step in enumerate(steps) if step.stage is Stage.CARRY]
        assert (states[lifted, 6] > actions[lifted, 6] + 0.05).all()


class Follower:
    """A policy that carries out the expert's action for the nearest of the next states."""

    def __init__(self, steps):
        self.states = torch.tensor(np.stack([step.observation["agent_pos"] for step in steps]))
        self.actions = torch.tensor(np.stack([step.action for step in steps]))

    def reset(self):
        self.row = 0

    def select_action(self, batch):
        assert batch["observation.images.wrist"].shape == (1, 3, 16, 16)
        following = self.states[self.row : self.row + 3]
        self.row += int((following - batch["observation.state"]).norm(dim=1).argmin())
        return self.actions[[self.row]]


def test_a_policy_succeeds_by_joint_positions(episodes, env):
    """Observations lead to the actions of the expert, by the loop of the evaluation."""
    for task_id, steps in list(episodes.items())[:2]:
        spec = EpisodeSpec(task_id, 0, task_id, "", -1)
        loaded = SimpleNamespace(policy=Follower(steps), preprocessor=dict, postprocessor=torch.clone)
        (info,) = run_episodes(loaded, [env], [spec], [[]])
        assert info["is_success"] == steps[-1].info["is_success"]
        assert loaded.policy.row == len(steps) - 1
    assert info["is_success"]


def test_expert_repeats_to_the_last_bit(episodes, env):
    for step, expected in zip(expert_episode(env, 64, seed=64), episodes[64], strict=True):
        np.testing.assert_array_equal(step.action, expected.action)
        images = [each.observation["pixels"]["wrist"] for each in (step, expected)]
        np.testing.assert_array_equal(*images)


def test_dataset_and_environment_have_the_names_of_a_robot(tmp_path):
    plan = CollectionPlan("4,90", 1, scene=SCENE)
    collect(tmp_path, plan)
    dataset = LeRobotDataset("user/joints", root=tmp_path)
    config = DeltacoEnv(task="4", scene=SCENE)
    assert config.fps == dataset.fps == 30
    named = dataset.features.items()
    inputs = {name: feature for name, feature in named if name.startswith(("action", "obs"))}
    assert {name: tuple(feature["shape"]) for name, feature in inputs.items()} == {
        "observation.images.front": (16, 16, 3),
        "observation.images.wrist": (16, 16, 3),
        "observation.state": (7,),
        "action": (7,),
    }
    assert set(env_to_policy_features(config)) == set(inputs)
    for name in ("observation.state", "action"):
        assert list(inputs[name]["names"]) == [f"{joint}.pos" for joint in NAMES]
    # Episodes replay.
    with closing(PickPlaceEnv(4, SCENE)) as env:
        batch = preprocess_observation(env.reset(seed=int(dataset[0]["benchmark.seed"]))[0])
        for name in set(inputs) - {"action"}:
            assert (batch[name][0] == dataset[0][name]).all()
    assert dataset[3]["timestamp"] == pytest.approx(3 / 30)
    card = dataset_card(tmp_path)
    assert "--scene.control joints" in card
    assert "nominal" not in card
