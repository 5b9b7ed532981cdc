"""Estimates the height offset of a grasp, from the demonstration and from the object's appearance.

If the demonstration moved the same object, its height is the right one. If it moved another object of that
color or shape, the appearance of the object in the scene is a better guide. So two estimates are averaged,
weighted by the inverse of their variances. The variance of the estimate from the demonstration is learned,
from the similarity of the two objects. The variance of the other is fixed: training objects have hardly any
error to learn it from.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_MIN_LOG_STD, _MAX_LOG_STD = -3.0, 1.0
# Standard deviation of the error of the estimate from appearance on novel objects; heights have one of 1.
_APPEARANCE_STD = 0.7


class GraspHeightEstimator(nn.Module):
    """Estimates the height offset of a grasp.

    Args:
        feature_dim: Size of the features of an object's appearance.
    """

    def __init__(self, feature_dim: int) -> None:
        super().__init__()
        self.by_appearance = nn.Linear(feature_dim, 1)
        self.demonstration_error = nn.Sequential(nn.Linear(1, 16), nn.ReLU(inplace=True), nn.Linear(16, 1))

    def losses(self, features: Tensor, similarity: Tensor, demonstrated: Tensor, heights: Tensor) -> Tensor:
        """Returns the loss of each sample, (batch,).

        Args:
            features: Features of the objects to grasp, (batch, feature_dim).
            similarity: Cosine of their descriptors with those of the demonstrated objects, (batch,).
            demonstrated: Height offsets of the demonstrations, (batch,).
            heights: Height offsets of the grasps, (batch,).
        """
        by_appearance = 0.5 * (self.by_appearance(features)[:, 0] - heights).square()
        log_std = self._log_std(similarity)
        error = (demonstrated - heights) * torch.exp(-log_std)
        return by_appearance + 0.5 * error.square() + log_std

    def forward(self, features: Tensor, similarity: Tensor, demonstrated: Tensor) -> Tensor:
        """Estimates height offsets, (...).

        Args:
            features: Features of the objects to grasp, (..., feature_dim).
            similarity: Cosine of their descriptors with those of the demonstrated objects, (...).
            demonstrated: Height offsets of the demonstrations, (...); NaN where they are not known.
        """
        by_appearance = self.by_appearance(features)[..., 0]
        variance = torch.exp(2 * self._log_std(similarity))
        weight = _APPEARANCE_STD**2 / (_APPEARANCE_STD**2 + variance)
        weight = torch.where(demonstrated.isnan(), 0.0, weight)
        return weight * demonstrated.nan_to_num() + (1 - weight) * by_appearance

    def _log_std(self, similarity: Tensor) -> Tensor:
        """Returns the log standard deviation of the error of the demonstrations' estimate, (...)."""
        log_std = self.demonstration_error(similarity[..., None])[..., 0]
        return _MIN_LOG_STD + (_MAX_LOG_STD - _MIN_LOG_STD) * torch.sigmoid(log_std)
