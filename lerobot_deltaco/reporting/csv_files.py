"""The report's CSV files. Rates are shares, 0..1."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from gym_deltaco.object_sets import find_label
from lerobot_deltaco.reporting.comparisons import by_novelty, differences
from lerobot_deltaco.reporting.paper_results import paper_result
from lerobot_deltaco.reporting.report_files import csv_bytes
from lerobot_deltaco.reporting.series import Report
from lerobot_deltaco.reporting.statistics import Proportion, breakdown, by_object, followed, paper_rate
from lerobot_deltaco.reporting.task_bootstrap import Estimate, mean_rate


def csv_files(report: Report) -> dict[str, bytes]:
    """Contents of the CSV files by name; those that a report does not have are missing.

    Args:
        report: Series of evaluations.
    """
    tables = {"curves.csv": _curve_rows(report), "breakdown.csv": _breakdown_rows(report)}
    if report.regular:
        tables["rates.csv"] = _rate_rows(report)
        tables["novelty.csv"] = _novelty_rows(report)
        tables["objects.csv"] = _object_rows(report)
        rows = _difference_rows(report)
        if rows:
            tables["differences.csv"] = rows
    if report.counterfactual:
        tables["counterfactual.csv"] = _counterfactual_rows(report)
    return {name: csv_bytes(rows) for name, rows in tables.items()}


def _rate_rows(report: Report) -> list[dict[str, Any]]:
    rows = []
    for series in report.regular:
        paper, last = paper_rate(series.rates), series.last
        published = paper_result(series.experiment)
        rows.append(
            {
                "experiment": series.experiment,
                "seeds": _joined(series.seeds),
                "evaluation_sets": len(series.steps),
                "best_sets": len(paper.best),
                "best_steps": _joined(series.steps[index] for index in paper.best),
                "rate": paper.rate,
                "sd": paper.sd,
                "last_step": series.steps[-1],
                **_proportion_columns(last, "last_"),
                **_interval_columns(mean_rate(series.last_task_rates), "last_bootstrap_"),
                "authors_rate_in_another_simulation": published and published.rate,
                "authors_sd_in_another_simulation": published and published.sd,
            }
        )
    return rows


def _curve_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "seed": item.record.run_seed,
            "step": item.record.step,
            "successes": item.result.count,
            "episodes": item.result.total,
            "rate": item.result.rate,
            "counted": item.record.step in series.steps,
        }
        for series in report.series
        for item in series.sets
    ]


def _breakdown_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "step": series.steps[-1],
            "kind_of_task": row.kind,
            "kind_of_container_word": row.word,
            "outcome": outcome,
            **_proportion_columns(proportion),
        }
        for series in report.series
        for row in breakdown(series.last_episodes)
        for outcome, proportion in row.outcomes.items()
    ]


def _difference_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "less": reference.experiment,
            "tasks": len(series.last_task_rates),
            "difference": estimate.value,
            **_interval_columns(estimate, "bootstrap_"),
        }
        for group in report.comparisons.values()
        for series, reference, estimate in differences(group)
    ]


def _novelty_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "step": series.steps[-1],
            "novelty": name,
            **_proportion_columns(proportion),
        }
        for series in report.regular
        for name, proportion in by_novelty(series).items()
    ]


def _object_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "step": series.steps[-1],
            "object": index,
            "name": find_label(index).name,
            "outcome": outcome,
            **_proportion_columns(proportion),
        }
        for series in report.regular
        for index, outcomes in by_object(series.last_episodes).items()
        for outcome, proportion in outcomes.items()
    ]


def _counterfactual_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "step": series.steps[-1],
            "seeds": _joined(series.seeds),
            "aspect": item.aspect,
            "among": item.among,
            "followed": item.cue,
            **_proportion_columns(item.proportion),
        }
        for series in report.counterfactual
        for item in followed(series.last_episodes, series.counterfactual)
    ]


def _interval_columns(estimate: Estimate, prefix: str) -> dict[str, Any]:
    return {f"{prefix}low": estimate.low, f"{prefix}high": estimate.high}


def _proportion_columns(proportion: Proportion, prefix: str = "") -> dict[str, Any]:
    low, high = proportion.interval or (None, None)
    values = {
        "count": proportion.count,
        "episodes": proportion.total,
        "rate": proportion.rate,
        "wilson_low": low,
        "wilson_high": high,
    }
    return {prefix + name: value for name, value in values.items()}


def _joined(numbers: Iterable[int]) -> str:
    return " ".join(map(str, numbers))
