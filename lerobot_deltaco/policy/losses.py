"""The losses: of the paper (equations 1 and 2), of BC-Z, and of a mixture of Gaussians (ours)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor


def gaussian_negative_log_likelihood(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """-log N(target; mean, std²), summed over the dimensions of an action.

    Args:
        mean: Mean of the Gaussian, (..., dims).
        log_std: Logarithm of its standard deviation, (..., dims), to be broadcast.
        target: Action to be predicted, (..., dims), to be broadcast.

    Returns:
        Loss of each action, (...).
    """
    scaled = (target - mean) * torch.exp(-log_std)
    return (0.5 * scaled.square() + log_std + 0.5 * math.log(2 * math.pi)).sum(dim=-1)


def mixture_negative_log_likelihood(means: Tensor, logits: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """-log of a mixture of Gaussians at a target.

    Args:
        means: Means of the modes, (batch, modes, dims).
        logits: Logits of the modes, (batch, modes).
        log_std: Logarithm of the standard deviation, (dims,) or (modes, dims), the same for all samples.
        target: Action to be predicted, (batch, dims).

    Returns:
        Loss of each sample, (batch,).
    """
    each = gaussian_negative_log_likelihood(means, log_std, target[:, None])  # (batch, modes)
    return -torch.logsumexp(logits.log_softmax(dim=1) - each, dim=1)


def gripper_loss(logit: Tensor, target: Tensor, kind: str) -> Tensor:
    """Loss of the gripper, the sigmoid of a logit, against its target.

    Args:
        logit: Logit of each sample, (batch,).
        target: Gripper command of each sample, (batch,) in 0..1.
        kind: Loss function: "squared_error", the paper's, or "cross_entropy".

    Returns:
        Loss of each sample, (batch,).
    """
    if kind == "squared_error":
        return (torch.sigmoid(logit) - target).square()
    return F.binary_cross_entropy_with_logits(logit, target, reduction="none")


def contrastive_logits(demo: Tensor, language: Tensor, temperature: float) -> Tensor:
    """Similarity of each demonstration to each instruction: the logits of the paper's equation 1.

    Args:
        demo: Unit embeddings of the samples' demonstrations, (batch, embedding).
        language: Unit embeddings of the distinct instructions in the batch, (tasks, embedding).
        temperature: Number by which the cosines are divided.

    Returns:
        (batch, tasks). The paper has one demonstration for each task, which makes this square.
    """
    return demo @ language.T / temperature


def contrastive_loss(logits: Tensor, task: Tensor) -> Tensor:
    """Cross-entropy of each demonstration's own instruction among those of the batch.

    Args:
        logits: Similarity of each demonstration to each instruction, (batch, tasks).
        task: Column of each sample's own instruction, (batch,) int64.

    Returns:
        Loss of each sample, (batch,).
    """
    return F.cross_entropy(logits, task, reduction="none")


def cosine_loss(demo: Tensor, language: Tensor) -> Tensor:
    """1 - cosine of each demonstration and its own instruction, as in BC-Z.

    Args:
        demo: Unit embeddings of the samples' demonstrations, (batch, embedding).
        language: Unit embeddings of the samples' own instructions, (batch, embedding).

    Returns:
        Loss of each sample, (batch,).
    """
    return 1 - (demo * language).sum(dim=-1)
