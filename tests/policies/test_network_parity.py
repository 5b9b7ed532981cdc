"""Networks and losses give the numbers of the paper's formulas, computed in NumPy."""

import numpy as np
import numpy_reference as reference
import pytest
import torch

from lerobot_deltaco.policies.base.losses import (
    contrastive_logits,
    contrastive_loss,
    cosine_loss,
    gaussian_negative_log_likelihood,
    gripper_loss,
    mixture_negative_log_likelihood,
)
from lerobot_deltaco.policies.base.networks import PolicyNetwork
from lerobot_deltaco.policies.deltaco.demo_encoders import FrameGridEncoder

TOLERANCE = {"rtol": 1e-5, "atol": 1e-5}
BATCH, CAMERAS, HEIGHT, WIDTH = 3, 2, 12, 16
FILM_DIM, CONCAT_DIM, EMBEDDING_DIM = 5, 4, 6


def drawn_weights(module, seed=0):
    """Sets weights that NumPy draws. Returns them by name, in double precision."""
    rng = np.random.default_rng(seed)
    weights = {}
    for name, tensor in sorted(module.state_dict().items()):
        shape = tuple(tensor.shape)
        if name.endswith("running_var"):
            weights[name] = rng.uniform(0.5, 2, shape)
        elif name.endswith("num_batches_tracked"):
            weights[name] = np.array(1)
        else:
            size = np.prod(shape[1:]) if len(shape) > 1 else 4
            weights[name] = rng.normal(size=shape) / np.sqrt(size)
    # Rounded to single precision, so that both compute with the same numbers.
    weights = {name: value.astype(np.float32) for name, value in weights.items()}
    dtypes = {name: tensor.dtype for name, tensor in module.state_dict().items()}
    module.load_state_dict({name: torch.tensor(value).to(dtypes[name]) for name, value in weights.items()})
    return {name: value.astype(np.float64) for name, value in weights.items()}


def drawn(*shape, seed):
    values = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    return values.astype(np.float64), torch.tensor(values)


@pytest.mark.parametrize("training", [True, False], ids=["training", "acting"])
@pytest.mark.parametrize(
    ("film_dim", "concat_dim", "has_gripper", "stem_stride"),
    [(FILM_DIM, CONCAT_DIM, True, 1), (FILM_DIM, 0, True, 2), (0, CONCAT_DIM, False, 1)],
    ids=["both", "film, strided", "concatenated, no gripper"],
)
def test_policy_network_matches_formulas(training, film_dim, concat_dim, has_gripper, stem_stride):
    network = PolicyNetwork(
        n_cameras=CAMERAS,
        film_dim=film_dim,
        concat_dim=concat_dim,
        action_dim=3,
        has_gripper=has_gripper,
        channels=(4, 4, 6),
        stem_stride=stem_stride,
        hidden_dims=(9, 8, 7),
        gripper_hidden_dim=4,
    ).train(training)
    weights = drawn_weights(network)
    images, image_tensor = drawn(BATCH, CAMERAS, 3, HEIGHT, WIDTH, seed=1)
    film, film_tensor = drawn(BATCH, film_dim, seed=2) if film_dim else (None, None)
    concat, concat_tensor = drawn(BATCH, concat_dim, seed=3) if concat_dim else (None, None)
    expected, expected_gripper = reference.network(weights, images, film, concat, stem_stride, training)
    with torch.no_grad():
        predicted, gripper = network(image_tensor, film_tensor, concat_tensor)
    assert np.abs(expected).max() > 0.1  # else this would test nothing
    np.testing.assert_allclose(predicted.mode[:, 0].numpy(), expected, **TOLERANCE)
    if has_gripper:
        np.testing.assert_allclose(gripper[:, 0].numpy(), expected_gripper, **TOLERANCE)
    else:
        assert gripper is None
        assert expected_gripper is None
    expected_std = reference.log_std(weights["raw_log_std"])
    np.testing.assert_allclose(network.log_std.detach().numpy(), expected_std, **TOLERANCE)


@pytest.mark.parametrize(("rows", "columns", "stride"), [(1, 2, 1), (2, 2, 1), (1, 3, 2)])
def test_demonstration_encoder_matches_formulas(rows, columns, stride):
    encoder = FrameGridEncoder(
        HEIGHT, WIDTH, rows, columns, EMBEDDING_DIM, stride=stride, channels=4, hidden_dims=(9, 8)
    )
    weights = drawn_weights(encoder)
    frames, frame_tensor = drawn(BATCH, rows * columns, 3, HEIGHT, WIDTH, seed=1)
    expected = reference.encoder(weights, frames, rows, stride)
    assert np.ptp(expected, axis=0).max() > 1e-3  # it depends on the frames
    with torch.no_grad():
        np.testing.assert_allclose(encoder(frame_tensor).numpy(), expected, **TOLERANCE)


def test_likelihood_of_an_action_matches_formula():
    mean, mean_tensor = drawn(BATCH, 3, seed=1)
    target, target_tensor = drawn(BATCH, 3, seed=2)
    log_std, log_std_tensor = drawn(3, seed=3)
    expected = -reference.normal_log_density(mean, log_std, target)
    found = gaussian_negative_log_likelihood(mean_tensor, log_std_tensor, target_tensor)
    np.testing.assert_allclose(found.numpy(), expected, **TOLERANCE)


@pytest.mark.parametrize("n_components", [1, 4])
def test_likelihood_of_a_mixture_of_steps_matches_formula(n_components):
    n_steps = 2
    means, mean_tensor = drawn(BATCH, n_components, n_steps, 3, seed=1)
    target, target_tensor = drawn(BATCH, n_steps, 3, seed=2)
    log_std, log_std_tensor = drawn(n_components, n_steps, 3, seed=3)
    logits, logit_tensor = drawn(BATCH, n_components, seed=4)
    probabilities = np.exp(reference.log_softmax(logits))
    densities = np.exp(reference.normal_log_density(means, log_std, target[:, None]).sum(axis=2))
    found = mixture_negative_log_likelihood(mean_tensor, logit_tensor, log_std_tensor, target_tensor)
    np.testing.assert_allclose(found.numpy(), -np.log((probabilities * densities).sum(axis=1)), **TOLERANCE)


def test_gripper_losses_match_formulas():
    logit, logit_tensor = drawn(BATCH, seed=1)
    target, target_tensor = drawn(BATCH, seed=2)
    target, target_tensor = (target + 1) / 2, (target_tensor + 1) / 2
    probability = reference.sigmoid(logit)
    squared = gripper_loss(logit_tensor, target_tensor, "squared_error")
    np.testing.assert_allclose(squared.numpy(), (probability - target) ** 2, **TOLERANCE)
    entropy = gripper_loss(logit_tensor, target_tensor, "cross_entropy")
    expected = -(target * np.log(probability) + (1 - target) * np.log(1 - probability))
    np.testing.assert_allclose(entropy.numpy(), expected, **TOLERANCE)


def test_encoder_losses_match_formulas():
    demo, language = (reference.unit(drawn(n, EMBEDDING_DIM, seed=n)[0]) for n in (5, 3))
    task = np.array([0, 2, 1, 1, 0])
    demo_tensor, language_tensor = torch.tensor(demo), torch.tensor(language)
    logits = contrastive_logits(demo_tensor, language_tensor, 0.1)
    found = contrastive_loss(logits, torch.tensor(task))
    np.testing.assert_allclose(
        found.numpy(), reference.contrastive_loss(demo, language, task, 0.1), **TOLERANCE
    )
    found = cosine_loss(demo_tensor, language_tensor[task])
    cosines = [a @ b for a, b in zip(demo, language[task], strict=True)]  # of unit vectors
    np.testing.assert_allclose(found.numpy(), 1 - np.array(cosines), **TOLERANCE)
