"""Polynomial regression from few samples: robust to outliers, and no more flexible than the samples allow."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor

_REWEIGHTINGS = 10
_RIDGES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # that are compared, as fractions of the number of samples
_OUTLIER = 2.0  # median errors at which a sample counts a quarter


def robust_regression(
    features: Tensor, targets: Tensor, degrees: Tensor, least_error: float, scale: Tensor | None = None
) -> Tensor:
    """Fits a linear regression by iteratively reweighted least squares.

    For each target and each degree, the ridge is the one with the least leave-one-out error, so that few
    samples make a smooth function.

    Args:
        features: (n, features), of the order of 1.
        targets: (n, targets).
        degrees: Degree of each feature, (features,) int; those of degree 0 are not penalized.
        least_error: Median error below which errors are all alike.
        scale: Factor by which each target counts in the error of a sample, (targets,); by default, 1.

    Returns:
        Weights, (features, targets).
    """
    weights = torch.ones(len(features), device=features.device)
    for _ in range(_REWEIGHTINGS):
        solution = _smooth_regression(features, targets, weights, degrees)
        errors = features @ solution - targets
        errors = (errors if scale is None else errors * scale).norm(dim=1)
        usual = errors.median().clamp_min(least_error)
        weights = 1 / (1 + (errors / (_OUTLIER * usual)) ** 2) ** 2
    return solution


def _smooth_regression(features: Tensor, targets: Tensor, weights: Tensor, degrees: Tensor) -> Tensor:
    """Returns the weights of a regression of weighted samples, each target with its own ridges."""
    present = [degree for degree in degrees.unique().tolist() if degree > 0]
    # A higher degree is never penalized less.
    combinations = torch.tensor(list(combinations_with_replacement(_RIDGES, len(present))))
    ridges = torch.zeros(len(combinations), len(degrees))
    for degree, values in zip(present, combinations.T, strict=True):
        ridges[:, degrees.cpu() == degree] = values[:, None] * len(features)
    weighted = features * weights[:, None]
    gram, moments = weighted.T @ features, weighted.T @ targets
    inverse = torch.linalg.inv(gram + torch.diag_embed(ridges.to(features)))  # (ridges, features, features)
    solutions = inverse @ moments  # (ridges, features, targets)
    leverage = ((features @ inverse) * weighted).sum(dim=2).clamp(max=0.999)  # (ridges, n)
    errors = (targets - features @ solutions) / (1 - leverage)[..., None]
    best = (weights[:, None] * errors.square()).sum(dim=1).argmin(dim=0)  # (targets,)
    return solutions[best, :, torch.arange(len(best), device=best.device)].T
