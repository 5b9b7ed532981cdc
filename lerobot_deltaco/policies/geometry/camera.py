"""A camera without distortion, known by the images of points: 11 numbers that hold at any height."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

_LEAST_ERROR = 0.02  # of a location, in -1..1, above which a point is taken for an outlier
# Weight of the perspective's strength beside an error of locations: a few points hardly tell it.
_PERSPECTIVE_WEIGHT = 0.005


def fit_camera(points: Tensor, locations: Tensor) -> Tensor:
    """Fits a projective map from points to locations, robust to outliers.

    Args:
        points: Points x, y, z, (n, 3), of the order of 1.
        locations: Where they are in the image, (n, 2) in -1..1.

    Returns:
        The camera, a homogeneous matrix (3, 4) whose last number is 1.
    """
    seen = locations.double().cpu().numpy()
    homogeneous = np.concatenate([points.double().cpu().numpy(), np.ones((len(points), 1))], axis=1)
    affine = np.linalg.lstsq(homogeneous, seen, rcond=None)[0].T  # (2, 4)

    def errors(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        camera = np.append(numbers, 1.0).reshape(3, 4)
        projected = homogeneous @ camera.T
        penalty = _PERSPECTIVE_WEIGHT * np.sqrt(len(seen)) * numbers[8:]
        return np.concatenate([(projected[:, :2] / projected[:, 2:] - seen).ravel(), penalty])

    start = np.concatenate([affine.ravel(), np.zeros(3)])
    numbers = least_squares(errors, start, loss="soft_l1", f_scale=_LEAST_ERROR).x
    return torch.from_numpy(np.append(numbers, 1.0).reshape(3, 4)).to(points)


def project(camera: Tensor, points: Tensor) -> Tensor:
    """Returns where a camera (3, 4) sees points (..., 3), (..., 2) in -1..1."""
    projected = points @ camera[:, :3].T + camera[:, 3]
    return projected[..., :2] / projected[..., 2:]


def point_at(camera: Tensor, locations: Tensor, z: Tensor) -> Tensor:
    """Returns the x and y of points that a camera sees at locations, (..., 2).

    Args:
        camera: The camera, (3, 4).
        locations: Locations in the image, (..., 2) in -1..1.
        z: Heights of the points, (...).
    """
    # A location (u, v) is two planes, camera[0] = u camera[2] and camera[1] = v camera[2].
    planes = camera[:2] - locations[..., None] * camera[2]  # (..., 2, 4)
    known = planes[..., 2] * z[..., None] + planes[..., 3]
    return torch.linalg.solve(planes[..., :2], -known[..., None])[..., 0]
