"""How novel the target of an episode is: whether training asked for the same object, and how."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from types import MappingProxyType
from typing import Literal, get_args

from gym_deltaco.tasks import CLEAN, SCENARIOS, VALIDATION, Scenario, get_task
from lerobot_deltaco.evaluation.record import EpisodeResult
from lerobot_deltaco.reporting.statistics import Proportion

Novelty = Literal["training_task", "other_words", "unnamed_target", "never_target"]
NOVELTIES: tuple[Novelty, ...] = get_args(Novelty)

DESCRIPTIONS = MappingProxyType[Novelty, str](
    {
        "training_task": "training task",
        "other_words": "target under other words",
        "unnamed_target": "object 29",  # in scenario A, the only one
        "never_target": "never a target",
    }
)

# Which scenario a selection of tasks belongs to; those that are not named belong to scenario A.
_SCENARIO_OF_TASKS = MappingProxyType(
    {
        "scenario_b_test": SCENARIOS["b"],
        "scenario_b_train": SCENARIOS["b"],
        "scenario_a_validation": VALIDATION,
        "scenario_a_selection_train": VALIDATION,
        "scenario_a_clean_test": CLEAN,
        "scenario_a_clean_train": CLEAN,
    }
)


def scenario_of(tasks: str) -> Scenario:
    """The scenario whose training tasks a policy has seen that is evaluated on a selection of tasks."""
    return _SCENARIO_OF_TASKS.get(tasks, SCENARIOS["a"])


def novelty(episode: EpisodeResult, scenario: Scenario) -> Novelty:
    """How novel the target of an episode is.

    Args:
        episode: The episode.
        scenario: Scenario of the training.

    Returns:
        "training_task" if the task is trained on; "other_words" if training asks for the target by its name,
        but not as this task does; "unnamed_target" if it asks for the target by a color or a shape alone, as
        for object 29, the only yellow one, in scenario A; "never_target" if it never asks for it.
    """
    target = episode.objects[episode.target_object]
    if episode.task_id in scenario.train_tasks:
        return "training_task"
    if target in scenario.train_rows:
        return "other_words"
    return "unnamed_target" if target in _trained_targets(scenario) else "never_target"


@cache
def _trained_targets(scenario: Scenario) -> frozenset[int]:
    return frozenset(target for task_id in scenario.train_tasks for target in get_task(task_id).targets)


def success_by_novelty(episodes: Iterable[EpisodeResult], scenario: Scenario) -> dict[Novelty, Proportion]:
    """Successes among the episodes of each novelty, those that have none left out."""
    groups: dict[Novelty, list[bool]] = {}
    for episode in episodes:
        groups.setdefault(novelty(episode, scenario), []).append(episode.success)
    return {name: Proportion(sum(groups[name]), len(groups[name])) for name in NOVELTIES if name in groups}
