"""Maps over images, and locations in them: x (to the right) and y (down), in -1..1 between the edges."""

from __future__ import annotations

import torch
from einops import rearrange
from torch import Tensor

LOCATION_STD = 1 / 12  # of the map of a location, where the image's edges are at -1 and 1


def spatial_weights(maps: Tensor) -> Tensor:
    """Returns the softmax of each map over its cells, (batch, channels, h, w) as float32."""
    weights = rearrange(maps, "b c h w -> b c (h w)").float().softmax(dim=-1)
    return rearrange(weights, "b c (h w) -> b c h w", h=maps.shape[-2])


def mean_location(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean x and y, each (batch, channels) in -1..1, under weights (batch, channels, h, w)."""
    height, width = weights.shape[-2:]
    # Sums of products, because mixed precision would round the factors of a matrix product.
    x = torch.linspace(-1, 1, width, device=weights.device)
    y = torch.linspace(-1, 1, height, device=weights.device)
    return (weights.sum(dim=2) * x).sum(-1), (weights.sum(dim=3) * y).sum(-1)


def cell_centers(n_cells: int, device: torch.device) -> Tensor:
    """Returns the centers of the cells of a row or column whose edges are at -1 and 1, (n_cells,)."""
    return (torch.arange(n_cells, device=device) + 0.5) * 2 / n_cells - 1


def grid_of_centers(height: int, width: int, device: torch.device) -> Tensor:
    """Returns the centers of a map's cells, row by row, (h w, 2) in -1..1."""
    x, y = cell_centers(width, device), cell_centers(height, device)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


def gaussian_maps(locations: Tensor, height: int, width: int, std: float | Tensor) -> Tensor:
    """Returns maps that are 1 at a location and fall off around it.

    Args:
        locations: Locations in -1..1, (batch, locations, 2).
        height: Number of rows.
        width: Number of columns.
        std: Standard deviation in the same unit: one number, or those of x and y, (2,).

    Returns:
        (batch, locations, height, width).
    """
    std = torch.as_tensor(std, device=locations.device).expand(2)
    across = torch.exp(-0.5 * ((cell_centers(width, locations.device) - locations[..., :1]) / std[0]) ** 2)
    down = torch.exp(-0.5 * ((cell_centers(height, locations.device) - locations[..., 1:]) / std[1]) ** 2)
    return down[..., :, None] * across[..., None, :]


def features_at(maps: Tensor, locations: Tensor) -> Tensor:
    """Returns features (batch, locations, channels) around locations (batch, locations, 2) in maps."""
    height, width = maps.shape[-2:]
    weights = gaussian_maps(locations, height, width, LOCATION_STD)
    weights = weights / weights.sum(dim=(2, 3), keepdim=True).clamp_min(1e-3)
    return torch.einsum("bphw,bchw->bpc", weights.to(maps.dtype), maps)


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
