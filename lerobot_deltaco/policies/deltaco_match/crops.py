"""Crops of images around locations, and their features: by EfficientNet-Lite0, and colors.

A network that learns from a few hundred objects compares them by color. The features of a network that was
trained on photographs tell shapes apart, too, if the object fills its view; but colors less exactly.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policies.base.image_encoder import (
    HEAD_CHANNELS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    EfficientNetLite0,
)
from lerobot_deltaco.policies.base.networks import cell_centers
from lerobot_deltaco.policies.deltaco_match.regression import robust_regression

_RESOLUTION = 128  # px, of crops as the encoder sees them
# Maps that describe a crop: at stride 16, as 4 x 4 cells, and at stride 32, as their mean.
_FINE_CHANNELS, _FINE_CELLS, _COARSE_CHANNELS = 112, 4, 320
# Of the fit of the perspective: change of a pixel (in 0..1) that counts, distance from the grasp (in -1..1),
# and width by which images blur an object (px).
_CHANGE, _REACH, _BLUR = 0.1, 1 / 3, 1.0
_MIN_SEEN, _MAX_SLOPE = 24, 1.5
_LEAST_ERROR = 0.02  # of the log of a size, below which errors are all alike
_COLOR_CELLS = 8  # of a row and of a column, whose mean colors are features
COLOR_DIM = 3 * _COLOR_CELLS**2
FEATURE_DIM = _FINE_CHANNELS * _FINE_CELLS**2 + _COARSE_CHANNELS + HEAD_CHANNELS + COLOR_DIM


def crop_features(images: Tensor, locations: Tensor, sizes: Tensor) -> Tensor:
    """Returns features of crops, (batch, n, FEATURE_DIM), the colors last.

    Args:
        images: Images (batch, 3, H, W), uint8 or in 0..1, at their own resolution.
        locations: Centers of the crops, (batch, n, 2) in -1..1.
        sizes: Sides of the crops as fractions of the image's, (batch, n).

    Raises:
        PretrainedWeightsError: The encoder's weights are missing.
    """
    crops = cut_crops(images, locations, sizes).flatten(0, 1)
    mean, std = (
        torch.tensor(values, device=crops.device)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD)
    )
    fine, coarse, last = _encoder(crops.device)((crops - mean) / std)
    parts = [
        F.adaptive_avg_pool2d(fine, _FINE_CELLS).flatten(1),
        coarse.mean(dim=(2, 3)),
        last.mean(dim=(2, 3)),
        F.adaptive_avg_pool2d(crops, _COLOR_CELLS).flatten(1),
    ]
    return torch.cat([part.float() for part in parts], dim=1).unflatten(0, locations.shape[:2])


def cut_crops(images: Tensor, locations: Tensor, sizes: Tensor, resolution: int = _RESOLUTION) -> Tensor:
    """Returns square crops of images, enlarged; beyond an image's edge, its last pixels are repeated.

    Args:
        images: Images (batch, 3, H, W), uint8 or in 0..1.
        locations: Centers of the crops, (batch, n, 2) in -1..1.
        sizes: Sides of the crops as fractions of the image's, (batch, n).
        resolution: Side of the result, px.

    Returns:
        (batch, n, 3, resolution, resolution) in 0..1.
    """
    if images.dtype == torch.uint8:
        images = images.float() / 255
    steps = (torch.arange(resolution, device=images.device) + 0.5) * 2 / resolution - 1
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    grid = sizes[..., None, None, None] * torch.stack([x, y], dim=-1)  # (batch, n, r, r, 2)
    grid = grid + locations[:, :, None, None]
    # All crops of an image at once, below one another.
    crops = F.grid_sample(
        images, grid.flatten(1, 2), mode="bicubic", padding_mode="border", align_corners=False
    )
    return crops.clamp(0, 1).unflatten(2, (-1, resolution)).transpose(1, 2)


def fit_perspective(first: Tensor, last: Tensor, locations: Tensor) -> Tensor:
    """Returns how the log of the apparent size of objects changes along x and y in the image, (2,).

    Things that are farther from the camera look smaller. The size of an object is the square root of the area
    around its grasp that differs between the first and the last image of the episode, since it is gone then.

    Args:
        first: First images of episodes, (episodes, 3, H, W) uint8.
        last: Last images of the same episodes.
        locations: Locations of the grasps, (episodes, 2) in -1..1.
    """
    height, width = first.shape[-2:]
    x, y = cell_centers(width, first.device), cell_centers(height, first.device)
    changes = torch.stack(
        [(b.int() - a.int()).abs().amax(dim=0) / 255 for a, b in zip(first, last, strict=True)]
    )  # (episodes, H, W)
    # The robot itself changes in every episode.
    changes = changes * (changes.median(dim=0).values < _CHANGE)
    away = torch.hypot(x - locations[:, :1, None], y[:, None] - locations[:, 1:, None])  # (episodes, H, W)
    side = ((changes > _CHANGE) & (away < _REACH)).float().sum(dim=(1, 2)).sqrt() - _BLUR
    seen = side > _BLUR
    if int(seen.sum()) < _MIN_SEEN:
        return torch.zeros(2, device=first.device)
    features = torch.cat([torch.ones_like(locations[:, :1]), locations], dim=1)[seen]
    degrees = torch.tensor([0, 1, 1], device=first.device)
    weights = robust_regression(features, side[seen].log()[:, None], degrees, _LEAST_ERROR)
    return weights[1:, 0].clamp(-_MAX_SLOPE, _MAX_SLOPE)


@cache
def _encoder(device: torch.device) -> EfficientNetLite0:
    return EfficientNetLite0().to(device)
