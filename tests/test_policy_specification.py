"""What every method, baseline and ablation must do, as one specification; and the paper's loss in numbers."""

import copy
import functools
from types import SimpleNamespace

import numpy as np
import numpy_reference as reference
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim.factory import make_optimizer_and_scheduler
from small_policies import (
    EPISODES_PER_TASK,
    REPO_ID,
    TASKS,
    batch_of,
    observation,
    small_policy,
    use_fake_encoder,
    write_dataset,
)

from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.options import BACKBONES, METHODS

OPTIONS = [
    *({"method": method} for method in METHODS),
    {"film": "demo+language", "concat": "none"},
    {"film": "none", "concat": "demo+language"},
    {"film": "language", "concat": "demo"},
    {"encoder_loss": "cosine"},
    {"encoder_loss": "none"},
    {"demo_rows": 2},
    {"demo_encoder": "attention"},
    {"demo_encoder": "attention", "demo_rows": 2},
    {"motion_modes": 3},
    {"demos_per_task": 2},
    {"gripper": "none"},
    {"gripper_loss": "cross_entropy"},
    {"language_encoder": "all-distilroberta-v1"},
    {"dtype": "bfloat16", "grad_clip_norm": 1.0},
]
# Samples of all three tasks.
SAMPLES = [0, 7, 16, 22, 29]


@pytest.fixture(autouse=True)
def _language(monkeypatch):
    use_fake_encoder(monkeypatch)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    episodes = [task for task in TASKS for _ in range(EPISODES_PER_TASK[task])]
    return write_dataset(tmp_path_factory.mktemp("data") / "foreign", episodes)


@pytest.fixture(params=OPTIONS, ids=str)
def make(request, dataset):
    """Makes the policy that is tested, and its processors, always with the same weights."""

    def make(**demos):
        torch.manual_seed(0)
        policy, before, after = small_policy(dataset, **demos, **request.param)
        return SimpleNamespace(policy=policy, before=before, after=after, config=policy.config)

    return make


@pytest.fixture
def demos(dataset):
    """Demonstrations for acting and for checkpoints. Without them, a policy acts by those of its training."""
    return {"demo_repo_id": REPO_ID, "demo_root": str(dataset.root)}


def optimizer_of(policy):
    """The optimizer that LeRobot makes for a policy."""
    config = TrainPipelineConfig(DatasetConfig(REPO_ID), policy=policy.config)
    config.optimizer = policy.config.get_optimizer_preset()
    return make_optimizer_and_scheduler(config, policy)[0]


def trained(made, batch, n_steps=2):
    """Losses of a few steps of training on one batch."""
    optimizer = optimizer_of(made.policy)
    losses = []
    for _ in range(n_steps):
        loss, _ = made.policy(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.detach())
    return torch.stack(losses)


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]


def test_it_trains_and_logs_and_leaves_the_batch_alone(make, dataset):
    made = make()
    batch = made.before(batch_of(dataset, SAMPLES))
    kept = copy.deepcopy(batch)
    loss, logged = made.policy(batch)
    loss.backward()
    assert loss.shape == ()
    assert torch.isfinite(loss)
    assert {"motion_nll", "motion_mse"} <= set(logged)
    assert ("gripper_accuracy" in logged) == (made.config.gripper_index is not None)
    assert ("demo_accuracy" in logged) == (made.config.conditioning.encoder_loss != "none")
    without = [name for name, parameter in made.policy.named_parameters() if parameter.grad is None]
    assert without == []
    assert_same(kept, batch)
    each, _ = make().policy(batch, reduction="none")
    assert each.shape == (len(SAMPLES),)
    torch.testing.assert_close(each.mean(), loss.detach(), rtol=1e-5, atol=1e-5)


def test_it_acts_in_batches_of_any_size_and_leaves_the_batch_alone(make, dataset, demos):
    made = make(**demos)
    made.policy.eval()
    for tasks in (TASKS[:1], TASKS):
        made.policy.reset()
        batch = made.before(observation(dataset, tasks))
        kept = copy.deepcopy(batch)
        action = made.policy.select_action(batch)
        assert action.shape == (len(tasks), 3)
        assert torch.isfinite(action).all()
        assert torch.isfinite(made.after(action)).all()
        assert torch.equal(made.policy.select_action(batch), action)
        assert torch.equal(made.policy.predict_action_chunk(batch), action[:, None])
        assert_same(kept, batch)


def test_the_optimizer_has_every_weight_of_the_networks_and_changes_it(make, dataset):
    made = make()
    policy, batch = made.policy, made.before(batch_of(dataset, SAMPLES))
    policy(batch)  # by now, all that is read later is there
    (group,) = optimizer_of(policy).param_groups
    expected = {
        id(parameter)
        for network in (policy.model, policy.demo_encoder, policy.language_head)
        if network is not None
        for parameter in network.parameters()
    }
    assert {id(parameter) for parameter in group["params"]} == expected
    assert len(group["params"]) == len(expected)
    # Neither demonstrations nor embeddings are weights: a checkpoint of the networks stays small.
    assert not any("demonstrations" in name for name in policy.state_dict())
    before = {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}
    trained(made, batch)
    unchanged = [
        name for name, parameter in policy.named_parameters() if torch.equal(parameter, before[name])
    ]
    assert unchanged == []


def test_the_same_seed_gives_the_same_result_to_the_bit(make, dataset):
    results = []
    for _ in range(2):
        made = make()
        batch = made.before(batch_of(dataset, SAMPLES))
        losses = trained(made, batch)
        made.policy.eval()
        results.append(
            {"losses": losses, **made.policy.state_dict(), "act": made.policy.select_action(batch)}
        )
    assert_same(*results)


def test_it_survives_saving_to_the_bit(make, dataset, demos, tmp_path):
    made = make(**demos)
    trained(made, made.before(batch_of(dataset, SAMPLES)), n_steps=1)
    made.policy.eval()
    batch = made.before(observation(dataset, TASKS))
    action = made.policy.select_action(batch)
    made.policy.save_pretrained(tmp_path)
    loaded = DeltacoPolicy.from_pretrained(tmp_path)
    assert not loaded.training
    assert_same(loaded.state_dict(), made.policy.state_dict())
    assert torch.equal(loaded.select_action(batch), action)
    # It needs its demonstrations' dataset no more.
    made.config.demo_repo_id = made.config.demo_root = None
    assert loaded.config == PreTrainedConfig.from_pretrained(tmp_path) == made.config


# The loss, in numbers


def weights_of(policy, prefix):
    return {
        name.removeprefix(prefix): value.numpy().astype(np.float64)
        for name, value in policy.state_dict().items()
        if name.startswith(prefix)
    }


@pytest.mark.parametrize("method", METHODS)
def test_the_loss_is_that_of_the_papers_formulas(dataset, method):
    # Of these samples' episodes, one has another one of its task, which demonstrates it, and the other none.
    samples, rows, task = [16, 22, 27], [4, 3, 5], np.array([0, 0, 1])
    policy, before, _ = small_policy(dataset, method=method, crop_padding=0, demo_crop_padding=0)
    batch = before(batch_of(dataset, samples))
    distinct = list(dict.fromkeys(batch["task"]))
    loss, _ = policy(batch, reduction="none")

    stride = BACKBONES["strided"]
    images = policy._images(batch).numpy().astype(np.float64)
    state = batch["observation.state"].numpy().astype(np.float64)
    action = batch["action"].numpy().astype(np.float64)
    known = policy.instructions(distinct, "cpu").numpy().astype(np.float64)
    demo = None
    if policy.config.uses_demo:
        frames = policy.train_demonstrations.frames[rows].numpy() / 255
        demo = reference.encoder(weights_of(policy, "demo_encoder."), frames, 1, stride.demo_stride)
    model = weights_of(policy, "model.")
    imitation = functools.partial(
        reference.imitation_loss,
        raw_log_std=model["raw_log_std"],
        motion=action[:, [0, 2]],
        gripper_target=(action[:, 1] + 1) / 2,
        gripper_weight=30,
    )

    def imitated(film, concatenated):
        outputs = reference.network(model, images, film, concatenated, stride.stem_stride, training=True)
        return imitation(*outputs)

    if method == "mcil":
        head = weights_of(policy, "language_head.layers.")
        hidden = reference.relu(known[task] @ head["0.weight"].T + head["0.bias"])
        projected = reference.unit(hidden @ head["2.weight"].T + head["2.bias"])
        expected = (imitated(projected, state) + imitated(demo, state)) / 2
    else:
        one_hot = np.eye(len(policy.config.one_hot_tasks) or 1)
        film = {
            "language_only": known[task],
            "one_hot": one_hot[[policy.config.one_hot_tasks.index(name) for name in batch["task"]]]
            if method == "one_hot"
            else None,
        }.get(method, demo)
        parts = [known[task], state] if method == "deltaco" else [state]
        expected = imitated(film, np.concatenate(parts, axis=1))
    if method in ("deltaco", "demo_only"):
        expected = expected + 10 * reference.contrastive_loss(demo, known, task, 0.1)
    if method == "bc_z":
        expected = expected + 10 * (1 - (demo * known[task]).sum(axis=1))
    np.testing.assert_allclose(loss.detach().numpy(), expected, rtol=1e-5, atol=1e-5)
