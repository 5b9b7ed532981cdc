"""The benchmark as LeRobot sees it: configuration, lazy vector environments, evaluation."""

from unittest import mock

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features, make_env
from lerobot.policies import PreTrainedPolicy
from lerobot.scripts.lerobot_eval import eval_policy_all

from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import TASKS, select_tasks
from lerobot_deltaco.evaluation.lerobot_env import DeltacoEnv

# One of each kind: a name, a color and a shape.
ONE_OF_EACH_KIND = "4,32,90"


def make_one(task, **options):
    """Makes the vector environment of a task, as LeRobot does."""
    (group,) = make_env(DeltacoEnv(task=task, **options), 1).values()
    return group[int(task)]


def test_features_are_those_of_datasets_and_of_the_spaces():
    config = DeltacoEnv(scene=SceneConfig(image_size=64))
    features = env_to_policy_features(config)
    assert {key: (feature.type, tuple(feature.shape)) for key, feature in features.items()} == {
        "observation.image": (FeatureType.VISUAL, (3, 64, 64)),
        "observation.state": (FeatureType.STATE, (10,)),
        "action": (FeatureType.ACTION, (4,)),
    }
    env = make_one("4", scene=config.scene)
    spaces = {**env.single_observation_space, "action": env.single_action_space}
    assert {name: space.shape for name, space in spaces.items()} == {
        name: tuple(feature.shape) for name, feature in config.features.items()
    }
    assert env.metadata["render_fps"] == config.fps


def test_invalid_options_say_what_is_valid():
    for options, message in [
        ({"task": "scenario_c"}, "scenario_a_test"),
        ({"task": "999"}, "0 to 299"),
        ({"max_parallel_tasks": 2}, r"`max_parallel_tasks` must be 1.*`deltaco evaluate`. Got 2\."),
        ({"paraphrases": "grammar", "paraphrases_split": "test"}, "must be one of all, train, held_out. Got"),
        ({"instruction": ""}, "must be a sentence"),
        ({"paraphrases": "missing.csv"}, "missing.csv"),
        ({"instruction": "put it there", "paraphrases": "a.csv"}, "not both"),
    ]:
        with pytest.raises(ValueError, match=message):
            make_env(DeltacoEnv(**options), 1)


def test_tasks_are_grouped_by_kind():
    groups = make_env(DeltacoEnv(task="all"), n_envs=2)
    kinds = {task_id: kind for kind, group in groups.items() for task_id in group}
    assert kinds == {task.index: task.kind for task in TASKS}


def test_a_finished_episode_stays_finished():
    env = make_one("4", scene=SceneConfig(episode_length=2))
    env.reset(seed=0)
    action = np.ones((1, 4), np.float32)
    env.step(action)
    last, _, _, truncated, _ = env.step(action)
    assert truncated.all()
    for _ in range(3):
        after, reward, *_ = env.step(action)
        np.testing.assert_array_equal(after["pixels"], last["pixels"])
        assert not reward.any()
    env.reset(seed=0)
    assert not env.step(action)[3].any()


def still_policy():
    """A policy that does nothing, and remembers which instructions it was given."""
    policy = mock.MagicMock(spec=PreTrainedPolicy, config=None, training=False, instructions=set())

    def select_action(batch):
        policy.instructions.update(batch["task"])
        return torch.zeros(len(batch["task"]), 4)

    policy.select_action.side_effect = select_action
    policy.parameters.side_effect = lambda: iter([torch.zeros(1)])
    return policy


def evaluate(policy, n_episodes, **options):
    envs = make_env(DeltacoEnv(scene=SceneConfig(episode_length=2), **options), n_envs=2)
    identity = [lambda data: data] * 4
    return eval_policy_all(envs, policy, *identity, n_episodes=n_episodes, start_seed=1000)


@pytest.mark.filterwarnings("error:The environment does not have 'task_description'")
def test_an_evaluation_reports_each_kind():
    policy = still_policy()
    info = evaluate(policy, 2, task=ONE_OF_EACH_KIND)
    kinds = {kind: group["n_episodes"] for kind, group in info["per_group"].items()}
    assert kinds == {"name": 2, "color": 2, "shape": 2}
    assert info["overall"]["pc_success"] == 0
    assert policy.instructions == {TASKS[i].instruction for i in select_tasks(ONE_OF_EACH_KIND)}


def test_instructions_may_be_sentences_of_people(tmp_path):
    file = tmp_path / "people.csv"
    file.write_text("task_id,instruction\n4,one of 4\n4,another of 4\n4,held out of 4\n14,one of 14\n")
    policy = still_policy()
    evaluate(policy, 12, task="4", paraphrases=str(file), paraphrases_split="train")
    assert policy.instructions == {"one of 4", "another of 4"}
    policy.instructions.clear()
    evaluate(policy, 2, task="4", instruction="putt it  in teh box")
    assert policy.instructions == {"putt it in teh box"}
