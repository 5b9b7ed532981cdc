"""The benchmark as LeRobot sees it: configuration, lazy vector environments, evaluation."""

import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pybullet
import pytest
import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.envs import EnvConfig, close_envs, env_to_policy_features, make_env, make_env_config
from lerobot.policies import PreTrainedPolicy
from torch import nn

from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import SCENARIOS, TASKS, select_tasks
from lerobot_deltaco.envs.configuration_env import DeltacoEnv

# One of each kind: a name, a color and a shape.
ONE_OF_EACH_KIND = "4,32,90"


def connected_clients():
    """Ids of PyBullet's running simulators in this process."""
    return {i for i in range(64) if pybullet.getConnectionInfo(i)["isConnected"]}


@pytest.fixture
def make_envs():
    """Makes {task: vector environment} as LeRobot does, and closes all of them afterwards."""
    made = []

    def make(task, n_envs=1, use_async_envs=False, **kwargs):
        groups = make_env(DeltacoEnv(task=task, **kwargs), n_envs, use_async_envs)
        made.append(groups)
        return {task_id: env for group in groups.values() for task_id, env in group.items()}

    yield make
    for groups in made:
        close_envs(groups)


def roll_out(env, seeds, n_steps=3):
    """Observations of an episode's first steps with the same random actions every time."""
    actions = np.random.default_rng(0).uniform(-1, 1, (n_steps, env.num_envs, 4)).astype(np.float32)
    observations = [env.reset(seed=seeds)[0]]
    observations.extend(env.step(action)[0] for action in actions)
    return {key: np.stack([o[key] for o in observations]) for key in observations[0]}


# Configuration


def test_lerobot_knows_the_type():
    assert EnvConfig.get_choice_class("deltaco") is DeltacoEnv
    config = make_env_config("deltaco", task="4,50-73")
    assert config.type == "deltaco"


def test_features_have_the_names_of_the_datasets():
    features = env_to_policy_features(DeltacoEnv(image_size=64))
    assert {key: (feature.type, tuple(feature.shape)) for key, feature in features.items()} == {
        "observation.image": (FeatureType.VISUAL, (3, 64, 64)),
        "observation.state": (FeatureType.STATE, (10,)),
        "action": (FeatureType.ACTION, (4,)),
    }


def test_features_agree_with_the_spaces(make_envs):
    config = DeltacoEnv()
    (env,) = make_envs("4").values()
    assert config.features["pixels"].shape == env.single_observation_space["pixels"].shape
    assert config.features["agent_pos"].shape == env.single_observation_space["agent_pos"].shape
    assert config.features["action"].shape == env.single_action_space.shape
    assert env.unwrapped.metadata["render_fps"] == config.fps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "scenario_c"}, "scenario_a_test"),
        ({"task": ""}, "empty"),
        ({"task": "300"}, "0 to 299"),
        ({"image_size": 3}, r"`image_size` must be at least \d+\. Got 3\."),
        ({"render_size": 0}, r"`render_size` must be at least \d+\. Got 0\."),
        ({"fps": 0}, r"`fps` must be at least 1\. Got 0\."),
        ({"episode_length": 0}, r"`episode_length` must be at least 1\. Got 0\."),
        ({"max_parallel_tasks": 0}, r"`max_parallel_tasks` must be at least 1\. Got 0\."),
        ({"ambiguity": "none"}, r"`ambiguity` must be one of container, object\. Got 'none'\."),
        ({"adversarial_draw": "both"}, r"`adversarial_draw` must be one of each, scene\. Got 'both'\."),
        ({"instructions_split": "test"}, "must be one of all, train, held_out. Got 'test'"),
        ({"instruction": ""}, "must be a sentence"),
        ({"instruction": "put it there", "instructions": "a.csv"}, "exclude each other"),
    ],
)
def test_bad_configurations_say_what_is_valid(arguments, message):
    with pytest.raises(ValueError, match=message):
        DeltacoEnv(**arguments)


@pytest.mark.parametrize("draw", [None, "each", "scene"])
def test_the_draw_of_distractors_reaches_the_environment(make_envs, draw):
    (env,) = make_envs("4", **({} if draw is None else {"adversarial_draw": draw})).values()
    env.reset(seed=[0])
    assert env.get_attr("adversarial_draw") == (draw or "each",)


# Vector environments


@pytest.mark.parametrize("selection", ["scenario_a_test", "scenario_b_train", "all", "4,50-73"])
def test_tasks_are_grouped_by_kind(selection):
    groups = make_env(DeltacoEnv(task=selection), n_envs=2)
    assert sorted(task_id for group in groups.values() for task_id in group) == sorted(
        select_tasks(selection)
    )
    for kind, group in groups.items():
        assert {TASKS[task_id].kind for task_id in group} == {kind}
    close_envs(groups)


def test_simulators_start_at_the_first_reset_and_are_passed_on(make_envs):
    before = connected_clients()
    envs = list(make_envs("all", n_envs=2).values())
    assert len(envs) == 300
    assert connected_clients() == before

    for env in envs[:3]:
        env.reset(seed=0)
        in_use = connected_clients()
        assert len(in_use - before) == 2
        env.close()
        assert connected_clients() == in_use

    # Two tasks at the same time, as with `max_parallel_tasks=2`.
    envs[3].reset(seed=0)
    envs[4].reset(seed=0)
    assert len(connected_clients() - before) == 4

    for env in envs:
        env.close()
    assert connected_clients() == before


def test_each_task_has_scenes_of_its_own(make_envs):
    first, second = make_envs("4,54", n_envs=2).values()
    for env in (first, second):
        observation, info = env.reset(seed=[1000, 1001])
        assert info["task_id"].tolist() == [env.task_id] * 2
        assert env.call("task_description") == (TASKS[env.task_id].instruction,) * 2

        direct = gym.make("gym_deltaco/PickPlace-v0", task_id=env.task_id)
        for i in range(2):
            expected, _ = direct.reset(seed=episode_seed(1000 + i, "evaluation", env.task_id, 0))
            np.testing.assert_array_equal(observation["pixels"][i], expected["pixels"])
        direct.close()


def test_a_single_seed_counts_up(make_envs):
    (env,) = make_envs("4", n_envs=2).values()
    np.testing.assert_array_equal(env.reset(seed=7)[0]["pixels"], env.reset(seed=[7, 8])[0]["pixels"])


def test_a_borrowed_simulator_does_not_remember(make_envs):
    first, second = make_envs("4,54").values()
    (fresh,) = make_envs("54").values()
    roll_out(first, seeds=[0], n_steps=5)
    first.close()
    used, unused = roll_out(second, seeds=[3]), roll_out(fresh, seeds=[3])
    for key in used:
        np.testing.assert_array_equal(used[key], unused[key])


def test_synchronous_and_asynchronous_observations_are_equal(make_envs):
    sync_envs = make_envs("4,54", n_envs=2)
    async_envs = make_envs("4,54", n_envs=2, use_async_envs=True)
    for task_id in (4, 54):
        expected, observed = (roll_out(envs[task_id], seeds=[5, 6]) for envs in (sync_envs, async_envs))
        for key in expected:
            np.testing.assert_array_equal(observed[key], expected[key])
        async_envs[task_id].close()


@pytest.mark.filterwarnings("ignore:.*ERROR")  # Gymnasium's report of the worker's error
@pytest.mark.parametrize("use_async_envs", [False, True], ids=["sync", "async"])
def test_an_environment_survives_a_bad_action(make_envs, use_async_envs):
    (env,) = make_envs("4", n_envs=2, use_async_envs=use_async_envs).values()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"(?i)action"):
        env.step(np.full((2, 4), np.nan, np.float32))
    env.reset(seed=0)
    env.step(np.zeros((2, 4), np.float32))


def test_a_finished_episode_stays_finished(make_envs):
    (env,) = make_envs("4", episode_length=2).values()
    env.reset(seed=0)
    action = np.ones((1, 4), np.float32)
    env.step(action)
    last, _, _, truncated, _ = env.step(action)
    assert truncated.all()
    for _ in range(3):
        after, reward, _, truncated, _ = env.step(action)
        np.testing.assert_array_equal(after["pixels"], last["pixels"])
        assert not reward.any()
    _, _, _, truncated, _ = (env.reset(seed=0), env.step(action))[1]
    assert not truncated.any()


def test_videos_have_the_size_of_the_configuration(make_envs):
    (env,) = make_envs("4", render_size=64).values()
    env.reset(seed=0)
    assert env.call("render")[0].shape == (64, 64, 3)


def test_use_before_reset_and_after_close_is_refused(make_envs):
    (env,) = make_envs("4").values()
    action = np.zeros((1, 4), np.float32)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(action)
    env.reset(seed=0)
    env.close()
    env.close()
    for use in (lambda: env.step(action), lambda: env.reset(seed=0), lambda: env.call("render")):
        with pytest.raises(gym.error.ClosedEnvironmentError, match="closed"):
            use()


# LeRobot's evaluation


class StillPolicy(PreTrainedPolicy):
    """Does nothing, and remembers which instructions it was given."""

    config_class = PreTrainedConfig
    name = "still"

    def __init__(self):
        nn.Module.__init__(self)
        self.config = None
        self.instructions = set()

    def select_action(self, batch):
        batch_size = len(batch["task"])
        assert batch["observation.image"].shape == (batch_size, 3, 48, 48)
        assert batch["observation.state"].shape == (batch_size, 10)
        self.instructions.update(batch["task"])
        return torch.zeros(batch_size, 4)

    def reset(self): ...

    def forward(self, batch): ...

    def get_optim_params(self): ...

    def predict_action_chunk(self, batch): ...


@pytest.mark.filterwarnings("error:The environment does not have 'task_description'")
@pytest.mark.parametrize("max_parallel_tasks", [1, 2])
@pytest.mark.parametrize("use_async_envs", [False, True], ids=["sync", "async"])
def test_an_evaluation_reports_each_kind(tmp_path, use_async_envs, max_parallel_tasks):
    from lerobot.scripts.lerobot_eval import eval_policy_all

    before = connected_clients()
    policy = StillPolicy()
    info = eval_policy_all(
        make_env(
            DeltacoEnv(task=ONE_OF_EACH_KIND, episode_length=3), n_envs=2, use_async_envs=use_async_envs
        ),
        policy,
        *[lambda data: data] * 4,
        n_episodes=2,
        max_episodes_rendered=2,
        videos_dir=tmp_path,
        start_seed=1000,
        max_parallel_tasks=max_parallel_tasks,
    )
    assert {kind: group["n_episodes"] for kind, group in info["per_group"].items()} == {
        "name": 2,
        "color": 2,
        "shape": 2,
    }
    assert info["overall"]["pc_success"] == 0
    assert len(list(tmp_path.rglob("*.mp4"))) == 6
    assert policy.instructions == {TASKS[i].instruction for i in select_tasks(ONE_OF_EACH_KIND)}
    # Each task was closed when it was done, and the last one stopped the simulators.
    assert connected_clients() == before


@pytest.mark.parametrize("use_async_envs", [False, True], ids=["sync", "async"])
def test_any_policy_can_be_evaluated_on_sentences_of_a_file(tmp_path, use_async_envs):
    from lerobot.scripts.lerobot_eval import eval_policy_all

    file = tmp_path / "sentences.csv"
    file.write_text("task_id,instruction\n4,one of 4\n4,another of 4\n4,held out of 4\n14,one of 14\n")
    policy = StillPolicy()

    def run(**options):
        policy.instructions.clear()
        envs = make_env(DeltacoEnv(task="4", episode_length=2, **options), 2, use_async_envs=use_async_envs)
        eval_policy_all(envs, policy, *[lambda data: data] * 4, n_episodes=8, start_seed=0)
        return policy.instructions.copy()

    assert run(instructions=str(file), instructions_split="train") == {"one of 4", "another of 4"}
    assert run(instruction="putt it  in teh box") == {"putt it in teh box"}
    for options, message in (
        ({"instructions": str(file)}, "no instruction for task 5"),
        ({"instructions": "missing.csv"}, "missing.csv cannot be read"),
    ):
        with pytest.raises(ValueError, match=message):
            make_env(DeltacoEnv(task="4,5", **options), 1)


@pytest.mark.slow
@pytest.mark.parametrize("use_async_envs", ["true", "false"])
def test_the_command_evaluates_a_saved_policy(tmp_path, use_async_envs):
    from lerobot.policies import make_policy, make_pre_post_processors
    from lerobot.policies.act.configuration_act import ACTConfig

    config = ACTConfig(
        device="cpu",
        dim_model=32,
        dim_feedforward=32,
        n_heads=2,
        n_encoder_layers=1,
        pretrained_backbone_weights=None,
    )
    make_policy(config, env_cfg=DeltacoEnv()).save_pretrained(tmp_path / "policy")
    for processor in make_pre_post_processors(config):
        processor.save_pretrained(tmp_path / "policy")
    subprocess.run(
        [
            sys.executable,
            "-m",
            "lerobot.scripts.lerobot_eval",
            f"--policy.path={tmp_path / 'policy'}",
            "--env.type=deltaco",
            "--env.task=scenario_b_test",
            "--eval.n_episodes=2",
            "--eval.batch_size=2",
            f"--eval.use_async_envs={use_async_envs}",
            f"--output_dir={tmp_path / 'eval'}",
        ],
        check=True,
    )
    info = json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2 * len(SCENARIOS["b"].test_tasks)
    assert set(info["per_group"]) == {"color", "shape"}
