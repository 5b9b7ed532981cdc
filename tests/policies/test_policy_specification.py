"""One specification for every method, baseline and ablation; and the paper's loss in numbers."""

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
from lerobot.datasets import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import get_policy_class
from small_policies import (
    TABLE_LENGTH,
    TABLE_TASKS,
    TASKS,
    batch_of,
    demos_of,
    hold_in_memory,
    observation,
    small_policy,
    with_chunks,
)

from lerobot_deltaco.data.reading import open_dataset
from lerobot_deltaco.policies.base import modeling as base_policy
from lerobot_deltaco.policies.base.networks import BACKBONES
from lerobot_deltaco.policies.deltaco.configuration_deltaco import METHODS

VARIANTS = [
    *(("deltaco", {"method": method}) for method in METHODS),
    ("deltaco", {"film": "demo+language", "concat": "none"}),
    ("deltaco", {"film": "none", "concat": "none", "encoder_loss": "none"}),
    ("deltaco", {"film": "none", "concat": "demo+language"}),
    ("deltaco", {"film": "language", "concat": "demo"}),
    ("deltaco", {"encoder_loss": "cosine"}),
    ("deltaco", {"encoder_loss": "none"}),
    ("deltaco", {"demo_rows": 2}),
    ("deltaco", {"demo_encoder": "attention"}),
    ("deltaco", {"demo_encoder": "attention", "demo_rows": 2, "num_mixture_components": 3}),
    ("deltaco", {"gripper": "none"}),
    ("deltaco", {"gripper_loss": "cross_entropy", "language_head": [8]}),
    ("deltaco", {"language_encoder": "all-distilroberta-v1"}),
    ("deltaco", {"precision": "bfloat16", "grad_clip_norm": 1.0}),
    ("deltaco", {"chunk_size": 4, "n_action_steps": 3}),
    ("deltaco_match", {"acting": "network"}),
    ("deltaco_match", {"acting": "network", "chunk_size": 3, "n_action_steps": 1}),
    ("deltaco_match", {"acting": "network", "precision": "bfloat16", "n_demonstrations": 2}),
    ("deltaco_match", {"frames_after_release": None, "num_mixture_components": 1}),
]
# Frames that are trained on, of all tasks.
FRAMES = {"deltaco": [0, 7, 16, 22, 29], "deltaco_match": list(range(0, 20 * TABLE_LENGTH, TABLE_LENGTH + 1))}


@pytest.fixture(scope="module")
def short_table(table):
    """As many episodes of the table as `deltaco_match` needs."""
    return hold_in_memory(LeRobotDataset(table.repo_id, root=table.root), episodes=list(range(24)))


# Opening a dataset takes longer than a training step.
open_once = functools.cache(open_dataset)


@pytest.fixture(params=VARIANTS, ids=lambda variant: f"{variant[0]}-{variant[1]}")
def make(request, dataset, short_table, fake_language, short_fit, monkeypatch):
    """Makes the policy that is tested, its processors and its data, always with the same weights."""
    monkeypatch.setattr(base_policy, "open_dataset", open_once)
    policy_type, options = request.param
    data = {"deltaco": dataset, "deltaco_match": short_table}[policy_type]

    def make(with_demos=False):
        torch.manual_seed(0)
        demos = demos_of(data) if with_demos else {}
        policy, before, after = small_policy(data, policy_type, **demos, **options)
        return SimpleNamespace(
            policy=policy,
            config=policy.config,
            before=before,
            after=after,
            data=data,
            tasks=TASKS if policy_type == "deltaco" else TABLE_TASKS,
            batch=before(batch_of(with_chunks(data, policy.config), FRAMES[policy_type])),
        )

    return make


def optimizer_of(policy):
    """The optimizer that LeRobot makes for a policy."""
    config = TrainPipelineConfig(DatasetConfig("test/data"), policy=policy.config)
    config.optimizer = policy.config.get_optimizer_preset()
    return make_optimizer_and_scheduler(config, policy)[0]


def train(made, n_steps=2):
    """Trains on one batch. Returns the losses."""
    optimizer = optimizer_of(made.policy)
    losses = []
    for _ in range(n_steps):
        loss, _ = made.policy(made.batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.detach())
    return torch.stack(losses)


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]


def test_training_loss_has_gradients_and_leaves_the_batch_unchanged(make):
    made = make()
    kept, twin = copy.deepcopy(made.batch), copy.deepcopy(made.policy)
    loss, logged = made.policy(made.batch)
    loss.backward()
    assert loss.shape == ()
    assert torch.isfinite(loss)
    assert {"action_nll", "action_mse"} <= set(logged)
    assert ("gripper_accuracy" in logged) == (made.config.gripper_index is not None)
    if made.config.type == "deltaco":
        assert ("demo_accuracy" in logged) == (made.config.conditioning.encoder_loss != "none")
    assert any(parameter.grad.any() for parameter in made.policy.get_optim_params())
    assert_same(kept, made.batch)
    each, _ = twin(made.batch, reduction="none")
    assert each.shape == (len(kept["task"]),)
    torch.testing.assert_close(each.mean(), loss.detach(), rtol=1e-5, atol=1e-5)


def test_acting_in_batches_of_any_size_leaves_the_batch_unchanged(make):
    made = make()
    made.policy(made.batch)
    made.policy.eval()
    for tasks in (made.tasks[:1], made.tasks):
        made.policy.reset()
        batch = made.before(observation(made.data, tasks))
        kept = copy.deepcopy(batch)
        chunk = made.policy.predict_action_chunk(batch)
        assert chunk.shape == (len(tasks), made.config.chunk_size, 3)
        assert torch.isfinite(made.after(chunk)).all()
        first, second = (made.policy.select_action(batch) for _ in range(2))
        assert torch.equal(first, chunk[:, 0])
        if (made.config.n_action_steps or made.config.chunk_size) > 1:
            assert torch.equal(second, chunk[:, 1])
        assert_same(kept, batch)
    # The first sample acts as it does alone, also where LeRobot's training evaluates in bfloat16.
    alone = made.before(observation(made.data, made.tasks[:1]))
    for together in (False, True):
        made.policy.reset()
        with torch.autocast("cpu", torch.bfloat16):
            found = made.policy.select_action(batch if together else alone)
        torch.testing.assert_close(found[:1], first[:1], rtol=0, atol=1e-5)


def test_optimizer_changes_every_weight_of_the_networks(make):
    made = make()
    policy = made.policy
    policy(made.batch)  # by now, all that is read later is there
    (group,) = optimizer_of(policy).param_groups
    trained = {id(parameter) for parameter in policy.get_optim_params()}
    assert {id(parameter) for parameter in group["params"]} == trained
    # Neither demonstrations nor embeddings are weights: a checkpoint of the networks stays small.
    assert not any("demonstrations" in name or "bank" in name for name in policy.state_dict())
    before = {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}
    train(made, n_steps=4)
    for name, parameter in policy.named_parameters():
        assert torch.equal(parameter, before[name]) == (id(parameter) not in trained), name


def test_same_seed_gives_the_same_result_to_the_bit(make):
    results = []
    for _ in range(2):
        made = make()
        losses = train(made)
        made.policy.eval()
        torch.manual_seed(99)  # draws do not depend on the global generator
        action = made.policy.select_action(made.batch)
        results.append({"losses": losses, **made.policy.state_dict(), "action": action})
    assert_same(*results)


def test_checkpoint_acts_the_same_to_the_bit(make, tmp_path):
    made = make(with_demos=True)
    train(made, n_steps=1)
    made.policy.eval()
    batch = made.before(observation(made.data, made.tasks))
    action = made.policy.select_action(batch)
    made.policy.save_pretrained(tmp_path)
    loaded = get_policy_class(made.config.type).from_pretrained(tmp_path)
    assert not loaded.training
    assert_same(loaded.state_dict(), made.policy.state_dict())
    assert torch.equal(loaded.select_action(batch), action)
    # It does not need the dataset of its demonstrations any more.
    made.config.demo_repo_id = made.config.demo_root = None
    assert loaded.config == PreTrainedConfig.from_pretrained(tmp_path) == made.config


def weights_of(policy, prefix):
    return {
        name.removeprefix(prefix): value.numpy().astype(np.float64)
        for name, value in policy.state_dict().items()
        if name.startswith(prefix)
    }


@pytest.mark.usefixtures("fake_language")
@pytest.mark.parametrize("method", METHODS)
def test_loss_matches_the_papers_formulas(dataset, method):
    # Each of these samples has exactly one episode that can demonstrate it.
    samples, rows, task = [16, 22, 27], [4, 3, 5], np.array([0, 0, 1])
    policy, before, _ = small_policy(dataset, method=method, shift_padding=0, demo_shift_padding=0)
    batch = before(batch_of(dataset, samples))
    distinct = list(dict.fromkeys(batch["task"]))
    loss, _ = policy(batch, reduction="none")

    stride = BACKBONES["strided"]
    images = policy._images(batch).numpy().astype(np.float64)
    state = batch["observation.state"].numpy().astype(np.float64)
    action = batch["action"].numpy().astype(np.float64)
    known = policy.instructions(distinct, "cpu").numpy().astype(np.float64)
    demo = None
    if policy.config.uses_demonstrations:
        frames = policy.training_data.demonstrations.frames[rows].numpy() / 255
        demo = reference.encoder(weights_of(policy, "demo_encoder."), frames, 1, stride.demo_stride)
    model = weights_of(policy, "policy_network.")
    imitation = functools.partial(
        reference.imitation_loss,
        raw_log_std=model["raw_log_std"][0, 0],
        action=action[:, [0, 2]],
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
