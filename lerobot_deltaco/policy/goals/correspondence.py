r"""Correspondence (ours): finds in a scene what a demonstration moved, and where an instruction wants it.

    demonstration's first and last image             first image of the scene
            |               \                            |             \
     moved (conv, softmax)   trunk  <---- shared ---->  trunk          container network
            |                  |                         |                  |    ^
     weights over places -> descriptor              features f(x)           |    | FiLM
                               |_______ cosine _________|                   | instruction
                                           |                                |
                              grasp map: where that thing is    release map: where it shall go
                                           \______________   ________________/
                                                          \ /
                                             two goals, places in the image

A task embedding that is pulled towards a sentence cannot say what a novel object looks like. A descriptor
can: it is made of the same features that the scene has, so what was demonstrated is looked for instead of
named.

Goal: a place in the image, x (to the right) and y (down) in -1..1 between its edges: where the gripper closes
(the grasp), and where it opens again (the release). Goals are found once, in the first image of an episode.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.networks import Film, cell_centers, gaussian_maps, mean_position, spatial_weights

GOALS = ("grasp", "release")
_TARGET_STD = 0.8  # of the places that count as right, in cells of the maps
_PEAK_RADIUS = 1  # of the cells around the greatest whose mean is a goal


class Description(NamedTuple):
    """What demonstrations say of their tasks.

    Attributes:
        moved: Features of what was moved, (batch, descriptor_dim).
        target: Features of where it was put, and that place, (batch, descriptor_dim + 2); None if the locator
            takes that from the condition.
        attention: Maps of both places over the demonstrations, (batch, 2, h, w); each map sums to 1.
    """

    moved: Tensor
    target: Tensor | None
    attention: Tensor


class Given(NamedTuple):
    """What is given of each task, for a locator that takes either: at least one of both.

    Attributes:
        demo: Whether there is a demonstration, (batch,) bool.
        condition: Whether there is a condition, (batch,) bool.
    """

    demo: Tensor
    condition: Tensor


class Located(NamedTuple):
    """Where the goals of scenes may be.

    Attributes:
        logits: Maps of the grasp and the release over places, (batch, 2, h, w), where h and w are the height
            and width of the images divided by `2 * detail`.
        features: Features of the scenes' places, (batch, descriptor_dim, h, w).
    """

    logits: Tensor
    features: Tensor


class GoalLocator(nn.Module):
    """Finds the grasp and the release of a task in the first image of an episode.

    Args:
        grasp_source: Source of what is to be grasped: "demo", its description, or "condition", an
            embedding of the instruction or the task's one-hot.
        release_source: Source of where it is to go; the same.
        condition_dim: Size of the condition, 0 for none. With a condition, it also weighs the channels of
            what a demonstration describes.
        channels: Number of channels of the maps.
        descriptor_dim: Size of a descriptor.
        bottleneck: Number of values through which the condition weighs a descriptor.
        condition_noise: Standard deviation of the noise on each number of the condition in training.
        takes_either: Whether a demonstration, a condition, or both describe the task. With both, the
            demonstration says what to grasp, and the condition where to release it.
        detail: Factor by which images are larger than those that the maps have half the side of: a power of
            2. Only the features see the images as they are: what needs detail is the shape of objects.
    """

    def __init__(
        self,
        grasp_source: str,
        release_source: str,
        condition_dim: int,
        channels: int = 64,
        descriptor_dim: int = 64,
        bottleneck: int = 3,
        condition_noise: float = 0.02,
        takes_either: bool = False,
        detail: int = 1,
    ) -> None:
        super().__init__()
        if takes_either and (grasp_source, release_source) != ("demo", "condition"):
            raise ValueError("A locator that takes either has the sources 'demo' and 'condition'.")
        self.grasp_source, self.release_source = grasp_source, release_source
        self.takes_either = takes_either
        self.condition_noise, self.descriptor_dim = condition_noise, descriptor_dim
        self.detail = detail
        self.trunk = _Trunk(channels, descriptor_dim, detail)
        self.log_scale = nn.Parameter(torch.tensor(math.log(10.0)))
        if "demo" in (grasp_source, release_source):
            self.attend = nn.Sequential(
                _convolution(6, 32, 5, 2), _convolution(32, 32), _convolution(32, 32), nn.Conv2d(32, 2, 1)
            )
        self.weigh: nn.Module | None = None
        if grasp_source == "condition" or takes_either:
            self.describe_condition = nn.Sequential(
                nn.Linear(condition_dim, 64), nn.ReLU(inplace=True), nn.Linear(64, descriptor_dim)
            )
        if grasp_source == "demo" and condition_dim:
            self.weigh = nn.Sequential(
                nn.Linear(condition_dim, bottleneck), nn.Tanh(), nn.Linear(bottleneck, descriptor_dim)
            )
        target_dim = descriptor_dim + 2
        if takes_either:
            self.release = ReleaseNetwork(condition_dim + target_dim)
        else:
            self.release = ReleaseNetwork(condition_dim if release_source == "condition" else target_dim)

    def describe(self, frames: Tensor) -> Description:
        """Describes demonstrations, from their first and last images (batch, 2, 3, H, W) in 0..1."""
        small = self._without_detail(frames.flatten(1, 2))
        weights = spatial_weights(self.attend(_channels_last(small)))  # (batch, 2, h, w)
        moved = (self.trunk(frames[:, 0]) * weights[:, :1]).sum(dim=(2, 3))  # (batch, descriptor_dim)
        if self.release_source != "demo" and not self.takes_either:
            return Description(moved, None, weights)
        container = (self.trunk(frames[:, -1]) * weights[:, 1:]).sum(dim=(2, 3))
        place = torch.cat(mean_position(weights[:, 1:]), dim=1)  # (batch, 2)
        return Description(moved, torch.cat([container, place], dim=1), weights)

    def no_description(self, n_tasks: int, device: torch.device) -> Description:
        """What stands for the descriptions of tasks without demonstrations: zeros."""
        zeros = torch.zeros(n_tasks, self.descriptor_dim + 2, device=device)
        return Description(zeros[:, :-2], zeros, zeros[:, :2, None, None])

    def forward(
        self,
        scenes: Tensor,
        plain_scenes: Tensor,
        description: Description | None,
        condition: Tensor | None,
        generator: torch.Generator | None = None,
        given: Given | None = None,
    ) -> Located:
        """Finds the goals.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1; in training, recolored like the
                demonstrations.
            plain_scenes: The same in their own colors.
            description: Description of the demonstrations; None without them.
            condition: (batch, condition_dim); None if there is none.
            generator: Source of the noise in training, on the CPU.
            given: What is given of each task, if the locator takes either; it ignores the rest.
        """
        if self.training and condition is not None:
            noise = torch.randn(condition.shape, generator=generator).to(condition)
            condition = condition + self.condition_noise * noise
        features = weighed = self.trunk(scenes)
        if self.grasp_source == "condition":
            descriptor = self.describe_condition(condition).float()
        else:
            assert description is not None
            descriptor = description.moved
            if self.weigh is not None:
                gate = 2 * torch.sigmoid(self.weigh(condition).float())  # (batch, descriptor_dim)
                if given is not None:
                    gate = torch.where((given.demo & given.condition)[:, None], gate, 1.0)
                descriptor, weighed = descriptor * gate, features * gate[:, :, None, None]
            if given is not None:
                named = self.describe_condition(condition).float()
                descriptor = torch.where(given.demo[:, None], descriptor, named)
        grasp = self.log_scale.exp() * torch.einsum(
            "bchw,bc->bhw", F.normalize(weighed, dim=1), F.normalize(descriptor, dim=1)
        )
        if given is not None:
            assert condition is not None
            assert description is not None
            assert description.target is not None
            says = given.condition[:, None]
            target = torch.where(says, 0.0, description.target)
            condition = torch.cat([torch.where(says, condition.float(), 0.0), target], dim=1)
        elif self.release_source == "demo":
            assert description is not None
            condition = description.target
        assert condition is not None
        release = self.release(self._without_detail(plain_scenes), condition)
        return Located(torch.stack([grasp, release], dim=1), features)

    def _without_detail(self, images: Tensor) -> Tensor:
        """Images (batch, channels, H, W) at the size that the maps have half the side of."""
        return images if self.detail == 1 else F.avg_pool2d(images, self.detail)


class ReleaseNetwork(nn.Module):
    """Where in a scene something is to go: convolutions with coordinates and FiLM.

    Args:
        condition_dim: Size of what says where.
        channels: Number of channels.
    """

    def __init__(self, condition_dim: int, channels: int = 32) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, channels, 5, 2), _convolution(channels, channels))
        self.locate = _convolution(channels + 2, channels)
        self.refine = _convolution(channels, channels)
        self.films = nn.ModuleList(Film(condition_dim, channels) for _ in range(2))
        self.output = nn.Conv2d(channels, 1, 1)

    def forward(self, scenes: Tensor, condition: Tensor) -> Tensor:
        """From (batch, 3, H, W) and (batch, condition_dim) to logits (batch, H / 2, W / 2)."""
        maps = self.stem(_channels_last(scenes))
        height, width = maps.shape[-2:]
        y, x = torch.meshgrid(
            torch.linspace(-1, 1, height, device=maps.device),
            torch.linspace(-1, 1, width, device=maps.device),
            indexing="ij",
        )
        places = torch.stack([x, y]).to(maps.dtype).expand(len(maps), -1, -1, -1)
        maps = F.relu(self.films[0](self.locate(torch.cat([maps, places], dim=1)), condition))
        maps = F.relu(self.films[1](self.refine(maps), condition))
        return self.output(maps)[:, 0].float()


class _Trunk(nn.Module):
    """Features of places, for scenes and demonstrations alike: (batch, 3, H, W) to (batch, dim, h, w)."""

    def __init__(self, channels: int, dim: int, detail: int) -> None:
        super().__init__()
        halvings = [_convolution(32, 32, 3, 2) for _ in range(detail.bit_length() - 1)]
        self.stem = nn.Sequential(_convolution(3, 32, 5, 2), *halvings, _convolution(32, channels))
        self.block = nn.Sequential(_convolution(channels, channels), _convolution(channels, channels))
        self.project = nn.Conv2d(channels, dim, 1)

    def forward(self, images: Tensor) -> Tensor:
        maps = self.stem(_channels_last(images))
        return self.project(maps + self.block(maps)).float()


def _convolution(in_channels: int, out_channels: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, size, stride, padding=size // 2, bias=False),
        nn.BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    )


def _channels_last(images: Tensor) -> Tensor:
    return images.contiguous(memory_format=torch.channels_last)


def goal_loss(logits: Tensor, goals: Tensor) -> Tensor:
    """Cross-entropy of maps and a small Gaussian around the places of the goals.

    Args:
        logits: (batch, goals, h, w).
        goals: Places in -1..1, (batch, goals, 2).

    Returns:
        (batch, goals).
    """
    height, width = logits.shape[-2:]
    std = 2 * _TARGET_STD / torch.tensor([width, height], device=logits.device)
    targets = gaussian_maps(goals, height, width, std).flatten(2)
    targets = targets / targets.sum(dim=2, keepdim=True).clamp_min(1e-6)
    return -(targets * logits.flatten(2).log_softmax(dim=2)).sum(dim=2)


def peak_places(logits: Tensor) -> Tensor:
    """Places of the peaks of maps: the mean of the cells around them.

    Args:
        logits: (batch, goals, h, w).

    Returns:
        (batch, goals, 2), x and y in -1..1.
    """
    height, width = logits.shape[-2:]
    weights = spatial_weights(logits)  # (batch, goals, h, w)
    greatest = F.avg_pool2d(weights, 3, 1, 1).flatten(2).argmax(dim=2)  # (batch, goals)
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
