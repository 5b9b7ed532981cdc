"""The losses: of the paper (equations 1 and 2), of BC-Z, and of a mixture of Gaussians (ours)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policies.base.image_coordinates import gaussian_maps
from lerobot_deltaco.policies.base.networks import ActionDistribution

# Kinds of the gripper's loss, and their usual weights.
GRIPPER_LOSSES = {"squared_error": 30.0, "cross_entropy": 3.0}
_TARGET_STD = 0.8  # of the map that a location's logits are compared with, in cells


def gaussian_negative_log_likelihood(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """Returns -log N(target; mean, std²), summed over the dimensions of an action.

    Args:
        mean: Mean of the Gaussian, (..., dims).
        log_std: Logarithm of its standard deviation, (..., dims), to be broadcast.
        target: Action to be predicted, (..., dims), to be broadcast.

    Returns:
        Loss of each action, (...).
    """
    scaled = (target - mean) * torch.exp(-log_std)
    return (0.5 * scaled.square() + log_std + 0.5 * math.log(2 * math.pi)).sum(dim=-1)


def mixture_negative_log_likelihood(
    means: Tensor, logits: Tensor, log_std: Tensor, target: Tensor, valid: Tensor | None = None
) -> Tensor:
    """Returns -log of a mixture of Gaussians at chunks of actions.

    Args:
        means: Means of the components, (batch, components, steps, dims).
        logits: Logits of the components, (batch, components).
        log_std: Logarithm of the standard deviation, (components, steps, dims), the same for all samples.
        target: Actions to be predicted, (batch, steps, dims).
        valid: Steps that count, (batch, steps) bool; None for all.

    Returns:
        Loss of each sample, (batch,).
    """
    each = gaussian_negative_log_likelihood(means, log_std, target[:, None])  # (batch, components, steps)
    if valid is not None:
        each = each * valid[:, None]
    return -torch.logsumexp(logits.log_softmax(dim=1) - each.sum(dim=2), dim=1)


def gripper_loss(logit: Tensor, target: Tensor, kind: str) -> Tensor:
    """Returns the loss of the gripper, the sigmoid of a logit, against its target.

    Args:
        logit: Logits, (...).
        target: Gripper commands, (...) in 0..1.
        kind: "squared_error", the paper's, or "cross_entropy".

    Returns:
        Loss of each, (...).
    """
    if kind == "squared_error":
        return (torch.sigmoid(logit) - target).square()
    return F.binary_cross_entropy_with_logits(logit, target, reduction="none")


def contrastive_logits(demo: Tensor, language: Tensor, temperature: float) -> Tensor:
    """Returns the similarity of each demonstration to each instruction: the logits of equation 1.

    Args:
        demo: Unit embeddings of the samples' demonstrations, (batch, embedding).
        language: Unit embeddings of the distinct instructions in the batch, (tasks, embedding).
        temperature: Number by which the cosines are divided.

    Returns:
        (batch, tasks). The paper has one demonstration for each task, which makes this square.
    """
    return demo @ language.T / temperature


def contrastive_loss(logits: Tensor, task: Tensor) -> Tensor:
    """Returns the cross-entropy of each demonstration's own instruction among those of the batch.

    Args:
        logits: Similarity of each demonstration to each instruction, (batch, tasks).
        task: Column of each sample's own instruction, (batch,) int64.

    Returns:
        Loss of each sample, (batch,).
    """
    return F.cross_entropy(logits, task, reduction="none")


def cosine_loss(demo: Tensor, language: Tensor) -> Tensor:
    """Returns 1 - cosine of each demonstration and its own instruction, as in BC-Z.

    Args:
        demo: Unit embeddings of the samples' demonstrations, (batch, embedding).
        language: Unit embeddings of the samples' own instructions, (batch, embedding).

    Returns:
        Loss of each sample, (batch,).
    """
    return 1 - (demo * language).sum(dim=-1)


def location_loss(logits: Tensor, locations: Tensor) -> Tensor:
    """Returns the cross-entropy of maps and a small Gaussian around the right locations.

    Args:
        logits: Maps, (batch, locations, h, w).
        locations: Right locations in -1..1, (batch, locations, 2).

    Returns:
        Loss of each location, (batch, locations).
    """
    height, width = logits.shape[-2:]
    std = 2 * _TARGET_STD / torch.tensor([width, height], device=logits.device)
    targets = gaussian_maps(locations, height, width, std).flatten(2)
    targets = targets / targets.sum(dim=2, keepdim=True).clamp_min(1e-6)
    return -(targets * logits.flatten(2).log_softmax(dim=2)).sum(dim=2)


def imitation_loss(
    predicted: ActionDistribution,
    gripper: Tensor | None,
    log_std: Tensor,
    action: Tensor,
    is_pad: Tensor | None,
    gripper_index: int | None,
    gripper_kind: str,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Returns the imitation loss L_pi (equation 2), in single precision; of a chunk, the mean over its steps.

    Args:
        predicted: Distributions of the samples' actions.
        gripper: Logits of the grippers, (batch, steps); None without a gripper.
        log_std: (components, steps, dims), the same for all samples.
        action: Actions of the expert, (batch, steps, action) in -1..1, or (batch, action) for one step. Steps
            beyond those that are predicted do not count.
        is_pad: Steps beyond the end of the episode, which do not count, (batch, steps) bool; None for none.
        gripper_index: The gripper's dimension of the action; None without a gripper.
        gripper_kind: Kind of the gripper's loss, one of `GRIPPER_LOSSES`.

    Returns:
        Loss of each sample, (batch,), and its parts to log, each of shape ().
    """
    n_predicted = predicted.means.shape[2]
    action = action.float()[:, :n_predicted] if action.ndim == 3 else action.float()[:, None]
    valid = torch.ones_like(action[..., 0])  # (batch, steps)
    if is_pad is not None:
        valid = 1.0 - is_pad[:, :n_predicted].float()
    n_steps = valid.sum(dim=1)  # at least the current one
    motion, target = split_action(action, gripper_index)
    likelihood = mixture_negative_log_likelihood(
        predicted.means.float(), predicted.logits.float(), log_std.float(), motion, valid
    )
    likelihood = likelihood / n_steps
    error = (predicted.mode.float() - motion).square().mean(dim=2) * valid
    logged = {"action_nll": likelihood.mean(), "action_mse": error.sum() / n_steps.sum()}
    if gripper is None or target is None:
        return likelihood, logged
    error = (gripper_loss(gripper.float(), target, gripper_kind) * valid).sum(dim=1) / n_steps
    is_right = ((gripper > 0) == (target > 0.5)) * valid
    logged["gripper_loss"] = error.mean()
    logged["gripper_accuracy"] = is_right.sum() / n_steps.sum()
    return likelihood + GRIPPER_LOSSES[gripper_kind] * error, logged


def split_action(action: Tensor, gripper_index: int | None) -> tuple[Tensor, Tensor | None]:
    """Splits actions (..., action) in -1..1 into the rest and the gripper in 0..1.

    Args:
        action: (..., action), -1..1.
        gripper_index: The gripper's dimension of the action; None without a gripper.

    Returns:
        (..., action - 1) and (...); without a gripper, the action and None.
    """
    if gripper_index is None:
        return action, None
    rest = torch.cat([action[..., :gripper_index], action[..., gripper_index + 1 :]], dim=-1)
    return rest, (action[..., gripper_index] + 1) / 2


def join_action(rest: Tensor, gripper: Tensor | None, gripper_index: int | None) -> Tensor:
    """Joins what `split_action` splits: (..., action - 1) and (...) to (..., action)."""
    if gripper_index is None or gripper is None:
        return rest
    parts = [rest[..., :gripper_index], 2 * gripper[..., None] - 1, rest[..., gripper_index:]]
    return torch.cat(parts, dim=-1)
