"""Matching by pretrained features (ours): finds what a demonstration moved by features learned on ImageNet.

A network that learns from a few hundred objects compares them by color: among objects of one color, it picks
nearly at random. The features of a network that was trained on photographs tell shapes apart, too. They are
frozen; learned is only how they are weighed: two linear layers, which are too few weights to learn the
training objects by heart. `policy/matching_fit.py` fits them before a training, or for a trained policy.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.efficientnet_lite import (
    COARSE_CHANNELS,
    FINE_CHANNELS,
    FINE_STRIDE,
    EfficientNetLite,
    ImageMaps,
)
from lerobot_deltaco.policy.networks import gaussian_maps

_POOLING_STD = 1.2  # of the places around a grasp that describe what was grasped, in cells of the fine maps
_LEAST_STD = 1e-3


class PretrainedMatching(nn.Module):
    """Describes what was moved by pretrained features, and finds it in scenes.

    No gradient reaches it in the training of a policy.

    Args:
        descriptor_dim: Size of a descriptor.
        detail: Factor by which images are larger than those that the maps have half the side of.

    Attributes:
        fitted: Whether it has been fitted, () bool.
    """

    fitted: Tensor

    def __init__(self, descriptor_dim: int = 64, detail: int = 1) -> None:
        super().__init__()
        self.detail = detail
        self.encoder = EfficientNetLite()
        self.fine = nn.Conv2d(FINE_CHANNELS, descriptor_dim, 1)
        self.coarse = nn.Conv2d(COARSE_CHANNELS, descriptor_dim, 1)
        self.log_scale = nn.Parameter(torch.tensor(math.log(10.0)))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        for name, channels in (("fine", FINE_CHANNELS), ("coarse", COARSE_CHANNELS)):
            self.register_buffer(f"{name}_mean", torch.zeros(channels, 1, 1))
            self.register_buffer(f"{name}_std", torch.ones(channels, 1, 1))
        self.requires_grad_(False)

    @torch.no_grad()
    def normalize_by(self, maps: ImageMaps) -> None:
        """Sets the means and spreads of the channels to those of maps as `encode` makes them."""
        for name, kind in zip(("fine", "coarse"), maps, strict=True):
            values = kind.float().transpose(0, 1).flatten(1)  # (channels, images * places)
            self.get_buffer(f"{name}_mean").copy_(values.mean(dim=1)[:, None, None])
            self.get_buffer(f"{name}_std").copy_(values.std(dim=1).clamp_min(_LEAST_STD)[:, None, None])

    def encode(self, images: Tensor) -> ImageMaps:
        """Maps of images (batch, 3, H, W) in 0..1, which the encoder sees enlarged."""
        size = [FINE_STRIDE * (side // (2 * self.detail)) for side in images.shape[-2:]]
        enlarged = F.interpolate(images, size=size, mode="bicubic", align_corners=False)
        return self.encoder(enlarged.clamp(0, 1))

    def features(self, maps: ImageMaps) -> Tensor:
        """Features of places, (batch, descriptor_dim, h, w), from maps as `encode` makes them."""
        fine = self.fine((maps.fine.float() - self.get_buffer("fine_mean")) / self.get_buffer("fine_std"))
        coarse = self.coarse(
            (maps.coarse.float() - self.get_buffer("coarse_mean")) / self.get_buffer("coarse_std")
        )
        # What is linear may be enlarged after it is projected, which is cheaper.
        enlarged = F.interpolate(coarse.float(), size=fine.shape[-2:], mode="bilinear", align_corners=False)
        return fine.float() + enlarged

    def describe(self, features: Tensor, places: Tensor) -> Tensor:
        """Descriptors of what is at places.

        Args:
            features: Features of places, (batch, descriptor_dim, h, w).
            places: Places of grasps, x and y in -1..1, (batch, 2).

        Returns:
            (batch, descriptor_dim).
        """
        height, width = features.shape[-2:]
        std = 2 * _POOLING_STD / torch.tensor([width, height], device=features.device)
        weights = gaussian_maps(places[:, None], height, width, std)  # (batch, 1, h, w)
        weights = weights / weights.sum(dim=(2, 3), keepdim=True).clamp_min(1e-6)
        return (features * weights).sum(dim=(2, 3))

    def similarity(self, features: Tensor, descriptors: Tensor) -> Tensor:
        """How similar the places of scenes are to descriptors, as logits (batch, h, w).

        Args:
            features: Features of the scenes' places, (batch, descriptor_dim, h, w).
            descriptors: (batch, descriptor_dim).
        """
        cosine = torch.einsum("bchw,bc->bhw", F.normalize(features, dim=1), F.normalize(descriptors, dim=1))
        return self.log_scale.exp() * cosine


def log_probabilities(logits: Tensor) -> Tensor:
    """Log probabilities of the places of maps (batch, h, w), of the same shape."""
    return logits.flatten(1).log_softmax(dim=1).view_as(logits)
