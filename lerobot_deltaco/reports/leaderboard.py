"""Results of experiments: evaluations grouped by experiment and settings, and the paper's results.

Training runs of the same name are one experiment; they differ in their seeds. Experiments whose names begin
alike, such as small_a/deltaco and small_a/one_hot, are a group.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import TEMPLATES, EvaluationRecord
from lerobot_deltaco.reports.metrics import Estimate, success_interval

CHANCE = 1 / 6  # success rate of a random object and container, in ambiguity scheme (i)
# Success rates of the paper's tables 1 to 3, 8 and 9 with their standard deviations over three seeds, by the
# name of the recipe that repeats a row. The authors measured them in their own simulation, with other
# objects. The paper calls both rows of CLIP with an MLP head DeL-TaCo; the authors' README calls the first
# one language only, as its settings are.
PAPER = pd.read_csv(Path(__file__).with_name("paper_results.csv"), index_col="experiment")
PAPER[["rate", "sd"]] /= 100
_OLDER_FAMILIES = {"small_a": "scenario_a", "small_b": "scenario_b", "small_ambiguity": "ambiguity_object"}
# Settings that never belong to the main ones of a group, other than with these values.
_MAIN = {
    **{"counterfactual": "none", "without": "none", "photo": False},
    **{"oracle": "none", "wording": TEMPLATES},
}


@dataclass(frozen=True)
class Result:
    """The evaluations of an experiment with the same settings.

    Args:
        experiment: Name of the experiment.
        settings: Settings of the evaluations.
        departures: Those settings that differ from the main ones of the group.
        records: Evaluations: a row for each step that was evaluated for all training seeds, a column for each
            of these seeds.
    """

    experiment: str
    settings: Mapping[str, Any]
    departures: Mapping[str, Any]
    records: pd.DataFrame

    @property
    def group(self) -> str:
        """First part of the experiment's name."""
        return self.experiment.rpartition("/")[0]

    @property
    def variant(self) -> str:
        """Settings that differ from the main ones of the group, as text."""
        return settings_text(self.departures)

    @property
    def name(self) -> str:
        """Name of the experiment and its variant."""
        return ", ".join(filter(None, [self.experiment, self.variant]))

    @property
    def paper(self) -> pd.Series:
        """Row of `PAPER` that the experiment repeats; NaN without one, and for a variant."""
        return PAPER.reindex(["" if self.departures else paper_row(self.experiment)]).iloc[0]

    @property
    def rates(self) -> pd.DataFrame:
        """Success rates by step and training seed."""
        return self.records.map(lambda record: record.success_rate)

    @property
    def last(self) -> pd.Series:
        """Evaluations of the last step, by training seed."""
        return self.records.iloc[-1]

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """Episodes of the last step, of all training seeds."""
        return pd.concat([record.episodes for record in self.last], ignore_index=True)

    @cached_property
    def success(self) -> Estimate:
        """Success rate at the last step."""
        return success_interval(self.episodes)

    @property
    def scenes(self) -> str:
        """Evaluation seed, followed by a slash and the scene split, if there is one."""
        plans = [record.plan for record in self.last]
        names = {
            f"{plan.seed}" if plan.scene_split is None else f"{plan.seed}/{plan.scene_split}"
            for plan in plans
        }
        return ", ".join(sorted(names))


def collect_results(records: Iterable[EvaluationRecord]) -> list[Result]:
    """Groups records by experiment and settings, in the paper's order, others by name.

    Raises:
        UserError: Records are of several versions of the benchmark, two are of the same checkpoint and
            settings, or training seeds have no step in common.
    """
    groups = defaultdict(list)
    for record in records:
        groups[record.experiment.rpartition("/")[0]].append(record)
    versions = {record.versions["benchmark"] for group in groups.values() for record in group}
    if len(versions) > 1:
        raise UserError(
            f"The records are of several versions of the benchmark, {', '.join(sorted(versions))}, which are "
            "not comparable. Report on them separately."
        )
    return sorted((result for group in groups.values() for result in _group_results(group)), key=_order)


def paper_row(experiment: str) -> str:
    """Returns the name of the row of `PAPER` that an experiment repeats, if there is one."""
    family, _, name = experiment.removeprefix("small/").removeprefix("paper/").rpartition("/")
    row = f"{_OLDER_FAMILIES.get(family, family)}/{name}"
    return row.replace("/demo_only_finetuned", "_finetuned/episodes")


def settings_text(settings: Mapping[str, Any]) -> str:
    """Returns settings as text, such as "seed 7, without instruction"."""
    texts = (f"{name.replace('_', ' ')} {value}" for name, value in settings.items())
    return ", ".join(text.partition(", SHA-256 ")[0] for text in texts)


def _group_results(group: Sequence[EvaluationRecord]) -> list[Result]:
    found = defaultdict(list)
    for record in group:
        found[record.experiment, tuple(_settings(record).items())].append(record)
    values = zip(*(_settings(record).items() for record in group), strict=True)
    main = dict(Counter(items).most_common(1)[0][0] for items in values) | _MAIN
    return [
        Result(
            experiment,
            settings=dict(settings),
            departures={name: value for name, value in settings if value != main[name]},
            records=_by_step_and_seed(records),
        )
        for (experiment, settings), records in found.items()
    ]


def _settings(record: EvaluationRecord) -> dict[str, Any]:
    plan = record.plan
    names = ("tasks", "trials", "seed", "counterfactual", "without", "photo", "oracle", "n_demonstrations")
    return {
        **{name: getattr(plan, name) for name in (*names, "joint_noise")},
        **asdict(plan.scene),
        "episode_length": plan.scene.n_steps,
        "scenes": plan.scene_split if isinstance(plan.scene_split, str) else "open",
        "demonstrations": record.demonstrations or "default",
        "wording": record.wording,
    }


def _by_step_and_seed(records: Sequence[EvaluationRecord]) -> pd.DataFrame:
    name = records[0].experiment
    table = pd.DataFrame({"step": [record.step for record in records]})
    table["seed"] = [record.train_seed for record in records]
    for step, seed in table[table.duplicated()].itertuples(index=False):
        raise UserError(
            f"Two records are of step {step} of {name!r} with the training seed {seed} and the same "
            "settings. Report on one of them, or name the experiments differently."
        )
    table = table.assign(record=records).pivot(index="step", columns="seed", values="record").dropna()
    if table.empty:
        raise UserError(
            f"The training seeds of {name!r} were evaluated at no common step. Evaluate them at one."
        )
    return table


def _order(result: Result) -> tuple[Any, ...]:
    rows = list(PAPER.index)
    row = paper_row(result.experiment)
    return (
        _natural_order(result.group),
        rows.index(row) if row in rows else len(rows),
        _natural_order(result.experiment),
        len(result.departures),
        result.variant,
    )


def _natural_order(name: str) -> list[str | int]:
    """Returns a key that sorts names, with numbers in them by value."""
    return [int(part) if n % 2 else part for n, part in enumerate(re.split(r"(\d+)", name))]
