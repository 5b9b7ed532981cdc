"""Demonstration encoders: from a few frames of an episode to a task embedding, a unit vector."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor, nn

from lerobot_deltaco.policy.networks import (
    mean_position,
    multilayer_perceptron,
    random_crop,
    spatial_weights,
)

# Of `AttentionEncoder`: channels of its convolutions, of which the first two halve the maps; places that are
# attended to; size of the hidden fully connected layer.
ATTENTION_CHANNELS = (32, 32, 64, 64)
ATTENTION_PLACES = 8
ATTENTION_HIDDEN_DIM = 512


class ArrayEncoder(nn.Module):
    """The paper's encoder (figure 7): a convolutional network on an array of frames, as if it were one image.

    Args:
        height: Height of a frame, px.
        width: Width of a frame, px.
        rows: Number of rows of the array.
        columns: Number of columns of the array.
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
        """From (batch, rows * columns, 3, height, width) in 0..1 to unit vectors (batch, embedding_dim)."""
        array = frame_array(frames, self.rows)
        maps = self.convolutions(array.contiguous(memory_format=torch.channels_last))
        return F.normalize(self.layers(maps), dim=-1)


class AttentionEncoder(nn.Module):
    """Ours: compares the frames at each place, and attends to a few places.

    A demonstration is what changed: an object has left one place, and one lies in a container at another.
    The paper's encoder has to learn this for each place separately, since its fully connected layers take the
    flattened maps. Here, the frames are stacked, convolutions see what changed, and attention reads the maps
    at the places that matter, along with their positions. So a demonstration in one corner teaches how to
    read those in all others.

    Args:
        n_frames: Number of frames of a demonstration.
        embedding_dim: Size of the embedding: the language encoder's.
    """

    def __init__(self, n_frames: int, embedding_dim: int) -> None:
        super().__init__()
        channels = ATTENTION_CHANNELS
        layers: list[nn.Module] = []
        for n, (in_dim, out_dim) in enumerate(zip([3 * n_frames, *channels[:-1]], channels, strict=True)):
            size, stride = (5, 2) if n == 0 else (3, 2) if n == 1 else (3, 1)
            layers += [
                nn.Conv2d(in_dim, out_dim, size, stride, padding=size // 2, bias=False),
                nn.BatchNorm2d(out_dim),
                nn.ReLU(inplace=True),
            ]
        self.convolutions = nn.Sequential(*layers)
        self.attention = nn.Conv2d(channels[-1], ATTENTION_PLACES, 1)
        flat_dim = ATTENTION_PLACES * (channels[-1] + 2)
        self.layers = multilayer_perceptron([flat_dim, ATTENTION_HIDDEN_DIM, embedding_dim])

    def forward(self, frames: Tensor) -> Tensor:
        """From (batch, n_frames, 3, height, width) in 0..1 to unit vectors (batch, embedding_dim)."""
        stacked = frames.flatten(1, 2)  # (batch, 3 n_frames, height, width)
        maps = self.convolutions(stacked.contiguous(memory_format=torch.channels_last))
        weights, found = attend(self.attention(maps), maps)
        x, y = mean_position(weights)
        return F.normalize(self.layers(torch.cat([found.flatten(1), x, y], dim=-1)), dim=-1)


def attend(logits: Tensor, maps: Tensor) -> tuple[Tensor, Tensor]:
    """Attention: a softmax over places, and the means of maps under it.

    Args:
        logits: How much each place matters, (batch, heads, h, w).
        maps: What is averaged, (batch, channels, h, w).

    Returns:
        Weights, (batch, heads, h, w), and means, (batch, heads, channels).
    """
    weights = spatial_weights(logits)
    return weights, torch.einsum("bkhw,bchw->bkc", weights.to(maps.dtype), maps)


def frame_array(frames: Tensor, rows: int) -> Tensor:
    """Lays the frames of demonstrations out in raster order (appendix B).

    Args:
        frames: Frames of demonstrations, (batch, rows * columns, 3, H, W).
        rows: Number of rows.

    Returns:
        (batch, 3, rows * H, columns * W).
    """
    return rearrange(frames, "b (r c) d h w -> b d (r h) (c w)", r=rows)


def crop_demonstrations(
    frames: Tensor, padding: int, array_rows: int | None, generator: torch.Generator
) -> Tensor:
    """Shifts demonstrations at random, for training. What comes in at the edges is black.

    Args:
        frames: Frames of demonstrations, (batch, frames, 3, H, W).
        padding: Largest shift in x and in y, px; at 0, nothing is drawn.
        array_rows: Number of rows of the array in which the frames are laid out and shifted as a whole, so
            that what leaves a frame enters its neighbor; None to shift each frame, all of a demonstration
            alike.
        generator: Source of the shifts, on the CPU.

    Returns:
        The same shape.
    """
    if not padding:
        return frames
    if array_rows is None:
        return random_crop(frames, padding, generator)
    height, width = frames.shape[-2:]
    array = random_crop(frame_array(frames, array_rows), padding, generator)
    return rearrange(array, "b d (r h) (c w) -> b (r c) d h w", r=array_rows, h=height, w=width)
