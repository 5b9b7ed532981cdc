"""Statistics of a LeRobotDataset: of an episode from its frames, of many episodes from theirs.

They mean what LeRobot's mean: population standard deviation, images in 0..1 and by channel. A quantile of
an episode is the smallest of its values which a sufficient share does not exceed (LeRobot estimates it from
bins); that of several episodes is, as LeRobot has it, the mean of theirs, weighted by count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)

Statistics = dict[str, NDArray]  # a statistic's name to its value


def feature_statistics(values: NDArray) -> Statistics:
    """Statistics of one feature in one episode.

    Args:
        values: Numbers or booleans, (N,) or (N, D), or images, (N, H, W, 3) uint8.

    Returns:
        Each statistic: (D,), (1,) for values of shape (N,), or (3, 1, 1) for images; the count is (1,).
    """
    if values.ndim == 4:
        return _image_statistics(values)
    numbers = values.astype(np.float64).reshape(len(values), -1)
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0, method="inverted_cdf")
    return {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def _image_statistics(images: NDArray[np.uint8]) -> Statistics:
    # Everything follows from how often each of the 256 levels occurs in each channel.
    levels = np.arange(256) / 255
    histograms = np.stack([np.bincount(images[..., channel].ravel(), minlength=256) for channel in range(3)])
    shares = histograms / histograms.sum(axis=1, keepdims=True)  # (3, 256)
    mean = shares @ levels
    reached = shares.cumsum(axis=1)
    statistics = {
        "min": levels[(histograms > 0).argmax(axis=1)],
        "max": levels[255 - (histograms > 0)[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0)),
        **{name: levels[(reached < share - 1e-12).sum(axis=1)] for name, share in QUANTILES.items()},
    }
    return {
        **{name: value.reshape(3, 1, 1) for name, value in statistics.items()},
        "count": np.array([len(images)]),
    }


def merged_statistics(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of a feature over several episodes (or parts of a dataset) from those of each."""
    stacked = {name: np.stack([part[name] for part in parts]) for name in STATISTICS}
    counts = stacked["count"].reshape(-1, *[1] * (stacked["mean"].ndim - 1))
    total = counts.sum()
    weights = counts / total
    mean = (weights * stacked["mean"]).sum(axis=0)
    variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([total]),
        **{name: (weights * stacked[name]).sum(axis=0) for name in QUANTILES},
    }


def merged_by_feature(parts: Sequence[dict[str, Statistics]]) -> dict[str, Statistics]:
    """Statistics of all features over several episodes (or parts of a dataset) from those of each."""
    return {feature: merged_statistics([part[feature] for part in parts]) for feature in parts[0]}
