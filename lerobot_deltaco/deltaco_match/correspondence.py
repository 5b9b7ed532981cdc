r"""Correspondence: finds in a scene what a demonstration moved, and where an instruction wants it.

    demonstration's first and last image             first image of the scene
            |               \                            |             \
     attention              trunk  <---- shared ---->  trunk        place network
     (conv, softmax)          |                         |                |    ^
            |                 |                      features f(x)       |    | FiLM
            +--- weights -> descriptor                  |                | instruction
                               |_______ cosine _________|                |
                                           |                             |
                          pick map: where that object is     place map: where it shall go

A task embedding that is pulled towards a sentence cannot say what a novel object looks like. A descriptor
can: it consists of the same features as the scene, so the demonstrated object is searched for instead of
named.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.networks import (
    Film,
    cell_centers,
    channels_last,
    conv_norm_relu,
    mean_location,
    spatial_weights,
)

DESCRIPTOR_DIM = 64
_CHANNELS = 64
_BOTTLENECK = 3  # values through which the instruction weighs the channels of a descriptor
_CONDITION_NOISE = 0.02  # on each number of the condition in training
_PEAK_RADIUS = 1  # of the cells around the maximum whose mean is a location


class Description(NamedTuple):
    """Descriptors of what demonstrations show.

    Attributes:
        moved: Descriptor of what was moved, (batch, DESCRIPTOR_DIM).
        target: Descriptor of where it was put, and that location, (batch, DESCRIPTOR_DIM + 2); None if the
            instruction alone says where.
        attention: Maps of both over the demonstrations, (batch, 2, h, w); each sums to 1.
    """

    moved: Tensor
    target: Tensor | None
    attention: Tensor


class Given(NamedTuple):
    """Which inputs are given, for a network that takes either: at least one of the two.

    Attributes:
        demonstration: Whether there is a demonstration, (batch,) bool.
        condition: Whether there is an instruction, (batch,) bool.
    """

    demonstration: Tensor
    condition: Tensor


class CorrespondenceNetwork(nn.Module):
    """Predicts the pick and place maps of a task over the first image of an episode.

    Args:
        picks_by_demonstration: Whether a demonstration says what to pick, and not the condition.
        places_by_demonstration: Whether a demonstration says where to place it, and not the condition.
        condition_dim: Size of the condition, an embedding of the instruction or the task's one-hot; 0 for
            none. With a condition, it also weighs the channels of what a demonstration describes.
        takes_either: Whether a demonstration, a condition, or both describe the task. With both, the
            demonstration says what to pick, and the condition where to place it.
    """

    def __init__(
        self,
        picks_by_demonstration: bool,
        places_by_demonstration: bool,
        condition_dim: int,
        takes_either: bool = False,
    ) -> None:
        super().__init__()
        self.picks_by_demonstration = picks_by_demonstration
        self.places_by_demonstration = places_by_demonstration
        self.takes_either = takes_either
        self.trunk = _Trunk()
        self.log_scale = nn.Parameter(torch.tensor(math.log(10.0)))
        if picks_by_demonstration or places_by_demonstration:
            self.attend = nn.Sequential(
                conv_norm_relu(6, 32, 5, 2),
                conv_norm_relu(32, 32),
                conv_norm_relu(32, 32),
                nn.Conv2d(32, 2, 1),
            )
        self.weigh: nn.Module | None = None
        if not picks_by_demonstration or takes_either:
            self.describe_condition = nn.Sequential(
                nn.Linear(condition_dim, 64), nn.ReLU(inplace=True), nn.Linear(64, DESCRIPTOR_DIM)
            )
        if picks_by_demonstration and condition_dim:
            self.weigh = nn.Sequential(
                nn.Linear(condition_dim, _BOTTLENECK), nn.Tanh(), nn.Linear(_BOTTLENECK, DESCRIPTOR_DIM)
            )
        target_dim = DESCRIPTOR_DIM + 2
        if takes_either:
            place_dim = condition_dim + target_dim
        else:
            place_dim = target_dim if places_by_demonstration else condition_dim
        self.place = PlaceNetwork(place_dim)

    def describe(self, ends: Tensor) -> Description:
        """Describes demonstrations by their first and last images, (batch, 2, 3, H, W) in 0..1."""
        weights = spatial_weights(self.attend(channels_last(ends.flatten(1, 2))))  # (batch, 2, h, w)
        moved = (self.trunk(ends[:, 0]) * weights[:, :1]).sum(dim=(2, 3))  # (batch, DESCRIPTOR_DIM)
        if not self.places_by_demonstration and not self.takes_either:
            return Description(moved, None, weights)
        container = (self.trunk(ends[:, -1]) * weights[:, 1:]).sum(dim=(2, 3))
        location = torch.cat(mean_location(weights[:, 1:]), dim=1)  # (batch, 2)
        return Description(moved, torch.cat([container, location], dim=1), weights)

    def no_description(self, n_tasks: int, device: torch.device) -> Description:
        """Returns zeros in place of descriptions, for tasks without demonstrations."""
        zeros = torch.zeros(n_tasks, DESCRIPTOR_DIM + 2, device=device)
        return Description(zeros[:, :-2], zeros, zeros[:, :2, None, None])

    def forward(
        self,
        scenes: Tensor,
        plain_scenes: Tensor,
        description: Description | None,
        condition: Tensor | None,
        given: Given | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Predicts pick and place maps.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1; in training, with the colors changed
                like those of the demonstrations.
            plain_scenes: The same in their own colors.
            description: Description of the demonstrations; None without them.
            condition: (batch, condition_dim); None if there is none.
            given: Which inputs are given, if the network takes either; the rest is ignored.
            generator: Source of the noise in training, on the CPU.

        Returns:
            Logits of the maps, (batch, 2, h, w), and features of the scenes, (batch, DESCRIPTOR_DIM, h, w),
            where h and w are half the height and width of the images.
        """
        if self.training and condition is not None:
            noise = torch.randn(condition.shape, generator=generator).to(condition)
            condition = condition + _CONDITION_NOISE * noise
        features = self.trunk(scenes)
        pick = self._pick_map(features, description, condition, given)
        if given is not None:
            assert description is not None
            assert description.target is not None
            assert condition is not None
            says = given.condition[:, None]
            target = torch.where(says, 0.0, description.target)
            condition = torch.cat([torch.where(says, condition.float(), 0.0), target], dim=1)
        elif self.places_by_demonstration:
            assert description is not None
            condition = description.target
        assert condition is not None
        place = self.place(plain_scenes, condition)
        return torch.stack([pick, place], dim=1), features

    def _pick_map(
        self, features: Tensor, description: Description | None, condition: Tensor | None, given: Given | None
    ) -> Tensor:
        """Returns the scaled cosine of the scenes' features and the descriptors, (batch, h, w)."""
        weighed = features
        if not self.picks_by_demonstration:
            descriptor = self.describe_condition(condition).float()
        else:
            assert description is not None
            descriptor = description.moved
            if self.weigh is not None:
                gate = 2 * torch.sigmoid(self.weigh(condition).float())  # (batch, DESCRIPTOR_DIM)
                if given is not None:
                    gate = torch.where((given.demonstration & given.condition)[:, None], gate, 1.0)
                descriptor, weighed = descriptor * gate, features * gate[:, :, None, None]
            if given is not None:
                named = self.describe_condition(condition).float()
                descriptor = torch.where(given.demonstration[:, None], descriptor, named)
        cosine = torch.einsum("bchw,bc->bhw", F.normalize(weighed, dim=1), F.normalize(descriptor, dim=1))
        return self.log_scale.exp() * cosine


class PlaceNetwork(nn.Module):
    """Predicts where in a scene an object is to go: convolutions with coordinates and FiLM.

    Args:
        condition_dim: Size of the input that specifies the place.
        channels: Number of channels.
    """

    def __init__(self, condition_dim: int, channels: int = 32) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_norm_relu(3, channels, 5, 2), conv_norm_relu(channels, channels))
        self.locate = conv_norm_relu(channels + 2, channels)
        self.refine = conv_norm_relu(channels, channels)
        self.films = nn.ModuleList(Film(condition_dim, channels) for _ in range(2))
        self.output = nn.Conv2d(channels, 1, 1)

    def forward(self, scenes: Tensor, condition: Tensor) -> Tensor:
        """Maps (batch, 3, H, W) and (batch, condition_dim) to logits (batch, H / 2, W / 2)."""
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


class _Trunk(nn.Module):
    """Features of scenes and demonstrations alike: (batch, 3, H, W) to (batch, DESCRIPTOR_DIM, h, w)."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_norm_relu(3, 32, 5, 2), conv_norm_relu(32, _CHANNELS))
        self.block = nn.Sequential(conv_norm_relu(_CHANNELS, _CHANNELS), conv_norm_relu(_CHANNELS, _CHANNELS))
        self.project = nn.Conv2d(_CHANNELS, DESCRIPTOR_DIM, 1)

    def forward(self, images: Tensor) -> Tensor:
        maps = self.stem(channels_last(images))
        return self.project(maps + self.block(maps)).float()


def peak_locations(logits: Tensor) -> Tensor:
    """Returns the peaks of maps: the means of the cells around them.

    Args:
        logits: (batch, maps, h, w).

    Returns:
        (batch, maps, 2) in -1..1.
    """
    height, width = logits.shape[-2:]
    weights = spatial_weights(logits)  # (batch, maps, h, w)
    greatest = F.avg_pool2d(weights, 3, 1, 1).flatten(2).argmax(dim=2)  # (batch, maps)
    row, column = greatest // width, greatest % width
    rows = torch.arange(height, device=logits.device)
    columns = torch.arange(width, device=logits.device)
    near = ((rows - row[..., None]).abs() <= _PEAK_RADIUS)[..., :, None] & (
        (columns - column[..., None]).abs() <= _PEAK_RADIUS
    )[..., None, :]
    weights = weights * near
    weights = weights / weights.sum(dim=(2, 3), keepdim=True)
    x = (weights.sum(dim=2) * cell_centers(width, logits.device)).sum(dim=2)
    y = (weights.sum(dim=3) * cell_centers(height, logits.device)).sum(dim=2)
    return torch.stack([x, y], dim=2)
