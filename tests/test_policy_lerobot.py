"""What LeRobot expects of policies: they are made, trained, resumed, and run by its commands."""

import copy
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_robot import CAMERA, IMAGE_SHAPE, MOTORS
from fresh_python import run_python
from lerobot.common.train_utils import load_training_state, save_checkpoint
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import get_policy_class, make_policy, make_policy_config, make_pre_post_processors
from small_policies import REPO_ID, batch_of, demos_of, observation, small_policy

from gym_deltaco.tasks import TASK_SETS, get_task
from lerobot_deltaco.checkpoints import load_policy
from lerobot_deltaco.deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.lerobot_env import DeltacoEnv

TESTS, SHIPPED = Path(__file__).parent, Path(__file__).parents[1] / "checkpoints" / "pick_place"

pytestmark = pytest.mark.usefixtures("fake_language", "short_fit")


# Construction


@pytest.mark.parametrize(
    ("policy_type", "policy_class", "config_class"),
    [
        ("deltaco", DeltacoPolicy, DeltacoConfig),
        ("deltaco_match", DeltacoMatchPolicy, DeltacoMatchConfig),
    ],
)
def test_type_names_a_policy_and_its_configuration(policy_type, policy_class, config_class):
    assert get_policy_class(policy_type) is policy_class
    assert type(make_policy_config(policy_type, device="cpu")) is config_class
    assert policy_class.config_class is config_class
    assert policy_class.name == config_class(device="cpu").type == policy_type


def test_policy_is_made_for_an_environment():
    """As `lerobot-eval` does without a checkpoint."""
    config = make_policy_config("deltaco", device="cpu", backbone="strided", method="language_only")
    policy = make_policy(config, env_cfg=DeltacoEnv(task="4"))
    assert set(config.input_features) == {"observation.image", "observation.state"}
    assert policy.config.action_feature.shape == (4,)
    assert policy.config.robot_state_feature.shape == (10,)


def test_features_of_the_dataset_become_inputs_and_outputs(make, dataset):
    config = make()[0].config
    assert {name: feature.shape for name, feature in config.image_features.items()} == {
        "observation.images.top": (3, 20, 28),
        "observation.images.wrist": (3, 24, 24),
    }
    assert config.robot_state_feature.shape == (2,)
    assert (config.action_feature.type, config.action_feature.shape) == (FeatureType.ACTION, (3,))
    # One camera of two, as `--policy.input_features` says.
    wrist = {"observation.images.wrist": config.input_features["observation.images.wrist"]}
    policy, before, _ = make(input_features=wrist)
    assert list(policy.config.input_features) == ["observation.images.wrist"]
    assert torch.isfinite(policy(before(batch_of(dataset, [0, 7])))[0])


# Processors


def test_processors_normalize_and_revert_it(make, dataset, tmp_path):
    policy, before, after = make()
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
    before.save_pretrained(tmp_path)
    after.save_pretrained(tmp_path)
    overrides = {"device_processor": {"device": "cpu"}}  # as those of `lerobot-eval`
    loaded_before, loaded_after = make_pre_post_processors(
        policy.config, pretrained_path=str(tmp_path), preprocessor_overrides=overrides
    )
    loaded = loaded_before(copy.deepcopy(raw))
    assert set(batch) == set(loaded)
    for name, value in batch.items():
        assert torch.equal(value, loaded[name]) if torch.is_tensor(value) else value == loaded[name]
    assert torch.equal(after(batch["action"]), loaded_after(batch["action"]))


# Training


def test_training_resumes_to_the_bit_from_a_checkpoint_of_lerobot(make, dataset, tmp_path):
    policy, before, after = make(scheduler_name="cosine")
    batch = before(batch_of(dataset, [0, 7, 20]))

    def update(policy, optimizer, scheduler):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()

    config = TrainPipelineConfig(DatasetConfig(REPO_ID), policy=policy.config, steps=4)
    config.optimizer, config.scheduler = (
        policy.config.get_optimizer_preset(),
        policy.config.get_scheduler_preset(),
    )
    optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
    update(policy, optimizer, scheduler)
    save_checkpoint(tmp_path, 1, config, policy, optimizer, scheduler, before, after)

    config.policy.pretrained_path = tmp_path / "pretrained_model"
    resumed = make_policy(config.policy, ds_meta=dataset.meta).train()
    step, *state = load_training_state(tmp_path, *make_optimizer_and_scheduler(config, resumed))
    assert step == int(resumed.step) == 1
    update(policy, optimizer, scheduler)
    update(resumed, *state)
    for name, value in policy.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


@pytest.fixture
def usual_priority():
    """Undoes what an encoder of videos may do for the superuser: it makes the thread a real-time one."""
    yield
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.mark.usefixtures("usual_priority")
def test_videos_are_trained_on_and_demonstrate(tmp_path):
    features = {
        "observation.images.top": {"dtype": "video", "shape": (64, 96, 3), "names": ["h", "w", "channels"]},
        "action": {"dtype": "float32", "shape": (2,), "names": ["left.pos", "right.pos"]},
    }
    root = tmp_path / "videos"
    encoder = RGBEncoderConfig(vcodec="h264")
    dataset = LeRobotDataset.create(REPO_ID, 10, features, root=root, rgb_encoder=encoder)
    for number, task in enumerate(["wave", "wave", "sing"]):
        for step in range(5):
            image = np.full((64, 96, 3), 60 * number + 10 * step, np.uint8)
            action = np.array([number, step], np.float32)
            dataset.add_frame({"observation.images.top": image, "action": action, "task": task})
        dataset.save_episode()
    dataset.finalize()
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    policy, before, _ = small_policy(dataset, **demos_of(dataset))
    loss, _ = policy(before(batch_of(dataset, [0, 6, 12])))
    assert torch.isfinite(loss)
    for bank in (policy.training_bank, policy.demonstrations):
        shades = bank.frames.float().mean(dim=(2, 3, 4))
        expected = torch.tensor([[60.0 * number, 60.0 * number + 40] for number in range(3)])
        torch.testing.assert_close(shades, expected, atol=6, rtol=0)
    policy.eval()
    assert policy.select_action(before(observation(dataset, ["sing", "wave"]))).shape == (2, 2)


# Commands

PICKS = (0.1, 0.4, 0.8)  # where the object is, as a fraction of the image's width
ROBOT_TASKS = ["move it to the end", "drop it"]


def write_robot_dataset(root, repo_id, tasks):
    """Writes an episode for each task, in which the arm moves a square from one of `PICKS` to the end."""
    height, width, _ = IMAGE_SHAPE
    motors = {"dtype": "float32", "shape": (2,), "names": list(MOTORS)}
    image = {"dtype": "image", "shape": IMAGE_SHAPE, "names": ["height", "width", "channels"]}
    features = {f"observation.images.{CAMERA}": image, "observation.state": motors, "action": motors}
    dataset = LeRobotDataset.create(repo_id, 20, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for number, task in enumerate(tasks):
        pick = PICKS[number % 3] + 0.1 * rng.random()
        shoulders, grippers = (0, pick, pick, pick, 1, 1, 0), (40, 40, 0, 0, 0, 40, 40)
        for step, (shoulder, gripper) in enumerate(zip(shoulders, grippers, strict=True)):
            picture = np.full(IMAGE_SHAPE, 120, np.uint8)
            left = round((pick if step < 4 else 1) * (width - 5))
            picture[height // 2 : height // 2 + 5, left : left + 5] = (230, 40, 30)
            state = np.array([100 * shoulder, gripper], np.float32)
            dataset.add_frame(
                {
                    f"observation.images.{CAMERA}": picture,
                    "observation.state": state,
                    "action": state,
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(repo_id, root=root)


# One process for all of it, since importing LeRobot takes 10 s.
ROLLOUTS = """
import json, sys
from pathlib import Path

import fake_robot
from lerobot.scripts import lerobot_rollout
from small_policies import fake_encoder, language

fake_encoder.calls = []
language.load_language_encoder = fake_encoder
sent = []
for words in json.loads(sys.argv[1]):
    fake_robot.FakeArm.sent.clear()
    sys.argv = ["lerobot-rollout", *words]
    lerobot_rollout.main()
    sent.append(list(fake_robot.FakeArm.sent))
Path("sent.json").write_text(json.dumps(sent))
"""


def test_rollouts_move_a_robot_by_the_demonstration_of_a_new_task(tmp_path):
    dataset = write_robot_dataset(tmp_path / "tasks", "me/tasks", ROBOT_TASKS[:1] * 24)
    demos = write_robot_dataset(tmp_path / "demos", "me/demos", ROBOT_TASKS[1:])
    common = ["--robot.type=fake_arm", "--fps=20", "--duration=1", "--return_to_initial_position=false"]
    named = ["--policy.demo_repo_id=me/demos", f"--policy.demo_root={demos.root}"]
    commands = []
    for policy_type in ("deltaco", "deltaco_match"):
        policy, before, after = small_policy(dataset, policy_type)
        policy(before(batch_of(dataset, [0, 7, 14, 21])))
        for part in (policy, before, after):
            part.save_pretrained(tmp_path / policy_type)
        commands.append([f"--policy.path={tmp_path / policy_type}", *named, *common])
    commands[0].append(f"--task={ROBOT_TASKS[1]}")
    commands[1] += ["--task=in other words", "--policy.demo_episode=0"]
    result = run_python(
        *(ROLLOUTS, json.dumps(commands)),
        cwd=tmp_path,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")]),
            "HF_HOME": str(tmp_path / "cache"),
        },
    )
    assert result.returncode == 0, result.stderr[-3000:]
    rollouts = json.loads((tmp_path / "sent.json").read_text())
    assert len(rollouts) == len(commands)
    for sent in rollouts:
        assert sent
        for action in sent:
            assert set(action) == set(MOTORS)
            assert 0 <= action["gripper.pos"] <= 40


# The checkpoint of this project


@pytest.fixture(scope="module")
def shipped():
    return load_policy(SHIPPED, ["--device=cpu"])


def test_shipped_checkpoint_knows_the_test_tasks(shipped):
    policy = shipped.policy
    assert isinstance(policy, DeltacoMatchPolicy)
    assert len(policy.demonstrations.rows) == len(TASK_SETS["scenario_a_test"])
    assert {"green", "bin", "gray", "bowl"} < set(policy.config.known_words)
    for file in SHIPPED.glob("*.json"):
        settings = json.loads(file.read_text(encoding="utf-8"))
        assert settings.get("demo_root") is None


def test_shipped_checkpoint_loads_offline_and_acts(shipped, monkeypatch):
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("asked the network"))
    config = PreTrainedConfig.from_pretrained(SHIPPED)
    config.pretrained_path = SHIPPED  # as `--policy.path` does
    config.device = "cpu"
    environment = DeltacoEnv(task="4")
    policy = make_policy(config, env_cfg=environment).eval()
    task_id = TASK_SETS["scenario_a_test"][0]
    generator = torch.Generator().manual_seed(0)
    batch = shipped.preprocessor(
        {
            "observation.image": torch.rand(2, 3, 48, 48, generator=generator),
            "observation.state": torch.zeros(2, 10),
            "task": [get_task(task_id).instruction] * 2,
        }
    )
    shipped.policy.reset()
    action = policy.select_action(batch)
    assert action.shape == (2, 4)
    assert torch.isfinite(action).all()
    assert torch.equal(action, shipped.policy.select_action(batch))
