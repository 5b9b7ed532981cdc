"""A random configuration of a policy works, or is refused by an error that names an option."""

import random
import re

import pytest
import torch
from small_policies import batch_of, small_policy

# Options, with values that are valid alone and others.
COMMON = {
    "image_size": [16, 24, 8],
    "num_mixture_components": [1, 5, 0],
    "gripper_closed": ["low", "x"],
    "demo_camera": [None, "observation.images.none"],
    "precision": ["float32", "bfloat16", "int8"],
    "optimizer_lr": [3e-4, 0.0],
    "grad_clip_norm": [0.0, 1.0, -1.0],
}
OPTIONS = {
    "deltaco": {
        "method": ["deltaco", "language_only", "demo_only", "one_hot", "bc_z", "mcil", "best"],
        "film": [None, "none", "demo", "language", "demo+language", "x"],
        "concat": [None, "none", "demo", "language"],
        "encoder_loss": [None, "contrastive", "cosine", "none"],
        "demo_encoder": ["cnn", "attention", "vit"],
        "demo_rows": [1, 2, 0],
        "gripper_loss": ["squared_error", "cross_entropy"],
        "shift_padding": [0, 4, -1],
        "language_head": [None, [8], [0]],
        "gripper": ["auto", "2", "0", "none", "7", "left"],
        "training_episodes": [None, [0, 1, 5], [99]],
        "scheduler_name": ["constant", "cosine", "linear"],
    },
    "deltaco_match": {
        "gripper": ["auto", "2", "7", "left"],
        "grasp_height_bias": [0.0, 0.75, 99],
        "location_noise": [0.0, 0.01, -1],
        "state_noise": [0.0, 0.5, -1],
        "p_color_jitter": [0.0, 0.5, 1.5],
        "frames_after_release": [None, 2, -1],
    },
}


@pytest.mark.usefixtures("fake_language", "short_fit")
@pytest.mark.parametrize("policy_type", OPTIONS)
def test_a_random_configuration_works_or_is_refused_by_name(dataset, table, policy_type):
    data = {"deltaco": dataset, "deltaco_match": table}[policy_type]
    values, rng = {**COMMON, **OPTIONS[policy_type]}, random.Random(0)
    batch = batch_of(data, [0, 7, 25])
    n_trained, refusals = 0, {}
    for _ in range(28):
        options = {name: rng.choice(values[name]) for name in rng.sample(sorted(values), 3)}
        try:
            policy, before, after = small_policy(data, policy_type, **options)
            loss, _ = policy(before(dict(batch)))
        except ValueError as error:
            refusals[str(options)] = str(error)
            continue
        loss.backward()
        policy.config.get_optimizer_preset().build(policy.get_optim_params()).step()
        policy.eval()
        seen = {name: value for name, value in batch.items() if name.startswith("observation.")}
        action = after(policy.select_action(before({**seen, "task": batch["task"]})))
        assert action.shape == (3, 3)
        assert torch.isfinite(action).all(), options
        n_trained += 1
    assert n_trained > 2
    for options, message in refusals.items():
        assert set(re.findall(r"`(\w+)", message)) & set(values), f"{options}: {message}"
