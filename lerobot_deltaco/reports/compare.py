"""The command `deltaco compare`: whether one of two policies is better in the same scenes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tyro

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import EvaluationRecord, read_records
from lerobot_deltaco.reports.leaderboard import Result, collect_results
from lerobot_deltaco.reports.metrics import Estimate, bootstrap, detectable_difference, task_differences

_MIN_TASKS = 10  # with fewer, the bootstrap's interval is too narrow
_MIN_SEEDS = 3  # of a training, to speak of methods
_LAYOUT_SETTINGS = ("ambiguity", "objects", "adversarial_probability", "adversarial_draw")


def compare_records(
    first: tyro.conf.Positional[Path],
    second: tyro.conf.Positional[Path],
    experiments: tuple[str, str] | None = None,
) -> str:
    """Compares the success of two evaluations in the same scenes, paired by task.

    Args:
        first: File of records, or folder that contains some.
        second: Those of the policy that may be better.
        experiments: Names of the two experiments, as in reports, where the files have several.

    Returns:
        Both success rates, their difference, and whether it is decided.

    Raises:
        UserError: A path has no records or several experiments, or the scenes are not the same.
    """
    names = experiments or (None, None)
    results = [_choose(path, name) for path, name in zip((first, second), names, strict=True)]
    scenes = [_scenes(result) for result in results]
    if differing := _differing(*scenes):
        raise UserError(
            f"The two were not evaluated in the same scenes. They differ in {differing}. Evaluate one of "
            "them again, with the settings of the other."
        )
    lines = [f"{label}: {_describe(result)}" for label, result in zip("AB", results, strict=True)]
    if differing := _differing(*(result.settings for result in results)):
        lines.append(f"They also differ in {differing}.")
    differences = task_differences(results[1].episodes, results[0].episodes)
    n_tasks = len(differences)
    if n_tasks < _MIN_TASKS:
        lines.append(f"Not decided: {n_tasks} tasks are too few. Evaluate at least {_MIN_TASKS}.")
        return "\n".join(lines)
    difference, detectable = bootstrap(differences), 100 * detectable_difference(differences)
    lines += [
        f"B - A: {_points(difference)} points, over {n_tasks} tasks",
        f"Detectable with a probability of 80 %: {detectable:.1f} points",
        _verdict(difference, detectable, min(len(result.last) for result in results)),
    ]
    return "\n".join(lines)


def _choose(path: Path, name: str | None) -> Result:
    results = {result.name: result for result in collect_results(read_records(path))}
    if name is None and len(results) == 1:
        return next(iter(results.values()))
    if name is None or name not in results:
        wrong = "has several experiments" if name is None else f"has no experiment {name!r}"
        raise UserError(f"{path} {wrong}. Choose with --experiments among: {'; '.join(results)}.")
    return results[name]


def _scenes(result: Result) -> dict[str, Any]:
    """Returns what the scenes of the episodes depend on."""

    def of_record(record: EvaluationRecord) -> dict[str, Any]:
        plan = record.plan
        return {
            "benchmark": record.versions["benchmark"],
            **{name: getattr(plan, name) for name in ("tasks", "trials", "seed", "scene_split")},
            **{name: getattr(plan.scene, name) for name in _LAYOUT_SETTINGS},
        }

    scenes = [of_record(record) for record in result.last]
    return {name: ", ".join(sorted({str(each[name]) for each in scenes})) for name in scenes[0]}


def _differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """Returns the names and values in which two mappings with the same keys differ."""
    names = [name for name in first if first[name] != second[name]]
    return ", ".join(f"{name.replace('_', ' ')} ({first[name]}, {second[name]})" for name in names)


def _describe(result: Result) -> str:
    seeds = " ".join(map(str, result.last.index))
    low_to_high = "[{:.1f}, {:.1f}]".format(*(100 * end for end in result.success[1:]))
    return (
        f"{result.name}, step {result.rates.index[-1]}, training seeds {seeds}: "
        f"{100 * result.success.value:.1f} % {low_to_high} of {len(result.episodes)} episodes"
    )


def _points(difference: Estimate) -> str:
    return "{:+.1f} [{:.1f}, {:.1f}]".format(*(100 * number for number in difference))


def _verdict(difference: Estimate, detectable: float, n_seeds: int) -> str:
    if difference.low <= 0 <= difference.high:
        return (
            "Not decided: the interval contains 0. These scenes tell apart policies that differ by "
            f"{detectable:.1f} points or more; run more tasks or trials."
        )
    better = "B" if difference.value > 0 else "A"
    if n_seeds < _MIN_SEEDS:
        return (
            f"Decided: {better} is better, of these trained policies. Of the methods, it is not: that takes "
            f"{_MIN_SEEDS} trainings of each."
        )
    return f"Decided: {better} is better."
