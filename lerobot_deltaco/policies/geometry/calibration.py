"""Calibration of the camera: from robot states to locations, learned from images of episodes.

Where the gripper closed around an object, the image stays changed: the object is gone while it is carried,
and at the end. The map from states to locations sends the states at the grasps to the locations of these
changes. So no calibrated camera is needed, only a fixed one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.base.image_coordinates import grid_of_centers, mean_near
from lerobot_deltaco.policies.geometry.camera import fit_camera, point_at, project
from lerobot_deltaco.policies.geometry.regression import robust_regression

logger = logging.getLogger(__name__)

EPISODES_PER_CLUSTER = 60
MIN_CLUSTERS, MAX_CLUSTERS = 12, 200
MIN_EPISODES = 2 * MIN_CLUSTERS
_CLUSTER_ROUNDS = 10  # of k-means
_BLUR = 1 / 24  # standard deviation, as a fraction of the image's side
_N_STARTS, _REFINEMENTS = 5, 5
_MAX_REFINEMENT = 1 / 8  # distance from a predicted location, as a fraction of the image's side
_PEAK_RADIUS = 1.5  # around a maximum, within which changes count for its location; in standard deviations
_LEAST_ERROR = 0.02  # of a location, in -1..1, below which errors are all alike
# Median distance of changes from where they are expected, as a fraction of that in other episodes. In
# episodes of the benchmark, it is at most 0.17; with states shuffled between 60 of them, at least 0.5.
_DOUBTFUL = 0.35


class ImageProjection(nn.Module):
    """Projects robot states to locations in the image.

    If it is known which dimensions are the hand's position, a camera sees that; otherwise, the map is
    quadratic in the state.

    Args:
        state_dim: Size of the robot's state.

    Attributes:
        position_dims: Dimensions that are the hand's position along x, y and z, (3,) int64; -1 if these are
            not known.
        residual: Median distance of changes in the training episodes from where they are expected, as a
            fraction of the image's side, (); negative if it is not known.
    """

    residual: Tensor
    mean: Tensor
    scale: Tensor
    weights: Tensor
    position_dims: Tensor
    camera: Tensor

    def __init__(self, state_dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(state_dim))
        self.register_buffer("scale", torch.zeros(state_dim))
        self.register_buffer("weights", torch.zeros(_quadratic(self.mean).shape[-1], 2))
        self.register_buffer("residual", torch.tensor(-1.0))
        self.register_buffer("position_dims", torch.full((3,), -1))
        self.register_buffer("camera", torch.zeros(3, 4))

    @property
    def has_camera(self) -> bool:
        """Whether the hand's position is known, and a camera sees it."""
        return bool((self.position_dims >= 0).all())

    def fit(
        self,
        first: Tensor,
        carried: Tensor,
        last: Tensor,
        states: Tensor,
        scale: Tensor,
        position_dims: Sequence[int] | None = None,
    ) -> None:
        """Learns the map from episodes; warns if it fits badly.

        Args:
            first: First images of episodes, (episodes, 3, H, W) uint8.
            carried: Images of the same episodes, halfway between grasp and release.
            last: Last images of the same episodes.
            states: States at their grasps, (episodes, state), at least `MIN_EPISODES`.
            scale: Factor by which each dimension counts, (state,), such as 1 / its standard deviation over
                all frames. So velocities, which are only noise at a grasp, hardly count.
            position_dims: Dimensions that are the hand's position along x, y and z; None if they are
                not known. Without any movement along x or y, they do not count.
        """
        states = states.float()
        mean, std = states.mean(dim=0), states.std(dim=0)
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(std > 1e-6 * (1 + mean.abs()), scale, 0.0))
        changes = _changes(first, carried, last)  # (episodes, H, W)
        x = (states - mean) * self.scale.to(mean)
        smooth = _blurred(changes)
        is_seen = position_dims is not None and bool((self.scale[list(position_dims[:2])] != 0).all())
        self.position_dims.copy_(torch.tensor(list(position_dims or ()) if is_seen else [-1] * 3))
        starts = [self._fit_to_changes(x, changes, smooth, seed) for seed in range(_N_STARTS)]
        best, near = max(starts, key=lambda start: _change_at(smooth, self._map(x, start[0])))
        (self.camera if self.has_camera else self.weights).copy_(best)
        locations = self._map(x, best)
        distance = _distance(near, locations)
        self.residual.fill_(distance)
        # As near as this, something changes in any episode.
        others = locations.roll(1, dims=0)
        chance = _distance(_peaks_near(smooth, others), others)
        if distance > _DOUBTFUL * chance:
            logger.warning(
                "Objects do not disappear where the robot's states at the grasps suggest, but %.0f %% of the "
                "image's side away (median), so the locations are probably wrong. See whether the rings of "
                "`deltaco check` lie on the objects. Another camera (--policy.demo_camera) or larger images "
                "(--policy.image_size) may help.",
                100 * distance,
            )

    def forward(self, states: Tensor) -> Tensor:
        """Maps states (..., state) to locations (..., 2)."""
        x = (states.float() - self.mean) * self.scale
        return self._map(x, self.camera if self.has_camera else self.weights)

    def positions_at(self, locations: Tensor, states: Tensor) -> Tensor:
        """Moves states to where the camera sees the hand at locations, as high as it is.

        Args:
            locations: Locations, (..., 2) in -1..1.
            states: States, (..., state).

        Returns:
            Another x and y in the states, (..., state).
        """
        *across, up = self.position_dims.tolist()
        mean, scale = self.mean, self.scale
        x_and_y = point_at(self.camera, locations, (states[..., up] - mean[up]) * scale[up])
        moved = states.clone()
        moved[..., across] = x_and_y / scale[across] + mean[across]
        return moved

    def _map(self, x: Tensor, weights: Tensor) -> Tensor:
        """Maps normalized states (..., dims) to locations (..., 2)."""
        if self.has_camera:
            return project(weights, x[..., self.position_dims])
        return _quadratic(x) @ weights

    def _fit_to_changes(self, x: Tensor, changes: Tensor, smooth: Tensor, seed: int) -> tuple[Tensor, Tensor]:
        """Fits the map from normalized states (episodes, dims) to where images change.

        Args:
            x: The states.
            changes: Change of each pixel, (episodes, H, W).
            smooth: The same, blurred.
            seed: Seed of the clusters with which the fit begins.

        Returns:
            Weights of the map, and the location of the change in each episode, (episodes, 2).
        """
        centers, members = _clusters(x, seed)
        # A change in the episodes of a cluster, but not in others, belongs to the states of the cluster.
        average = torch.stack([changes[members == k].mean(dim=0) for k in range(len(centers))])
        peaks = _peaks(_blurred(average - average.mean(dim=0)))
        locations = _linear(x) @ _fit(_linear(centers), peaks, x.shape[1])
        # Refine with each episode's own change near the expected location, which gives many more points.
        for _ in range(_REFINEMENTS):
            near = _peaks_near(smooth, locations)
            if self.has_camera:
                weights = fit_camera(x[:, self.position_dims], near)
            else:
                weights = _fit(_quadratic(x), near, x.shape[1])
            locations = self._map(x, weights)
        return weights, near


def _changes(first: Tensor, carried: Tensor, last: Tensor) -> Tensor:
    """Returns the lasting change of each pixel in an episode, beyond its usual change, (episodes, H, W)."""
    # The robot moves on, so that it hardly ever changes a pixel in both of the later images.
    changes = torch.stack(
        [
            torch.minimum(*((image.float() - before.float()).abs().mean(dim=0) / 255 for image in later))
            for before, *later in zip(first, carried, last, strict=True)
        ]
    )
    # But it has left its first place in every episode.
    return (changes - changes.mean(dim=0)) / (changes.std(dim=0) + 0.02)


def _change_at(maps: Tensor, locations: Tensor) -> float:
    """Returns the mean value of maps (n, H, W) at locations (n, 2); 0 outside of them."""
    return float(F.grid_sample(maps[:, None], locations[:, None, None], align_corners=False).mean())


def _clusters(x: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Returns centers (clusters, dims) by k-means, none empty, and the cluster of each point, (points,)."""
    n_clusters = max(MIN_CLUSTERS, min(MAX_CLUSTERS, len(x) // EPISODES_PER_CLUSTER))
    generator = torch.Generator().manual_seed(seed)
    centers = x[torch.randperm(len(x), generator=generator)[:n_clusters].to(x.device)]
    for _ in range(_CLUSTER_ROUNDS):
        members = torch.cdist(x, centers).argmin(dim=1)
        centers = torch.stack([x[members == k].mean(dim=0) for k in members.unique()])
    members = torch.cdist(x, centers).argmin(dim=1)
    numbers, members = members.unique(return_inverse=True)
    return centers[numbers], members


def _blur_std(maps: Tensor) -> float:
    """Returns the standard deviation of the blur of maps (n, H, W), px."""
    return max(1.0, _BLUR * max(maps.shape[-2:]))


def _blurred(maps: Tensor) -> Tensor:
    """Convolves maps (n, H, W) with a Gaussian."""
    std = _blur_std(maps)
    radius = math.ceil(3 * std)
    offsets = torch.arange(-radius, radius + 1, device=maps.device)
    kernel = torch.exp(-(offsets**2) / (2 * std**2))
    kernel = kernel / kernel.sum()
    across = F.conv2d(maps[:, None], kernel.view(1, 1, 1, -1), padding=(0, radius))
    return F.conv2d(across, kernel.view(1, 1, -1, 1), padding=(radius, 0))[:, 0]


def _distance(locations: Tensor, others: Tensor) -> float:
    """Returns the median distance of locations (n, 2) from others, as a fraction of the image's side."""
    return float((locations - others).norm(dim=1).median()) / 2


def _peaks(maps: Tensor) -> Tensor:
    """Returns the locations of the maxima of maps (n, H, W), (n, 2)."""
    top, cells = maps.flatten(1).max(dim=1)
    weights = (maps / top[:, None, None].clamp_min(1e-6)).clamp_min(0).square()
    return mean_near(weights, cells, _PEAK_RADIUS * _blur_std(maps))


def _peaks_near(maps: Tensor, locations: Tensor) -> Tensor:
    """Returns the locations of the maxima within `_MAX_REFINEMENT` of locations (n, 2).

    For the few locations farther outside the image, it is the top left corner, which the fit downweights as
    an outlier.
    """
    grid = grid_of_centers(maps.shape[1], maps.shape[2], maps.device)
    peaks = []
    for some, around in zip(maps.split(512), locations.split(512), strict=True):
        far = torch.cdist(around, grid) > 2 * _MAX_REFINEMENT  # (some, H * W)
        peaks.append(_peaks(some.masked_fill(far.view_as(some), -math.inf)))
    return torch.cat(peaks)


def _fit(features: Tensor, locations: Tensor, n_dims: int) -> Tensor:
    """Returns the weights of a regression of locations (n, 2) on linear or quadratic features."""
    columns = torch.arange(features.shape[1], device=features.device)
    degrees = (columns > 0).int() + (columns > n_dims).int()
    return robust_regression(features, locations, degrees, _LEAST_ERROR)


def _linear(x: Tensor) -> Tensor:
    """Prepends 1 to numbers: (..., dims) to (..., 1 + dims)."""
    return torch.cat([torch.ones_like(x[..., :1]), x], dim=-1)


def _quadratic(x: Tensor) -> Tensor:
    """Appends the products of numbers to these."""
    n_dims = x.shape[-1]
    i, j = torch.triu_indices(n_dims, n_dims, device=x.device)
    return torch.cat([_linear(x), x[..., i] * x[..., j]], dim=-1)
