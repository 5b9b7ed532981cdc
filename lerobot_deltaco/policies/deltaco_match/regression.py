"""Polynomial regression from few samples: robust to outliers, and no more flexible than the samples allow."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor

_ROUNDS = 10  # of reweighting
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
    for _ in range(_ROUNDS):
        solution = _smooth_regression(features, targets, weights, degrees)
        errors = features @ solution - targets
        errors = (errors if scale is None else errors * scale).norm(dim=1)
        usual = errors.median().clamp_min(least_error)
        weights = 1 / (1 + (errors / (_OUTLIER * usual)) ** 2) ** 2
    return solution


def _smooth_regression(features: Tensor, targets: Tensor, weights: Tensor, degrees: Tensor) -> Tensor:
    """Returns the weights of a regression of weighted samples, each target with its own ridges."""
    present = [degree for degree in degrees.unique().tolist() if degree > 0]
    weighted = features * weights[:, None]
    gram, moments = weighted.T @ features, weighted.T @ targets
    best = torch.zeros_like(moments)
    least = torch.full((targets.shape[1],), torch.inf, device=features.device)
    # A higher degree is never penalized less.
    for ridges in combinations_with_replacement(_RIDGES, len(present)):
        ridge = torch.zeros(len(degrees), device=features.device)
        for degree, value in zip(present, ridges, strict=True):
            ridge[degrees == degree] = value * len(features)
        inverse = torch.linalg.inv(gram + torch.diag(ridge))
        solution = inverse @ moments
        leverage = ((features @ inverse) * weighted).sum(dim=1).clamp(max=0.999)
        errors = (targets - features @ solution) / (1 - leverage)[:, None]
        error = (weights[:, None] * errors.square()).sum(dim=0)
        best, least = torch.where(error < least, solution, best), torch.minimum(error, least)
    return best
