"""Estimates the height offset of a grasp, from the demonstration and from the object's appearance.

If the demonstration moved the same object, its height is the right one. If it moved another object of that
color or shape, the appearance of the object in the scene is a better guide. So two estimates are averaged,
weighted by the inverse of their variances. The variance of the estimate from the demonstration is learned,
from the kind of instruction and the similarity of the two objects. The variance of the other is fixed:
training objects have hardly any error to learn it from.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.networks import features_at

_HIDDEN_DIM = 64
_BOTTLENECK = 3
_MIN_LOG_STD, _MAX_LOG_STD = -3.0, 1.0
_CONDITION_NOISE = 0.02  # on each number of the condition in training, as in the correspondence network
# Standard deviation of the error of the estimate from appearance on novel objects; heights have one of 1.
_APPEARANCE_STD = 0.7


class GraspHeightEstimator(nn.Module):
    """Estimates the height offset of a grasp.

    Args:
        descriptor_dim: Size of the features of a location.
        condition_dim: Size of the embedding of the instruction, 0 for none.
        has_demonstration: Whether there is a demonstration.
    """

    def __init__(self, descriptor_dim: int, condition_dim: int, has_demonstration: bool) -> None:
        super().__init__()
        self.by_appearance = nn.Sequential(
            nn.Linear(descriptor_dim, _HIDDEN_DIM), nn.ReLU(inplace=True), nn.Linear(_HIDDEN_DIM, 1)
        )
        self.kind = self.demonstration_error = None
        if has_demonstration:
            if condition_dim:
                self.kind = nn.Sequential(nn.Linear(condition_dim, _BOTTLENECK), nn.Tanh())
            n_inputs = 1 + (_BOTTLENECK if condition_dim else 0)
            self.demonstration_error = nn.Sequential(
                nn.Linear(n_inputs, 16), nn.ReLU(inplace=True), nn.Linear(16, 1)
            )

    def losses(
        self,
        features: Tensor,
        locations: Tensor,
        heights: Tensor,
        descriptors: Tensor | None,
        demonstrated: Tensor | None,
        condition: Tensor | None,
        generator: torch.Generator,
    ) -> Tensor:
        """Returns the loss of each sample, (batch,).

        Args:
            features: Features of the scenes, (batch, descriptor_dim, h, w).
            locations: Locations of the grasps, (batch, 2).
            heights: Height offsets of the grasps, (batch,).
            descriptors: Features of what the demonstrations moved, (batch, descriptor_dim).
            demonstrated: Height offsets of the demonstrations, (batch,); NaN where they are not known.
            condition: Embeddings of the instructions, (batch, condition_dim).
            generator: Source of the noise, on the CPU.
        """
        here = features_at(features, locations[:, None])[:, 0]  # (batch, descriptor_dim)
        losses = 0.5 * (self.by_appearance(here.detach())[:, 0].float() - heights).square()
        if demonstrated is None:
            return losses
        if condition is not None:
            noise = torch.randn(condition.shape, generator=generator).to(condition)
            condition = condition + _CONDITION_NOISE * noise
        assert descriptors is not None
        log_std = self._log_std(here, descriptors, condition)
        known = ~demonstrated.isnan()
        error = torch.where(known, demonstrated - heights, 0.0) * torch.exp(-log_std)
        return losses + known * (0.5 * error.square() + log_std)

    def forward(
        self,
        features: Tensor,
        locations: Tensor,
        descriptors: Tensor | None,
        demonstrated: Tensor | None,
        condition: Tensor | None,
    ) -> Tensor:
        """Estimates height offsets, (batch,). The arguments are those of `losses`."""
        here = features_at(features, locations[:, None])[:, 0]
        by_appearance = self.by_appearance(here.detach())[:, 0].float()
        if demonstrated is None or descriptors is None:
            return by_appearance
        variance = torch.exp(2 * self._log_std(here, descriptors, condition))
        weight = _APPEARANCE_STD**2 / (_APPEARANCE_STD**2 + variance)
        weight = torch.where(demonstrated.isnan(), 0.0, weight)
        return weight * demonstrated.nan_to_num() + (1 - weight) * by_appearance

    def _log_std(self, here: Tensor, descriptors: Tensor, condition: Tensor | None) -> Tensor:
        """Returns the log standard deviation of the error of the demonstrations' estimate, (batch,).

        Its loss does not train the features, which have to tell objects apart.
        """
        assert self.demonstration_error is not None
        inputs = [F.cosine_similarity(here, descriptors, dim=1).detach().float()[:, None]]
        if self.kind is not None:
            inputs.append(self.kind(condition).float())
        log_std = self.demonstration_error(torch.cat(inputs, dim=1))[:, 0].float()
        return _MIN_LOG_STD + (_MAX_LOG_STD - _MIN_LOG_STD) * torch.sigmoid(log_std)
