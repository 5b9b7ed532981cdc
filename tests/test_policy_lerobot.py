"""What LeRobot asks of its own policies: they are made, saved, loaded, optimized, and trained on videos."""

import copy
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from lerobot.common.train_utils import load_training_state, save_checkpoint
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import get_policy_class, make_policy, make_policy_config, make_pre_post_processors
from safetensors.torch import load_file, save_file
from small_policies import (
    EPISODES_PER_TASK,
    LENGTH,
    REPO_ID,
    TASKS,
    batch_of,
    fake_encoder,
    observation,
    small_policy,
)

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.policy.language.instruction_table import InstructionTable

pytestmark = pytest.mark.usefixtures("fake_language")


def assert_equal_weights(policy, other):
    assert list(policy.state_dict()) == list(other.state_dict())
    for name, value in policy.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


# Construction


def test_the_type_names_the_policy_and_its_configuration():
    assert get_policy_class("deltaco") is DeltacoPolicy
    assert type(make_policy_config("deltaco", device="cpu")) is DeltacoConfig
    assert DeltacoPolicy.config_class is DeltacoConfig
    assert DeltacoPolicy.name == DeltacoConfig(device="cpu").type == "deltaco"


def test_a_policy_is_made_for_an_environment():
    """As `lerobot-eval` does without a checkpoint, and other policies' tests do."""
    config = make_policy_config("deltaco", device="cpu", backbone="strided", method="language_only")
    policy = make_policy(config, env_cfg=DeltacoEnv(task="4"))
    assert set(config.input_features) == {"observation.image", "observation.state"}
    assert policy.config.action_feature.shape == (4,)
    assert policy.config.robot_state_feature.shape == (10,)


def test_the_datasets_features_become_inputs_and_outputs(make):
    config = make()[0].config
    assert {name: feature.shape for name, feature in config.image_features.items()} == {
        "observation.images.top": (3, 20, 28),
        "observation.images.wrist": (3, 24, 24),
    }
    assert config.robot_state_feature.shape == (2,)
    assert (config.action_feature.type, config.action_feature.shape) == (FeatureType.ACTION, (3,))


def test_inputs_that_are_given_are_kept(dataset):
    """One camera of two, as `--policy.input_features` says."""
    config = make_policy_config("deltaco", device="cpu", image_size=16, backbone="strided")
    both = make_policy(copy.deepcopy(config), ds_meta=dataset.meta).config.input_features
    config.input_features = {"observation.images.wrist": both["observation.images.wrist"]}
    policy = make_policy(config, ds_meta=dataset.meta)
    before, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    loss, _ = policy.train()(before(batch_of(dataset, [0, 7])))
    assert torch.isfinite(loss)
    assert list(policy.config.input_features) == ["observation.images.wrist"]


# Saving and loading


@pytest.mark.parametrize(
    "with_state_dict", [True, False], ids=["as LeRobot 0.6.1 does", "as later versions do"]
)
def test_a_policy_is_saved_by_either_signature(make, tmp_path, with_state_dict):
    policy, _, _ = make(method="language_only")
    arguments = {"state_dict": None} if with_state_dict else {}
    policy._save_pretrained(tmp_path, **arguments)
    assert_equal_weights(policy, DeltacoPolicy.from_pretrained(tmp_path))


def test_weights_with_names_of_an_earlier_version_say_what_to_do(make, tmp_path):
    policy, _, _ = make(method="language_only")
    policy.save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    assert any(name.startswith("model.") for name in weights)
    old = {name.replace("model.", "policy.", 1): value for name, value in weights.items()}
    save_file(old, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"earlier version.*Train the policy again.*`policy.` by `model.`"):
        DeltacoPolicy.from_pretrained(tmp_path)


def test_a_configuration_survives_its_own_file(make, tmp_path):
    config = make()[0].config
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config
    overridden = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--demo_episode=2", "--seed=7"])
    assert (overridden.demo_episode, overridden.seed) == (2, 7)


def test_training_goes_on_from_a_checkpoint_of_lerobots(make, dataset, tmp_path):
    """Weights, step, Adam's moments: the next update is the same to the bit."""
    batch = make()[1](batch_of(dataset, [0, 7, 20]))

    def update(policy, optimizer):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    policy, before, after = make()
    config = TrainPipelineConfig(DatasetConfig(REPO_ID), policy=policy.config, steps=2)
    config.optimizer = policy.config.get_optimizer_preset()
    optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
    assert scheduler is None
    update(policy, optimizer)
    save_checkpoint(tmp_path, 1, config, policy, optimizer, scheduler, before, after)

    config.policy.pretrained_path = tmp_path / "pretrained_model"
    resumed = make_policy(config.policy, ds_meta=dataset.meta).train()
    other, _ = make_optimizer_and_scheduler(config, resumed)
    step, other, _ = load_training_state(tmp_path, other, None)
    assert step == int(resumed.step) == 1
    update(policy, optimizer)
    update(resumed, other)
    assert_equal_weights(policy, resumed)


# Processors


def test_processors_survive_saving(make, dataset, tmp_path):
    policy, before, after = make()
    before.save_pretrained(tmp_path)
    after.save_pretrained(tmp_path)
    # As `lerobot-eval` loads them.
    overrides = {
        "device_processor": {"device": "cpu"},
        "rename_observations_processor": {"rename_map": {}},
    }
    loaded_before, loaded_after = make_pre_post_processors(
        policy.config, pretrained_path=str(tmp_path), preprocessor_overrides=overrides
    )
    raw = batch_of(dataset, [0, 7, 20])
    batch, loaded = before(copy.deepcopy(raw)), loaded_before(copy.deepcopy(raw))
    assert set(batch) == set(loaded)
    for name, value in batch.items():
        assert torch.equal(value, loaded[name]) if torch.is_tensor(value) else value == loaded[name]
    action = torch.rand(3, 3) * 2 - 1
    assert torch.equal(after(action), loaded_after(action))


def test_processors_normalize_and_undo_it(make, dataset):
    _, before, after = make()
    raw = batch_of(dataset, list(range(len(dataset))))
    batch = before(copy.deepcopy(raw))
    state = batch["observation.state"]
    torch.testing.assert_close(state.mean(dim=0), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(state.std(dim=0, correction=0), torch.ones(2), atol=1e-3, rtol=0)
    assert batch["action"].min() == pytest.approx(-1, abs=1e-4)
    assert batch["action"].max() == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(after(batch["action"]), raw["action"], atol=1e-3, rtol=0)
    for camera in dataset.meta.camera_keys:
        assert torch.equal(batch[camera], raw[camera])


# Evaluation by several threads


def test_a_thread_that_never_reset_the_policy_may_act(make, dataset):
    """As in LeRobot's policy server, whose requests come in threads of their own."""
    policy, before, _ = make(method="language_only")
    batch = before(observation(dataset, TASKS))
    expected = policy.eval().select_action(batch)
    with ThreadPoolExecutor(1) as pool:
        assert torch.equal(pool.submit(policy.select_action, batch).result(), expected)


@pytest.mark.parametrize("n_threads", [1, 2])
def test_the_trials_of_a_task_do_not_depend_on_other_tasks(make, dataset, n_threads):
    """Each task's demonstrations take turns, and for MCIL language and demonstration, whoever came before."""
    policy, before, _ = make(method="mcil", demo_repo_id=REPO_ID, demo_root=str(dataset.root))
    policy.eval()
    batches = {task: before(observation(dataset, [task])) for task in TASKS}

    def act(task, policy):
        actions = []
        for _ in range(3):
            policy.reset()
            actions.append(policy.select_action(batches[task]))
        return torch.cat(actions)

    alone = {task: act(task, copy.deepcopy(policy)) for task in TASKS}
    with ThreadPoolExecutor(n_threads) as pool:
        shown = {task: pool.submit(act, task, policy) for task in TASKS}
    for task, actions in alone.items():
        assert torch.equal(shown[task].result(), actions)


def test_threads_embed_instructions_without_mixing_them_up(monkeypatch):
    """Each is embedded once, even if several threads ask for it at the same time."""
    encode = fake_encoder("all-MiniLM-L6-v2")

    def slowly(sentences):
        time.sleep(0.01)
        return encode(sentences)

    monkeypatch.setattr(instruction_table, "load_language_encoder", lambda _: slowly)
    table = InstructionTable("all-MiniLM-L6-v2")
    asked = [[f"task {n // 2}"] for n in range(16)]
    with ThreadPoolExecutor(8) as pool:
        embeddings = list(pool.map(lambda instructions: table(instructions, "cpu"), asked))
    for instructions, embedding in zip(asked, embeddings, strict=True):
        assert torch.equal(embedding, encode(instructions))
        assert torch.equal(table(instructions, "cpu"), encode(instructions))
    assert len(table.embeddings) == len(table.rows) == 8


# The loss of episodes that `--dataset.eval_split` holds back


def test_an_episode_that_is_held_back_is_shown_by_any_of_its_task(make, dataset):
    policy, before, _ = make(demo_episodes=[0, 1, 3, 5])
    held_back = before(batch_of(dataset, [2 * LENGTH, 4 * LENGTH]))
    with pytest.raises(ValueError, match="Episode 2 is trained on, but is not among"):
        policy(held_back)
    policy.eval()
    loss, _ = policy(held_back)
    assert torch.isfinite(loss)
    # As `deltaco-train` gives them.
    policy.set_train_demonstrations(policy.train_demonstrations)
    assert policy(held_back)[0] == loss

    demonstrations, generator = policy.train_demonstrations, torch.Generator().manual_seed(0)
    drawn = {}
    tasks = [task for task in TASKS for _ in range(EPISODES_PER_TASK[task])]
    for episode, task in enumerate(tasks):
        rows = demonstrations.sample_other_episodes(
            torch.full((100,), episode), generator, tasks=[task] * 100
        )
        drawn[episode] = set(demonstrations.episodes[rows].tolist())
    assert drawn == {0: {1}, 1: {0}, 2: {0, 1}, 3: {3}, 4: {3}, 5: {5}}


def test_a_task_that_is_held_back_altogether_is_named(make, dataset):
    policy, before, _ = make(demo_episodes=[0, 1, 2])
    policy.eval()
    with pytest.raises(ValueError, match="'wave' has no episode .*`demo_episodes`"):
        policy(before(batch_of(dataset, [0, 5 * LENGTH])))


# Videos


@pytest.fixture
def usual_priority():
    """Undoes what SVT-AV1 does for the superuser: it makes the encoding thread a real-time one for good."""
    yield
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.mark.usefixtures("usual_priority")
@pytest.mark.parametrize("codec", ["h264", "libsvtav1"])
def test_a_dataset_of_videos_trains_and_demonstrates(tmp_path, codec):
    features = {
        "observation.images.top": {
            "dtype": "video",
            "shape": (64, 96, 3),
            "names": ["height", "width", "channels"],
        },
        "action": {"dtype": "float32", "shape": (2,), "names": ["left.pos", "right.pos"]},
    }
    root = tmp_path / "videos"
    encoder = RGBEncoderConfig(vcodec=codec)
    dataset = LeRobotDataset.create(REPO_ID, 10, features, root=root, rgb_encoder=encoder)
    for number, task in enumerate(["wave", "wave", "sing"]):
        for step in range(LENGTH):
            dataset.add_frame(
                {
                    "observation.images.top": np.full((64, 96, 3), 60 * number + 10 * step, np.uint8),
                    "action": np.array([number, step], np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    assert dataset.meta.video_keys == ["observation.images.top"]

    policy, before, _ = small_policy(dataset, demo_repo_id=REPO_ID, demo_root=str(root))
    batch = before(batch_of(dataset, [0, 6, 12]))
    loss, _ = policy(batch)
    loss.backward()
    assert torch.isfinite(loss)
    # Each demonstration is the first and the last frame of its own episode, as well as the codec keeps them.
    for demonstrations in (policy.train_demonstrations, policy.eval_demonstrations):
        shades = demonstrations.frames.float().mean(dim=(2, 3, 4))
        expected = [[60.0 * number, 60.0 * number + 10 * (LENGTH - 1)] for number in range(3)]
        torch.testing.assert_close(shades, torch.tensor(expected), atol=6, rtol=0)
    policy.eval()
    assert policy.select_action(before(observation(dataset, ["sing", "wave"]))).shape == (2, 2)
