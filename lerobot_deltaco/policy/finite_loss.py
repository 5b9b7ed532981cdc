"""Stops a training whose numbers are not finite, before a checkpoint of them is saved."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class TrainingDivergedError(FloatingPointError):
    """The loss or the weights are not finite; the message says since when, and what the cause may be."""


class FiniteLoss:
    """Remembers the loss of the last training step, and checks it when the next one begins.

    Checking at once would make the CPU wait for the GPU in the middle of a step. The loop itself waits at the
    end of the step.
    """

    def __init__(self) -> None:
        self._loss: Tensor | None = None
        self._inputs_are_finite: Tensor | None = None
        self._step: Tensor | None = None
        self._names: tuple[str, ...] = ()

    def remember(self, loss: Tensor, inputs: dict[str, Tensor], step: Tensor) -> None:
        """Keeps the loss of a step.

        Args:
            loss: The loss, of any shape.
            inputs: Actions and states of the batch, by name.
            step: Number of the step, from 1, of shape ().
        """
        self._loss = loss.detach()
        self._inputs_are_finite = torch.stack(
            [torch.isfinite(values).all() for values in inputs.values()]
        ).all()
        self._names = tuple(inputs)
        self._step = step.clone()

    def check(self) -> None:
        """Checks the loss that was kept.

        Raises:
            TrainingDivergedError: It is not finite.
        """
        loss, self._loss = self._loss, None
        if loss is None or bool(torch.isfinite(loss).all()):
            return
        assert self._inputs_are_finite is not None
        assert self._step is not None
        if not bool(self._inputs_are_finite):
            names = " or ".join(f"`{name}`" for name in self._names)
            cause = (
                f"In its batch, {names} had numbers that are not finite: the dataset or its statistics are "
                "damaged."
            )
        else:
            cause = (
                "The batch was finite, so the training has diverged: lower --policy.optimizer_lr, or limit "
                "the gradient with --policy.grad_clip_norm=10."
            )
        value = loss.float().mean().item()
        raise TrainingDivergedError(
            f"The loss of training step {int(self._step)} is not finite ({value}). {cause} "
            "A checkpoint that was saved is from before that: go on from it with --resume=true."
        )


def check_weights_to_save(module: nn.Module, step: int) -> None:
    """Checks that what is about to be saved can be used.

    Args:
        module: The trained module.
        step: The training step, for the message.

    Raises:
        TrainingDivergedError: A weight is not finite.
    """
    name = non_finite_weight(module)
    if name is not None:
        raise TrainingDivergedError(
            f"After training step {step}, the weight {name} is not finite: the training has diverged, and no "
            "checkpoint is saved. Lower --policy.optimizer_lr, or limit the gradient with "
            "--policy.grad_clip_norm=10, and go on from the last checkpoint with --resume=true."
        )


def non_finite_weight(module: nn.Module) -> str | None:
    """The name of a weight with a number that is not finite; None if there is none."""
    for name, tensor in module.state_dict().items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            return name
    return None
