"""Scalars that a training step logs, which are copied from the device only when they are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor


class LoggedScalars:
    """Scalars by name, read like a dictionary of floats.

    They stay on the device until one of them is read. LeRobot reads them when the step is done, so that the
    backward pass is under way before anyone waits for the forward pass.

    It is not a `Mapping`, because accelerate rebuilds those value by value.

    Args:
        values: Tensors of shape ().
    """

    def __init__(self, values: Mapping[str, Tensor]) -> None:
        self._names = tuple(values)
        self._tensor = torch.stack([value.detach().float() for value in values.values()])
        self._floats: dict[str, float] | None = None

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __getitem__(self, name: str) -> float:
        return dict(self.items())[name]

    def keys(self) -> tuple[str, ...]:
        """Their names."""
        return self._names

    def items(self) -> list[tuple[str, float]]:
        """Names and values. The first time, this waits for the device."""
        if self._floats is None:
            self._floats = dict(zip(self._names, self._tensor.tolist(), strict=True))
        return list(self._floats.items())
