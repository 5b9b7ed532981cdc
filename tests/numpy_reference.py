"""The paper's formulas in NumPy and double precision, written from the paper, not from the tested code.

Only the names of weights are those of the networks.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

BATCH_NORM_EPSILON = 1e-5


def convolution(x, weight, bias=None, stride=1, padding=0):
    """(batch, in, h, w) with (out, in, k, k): the sum over each window."""
    x = np.pad(x, [(0, 0), (0, 0), (padding, padding), (padding, padding)])
    windows = sliding_window_view(x, weight.shape[2:], axis=(2, 3))[:, :, ::stride, ::stride]
    y = np.einsum("bchwij,ocij->bohw", windows, weight, optimize=True)
    return y if bias is None else y + bias[:, None, None]


def max_pool(x, size, stride, padding=0):
    x = np.pad(x, [(0, 0), (0, 0), (padding, padding), (padding, padding)], constant_values=-np.inf)
    return sliding_window_view(x, (size, size), axis=(2, 3))[:, :, ::stride, ::stride].max(axis=(-2, -1))


def relu(x):
    return np.maximum(x, 0)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def log_softmax(x):
    shifted = x - x.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def batch_norm(x, weights, name, training):
    """Normalized by the batch's statistics in training, and by the running ones after it."""
    if training:
        mean, variance = x.mean(axis=(0, 2, 3)), x.var(axis=(0, 2, 3))
    else:
        mean, variance = weights[f"{name}.running_mean"], weights[f"{name}.running_var"]
    scale = weights[f"{name}.weight"] / np.sqrt(variance + BATCH_NORM_EPSILON)
    return (x - mean[:, None, None]) * scale[:, None, None] + weights[f"{name}.bias"][:, None, None]


def fully_connected(x, weights, name):
    """Layers with ReLU between them; `name` has them at the even indices."""
    layers = sorted(
        int(key.removeprefix(f"{name}.").split(".")[0])
        for key in weights
        if key.startswith(f"{name}.") and key.endswith(".weight")
    )
    for layer in layers:
        x = x @ weights[f"{name}.{layer}.weight"].T + weights[f"{name}.{layer}.bias"]
        if layer != layers[-1]:
            x = relu(x)
    return x


def spatial_softmax(maps):
    """The mean location under each map's softmax, in -1..1: all x, then all y."""
    batch, channels, height, width = maps.shape
    softmax = np.exp(log_softmax(maps.reshape(batch, channels, -1))).reshape(maps.shape)
    x = (softmax * np.linspace(-1, 1, width)).sum(axis=(2, 3))
    y = (softmax * np.linspace(-1, 1, height)[:, None]).sum(axis=(2, 3))
    return np.concatenate([x, y], axis=1)


def film(x, embedding, weights, name):
    """(1 + gamma) x + beta, with gamma and beta linear in the embedding."""
    projected = embedding @ weights[f"{name}.project.weight"].T + weights[f"{name}.project.bias"]
    gamma, beta = np.split(projected, 2, axis=1)
    return (1 + gamma)[:, :, None, None] * x + beta[:, :, None, None]


def network(weights, images, film_embedding, concatenated, stem_stride, training):
    """The policy's network (appendix B, figure 3).

    Args:
        weights: By name, of a `PolicyNetwork`.
        images: (batch, cameras, 3, h, w).
        film_embedding: (batch, embedding), or None.
        concatenated: (batch, numbers), or None.
        stem_stride: Of the first convolution.
        training: Whether batch norms use the batch's statistics.

    Returns:
        The outputs of the action's layers, (batch, outputs), and the gripper's logit, (batch,), or None.
    """
    batch, cameras = images.shape[:2]
    x = images.reshape(batch * cameras, *images.shape[2:])
    embedding = None if film_embedding is None else np.repeat(film_embedding, cameras, axis=0)
    x = convolution(x, weights["backbone.stem.0.weight"], stride=stem_stride, padding=3)
    x = max_pool(relu(batch_norm(x, weights, "backbone.stem.1", training)), 3, 2, 1)
    n_blocks = len({key.split(".")[2] for key in weights if key.startswith("backbone.blocks.")})
    for number in range(n_blocks):
        name = f"backbone.blocks.{number}"
        y = convolution(x, weights[f"{name}.conv1.weight"], padding=1)
        y = relu(batch_norm(y, weights, f"{name}.norm1", training))
        y = convolution(y, weights[f"{name}.conv2.weight"], padding=1)
        y = batch_norm(y, weights, f"{name}.norm2", training)
        if embedding is not None:
            y = film(y, embedding, weights, f"{name}.film")
        if f"{name}.shortcut.0.weight" in weights:
            x = convolution(x, weights[f"{name}.shortcut.0.weight"])
            x = batch_norm(x, weights, f"{name}.shortcut.1", training)
        x = relu(y + x)
    features = spatial_softmax(x).reshape(batch, -1)
    if concatenated is not None:
        features = np.concatenate([features, concatenated], axis=1)
    has_gripper = "gripper_head.0.weight" in weights
    gripper = fully_connected(features, weights, "gripper_head")[:, 0] if has_gripper else None
    return fully_connected(features, weights, "action_head"), gripper


def encoder(weights, frames, rows, stride):
    """The paper's demonstration encoder (appendix B), from (batch, frames, 3, h, w) to unit vectors."""
    batch, n_frames, channels, height, width = frames.shape
    columns = n_frames // rows
    array = np.zeros((batch, channels, rows * height, columns * width))
    for n in range(n_frames):
        row, column = divmod(n, columns)
        top, left = row * height, column * width
        array[:, :, top : top + height, left : left + width] = frames[:, n]
    x = array
    for layer, pooled in ((0, True), (3, True), (6, False)):
        weight, bias = weights[f"convolutions.{layer}.weight"], weights[f"convolutions.{layer}.bias"]
        x = relu(convolution(x, weight, bias, stride=stride if layer == 0 else 1, padding=1))
        x = max_pool(x, 2, 2) if pooled else x
    return unit(fully_connected(x.reshape(batch, -1), weights, "layers"))


def log_std(raw):
    """The learned standard deviation's logarithm, in (-6, 0)."""
    return -6 + 6 * sigmoid(raw)


def normal_log_density(mean, log_std, target):
    """log N(target; mean, exp(log_std)^2), summed over the dimensions of the action."""
    density = np.exp(-((target - mean) ** 2) / (2 * np.exp(log_std) ** 2)) / (
        np.exp(log_std) * np.sqrt(2 * np.pi)
    )
    return np.log(density).sum(axis=-1)


def imitation_loss(outputs, gripper, raw_log_std, action, gripper_target, gripper_weight):
    """L_pi of each sample: -log N, and the gripper's squared error."""
    loss = -normal_log_density(outputs, log_std(raw_log_std), action)
    if gripper is None:
        return loss
    return loss + gripper_weight * (sigmoid(gripper) - gripper_target) ** 2


def contrastive_loss(demo, language, task, temperature):
    """Cross-entropy of each demonstration's own instruction (equation 3, with one row for each sample)."""
    logits = demo @ language.T / temperature
    return -log_softmax(logits)[np.arange(len(task)), task]
