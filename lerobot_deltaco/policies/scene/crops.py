"""Crops of images, and their features: those of a frozen network, and mean colors.

A network that learns from a few hundred objects compares them by color. The features of a network that was
trained on photographs tell shapes apart, too, if the object fills its view; but colors less exactly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache
from typing import ClassVar

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policies.base.image_encoder import (
    HEAD_CHANNELS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    EfficientNetLite0,
)

CROP_RESOLUTION = 128  # px, of crops as the network sees them
# Maps that describe a crop: at stride 16, as 4 x 4 cells, and at stride 32, as their mean.
_FINE_CHANNELS, _FINE_CELLS, _COARSE_CHANNELS = 112, 4, 320
_COLOR_CELLS = 8  # of a row and of a column, whose mean colors are features


class CropEncoder(ABC):
    """Describes crops of images. A subclass is another frozen encoder.

    It is no module, so that checkpoints do not contain its weights.

    Attributes:
        feature_dim: Number of features of a crop.
        color_dim: Number of those that are colors, the last ones.
        resolution: Side of the crops as they are encoded, px.
    """

    feature_dim: ClassVar[int]
    color_dim: ClassVar[int]
    resolution: ClassVar[int] = CROP_RESOLUTION

    @abstractmethod
    def encode(self, crops: Tensor) -> Tensor:
        """Returns the features of crops (n, 3, resolution, resolution) in 0..1, (n, feature_dim)."""

    def __call__(self, images: Tensor, locations: Tensor, sizes: Tensor) -> Tensor:
        """Returns features of crops, (batch, n, feature_dim) in float32.

        Args:
            images: Images (batch, 3, H, W), uint8 or in 0..1, at their own resolution.
            locations: Centers of the crops, (batch, n, 2) in -1..1; NaN for none, whose features are NaN.
            sizes: Sides of the crops as fractions of the image's, (batch, n).

        Raises:
            PretrainedWeightsError: The encoder's weights are missing.
        """
        is_crop = ~locations.isnan().any(dim=2)
        rows, at = is_crop.nonzero()[:, 0], (locations[is_crop][:, None], sizes[is_crop][:, None])
        features = self.encode(cut_crops(images[rows], *at, self.resolution)[:, 0]).float()
        every = features.new_full((*is_crop.shape, self.feature_dim), torch.nan)
        every[is_crop] = features
        return every


class EfficientNetCropEncoder(CropEncoder):
    """Describes crops by EfficientNet-Lite0 and by the mean colors of their cells."""

    color_dim = 3 * _COLOR_CELLS**2
    feature_dim = _FINE_CHANNELS * _FINE_CELLS**2 + _COARSE_CHANNELS + HEAD_CHANNELS + color_dim

    def encode(self, crops: Tensor) -> Tensor:
        """Returns features of crops. See `CropEncoder.encode`."""
        mean, std = (
            torch.tensor(values, device=crops.device)[:, None, None]
            for values in (IMAGENET_MEAN, IMAGENET_STD)
        )
        fine, coarse, last = _network(crops.device)((crops - mean) / std)
        parts = [
            F.adaptive_avg_pool2d(fine, _FINE_CELLS).flatten(1),
            coarse.mean(dim=(2, 3)),
            last.mean(dim=(2, 3)),
            F.adaptive_avg_pool2d(crops, _COLOR_CELLS).flatten(1),
        ]
        return torch.cat([part.float() for part in parts], dim=1)


@cache
def _network(device: torch.device) -> EfficientNetLite0:
    return EfficientNetLite0().to(device)


def cut_crops(images: Tensor, locations: Tensor, sizes: Tensor, resolution: int) -> Tensor:
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
