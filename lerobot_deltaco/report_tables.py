"""Tables of a report, each a `pandas.DataFrame` made from records of evaluations.

Rates are fractions, 0..1. A row is an experiment: training runs of the same name, which differ in their
seeds. Experiments whose names begin alike, such as small_a/deltaco and small_a/one_hot, are a group.
Evaluations with other settings than most of their group, with a counterfactual, with an input left out or
with paraphrases have separate rows.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gym_deltaco.tasks import get_task
from lerobot_deltaco.paper_results import in_order, label_of, paper_result
from lerobot_deltaco.records import TEMPLATES, EvaluationRecord
from lerobot_deltaco.statistics import (
    NOVELTIES,
    Estimate,
    followed,
    novelties,
    paired_difference,
    paper_rate,
    success_interval,
    wilson_interval,
)

KINDS = ("name", "color", "shape", "color_shape", "foreign")
# Settings that never belong to the main ones of a group.
_MAIN = {"counterfactual": "none", "without": "none", "wording": TEMPLATES}


class ReportError(ValueError):
    """Raised when records cannot be reported on together; the message says why."""


@dataclass(frozen=True)
class Series:
    """The evaluations of an experiment with the same settings.

    Args:
        experiment: Name of the experiment.
        settings: Settings of the evaluations.
        departures: Names of the settings that differ from the main ones of the group.
        runs: Evaluations by training seed and step.
    """

    experiment: str
    settings: Mapping[str, Any]
    departures: frozenset[str]
    runs: Mapping[int, Mapping[int, EvaluationRecord]]

    @property
    def group(self) -> str:
        """First part of the experiment's name."""
        return self.experiment.rpartition("/")[0]

    @property
    def variant(self) -> str:
        """Settings that differ from the main ones of the group, as text."""
        return ", ".join(_departure_texts(self.settings, self.departures))

    @property
    def name(self) -> str:
        """Name on the page and in figures."""
        return name_of(self.experiment, self.variant)

    @property
    def is_counterfactual(self) -> bool:
        """Whether the demonstration or the instruction is another task's."""
        return self.settings["counterfactual"] != "none"

    @property
    def seeds(self) -> tuple[int, ...]:
        """Training seeds, ascending."""
        return tuple(sorted(self.runs))

    @cached_property
    def steps(self) -> tuple[int, ...]:
        """Steps that were evaluated for every seed, ascending. Only these count."""
        return tuple(sorted(set.intersection(*map(set, self.runs.values()))))

    @property
    def rates(self) -> NDArray[np.float64]:
        """Success rates, (steps, seeds)."""
        return np.array([[self.runs[seed][step].success_rate for seed in self.seeds] for step in self.steps])

    @property
    def last(self) -> list[EvaluationRecord]:
        """Evaluations of the last step that counts, by seed."""
        return [self.runs[seed][self.steps[-1]] for seed in self.seeds]

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """Episodes of the last step that counts, of all seeds."""
        return pd.concat([record.episodes for record in self.last], ignore_index=True)

    @cached_property
    def success(self) -> Estimate:
        """Success rate at the last step that counts."""
        return success_interval(self.episodes)

    @property
    def columns(self) -> dict[str, str]:
        """The first columns of every table."""
        return {"experiment": self.experiment, "variant": self.variant}


def name_of(experiment: str, variant: str) -> str:
    """Returns the name of a row, such as "DeL-TaCo: without the demonstration"."""
    return f"{label_of(experiment)}: {variant}" if variant else label_of(experiment)


def make_series(records: Sequence[EvaluationRecord]) -> list[Series]:
    """Groups records by experiment and settings, in the order of the tables.

    Raises:
        ReportError: Two records are of the same checkpoint and settings, or the benchmark's versions differ.
    """
    versions = sorted({record.versions["benchmark"] for record in records})
    if len(versions) > 1:
        raise ReportError(
            f"The records are of several versions of the benchmark, {', '.join(versions)}, which are not "
            "comparable. Report on them separately."
        )
    groups = defaultdict(list)
    for record in records:
        groups[record.experiment.rpartition("/")[0]].append((record, _settings(record)))
    everything = [series for group in groups.values() for series in _group_series(group)]
    everything = [series for series in everything if series.steps]
    return sorted(
        everything, key=lambda item: (in_order(item.experiment), len(item.departures), item.variant)
    )


def _settings(record: EvaluationRecord) -> dict[str, Any]:
    plan = record.plan
    names = ("tasks", "trials", "seed", "counterfactual", "without", "n_demonstrations")
    return {
        **{name: getattr(plan, name) for name in names},
        **asdict(plan.scene),
        "demonstrations": record.demonstrations,
        "wording": record.wording,
    }


def _group_series(group: Sequence[tuple[EvaluationRecord, dict[str, Any]]]) -> Iterator[Series]:
    common = {name: Counter(settings[name] for _, settings in group) for name in group[0][1]}
    main = {name: values.most_common(1)[0][0] for name, values in common.items()} | _MAIN
    found: dict[tuple[Any, ...], dict[int, dict[int, EvaluationRecord]]] = {}
    for record, settings in group:
        runs = found.setdefault((record.experiment, *settings.values()), {})
        run = runs.setdefault(record.train_seed, {})
        if record.step in run:
            raise ReportError(
                f"Two records are of step {record.step} of {record.experiment!r} with the training seed "
                f"{record.train_seed} and the same settings. Report on one of them, or name the experiments "
                "differently."
            )
        run[record.step] = record
    for (experiment, *values), runs in found.items():
        settings = dict(zip(main, values, strict=True))
        departures = frozenset(name for name in main if settings[name] != main[name])
        yield Series(experiment, settings, departures, runs)


def _departure_texts(settings: Mapping[str, Any], departures: frozenset[str]) -> Iterator[str]:
    for name in sorted(departures, key=list(settings).index):
        value = settings[name]
        if name == "tasks":
            yield f"on {value}"
        elif name in ("trials", "demonstrations") and "tasks" in departures:
            continue  # as they must
        elif name == "counterfactual":
            yield f"another task's {value}"
        elif name == "without":
            yield f"without the {value}"
        elif name == "wording":
            yield wording_label(value)
        elif name == "demonstrations":
            yield f"dataset {value}" if value else "demonstrations of the checkpoint"
        elif name == "n_demonstrations":
            yield f"{value} demonstration{'s' * (value > 1)}"
        elif name == "seed":
            yield f"evaluation seed {value}"
        elif isinstance(value, float):
            yield f"{name.replace('_', ' ')} {value:g}"
        else:
            yield f"{name.replace('_', ' ')} {value}"


def wording_label(wording: str) -> str:
    """Returns a wording without its file's SHA-256, such as "human_instructions.csv (held_out)"."""
    return wording.partition(", SHA-256 ")[0]


# Tables


def success_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success at the last step, over all training seeds and for each."""
    rows = []
    for series in _regular(everything):
        parts = [(" ".join(map(str, series.seeds)), series.episodes)]
        if len(series.seeds) > 1:
            parts += [
                (str(seed), record.episodes) for seed, record in zip(series.seeds, series.last, strict=True)
            ]
        for seeds, episodes in parts:
            wilson = wilson_interval(int(episodes["success"].sum()), len(episodes))
            rows.append(
                {
                    **series.columns,
                    "training_seeds": seeds,
                    "step": series.steps[-1],
                    "n_episodes": len(episodes),
                    **_estimate_columns("success", success_interval(episodes)),
                    "wilson_low": wilson[0],
                    "wilson_high": wilson[1],
                }
            )
    return pd.DataFrame(rows)


def kinds_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success by how the task describes its object and its container."""
    rows = []
    for series in _regular(everything):
        tasks = series.episodes["task_id"].map(get_task)
        success = series.episodes["success"]
        kinds = tasks.map(lambda task: task.kind)
        words = tasks.map(lambda task: "position_word" if task.is_position_task else "color_word")
        by = {**success.groupby(kinds).mean(), **success.groupby(words).mean()}
        names = (*KINDS, "color_word", "position_word")
        rows.append({**series.columns, **{name: by.get(name, np.nan) for name in names}})
    return pd.DataFrame(rows).dropna(axis=1, how="all")


def outcomes_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the outcomes of the episodes: which of the steps to success they reached."""
    rows = []
    for series in _regular(everything):
        episodes = series.episodes
        has_grasped = episodes["grasped_object"] >= 0
        has_placed = episodes["object_containers"].map(max) >= 0
        right_object, right_container = episodes["right_object"], episodes["right_container"]
        rows.append(
            {
                **series.columns,
                "n_episodes": len(episodes),
                "success": episodes["success"].mean(),
                "grasped_anything": has_grasped.mean(),
                "right_object": right_object.mean(),
                "right_container": right_container.mean(),
                "right_object_and_container": (right_object & right_container).mean(),
                "right_object_of_grasped": right_object[has_grasped].mean(),
                "right_container_of_placed": right_container[has_placed].mean(),
            }
        )
    return pd.DataFrame(rows)


def differences_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates differences of success, paired by task.

    An evaluation with other settings is compared with that of the same training runs in the main settings, or
    in those nearest to them; all others with the first experiment of their group in the same settings.
    """
    rows = []
    for series in _regular(everything):
        reference = _reference(series, everything)
        if reference is None:
            continue
        same_runs = reference.runs if reference.experiment == series.experiment else {}
        last = [runs[reference.steps[-1]].episodes for seed, runs in same_runs.items() if seed in series.runs]
        difference = paired_difference(series.episodes, pd.concat(last) if last else reference.episodes)
        if difference is not None:
            rows.append(
                {
                    **series.columns,
                    "less": reference.experiment,
                    "less_variant": reference.variant,
                    **_estimate_columns("difference", difference),
                }
            )
    return pd.DataFrame(rows)


def _reference(series: Series, everything: Sequence[Series]) -> Series | None:
    group = [item for item in _regular(everything) if item.group == series.group]
    same = [
        item
        for item in group
        if item.experiment == series.experiment
        and item.departures < series.departures
        and item.settings["tasks"] == series.settings["tasks"]
    ]
    if same:
        return max(same, key=lambda item: len(item.departures))
    first = next(item for item in group if item.settings == series.settings)
    return None if first is series else first


def novelty_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success by what the scenario's training tasks ask for."""
    rows = []
    for series in _regular(everything):
        found = pd.concat([novelties(record) for record in series.last], ignore_index=True)
        groups = series.episodes["success"].groupby(found)
        row: dict[str, Any] = dict(series.columns)
        for name in NOVELTIES:
            has_some = name in groups.groups
            row[name] = groups.mean()[name] if has_some else np.nan
            row[f"{name}_episodes"] = groups.size()[name] if has_some else np.nan
        rows.append(row)
    return pd.DataFrame(rows).dropna(axis=1, how="all")


def paraphrases_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success with paraphrases and with templates, in the same scenes."""
    rows = []
    for series in _regular(everything):
        others = [
            item
            for item in _regular(everything)
            if item.experiment == series.experiment
            and item.settings == {**series.settings, "wording": TEMPLATES}
        ]
        if series.settings["wording"] == TEMPLATES or not others:
            continue
        templates = others[0]
        difference = paired_difference(series.episodes, templates.episodes)
        assert difference is not None  # the tasks are the same
        rows.append(
            {
                "experiment": series.experiment,
                "tasks": series.settings["tasks"],
                "instructions": wording_label(series.settings["wording"]),
                **_estimate_columns("paraphrases", series.success),
                **_estimate_columns("templates", templates.success),
                **_estimate_columns("difference", difference),
                "fraction": series.success.value / (templates.success.value or np.nan),
            }
        )
    return pd.DataFrame(rows)


def counterfactuals_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates which input the policy follows where demonstration and instruction disagree."""
    rows = []
    for series in everything:
        if not series.is_counterfactual:
            continue
        for row in followed(series.last).to_dict("records"):
            total = row["episodes"] or np.nan
            fractions = {name: row[name] / total for name in ("demonstration", "instruction", "neither")}
            rows.append(
                {
                    **series.columns,
                    "training_seeds": " ".join(map(str, series.seeds)),
                    **_estimate_columns("success", series.success),
                    "aspect": row["aspect"],
                    **fractions,
                    "n_episodes": row["episodes"],
                }
            )
    return pd.DataFrame(rows)


def paper_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success by the paper's protocol, next to the paper's."""
    rows = []
    for series in _regular(everything):
        published = paper_result(series.experiment)
        if series.departures or (published is None and len(series.steps) == 1):
            continue
        rate = paper_rate(series.rates)
        rows.append(
            {
                **series.columns,
                "best_sets": f"{len(rate.best)} of {len(series.steps)}",
                "rate": rate.rate,
                "rate_sd": rate.sd,
                "last": series.success.value,
                "paper": published.rate if published else np.nan,
                "paper_sd": published.sd if published else np.nan,
            }
        )
    return pd.DataFrame(rows)


def curves_table(everything: Sequence[Series]) -> pd.DataFrame:
    """Tabulates the success of every evaluation over training steps, where there are several."""
    return pd.DataFrame(
        [
            {
                **series.columns,
                "training_seed": seed,
                "step": step,
                "success": series.runs[seed][step].success_rate,
            }
            for series in _regular(everything)
            if len(series.steps) > 1
            for seed in series.seeds
            for step in series.steps
        ]
    )


def _regular(everything: Sequence[Series]) -> list[Series]:
    return [series for series in everything if not series.is_counterfactual]


def _estimate_columns(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
