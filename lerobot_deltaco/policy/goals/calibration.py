"""From robot states to places in the image, learned from what changes between an episode's two ends.

Where the gripper closed around an object, the image has changed at the end of the episode: the object is
gone. The map from states to places sends the states at the grasps to the places of these changes. So no
calibrated camera is needed, only one that does not move.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.networks import cell_centers

EPISODES_PER_CLUSTER = 60
MIN_CLUSTERS, MAX_CLUSTERS = 12, 200
MIN_EPISODES = 2 * MIN_CLUSTERS
_ROUNDS = 10  # of k-means, of the robust regression and of the refinement
_BLUR = 1 / 32  # standard deviation, as a share of the image's side
_REACH = 1 / 8  # of the refinement around a predicted place, as a share of the image's side
_RIDGE = 1e-2


class StateToImage(nn.Module):
    """A map from robot states to places in the image, quadratic in the state.

    Places are x (to the right) and y (down), -1..1 between the image's edges.

    Args:
        state_dim: Size of the robot's state.
    """

    mean: Tensor
    scale: Tensor
    weights: Tensor

    def __init__(self, state_dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(state_dim))
        self.register_buffer("scale", torch.zeros(state_dim))
        self.register_buffer("weights", torch.zeros(_quadratic(self.mean).shape[-1], 2))

    def fit(self, first: Tensor, last: Tensor, states: Tensor) -> None:
        """Learns the map from episodes.

        Args:
            first: First images of episodes, (episodes, 3, H, W) uint8.
            last: Last images of the same episodes.
            states: States at their grasps, (episodes, state).

        Raises:
            ValueError: There are fewer than `MIN_EPISODES`.
        """
        if len(states) < MIN_EPISODES:
            raise ValueError(
                "With `demo_encoder=correspondence`, the policy learns where grasps are in the image from at "
                f"least {MIN_EPISODES} episodes in which the gripper closes and opens. Got {len(states)}. "
                "Collect more, or choose another `demo_encoder`, such as 'attention'."
            )
        states = states.float()
        mean, std = states.mean(dim=0), states.std(dim=0)
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(std > 1e-6 * (1 + mean.abs()), 1 / std.clamp_min(1e-12), 0.0))
        changes = _changes(first, last)  # (episodes, H, W)
        x = (states - mean) * self.scale.to(mean)
        centers, members = _clusters(x)
        # What changes in the episodes of a cluster, and not in the others, is what its states have in common.
        average = torch.stack([changes[members == k].mean(dim=0) for k in range(len(centers))])
        peaks = _peaks(_blurred(average - average.mean(dim=0)))
        linear = _robust_fit(_linear(centers), peaks)
        places = _linear(x) @ linear
        # Each episode's own change near the place that is expected: that is many more points.
        smooth = _blurred(changes)
        weights = _padded(linear, len(self.weights))
        for _ in range(_ROUNDS):
            weights = _robust_fit(_quadratic(x), _peaks_near(smooth, places))
            places = _quadratic(x) @ weights
        self.weights.copy_(weights)

    def forward(self, states: Tensor) -> Tensor:
        """Places of states: (..., state) to (..., 2)."""
        return _quadratic((states.float() - self.mean) * self.scale) @ self.weights


def _changes(first: Tensor, last: Tensor) -> Tensor:
    """Change of each pixel in an episode, beyond its usual change in the others, (episodes, H, W)."""
    changes = torch.stack(
        [(b.float() - a.float()).abs().mean(dim=0) / 255 for a, b in zip(first, last, strict=True)]
    )
    # What changes in every episode is the robot itself.
    return (changes - changes.mean(dim=0)) / (changes.std(dim=0) + 0.02)


def _clusters(x: Tensor) -> tuple[Tensor, Tensor]:
    """k-means: centers, (clusters, dims), and the cluster of each point, (points,). None is empty."""
    n_clusters = max(MIN_CLUSTERS, min(MAX_CLUSTERS, len(x) // EPISODES_PER_CLUSTER))
    generator = torch.Generator().manual_seed(0)
    centers = x[torch.randperm(len(x), generator=generator)[:n_clusters].to(x.device)]
    for _ in range(_ROUNDS):
        members = torch.cdist(x, centers).argmin(dim=1)
        numbers = members.unique()
        centers = torch.stack([x[members == k].mean(dim=0) for k in numbers])
    members = torch.cdist(x, centers).argmin(dim=1)
    numbers, members = members.unique(return_inverse=True)
    return centers[numbers], members


def _blurred(maps: Tensor) -> Tensor:
    """Maps (n, H, W) under a Gaussian."""
    height, width = maps.shape[-2:]
    std = max(1.0, _BLUR * max(height, width))
    radius = math.ceil(3 * std)
    offsets = torch.arange(-radius, radius + 1, device=maps.device)
    kernel = torch.exp(-(offsets**2) / (2 * std**2))
    kernel = kernel / kernel.sum()
    across = F.conv2d(maps[:, None], kernel.view(1, 1, 1, -1), padding=(0, radius))
    return F.conv2d(across, kernel.view(1, 1, -1, 1), padding=(radius, 0))[:, 0]


def _grid(maps: Tensor) -> Tensor:
    """Places of the pixels of (n, H, W) maps, (H * W, 2)."""
    height, width = maps.shape[-2:]
    y, x = cell_centers(height, maps.device), cell_centers(width, maps.device)
    return torch.stack([x.repeat(height), y.repeat_interleave(width)], dim=1)


def _peaks(maps: Tensor) -> Tensor:
    """Places where (n, H, W) maps are greatest, (n, 2)."""
    return _grid(maps)[maps.flatten(1).argmax(dim=1)]


def _peaks_near(maps: Tensor, places: Tensor) -> Tensor:
    """The same within `_REACH` of places (n, 2).

    For the few places farther than that outside of the image, it is the top left corner. The fit counts it
    little, as an outlier.
    """
    grid = _grid(maps)
    peaks = []
    for some, around in zip(maps.split(512), places.split(512), strict=True):
        far = torch.cdist(around, grid) > 2 * _REACH  # (some, H * W)
        peaks.append(grid[some.flatten(1).masked_fill(far, -math.inf).argmax(dim=1)])
    return torch.cat(peaks)


def _robust_fit(features: Tensor, targets: Tensor) -> Tensor:
    """Weights of a linear regression in which outliers count little, (features, targets)."""
    weights = torch.ones(len(features), device=features.device)
    ridge = _RIDGE * len(features) * torch.eye(features.shape[1], device=features.device)
    ridge[0, 0] = 0
    for _ in range(_ROUNDS):
        weighted = features * weights[:, None]
        solution = torch.linalg.solve(weighted.T @ features + ridge, weighted.T @ targets)
        errors = (features @ solution - targets).norm(dim=1)
        usual = errors.median().clamp_min(0.02)
        weights = 1 / (1 + (errors / (2 * usual)) ** 2) ** 2
    return solution


def _padded(weights: Tensor, n_features: int) -> Tensor:
    return F.pad(weights, (0, 0, 0, n_features - len(weights)))


def _linear(x: Tensor) -> Tensor:
    """1 and the numbers themselves: (..., dims) to (..., 1 + dims)."""
    return torch.cat([torch.ones_like(x[..., :1]), x], dim=-1)


def _quadratic(x: Tensor) -> Tensor:
    """These and their products."""
    n_dims = x.shape[-1]
    i, j = torch.triu_indices(n_dims, n_dims, device=x.device)
    return torch.cat([_linear(x), x[..., i] * x[..., j]], dim=-1)
