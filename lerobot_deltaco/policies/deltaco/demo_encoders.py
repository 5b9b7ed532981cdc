"""Demonstration encoders: from a few frames of an episode to a task embedding, a unit vector."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.data.demonstrations import DemonstrationBank, sample_frames
from lerobot_deltaco.policies.base.augmentation import random_shift
from lerobot_deltaco.policies.base.image_coordinates import mean_location, spatial_weights
from lerobot_deltaco.policies.base.networks import channels_last, conv_norm_relu, multilayer_perceptron
from lerobot_deltaco.policies.deltaco.vision import VisionEncoder

# `AttentionEncoder`: channels of its convolutions, the first two of which halve the maps; number of locations
# attended to; size of the hidden fully connected layer.
_ATTENTION_CHANNELS = (32, 32, 64, 64)
_ATTENTION_HEADS = 8
_ATTENTION_HIDDEN_DIM = 512
_ENCODED_AT_A_TIME = 64


class FrameGridEncoder(nn.Module):
    """The paper's encoder (figure 7): a convolutional network on a grid of frames, as if it were one image.

    Args:
        height: Height of a frame, px.
        width: Width of a frame, px.
        rows: Number of rows of the grid.
        columns: Number of columns of the grid.
        embedding_dim: Size of the embedding: the language encoder's.
        stride: Stride of the first convolution.
        channels: Number of channels of the convolutions.
        hidden_dims: Sizes of the hidden fully connected layers.
    """

    def __init__(
        self,
        height: int,
        width: int,
        rows: int,
        columns: int,
        embedding_dim: int,
        stride: int = 1,
        channels: int = 16,
        hidden_dims: Sequence[int] = (1024, 512, 256),
    ) -> None:
        super().__init__()
        self.rows = rows
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, channels, 3, stride, padding=1),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Flatten(),
        )
        # The first convolution rounds up, the poolings down.
        sides = (math.ceil(size / stride) // 4 for size in (rows * height, columns * width))
        flat_dim = channels * math.prod(sides)
        self.layers = multilayer_perceptron([flat_dim, *hidden_dims, embedding_dim])

    def forward(self, frames: Tensor) -> Tensor:
        """Maps frames (batch, rows * columns, 3, H, W) in 0..1 to unit vectors (batch, embedding_dim)."""
        maps = self.convolutions(channels_last(frame_grid(frames, self.rows)))
        return F.normalize(self.layers(maps), dim=-1)


class AttentionEncoder(nn.Module):
    """Compares the frames at each location, and attends to a few locations; not in the paper.

    A demonstration is defined by what changed: an object has left one location, and lies in a container at
    another. The paper's encoder has to learn this for each location separately, since its fully connected
    layers take the flattened maps. Here, the frames are stacked, convolutions see what changed, and attention
    reads the maps at the locations that matter, along with their coordinates. So what is learned from a
    demonstration in one corner applies to all others.

    Args:
        n_frames: Number of frames of a demonstration.
        embedding_dim: Size of the embedding: the language encoder's.
    """

    def __init__(self, n_frames: int, embedding_dim: int) -> None:
        super().__init__()
        channels = _ATTENTION_CHANNELS
        layers: list[nn.Module] = []
        for n, (in_dim, out_dim) in enumerate(zip([3 * n_frames, *channels[:-1]], channels, strict=True)):
            layers += conv_norm_relu(in_dim, out_dim, 5 if n == 0 else 3, 2 if n < 2 else 1)
        self.convolutions = nn.Sequential(*layers)
        self.attention = nn.Conv2d(channels[-1], _ATTENTION_HEADS, 1)
        flat_dim = _ATTENTION_HEADS * (channels[-1] + 2)
        self.layers = multilayer_perceptron([flat_dim, _ATTENTION_HIDDEN_DIM, embedding_dim])

    def forward(self, frames: Tensor) -> Tensor:
        """Maps frames (batch, n_frames, 3, H, W) in 0..1 to unit vectors (batch, embedding_dim)."""
        maps = self.convolutions(channels_last(frames.flatten(1, 2)))  # (batch, channels, h, w)
        weights = spatial_weights(self.attention(maps))  # (batch, heads, h, w)
        found = torch.einsum("bkhw,bchw->bkc", weights.to(maps.dtype), maps)
        x, y = mean_location(weights)
        return F.normalize(self.layers(torch.cat([found.flatten(1), x, y], dim=-1)), dim=-1)


def frame_grid(frames: Tensor, rows: int) -> Tensor:
    """Lays frames (batch, rows * columns, 3, H, W) out in raster order, (batch, 3, rows * H, columns * W)."""
    return rearrange(frames, "b (r c) d h w -> b d (r h) (c w)", r=rows)


def shift_demonstrations(
    frames: Tensor, padding: int, rows: int | None, generator: torch.Generator
) -> Tensor:
    """Shifts demonstrations at random, for training. Uncovered edges are black.

    Args:
        frames: Frames of demonstrations, (batch, frames, 3, H, W).
        padding: Largest shift in x and in y, px; at 0, nothing is drawn.
        rows: Number of rows of the grid, which is shifted as a whole, as in the authors' code, so that pixels
            that leave a frame enter its neighbor; None to shift the frames separately, all frames of a
            demonstration by the same amount.
        generator: Source of the shifts, on the CPU.

    Returns:
        Shifted frames, of the same shape.
    """
    if not padding:
        return frames
    if rows is None:
        return random_shift(frames, padding, generator)
    height, width = frames.shape[-2:]
    grid = random_shift(frame_grid(frames, rows), padding, generator)
    return rearrange(grid, "b d (r h) (c w) -> b (r c) d h w", r=rows, h=height, w=width)


def encode_bank(
    bank: DemonstrationBank,
    encoder: VisionEncoder,
    n_frames: int,
    rows: int,
    n_variants: int,
    padding: int,
    seed: int,
) -> Tensor:
    """Computes the features of all demonstrations with a frozen encoder.

    Args:
        bank: The demonstrations.
        encoder: The frozen encoder.
        n_frames: Number of frames of a demonstration.
        rows: Number of rows of the grid that they are laid out in.
        n_variants: Number of random variants, 0 for none.
        padding: Largest shift of a variant, px.
        seed: Seed of the draws.

    Returns:
        (demonstrations, 1 + n_variants, features) float16: without a shift, and of the variants.
    """
    generator = torch.Generator().manual_seed(seed)
    columns = []
    n_images = len(bank) * (1 + n_variants)
    with tqdm(total=n_images, desc="Encoding demonstrations", unit="image", leave=False) as progress:
        for variant in range(1 + n_variants):
            parts = []
            for kept in bank.frames.split(_ENCODED_AT_A_TIME):
                frames = sample_frames(kept, n_frames, generator)
                if variant > 0:
                    frames = shift_demonstrations(frames, padding, rows, generator)
                parts.append(encoder(frame_grid(frames, rows)).half())
                progress.update(len(kept))
            columns.append(torch.cat(parts))
    return torch.stack(columns, dim=1)
