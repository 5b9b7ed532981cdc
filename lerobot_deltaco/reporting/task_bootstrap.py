"""Intervals by bootstrap over tasks.

The episodes of a task are alike, and runs with different seeds of training see the same scenes: neither are
independent trials. Therefore tasks are drawn with replacement, each with all its episodes of all seeds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.evaluation.record import EpisodeResult

N_DRAWS = 10_000
_SEED = 0  # of the draws, so that a report is a function of its records


class Estimate(NamedTuple):
    """A mean over tasks, or a difference of two, with its interval.

    Attributes:
        value: Share, 0..1, or difference of shares, -1..1.
        low: Lower end of the 95 % interval.
        high: Upper end of the 95 % interval.
    """

    value: float
    low: float
    high: float


def estimate_text(estimate: Estimate, sign: str = "") -> str:
    """An estimate in %, such as "25.8 [20.1, 31.4]".

    Args:
        estimate: The estimate.
        sign: "+" for a sign before positive numbers, too.
    """
    value, low, high = (f"{100 * number:{sign}.1f}" for number in estimate)
    return f"{value} [{low}, {high}]"


def task_rates(episodes: Iterable[EpisodeResult]) -> dict[int, float]:
    """Success rate of each task, 0..1, over all its episodes."""
    outcomes = defaultdict(list)
    for episode in episodes:
        outcomes[episode.task_id].append(episode.success)
    return {task_id: float(np.mean(found)) for task_id, found in outcomes.items()}


def mean_rate(rates: Mapping[int, float]) -> Estimate:
    """The mean success rate over tasks, with its 95 % interval.

    Args:
        rates: Success rate of each task, at least one.
    """
    return _estimate(np.array(list(rates.values())))


def paired_difference(first: Mapping[int, float], second: Mapping[int, float]) -> Estimate:
    """The mean difference of two success rates over the tasks that both have, first less second.

    Args:
        first: Success rate of each task.
        second: The same; at least one task is in both.
    """
    return _estimate(np.array([first[task_id] - second[task_id] for task_id in first if task_id in second]))


def _estimate(values: NDArray[np.float64]) -> Estimate:
    """The mean of values, (tasks,), with the 2.5 % and 97.5 % quantiles of the means of their resamples."""
    rng = np.random.default_rng(_SEED)
    means = values[rng.integers(len(values), size=(N_DRAWS, len(values)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Estimate(float(values.mean()), float(low), float(high))
