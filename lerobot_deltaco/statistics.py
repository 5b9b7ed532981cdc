"""Statistics of evaluations: success with intervals, paired differences, and counterfactuals.

Rates are fractions, 0..1. The episodes of a task are alike, and training seeds share the evaluation scenes,
so neither are independent trials. Therefore, intervals come from a bootstrap over tasks, in which a task is
drawn with all its episodes of all training seeds.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from math import sqrt
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from gym_deltaco.object_sets import find_label
from gym_deltaco.tasks import (
    CLEAN,
    COLOR_SHAPE_TASKS,
    CONTAINER_COLORS,
    SCENARIOS,
    TASKS,
    VALIDATION,
    Scenario,
    Task,
    get_task,
)
from gym_deltaco.workspace import Quadrant, container_matches
from lerobot_deltaco.records import EvaluationRecord, scene_columns

N_DRAWS = 10_000
_SEED = 0  # of the bootstrap, so that a report is a function of its records
N_BEST_SETS = 10  # evaluation sets that the paper averages
NOVELTIES = ("training_task", "other_words", "unnamed_target", "never_target")

# Scenario of the training, by the task set of the evaluation; scenario A for all others.
_SCENARIOS = {
    "scenario_b_test": SCENARIOS["b"],
    "scenario_b_train": SCENARIOS["b"],
    "scenario_a_validation": VALIDATION,
    "scenario_a_selection_train": VALIDATION,
    "scenario_a_clean_test": CLEAN,
    "scenario_a_clean_train": CLEAN,
}


class Estimate(NamedTuple):
    """A mean over tasks with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def bootstrap(values: ArrayLike) -> Estimate:
    """Estimates the mean of one value per task, with the 2.5 % and 97.5 % quantiles of resampled means."""
    values = np.asarray(values, dtype=np.float64)
    rng = np.random.default_rng(_SEED)
    means = values[rng.integers(len(values), size=(N_DRAWS, len(values)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Estimate(float(values.mean()), float(low), float(high))


def task_rates(episodes: pd.DataFrame) -> pd.Series:
    """Returns the success rate of each task, indexed by task, in the order of the episodes."""
    return episodes.groupby("task_id", sort=False)["success"].mean()


def success_interval(episodes: pd.DataFrame) -> Estimate:
    """Returns the success rate with its 95 % interval by bootstrap over tasks."""
    return bootstrap(task_rates(episodes))


def paired_difference(episodes: pd.DataFrame, reference: pd.DataFrame) -> Estimate | None:
    """Returns the difference of two success rates, paired by task; None if they share no task."""
    difference = task_rates(episodes) - task_rates(reference).reindex(episodes["task_id"].unique())
    difference = difference.reindex(episodes["task_id"].unique()).dropna()
    return bootstrap(difference) if len(difference) else None


def wilson_interval(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's interval of a fraction (Wilson 1927), which is not empty at 0 and 1."""
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = count / total
    middle = (rate + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z / (1 + z**2 / total) * sqrt(rate * (1 - rate) / total + z**2 / (4 * total**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


class PaperRate(NamedTuple):
    """A success rate by the paper's protocol.

    Attributes:
        rate: Mean over the best evaluation sets and the seeds.
        sd: Mean over the best evaluation sets of the standard deviation over seeds; NaN with one seed.
        best: Indices of the best evaluation sets, ascending: ten, or all if there are fewer.
    """

    rate: float
    sd: float
    best: tuple[int, ...]


def paper_rate(rates: ArrayLike) -> PaperRate:
    """Computes the paper's success rate: the mean over the ten evaluation sets with the highest means.

    The sets are chosen by the episodes that are then averaged, so the rate is biased upward. The standard
    deviation is the population's: the paper does not say which one it reports.

    Args:
        rates: (sets, seeds), sets in the order of their steps. Ties go to the earlier sets.
    """
    rates = np.asarray(rates, dtype=np.float64)
    means = rates.mean(axis=1)
    # Rounded, so that means that differ only by the order of their sum remain a tie.
    best = np.sort(np.argsort(-means.round(12), kind="stable")[:N_BEST_SETS])
    sd = float(rates[best].std(axis=1).mean()) if rates.shape[1] > 1 else float("nan")
    return PaperRate(float(means[best].mean()), sd, tuple(best.tolist()))


# Novelty


def novelties(record: EvaluationRecord) -> pd.Series:
    """Classifies the target of each episode by what the scenario's training tasks ask for.

    Returns:
        "training_task" if the task is trained on; "other_words" if training asks for the target by its name,
        but not as this task does; "unnamed_target" if it asks for the target by a color or a shape alone, as
        for object 29 in scenario A; "never_target" if it never asks for it.
    """
    scenario = _SCENARIOS.get(record.plan.tasks, SCENARIOS["a"])
    scenes = scene_columns(record)
    targets = [
        objects[target] for objects, target in zip(scenes["objects"], scenes["target_object"], strict=True)
    ]
    found = [
        _novelty(task_id, target, scenario)
        for task_id, target in zip(record.episodes["task_id"], targets, strict=True)
    ]
    return pd.Series(found, index=record.episodes.index)


def _novelty(task_id: int, target: int, scenario: Scenario) -> str:
    if task_id in scenario.train_tasks:
        return "training_task"
    if target in scenario.train_rows:
        return "other_words"
    return "unnamed_target" if target in _trained_targets(scenario) else "never_target"


@cache
def _trained_targets(scenario: Scenario) -> frozenset[int]:
    return frozenset(target for task_id in scenario.train_tasks for target in get_task(task_id).targets)


# Counterfactuals

_TASK_OF_INSTRUCTION = {task.instruction: task for task in (*TASKS, *COLOR_SHAPE_TASKS)}


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
    counts = {name: {"demonstration": 0, "instruction": 0, "neither": 0} for name in ("object", "container")}
    for record in records:
        rows = pd.concat([record.episodes, scene_columns(record)], axis=1)
        for row in rows.itertuples():
            own = get_task(row.task_id)
            demonstration = get_task(row.demonstration_task) if row.demonstration_task >= 0 else None
            instruction = _task_of(row.instruction, own, record.plan.counterfactual == "instruction")
            filled = {container for container in row.object_containers if container >= 0}
            chosen = {
                "object": row.grasped_object,
                "container": next(iter(filled)) if len(filled) == 1 else -1,
            }
            for aspect, choice in chosen.items():
                asked_by = _objects if aspect == "object" else _containers
                by_demonstration = asked_by(row, demonstration, True)
                by_instruction = asked_by(row, instruction, False)
                if not by_demonstration or not by_instruction or by_demonstration & by_instruction:
                    continue
                in_neither = "instruction" if choice in by_instruction else "neither"
                counts[aspect]["demonstration" if choice in by_demonstration else in_neither] += 1
    table = pd.DataFrame.from_dict(counts, orient="index").rename_axis("aspect").reset_index()
    return table.assign(episodes=table[["demonstration", "instruction", "neither"]].sum(axis=1))


def _task_of(instruction: str | None, own: Task, is_counterfactual: bool) -> Task | None:
    """Returns the task of an instruction; a paraphrase is the scene's task, unless it is a counterfactual."""
    if instruction is None:
        return own
    return _TASK_OF_INSTRUCTION.get(instruction, None if is_counterfactual or not instruction else own)


def _objects(row: Any, task: Task | None, is_demonstration: bool) -> set[int]:
    """Returns the numbers of the objects that a task asks for; none if these are all."""
    if task is None:
        return set()
    if task.index == row.task_id and is_demonstration:
        # With two identical objects (ambiguity scheme ii), an instruction also describes the target's twin.
        return {row.target_object}
    found = {n for n, index in enumerate(row.objects) if task.describes(find_label(index))}
    return found if len(found) < len(row.objects) else set()


def _containers(row: Any, task: Task | None, is_demonstration: bool) -> set[int]:
    """Returns the numbers of the containers that a task asks for; none if these are all."""
    if task is None:
        return set()
    if task.index == row.task_id:
        return {row.target_container}
    found = {
        n
        for n, color in enumerate(CONTAINER_COLORS)
        if container_matches(task.container, color, Quadrant(*row.container_quadrants[n]))
    }
    return found if len(found) < len(row.container_quadrants) else set()
