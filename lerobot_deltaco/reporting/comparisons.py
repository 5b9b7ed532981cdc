"""Comparisons of experiments: what both the report's page and its CSV files say of a group of series."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_deltaco.reporting.novelty import Novelty, scenario_of, success_by_novelty
from lerobot_deltaco.reporting.paper_results import TITLES
from lerobot_deltaco.reporting.series import Series
from lerobot_deltaco.reporting.statistics import Proportion
from lerobot_deltaco.reporting.task_bootstrap import Estimate, paired_difference


def by_novelty(series: Series) -> dict[Novelty, Proportion]:
    """Successes at the last step, by whether the training tasks ask for the target."""
    return success_by_novelty(series.last_episodes, scenario_of(series.sets[0].record.tasks))


def differences(group: Sequence[Series]) -> list[tuple[Series, Series, Estimate]]:
    """The difference of each series of a comparison to the first one, in the order of the tables."""
    reference, *others = group
    return [
        (series, reference, paired_difference(series.last_task_rates, reference.last_task_rates))
        for series in others
    ]


def title_of(comparison: str) -> str:
    """Title of a comparison."""
    return TITLES.get(comparison, comparison or "Experiments")
