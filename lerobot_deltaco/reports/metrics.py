"""Statistics of evaluations: success with intervals, paired differences, and counterfactuals.

Rates are fractions, 0..1. The episodes of a task are alike, and training seeds share the evaluation scenes,
so neither are independent trials. Intervals therefore come from a bootstrap over tasks: a resampled task
keeps all its episodes of all training seeds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from gym_deltaco.containers import CONTAINER_COLORS
from gym_deltaco.objects.labels import find_label
from gym_deltaco.sim.workspace import Quadrant, container_matches
from gym_deltaco.tasks import Task, find_task, get_task
from lerobot_deltaco.evaluation.records import EvaluationRecord, scene_columns

N_RESAMPLES = 10_000
N_BEST_SETS = 10  # evaluation sets that the paper averages
_SEED = 0  # of the bootstrap, so that a report is a function of its records
_MIN_SUCCESSES = 5  # with fewer, the bootstrap's interval is too narrow
_POWER = 1.960 + 0.842  # standard errors that are found at the level of 5 % with a probability of 80 %


class Estimate(NamedTuple):
    """A mean over tasks with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def bootstrap(values: ArrayLike) -> Estimate:
    """Estimates the mean of one value per task; its interval has the percentiles of resampled means."""
    values = np.asarray(values, dtype=np.float64)
    mean = float(values.mean())
    if len(values) == 1:  # nothing to resample
        return Estimate(mean, mean, mean)
    interval = stats.bootstrap(
        (values,), np.mean, n_resamples=N_RESAMPLES, method="percentile", rng=_SEED
    ).confidence_interval
    return Estimate(mean, float(interval.low), float(interval.high))


def task_rates(episodes: pd.DataFrame) -> pd.Series:
    """Returns the success rate of each task, indexed by task, in the order of the episodes."""
    return episodes.groupby("task_id", sort=False)["success"].mean()


def success_interval(episodes: pd.DataFrame) -> Estimate:
    """Returns the success rate with its 95 % interval: Wilson's if few succeed, else by bootstrap."""
    count, total = int(episodes["success"].sum()), len(episodes)
    if count < _MIN_SUCCESSES:
        interval = stats.binomtest(count, total).proportion_ci(method="wilson")
        return Estimate(count / total, float(interval.low), float(interval.high))
    return bootstrap(task_rates(episodes))


def task_differences(episodes: pd.DataFrame, reference: pd.DataFrame) -> pd.Series:
    """Returns the difference of the success rates of each task that both have, indexed by task."""
    rates = task_rates(episodes)
    return (rates - task_rates(reference)).reindex(rates.index).dropna()


def paired_difference(episodes: pd.DataFrame, reference: pd.DataFrame) -> Estimate | None:
    """Returns the difference of two success rates, paired by task; None if they share no task."""
    differences = task_differences(episodes, reference)
    return bootstrap(differences) if len(differences) else None


def detectable_difference(differences: ArrayLike) -> float:
    """Returns the smallest true difference whose 95 % interval excludes 0 in 80 % of such comparisons.

    Args:
        differences: Differences of two or more tasks.
    """
    values = np.asarray(differences, dtype=np.float64)
    return float(_POWER * values.std(ddof=1) / np.sqrt(len(values)))


def paper_rate(rates: pd.DataFrame) -> tuple[float, float]:
    """Computes the paper's success rate: the mean over the ten evaluation sets with the highest means.

    The sets are chosen by the episodes that are then averaged, so the rate is biased upward. The standard
    deviation is the population's: the paper does not say which one it reports.

    Args:
        rates: Success rates, a row for each evaluation set in the order of steps, a column for each seed.

    Returns:
        Mean over the best sets and the seeds, and mean over these sets of the standard deviation over seeds,
        NaN with one seed. Of sets with equal means, the earlier ones count as better.
    """
    # Rounded, so that means that differ only by the order of their sum remain a tie.
    best = rates.loc[rates.mean(axis=1).round(12).nlargest(N_BEST_SETS).index]
    sd = best.std(axis=1, ddof=0).mean() if len(rates.columns) > 1 else np.nan
    return float(best.mean(axis=None)), float(sd)


def followed(records: Iterable[EvaluationRecord]) -> pd.DataFrame:
    """Counts which input the policy followed where demonstration and instruction disagree.

    A task asks for those objects (containers) of the scene that it describes. An episode counts if both
    inputs ask for some of them but not for all, and for none in common. The object is the one that the
    gripper held last; the container is the only one in which something lies at the end.

    Args:
        records: Evaluations with a counterfactual.

    Returns:
        A row for the object and one for the container: `aspect`; numbers of episodes that followed the
        `demonstration`, the `instruction` and `neither`; and `episodes`, their sum.
    """
    sources = ("demonstration", "instruction", "neither")
    counts = {aspect: dict.fromkeys(sources, 0) for aspect in ("object", "container")}
    for record in records:
        for row in record.episodes.join(scene_columns(record)).itertuples():
            demonstrated = get_task(row.demonstration_task) if row.demonstration_task >= 0 else None
            instructed = _task_of_instruction(row, record.plan.counterfactual == "instruction")
            demonstration = _asked_for(row, demonstrated, is_demonstration=True)
            instruction = _asked_for(row, instructed, is_demonstration=False)
            filled = set(row.object_containers) - {-1}
            choices = {"object": row.grasped_object, "container": filled.pop() if len(filled) == 1 else -1}
            for aspect, choice in choices.items():
                by_source = {"demonstration": demonstration[aspect], "instruction": instruction[aspect]}
                if all(by_source.values()) and not set.intersection(*by_source.values()):
                    followed_source = (source for source, numbers in by_source.items() if choice in numbers)
                    counts[aspect][next(followed_source, "neither")] += 1
    table = pd.DataFrame.from_dict(counts, orient="index")
    return table.assign(episodes=table.sum(axis=1)).rename_axis("aspect").reset_index()


def _task_of_instruction(row: Any, is_counterfactual: bool) -> Task | None:
    """Returns the task of an instruction; a paraphrase is the scene's task, unless it is a counterfactual."""
    own = get_task(row.task_id)
    if row.instruction is None:
        return own
    return find_task(row.instruction) or (None if is_counterfactual or not row.instruction else own)


def _asked_for(row: Any, task: Task | None, is_demonstration: bool) -> dict[str, set[int]]:
    """Returns the numbers of the objects and of the containers that a task asks for; none instead of all."""
    if task is None:
        return {"object": set(), "container": set()}
    objects = set(task.object.meant([find_label(index) for index in row.objects]))
    if is_demonstration and task.index == row.task_id:
        # With two identical objects (ambiguity scheme ii), only an instruction describes the target's twin.
        objects = {row.target_object}
    containers = {
        n
        for n, (color, quadrant) in enumerate(zip(CONTAINER_COLORS, row.container_quadrants, strict=True))
        if container_matches(task.container, color, Quadrant(*quadrant))
    }
    return {
        "object": objects if len(objects) < len(row.objects) else set(),
        "container": containers if len(containers) < len(row.container_quadrants) else set(),
    }
