"""Locations in images: x (to the right) and y (down), in -1..1 between an image's edges."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_deltaco.policies.base.networks import grid_of_centers


def mean_near(weights: Tensor, cells: Tensor, radius: float) -> Tensor:
    """Returns the mean location of the cells around a peak.

    Args:
        weights: Weights of cells, (batch, h, w), not negative.
        cells: Index of each peak's cell, row by row, (batch,).
        radius: Distance up to which cells count, in x and in y, in cells.

    Returns:
        (batch, 2) in -1..1.
    """
    height, width = weights.shape[-2:]
    grid = grid_of_centers(height, width, weights.device)  # (h w, 2)
    reach = radius * 2 / torch.tensor([width, height], device=weights.device)
    near = ((grid - grid[cells][:, None]).abs() <= reach + 1e-6).all(dim=2)  # (batch, h w)
    weights = weights.flatten(1) * near
    return weights @ grid / weights.sum(dim=1, keepdim=True).clamp_min(1e-12)
