"""Actions as motions and a gripper: taken apart, put together, and the loss of predicted ones."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_deltaco.policy.losses import gripper_loss, mixture_negative_log_likelihood
from lerobot_deltaco.policy.networks import Motion


def split_action(action: Tensor, gripper_index: int | None) -> tuple[Tensor, Tensor | None]:
    """The motion of an action, and its gripper in 0..1 if it has one.

    Args:
        action: (batch, action), -1..1.
        gripper_index: The gripper's dimension of the action; None without a gripper.

    Returns:
        (batch, action - 1) and (batch,); without a gripper, the action and None.
    """
    if gripper_index is None:
        return action, None
    motion = torch.cat([action[:, :gripper_index], action[:, gripper_index + 1 :]], dim=1)
    return motion, (action[:, gripper_index] + 1) / 2


def join_action(motion: Tensor, gripper: Tensor | None, gripper_index: int | None) -> Tensor:
    """The inverse of `split_action`.

    Args:
        motion: (batch, action - 1); the whole action without a gripper.
        gripper: (batch,) in 0..1; None without a gripper.
        gripper_index: The gripper's dimension of the action; None without a gripper.

    Returns:
        (batch, action).
    """
    if gripper_index is None or gripper is None:
        return motion
    return torch.cat([motion[:, :gripper_index], 2 * gripper[:, None] - 1, motion[:, gripper_index:]], dim=1)


def policy_loss(
    predicted: Motion,
    gripper: Tensor | None,
    log_std: Tensor,
    action: Tensor,
    gripper_index: int | None,
    gripper_weight: float | None,
    gripper_loss_kind: str,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The policy loss L_pi (the paper's equation 2), in single precision.

    Args:
        predicted: Distributions of the samples' motions.
        gripper: Logit of each gripper, (batch,); None without a gripper.
        log_std: (dims,) or (modes, dims), the same for all samples.
        action: Actions of the expert, (batch, action), -1..1.
        gripper_index: The gripper's dimension of the action; None without a gripper.
        gripper_weight: Weight of the gripper's loss; None without a gripper.
        gripper_loss_kind: Kind of the gripper's loss, as in `gripper_loss`.

    Returns:
        The loss of each sample, (batch,), and its parts to log, each of shape ().
    """
    motion, target = split_action(action.float(), gripper_index)
    likelihood = mixture_negative_log_likelihood(
        predicted.means.float(), predicted.logits.float(), log_std.float(), motion
    )
    error = (predicted.mean.float() - motion).square()
    logged = {"motion_nll": likelihood.mean(), "motion_mse": error.mean()}
    if gripper is None:
        return likelihood, logged
    assert target is not None
    assert gripper_weight is not None
    error = gripper_loss(gripper.float(), target, gripper_loss_kind)
    logged["gripper_loss"] = error.mean()
    logged["gripper_accuracy"] = ((gripper > 0) == (target > 0.5)).float().mean()
    return likelihood + gripper_weight * error, logged
