"""What LeRobot expects of policies: they are made, trained, resumed, and run by its commands."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_robot import CAMERA, IMAGE_SHAPE, MOTORS, FakeArm
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.policies import make_policy
from lerobot.scripts import lerobot_rollout
from small_policies import as_options, batch_of, observation, small_policy, write_episodes

from gym_deltaco.tasks import TASK_SETS, get_task
from lerobot_deltaco.evaluation.checkpoints import load_policy
from lerobot_deltaco.evaluation.lerobot_env import DeltacoEnv
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "pick_place"

small = pytest.mark.usefixtures("fake_language", "short_fit")  # not for the shipped checkpoint


@small
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


@small
def test_processors_normalize_and_revert_it(make, dataset):
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


@small
def test_the_network_that_acts_is_copied_once_for_the_same_weights(make, dataset):
    policy, before, _ = make(method="language_only")
    policy.eval()
    seen = before(observation(dataset, ["wave"]))
    actions, networks = [], []
    for factor in (1, 1, 0.9):
        with torch.no_grad():
            for weight in policy.policy_network.parameters():
                weight *= factor
        policy.reset()
        actions.append(policy.select_action(seen))
        networks.append(policy._inference_network())
    assert networks[0] is not networks[2]
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[1], actions[2])
    policy.reset()
    policy.select_action(seen)
    assert policy._inference_network() is networks[2]


# Commands

PICKS = (0.1, 0.4, 0.8)  # where the object is, as a fraction of the image's width


def write_robot_dataset(root, tasks):
    """Writes an episode for each task, in which the arm moves a square from one of `PICKS` to the end."""
    height, width, _ = IMAGE_SHAPE
    rng = np.random.default_rng(0)

    def frames(number):
        pick = PICKS[number % 3] + 0.1 * rng.random()
        shoulders, grippers = (0, pick, pick, pick, 1, 1, 0), (40, 40, 0, 0, 0, 40, 40)
        for step, (shoulder, gripper) in enumerate(zip(shoulders, grippers, strict=True)):
            image = np.full(IMAGE_SHAPE, 120, np.uint8)
            left = round((pick if step < 4 else 1) * (width - 5))
            image[height // 2 : height // 2 + 5, left : left + 5] = (230, 40, 30)
            state = np.array([100 * shoulder, gripper], np.float32)
            yield {f"observation.images.{CAMERA}": image, "observation.state": state, "action": state}

    names = {"observation.state": list(MOTORS), "action": list(MOTORS)}
    episodes = [(task, list(frames(number))) for number, task in enumerate(tasks)]
    return write_episodes(root, "me/robot", episodes, fps=20, **names)


@pytest.fixture(scope="module")
def robot_data(tmp_path_factory):
    """The dataset of a robot, and one with a demonstration of a new task."""
    folder = tmp_path_factory.mktemp("robot")
    tasks = {"tasks": ["move it to the end"] * 24, "demos": ["drop it"]}
    return [write_robot_dataset(folder / name, own) for name, own in tasks.items()]


@small
@pytest.mark.parametrize(
    ("policy_type", "task"),
    [
        ("deltaco", ["--task=drop it"]),
        ("deltaco_match", ["--task=in words", "--policy.demo_episode=0"]),
        ("deltaco_match", ["--task=in words", "--policy.demo_point=[8, 14]"]),
    ],
)
def test_rollouts_move_a_robot_by_the_demonstration_of_a_new_task(
    robot_data, tmp_path, monkeypatch, policy_type, task
):
    dataset, demos = robot_data
    policy, before, after = small_policy(dataset, policy_type)
    policy(before(batch_of(dataset, [0, 7, 14, 21])))
    for part in (policy, before, after):
        part.save_pretrained(tmp_path / "policy")
    options = {
        "policy.path": tmp_path / "policy",
        "robot.type": "fake_arm",
        "robot.calibration_dir": tmp_path,
    }
    options |= {"policy.demo_repo_id": "me/demos", "policy.demo_root": demos.root}
    options |= {"fps": 20, "duration": 1, "return_to_initial_position": False}
    monkeypatch.setattr("sys.argv", ["lerobot-rollout", *as_options(options), *task])
    monkeypatch.setattr("signal.signal", lambda *_: None)  # leave Ctrl+C to pytest
    FakeArm.sent.clear()
    lerobot_rollout.main()
    assert FakeArm.sent
    for action in FakeArm.sent:
        assert set(action) == set(MOTORS)
        assert -1e-3 <= action["gripper.pos"] <= 40 + 1e-3


def test_shipped_checkpoint_knows_the_test_tasks_and_acts_offline(monkeypatch):
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("asked the network"))
    shipped = load_policy(SHIPPED, ["--device=cpu"])
    policy = shipped.policy
    assert isinstance(policy, DeltacoMatchPolicy)
    assert len(policy.demonstrations.rows) == len(TASK_SETS["scenario_a_test"])
    assert {"green", "bin", "gray", "bowl"} < set(policy.config.known_words)
    for file in SHIPPED.glob("*.json"):
        assert json.loads(file.read_text(encoding="utf-8")).get("demo_root") is None
    config = PreTrainedConfig.from_pretrained(SHIPPED)
    config.pretrained_path = SHIPPED  # as `--policy.path` does
    config.device = "cpu"
    policy = make_policy(config, env_cfg=DeltacoEnv(task="4")).eval()
    images = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    seen = {"observation.image": images, "observation.state": torch.zeros(2, 10)}
    tasks = [get_task(TASK_SETS["scenario_a_test"][0]).instruction] * 2
    batch = shipped.preprocessor({**seen, "task": tasks})
    shipped.policy.reset()
    action = policy.select_action(batch)
    assert action.shape == (2, 4)
    assert torch.isfinite(action).all()
    assert torch.equal(action, shipped.policy.select_action(batch))
