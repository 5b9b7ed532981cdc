r"""Matching by pretrained features (ours): finds what a task asks for by features learned on ImageNet.

A network that learns from a few hundred objects compares them by color: among objects of one color, it picks
nearly at random. The features of a network that was trained on photographs tell shapes apart, too. They are
frozen; small networks behind them learn what to compare things by. `policy/goals/matching_fit.py` fits them
before a training, or for a trained policy.

    demonstration's first image     scene                     instruction
            |                         |                            |
        encoder (frozen) <-------> encoder (frozen)          words it has
            |                         |        \                   |
    compared features <- same -> compared   compared        sum of the words' descriptors
            |                         |           |                |
    descriptor of what was grasped    |           |                |
            |________ cosine _________|           |____ cosine ____|
                        |                                 |
                by the demonstration                 by the words
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.goals.efficientnet_lite import (
    COARSE_CHANNELS,
    COARSE_STRIDE,
    FINE_CHANNELS,
    FINE_STRIDE,
    EfficientNetLite,
)
from lerobot_deltaco.policy.networks import gaussian_maps

_POOLING_STD = 1.2  # of the places around a grasp that describe what was grasped, in cells of the features
_LEAST_STD = 1e-3
# Of a side of the maps. The encoder's work and the memory of a fit grow with its square: without a limit, the
# encoder would see the images of a camera of 256 px with 1,024 px.
_MAX_CELLS = 24


class ImageMaps(NamedTuple):
    """Feature maps of images, of the size (h, w): a quarter of their sides (without detail), at most 24.

    Attributes:
        fine: (batch, FINE_CHANNELS, h, w).
        coarse: (batch, COARSE_CHANNELS, h, w), of images of twice the size.
    """

    fine: Tensor
    coarse: Tensor

    def rows(self, rows: Tensor) -> ImageMaps:
        """The maps of some of the images."""
        return ImageMaps(self.fine[rows], self.coarse[rows])


class PretrainedMatching(nn.Module):
    """Finds what a demonstration moved, or what words name, in scenes.

    No gradient reaches it in the training of a policy.

    Args:
        n_words: Number of words that are known, 0 for a policy without instructions.
        descriptor_dim: Size of a descriptor.
        detail: Factor by which images are larger than those that the maps have half the side of.

    Attributes:
        fitted: Whether it has been fitted, () bool.
    """

    fitted: Tensor

    def __init__(self, n_words: int = 0, descriptor_dim: int = 64, detail: int = 1) -> None:
        super().__init__()
        self.detail = detail
        self.encoder = EfficientNetLite()
        self.demo = ComparedFeatures(descriptor_dim)
        self.named = ComparedFeatures(descriptor_dim) if n_words else None
        if n_words:
            # With a bias, which stands for no word.
            self.words = nn.Parameter(torch.zeros(n_words + 1, descriptor_dim))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        for name, channels in (("fine", FINE_CHANNELS), ("coarse", COARSE_CHANNELS)):
            self.register_buffer(f"{name}_mean", torch.zeros(channels, 1, 1))
            self.register_buffer(f"{name}_std", torch.ones(channels, 1, 1))
        self.requires_grad_(False)

    @property
    def learned(self) -> list[nn.Parameter]:
        """What a fit changes."""
        frozen = {id(weights) for weights in self.encoder.parameters()}
        return [weights for weights in self.parameters() if id(weights) not in frozen]

    @torch.no_grad()
    def normalize_by(self, maps: ImageMaps) -> None:
        """Sets the means and spreads of the channels to those of maps as `encode` makes them."""
        for name, kind in zip(("fine", "coarse"), maps, strict=True):
            values = kind.float().transpose(0, 1).flatten(1)  # (channels, images * places)
            self.get_buffer(f"{name}_mean").copy_(values.mean(dim=1)[:, None, None])
            self.get_buffer(f"{name}_std").copy_(values.std(dim=1).clamp_min(_LEAST_STD)[:, None, None])

    def encode(self, images: Tensor) -> ImageMaps:
        """Maps of images (batch, 3, H, W) in 0..1, which the encoder sees scaled to its strides."""
        size = [min(_MAX_CELLS, max(1, side // (4 * self.detail))) for side in images.shape[-2:]]

        def scaled(stride: int) -> Tensor:
            sides = [stride * cells for cells in size]
            # Averaging is for images that are scaled down: large ones, and those with much detail.
            is_smaller = any(new < old for new, old in zip(sides, images.shape[-2:], strict=True))
            larger_or_smaller = F.interpolate(
                images.float(), size=sides, mode="bicubic", align_corners=False, antialias=is_smaller
            )
            return larger_or_smaller.clamp(0, 1)

        return ImageMaps(
            self.encoder.fine_maps(scaled(FINE_STRIDE)), self.encoder.coarse_maps(scaled(COARSE_STRIDE))
        )

    def normalized(self, maps: ImageMaps) -> ImageMaps:
        """Maps as `encode` makes them, with channels of mean 0 and spread 1, in float32."""
        return ImageMaps(
            (maps.fine.float() - self.get_buffer("fine_mean")) / self.get_buffer("fine_std"),
            (maps.coarse.float() - self.get_buffer("coarse_mean")) / self.get_buffer("coarse_std"),
        )

    def describe(self, maps: ImageMaps, places: Tensor) -> Tensor:
        """Descriptors of what demonstrations grasped, (batch, descriptor_dim).

        Args:
            maps: Normalized maps of their first images.
            places: Places of the grasps, x and y in -1..1, (batch, 2).
        """
        features = self.demo(maps)
        height, width = features.shape[-2:]
        std = 2 * _POOLING_STD / torch.tensor([width, height], device=features.device)
        weights = gaussian_maps(places[:, None], height, width, std)  # (batch, 1, h, w)
        weights = weights / weights.sum(dim=(2, 3), keepdim=True).clamp_min(1e-6)
        return (features * weights).sum(dim=(2, 3))

    def find(self, maps: ImageMaps, descriptors: Tensor) -> Tensor:
        """Where scenes are like descriptors (batch, descriptor_dim), as logits (batch, h, w).

        Args:
            maps: Normalized maps of the scenes.
            descriptors: As `describe` makes them.
        """
        return self.demo.similarity(self.demo(maps), descriptors)

    def find_named(self, maps: ImageMaps, present: Tensor) -> Tensor:
        """Where scenes are like what words name, as logits (batch, h, w).

        Args:
            maps: Normalized maps of the scenes.
            present: Which words there are, (batch, words): 0 or 1.
        """
        assert self.named is not None
        descriptors = present @ self.words[:-1] + self.words[-1]
        return self.named.similarity(self.named(maps), descriptors)


class ComparedFeatures(nn.Module):
    """Features of places that things are compared by: a linear layer, and a small network of what is around.

    With the network, words find shapes. What a demonstration shows is found as well without it
    (docs/experiment-log.md).

    Args:
        dim: Number of features.
        hidden_dim: Number of features inside the network.
    """

    def __init__(self, dim: int, hidden_dim: int = 128) -> None:
        super().__init__()
        channels = FINE_CHANNELS + COARSE_CHANNELS
        self.linear = nn.Conv2d(channels, dim, 1)
        self.around = nn.Sequential(
            nn.Conv2d(channels, hidden_dim, 1), nn.ReLU(), nn.Conv2d(hidden_dim, dim, 3, padding=1)
        )
        self.log_scale = nn.Parameter(torch.tensor(math.log(10.0)))

    def forward(self, maps: ImageMaps) -> Tensor:
        """From normalized maps (batch, channels, h, w) to (batch, dim, 2 h, 2 w)."""
        both = torch.cat(maps, dim=1)
        features = self.linear(both) + self.around(both)
        return F.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)

    def similarity(self, features: Tensor, descriptors: Tensor) -> Tensor:
        """Scaled cosine of features (batch, dim, h, w) and descriptors (batch, dim): (batch, h, w)."""
        cosine = torch.einsum("bchw,bc->bhw", F.normalize(features, dim=1), F.normalize(descriptors, dim=1))
        return self.log_scale.exp() * cosine


def log_probabilities(logits: Tensor) -> Tensor:
    """Log probabilities of the places of maps (batch, h, w), of the same shape."""
    return logits.flatten(1).log_softmax(dim=1).view_as(logits)
