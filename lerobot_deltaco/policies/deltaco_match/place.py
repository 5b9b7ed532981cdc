r"""Finds where in a scene an object is to go, as the instruction or the demonstration says.

    demonstration's first and last image                 instruction
               |              |                               |
           attention         stem                           words
               |______________|                               |
                       |                                      |
          what is there, and where  _____ one of both ________|
                                            |
                                            | FiLM
    scene -> stem -> convolutions with coordinates -> place map

The attention also tells what a demonstration moved, if the robot's state at its grasp is not known.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.base.image_coordinates import mean_location, mean_near, spatial_weights
from lerobot_deltaco.policies.base.networks import Film, channels_last, conv_norm_relu

_CHANNELS = 32
TARGET_DIM = _CHANNELS + 2
_PEAK_RADIUS = 1  # of the cells around the maximum whose mean is a location


class DemonstrationAttention(nn.Module):
    """Finds what moved between the first and the last image of a demonstration, and where it was put."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv_norm_relu(6, _CHANNELS, 5, 2),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            nn.Conv2d(_CHANNELS, 2, 1),
        )

    def forward(self, ends: Tensor) -> Tensor:
        """Maps first and last images (batch, 2, 3, H, W) to two maps that sum to 1, (batch, 2, h, w)."""
        return spatial_weights(self.layers(channels_last(ends.flatten(1, 2))))


class PlaceNetwork(nn.Module):
    """Predicts where in a scene an object is to go: convolutions with coordinates and FiLM.

    Args:
        instruction_dim: Size of the embedding of an instruction.
    """

    def __init__(self, instruction_dim: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_norm_relu(3, _CHANNELS, 5, 2), conv_norm_relu(_CHANNELS, _CHANNELS))
        self.locate = conv_norm_relu(_CHANNELS + 2, _CHANNELS)
        self.refine = conv_norm_relu(_CHANNELS, _CHANNELS)
        self.films = nn.ModuleList(Film(instruction_dim + TARGET_DIM, _CHANNELS) for _ in range(2))
        self.output = nn.Conv2d(_CHANNELS, 1, 1)

    def target(self, last: Tensor, attention: Tensor) -> Tensor:
        """Describes where demonstrations put the object: the features there, and the location.

        Args:
            last: Last images, (batch, 3, H, W) in 0..1.
            attention: Maps of where the object was put, (batch, h, w); each sums to 1.

        Returns:
            (batch, TARGET_DIM).
        """
        weights = attention[:, None]
        features = (self.stem(channels_last(last)) * weights).sum(dim=(2, 3))
        return torch.cat([features.float(), *mean_location(weights)], dim=1)

    def forward(self, scenes: Tensor, instruction: Tensor, target: Tensor) -> Tensor:
        """Predicts place maps.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            instruction: Embeddings of instructions, (batch, instruction_dim); zeros where the demonstration
                says where.
            target: Results of `target`, (batch, TARGET_DIM); zeros where the instruction says where.

        Returns:
            Logits, (batch, h, w), where h and w are half the height and width of the images.
        """
        condition = torch.cat([instruction.float(), target], dim=1)
        maps = self.stem(channels_last(scenes))
        height, width = maps.shape[-2:]
        y, x = torch.meshgrid(
            torch.linspace(-1, 1, height, device=maps.device),
            torch.linspace(-1, 1, width, device=maps.device),
            indexing="ij",
        )
        coordinates = torch.stack([x, y]).to(maps.dtype).expand(len(maps), -1, -1, -1)
        maps = F.relu(self.films[0](self.locate(torch.cat([maps, coordinates], dim=1)), condition))
        maps = F.relu(self.films[1](self.refine(maps), condition))
        return self.output(maps)[:, 0].float()


def peak_locations(logits: Tensor) -> Tensor:
    """Returns the peaks of maps: the means of the cells around them.

    Args:
        logits: (batch, maps, h, w).

    Returns:
        (batch, maps, 2) in -1..1.
    """
    weights = spatial_weights(logits)
    cells = F.avg_pool2d(weights, 3, 1, 1).flatten(2).argmax(dim=2)  # (batch, maps)
    return mean_near(weights.flatten(0, 1), cells.flatten(), _PEAK_RADIUS).unflatten(0, cells.shape)
