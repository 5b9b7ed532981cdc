"""The robot's state as the networks get it: without the noise of joints that hardly move."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

logger = logging.getLogger(__name__)

# Least standard deviation of a dimension of the state, as a fraction of the median of all.
MIN_STD_FRACTION = 0.03
MAX_STATE = 5.0  # in standard deviations
_P_NOISE = 0.5  # probability that a number gets noise in training


class StateLimits(nn.Module):
    """Limits normalized states.

    A joint that hardly moves in the training data has a tiny standard deviation, by which its noise is
    divided: it would decide the action. So no dimension is divided by less than 3 % of the median of the
    standard deviations. States beyond 5 standard deviations are clipped.

    Args:
        state_dim: Size of the robot's state.
        stats: Statistics of the training dataset; None in evaluation, where the weights are loaded.

    Attributes:
        scale: Factors of the dimensions, (state,): 1, or less for one that hardly moves.
    """

    scale: Tensor

    def __init__(self, state_dim: int, stats: Mapping[str, Mapping[str, Any]] | None) -> None:
        super().__init__()
        scale = torch.ones(state_dim)
        if state_dim and stats is not None and "std" in stats.get(OBS_STATE, {}):
            std = torch.as_tensor(stats[OBS_STATE]["std"]).float().reshape(state_dim)
            least = MIN_STD_FRACTION * std.median()
            scale = torch.where(std < least, std / least, 1.0)
            still = (scale < 1).nonzero().flatten().tolist()
            if still:
                logger.warning(
                    "In the training data, %s of the robot's state hardly %s. %.2g stands in for the "
                    "smaller standard deviation.",
                    f"the dimensions {', '.join(map(str, still))}" if still[1:] else f"dimension {still[0]}",
                    "move" if still[1:] else "moves",
                    least.item(),
                )
        self.register_buffer("scale", scale)

    def forward(self, states: Tensor) -> Tensor:
        """Maps normalized states, (..., state), to limited ones."""
        return (states * self.scale).clamp(-MAX_STATE, MAX_STATE)

    def add_noise(self, states: Tensor, noise: float, generator: torch.Generator) -> Tensor:
        """Adds noise to limited states (batch, state) in training, so that no number alone decides.

        Half of the numbers get little noise; dimensions that hardly move get more than they move.

        Args:
            states: Limited states, (batch, state).
            noise: Standard deviation of the noise.
            generator: Source of the draws, on the CPU.
        """
        std = torch.maximum(1 - self.scale, self.scale.new_tensor(noise))
        is_noisy = torch.rand(states.shape, generator=generator) < _P_NOISE
        drawn = torch.randn(states.shape, generator=generator) * is_noisy
        return states + std * drawn.to(states)
