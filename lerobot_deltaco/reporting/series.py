"""The evaluations of several runs: read, checked that they belong together, and grouped by experiment."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.evaluation.record import (
    BENCHMARK,
    COUNTERFACTUALS,
    RECORDS_FOLDER,
    Counterfactual,
    EpisodeResult,
    EvaluationRecord,
    read_record,
)
from lerobot_deltaco.reporting.paper_results import in_order
from lerobot_deltaco.reporting.statistics import Proportion, unknown_sentences
from lerobot_deltaco.reporting.task_bootstrap import task_rates

# Of a policy's configuration: what may differ between the runs of an experiment.
_OPTIONS_OF_A_RUN = {"seed", "device", "pretrained_path", "demo_root", "repo_id", "push_to_hub"}


class ReportError(ValueError):
    """The records cannot be reported on together; the message says why."""


@dataclass(frozen=True)
class EvaluationSet:
    """A record without its episodes, of which a large report has hundreds of thousands.

    Args:
        path: Path of the whole record.
        record: Without episodes.
        task_ids: Indices of the tasks that were evaluated, ascending.
        result: Share of the episodes that succeeded.
    """

    path: Path
    record: EvaluationRecord
    task_ids: tuple[int, ...]
    result: Proportion

    @property
    def benchmark(self) -> str:
        """Its version: the environment's id."""
        return self.record.versions[BENCHMARK]


@dataclass(frozen=True)
class Series:
    """The evaluation sets of an experiment, all with or without the same counterfactual.

    Args:
        experiment: Name of the experiment.
        counterfactual: none, demo or instruction.
        runs: For each seed of training, for each step, what came of it.
    """

    experiment: str
    counterfactual: Counterfactual
    runs: Mapping[int, Mapping[int, EvaluationSet]]

    @property
    def comparison(self) -> str:
        """What the names of the experiments begin with that are compared with this one."""
        return self.experiment.rpartition("/")[0]

    @property
    def name(self) -> str:
        """Name in tables, with the counterfactual."""
        suffix = "" if self.counterfactual == "none" else f" (another task's {self.counterfactual})"
        return self.experiment + suffix

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of training, ascending."""
        return tuple(sorted(self.runs))

    @cached_property
    def steps(self) -> tuple[int, ...]:
        """The steps that every seed has a record of, ascending. Only these count."""
        return tuple(sorted(set.intersection(*map(set, self.runs.values()))))

    @property
    def rates(self) -> NDArray[np.float64]:
        """Success rates, (steps, seeds), 0..1."""
        return np.array([[self.runs[seed][step].result.rate for seed in self.seeds] for step in self.steps])

    @property
    def last(self) -> Proportion:
        """Success at the last step that counts, over the episodes of all seeds."""
        results = [self.runs[seed][self.steps[-1]].result for seed in self.seeds]
        return Proportion(sum(result.count for result in results), sum(result.total for result in results))

    @cached_property
    def last_episodes(self) -> list[EpisodeResult]:
        """All episodes of the last step that counts. They are read again."""
        return [
            episode
            for seed in self.seeds
            for episode in read_record(self.runs[seed][self.steps[-1]].path).episodes
        ]

    @cached_property
    def last_task_rates(self) -> dict[int, float]:
        """Success rate of each task at the last step that counts, 0..1, over the episodes of all seeds."""
        return task_rates(self.last_episodes)

    @property
    def last_scene_sets(self) -> tuple[int, ...]:
        """Numbers of the sets of scenes at the last step that counts, ascending; one, unless seeds differ."""
        step = self.steps[-1]
        numbers = [self.runs[seed][step].record.scene_set for seed in self.seeds]
        return tuple(sorted({step if number is None else number for number in numbers}))

    @property
    def sets(self) -> list[EvaluationSet]:
        """All evaluation sets by seed and step, those that do not count included."""
        return [self.runs[seed][step] for seed in self.seeds for step in sorted(self.runs[seed])]


@dataclass(frozen=True)
class Report:
    """What the records come to.

    Args:
        series: Those with at least one step that counts, in the order of the tables.
        notes: Caveats and what was left out; a sentence each.
    """

    series: list[Series]
    notes: list[str]

    @property
    def regular(self) -> list[Series]:
        """Without counterfactuals."""
        return [series for series in self.series if series.counterfactual == "none"]

    @property
    def counterfactual(self) -> list[Series]:
        """With another task's demonstration or instruction."""
        return [series for series in self.series if series.counterfactual != "none"]

    @property
    def comparisons(self) -> dict[str, list[Series]]:
        """Regular series whose experiments are compared with one another, by what their names begin with."""
        groups = defaultdict(list)
        for series in self.regular:
            groups[series.comparison].append(series)
        return dict(groups)


def find_records(folders: Sequence[Path]) -> list[Path]:
    """The files of the records in some folders, each once.

    Raises:
        ReportError: A folder has none.
    """
    found = {}
    for folder in folders:
        if not folder.is_dir():
            raise ReportError(f"{folder} is no folder. Name the output folders of training runs.")
        paths = sorted(folder.rglob(f"{RECORDS_FOLDER}/*.json"))
        if folder.name == RECORDS_FOLDER:
            paths += sorted(folder.glob("*.json"))
        if not paths:
            raise ReportError(
                f"{folder} has no records of evaluations ({RECORDS_FOLDER}/*.json, at any depth). "
                "`deltaco-evaluate` writes them into a training run's folder."
            )
        found.update({path.resolve(): path for path in paths})
    return list(found.values())


def make_report(paths: Iterable[Path]) -> Report:
    """Reads records, checks that they belong together, and groups them.

    Raises:
        ReportError: They do not belong together.
        RecordError: One is damaged.
    """
    groups: dict[tuple[str, Counterfactual], dict[int, dict[int, EvaluationSet]]] = {}
    for path in paths:
        item = _read_set(path)
        record = item.record
        runs = groups.setdefault((record.experiment, record.counterfactual), {})
        run = runs.setdefault(record.run_seed, {})
        if record.step in run:
            raise ReportError(
                f"Two records are of step {record.step} of {record.experiment!r} with the seed "
                f"{record.run_seed}: {run[record.step].path} and {path}. Report on one of the two runs only, "
                "or name their experiments differently."
            )
        run[record.step] = item
    everything = sorted(
        (Series(experiment, counterfactual, runs) for (experiment, counterfactual), runs in groups.items()),
        key=lambda series: (in_order(series.experiment), COUNTERFACTUALS.index(series.counterfactual)),
    )
    _check_together(everything)
    reported = [series for series in everything if series.steps]
    if not reported:
        raise ReportError(
            "There is nothing to report: no experiment has a step of which all its seeds have a record."
        )
    return Report(reported, _notes(everything))


def _read_set(path: Path) -> EvaluationSet:
    record = read_record(path)
    seen = {(episode.task_id, episode.trial) for episode in record.episodes}
    task_ids = tuple(sorted({task_id for task_id, _ in seen}))
    expected = {(task_id, trial) for task_id in task_ids for trial in range(record.trials)}
    if seen != expected or len(seen) != len(record.episodes):
        raise ReportError(
            f"{path} has {len(record.episodes)} episodes, which are not {record.trials} different trials of "
            f"each of its {len(task_ids)} tasks. Evaluate the checkpoint again with `deltaco-evaluate`."
        )
    n_successes = sum(episode.success for episode in record.episodes)
    return EvaluationSet(
        path, replace(record, episodes=[]), task_ids, Proportion(n_successes, len(record.episodes))
    )


def _check_together(everything: Sequence[Series]) -> None:
    """Raises a ReportError unless what is compared was measured in the same way."""
    _check_same("version of the benchmark", "records", everything, lambda item: item.benchmark)
    experiments, comparisons = defaultdict(list), defaultdict(list)
    for series in everything:
        experiments[series.experiment].append(series)
        comparisons[series.comparison, series.counterfactual].append(series)
    for experiment, group in experiments.items():
        _check_same("method", f"records of {experiment!r}", group, lambda item: item.record.method)
        _check_same("wording", f"records of {experiment!r}", group, lambda item: item.record.wording)
    for (comparison, counterfactual), group in comparisons.items():
        records = f"records of {comparison or group[0].experiment!r}"
        if counterfactual != "none":
            records += f" with another task's {counterfactual}"
        _check_same("tasks", records, group, lambda item: item.task_ids, lambda item: item.record.tasks)
        _check_same("trials", records, group, lambda item: item.record.trials)
        check_same_scenes(records, group)


def check_same_scenes(records: str, group: Sequence[Series]) -> None:
    """Checks that the scenes of some series were drawn in the same way; their tasks may differ.

    Args:
        records: Name of the records, for the message.
        group: The series.

    Raises:
        ReportError: Two records differ; the message names them.
    """
    _check_same("version of the benchmark", records, group, lambda item: item.benchmark)
    _check_same("evaluation seed", records, group, lambda item: item.record.evaluation_seed)
    _check_same("ambiguity scheme", records, group, lambda item: item.record.ambiguity)
    _check_same("image size", records, group, lambda item: item.record.image_size)
    _check_same("episode length", records, group, lambda item: item.record.episode_length)
    _check_same("objects", records, group, lambda item: item.record.objects)
    _check_same(
        "probability of adversarial distractors",
        records,
        group,
        lambda item: item.record.adversarial_probability,
    )
    _check_same("draw of adversarial distractors", records, group, lambda item: item.record.adversarial_draw)


def _check_same(
    name: str,
    records: str,
    group: Sequence[Series],
    value: Callable[[EvaluationSet], Any],
    in_words: Callable[[EvaluationSet], Any] | None = None,
) -> None:
    """Raises a ReportError that names two records if a value is not the same in all of them."""
    sets = [item for series in group for item in series.sets]
    first, in_words = sets[0], in_words or value
    for other in sets:
        if value(other) != value(first):
            raise ReportError(
                f"The {records} differ in their {name}: {in_words(first)!r} in {first.path}, "
                f"{in_words(other)!r} in {other.path}. Only what was evaluated in the same way is compared: "
                "report on them separately, or evaluate again."
            )


def _notes(everything: Sequence[Series]) -> list[str]:
    """What was left out, and what else a reader has to know."""
    groups = defaultdict(list)
    for series in everything:
        groups[series.comparison, series.counterfactual].append(series)
    return [
        *(note for group in groups.values() for note in _notes_on_comparison(group)),
        *(note for series in everything for note in _notes_on_series(series)),
    ]


def _notes_on_comparison(group: Sequence[Series]) -> Iterator[str]:
    seeds = sorted({seed for series in group for seed in series.seeds})
    for series in group:
        missing = [seed for seed in seeds if seed not in series.runs]
        if missing:
            yield (
                f"{series.name} has no records of {counted('seed', missing)}, which others in its table "
                f"have: its numbers are of {counted('seed', series.seeds)}."
            )
    ends = {series.name: series.steps[-1] for series in group if series.steps}
    if len(set(ends.values())) > 1:
        yield (
            "Experiments of one table end at different steps, so that their last rates are not of equally "
            f"long training: {', '.join(f'{name} {step:,}' for name, step in ends.items())}."
        )
    scene_sets = {number for series in group if series.steps for number in series.last_scene_sets}
    if len(scene_sets) > 1:
        yield (
            f"The last rates of one table are of different sets of scenes (numbers {_listed(scene_sets)}; by "
            "default, the step), so that differences between them are paired by task, but not by scene. "
            "`deltaco-evaluate --scene-set` evaluates checkpoints of different steps in the same scenes."
        )


def _notes_on_series(series: Series) -> Iterator[str]:
    differing = _differing_options(series)
    if differing:
        yield (
            f"The runs of {series.name} differ in more than their seed: in {', '.join(differing)} of the "
            "policy's configuration."
        )
    if not series.steps:
        yield f"{series.name} is left out: of no step, all of its seeds have a record."
        return
    for seed in series.seeds:
        left_out = sorted(set(series.runs[seed]) - set(series.steps))
        if left_out:
            yield (
                f"Left out of {series.name}, seed {seed}: {counted('step', left_out)}, of which not every "
                "seed has a record."
            )
    unknown = unknown_sentences(series.last_episodes, series.counterfactual)
    if unknown:
        yield (
            f"{series.name}: in {unknown} of {len(series.last_episodes)} episodes, the other task's sentence "
            "is none of the benchmark's, so that nobody knows what it asks for. It is not counted as a cue."
        )


def _differing_options(series: Series) -> list[str]:
    policies = [run[max(run)].record.policy for run in series.runs.values()]
    names = sorted(set().union(*policies) - _OPTIONS_OF_A_RUN)
    is_lacking = any(name not in policy for name in names for policy in policies)
    defaults = _default_options() if is_lacking else {}
    values = {name: [policy.get(name, defaults.get(name)) for policy in policies] for name in names}
    return [name for name in names if any(value != values[name][0] for value in values[name])]


def _default_options() -> dict[str, Any]:
    """As which what an older record lacks is read."""
    # Takes seconds, and is seldom needed.
    from lerobot_deltaco.configuration_deltaco import DeltacoConfig

    return {field.name: field.default for field in fields(DeltacoConfig)}


def counted(noun: str, numbers: Sequence[int]) -> str:
    """For example "seeds 0, 1 and 2"; of many, only the first and the last."""
    if len(numbers) > 6:
        return f"{len(numbers)} {noun}s from {numbers[0]:,} to {numbers[-1]:,}"
    return f"{noun}{'s' * (len(numbers) > 1)} {_listed(numbers)}"


def _listed(numbers: Iterable[int]) -> str:
    """For example "0, 1 and 2"."""
    words = [f"{number:,}" for number in sorted(numbers)]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
