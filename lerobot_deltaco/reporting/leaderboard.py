"""The table of docs/leaderboard.md, made from the committed records and `results/leaderboard.yaml`.

`python scripts/update_docs.py`, in a clone of the repository, writes it anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from lerobot_deltaco.common.typed_fields import in_words, is_a, type_hints
from lerobot_deltaco.reporting.page_tables import PageTableError, replaced
from lerobot_deltaco.reporting.report_files import markdown_table
from lerobot_deltaco.reporting.series import Series, find_records, make_report
from lerobot_deltaco.reporting.statistics import KINDS, breakdown
from lerobot_deltaco.reporting.task_bootstrap import estimate_text, mean_rate

ROWS_FILE = Path("results", "leaderboard.yaml")
PAGE = Path("docs", "leaderboard.md")
# Between these lines of the page, the table stands.
BEGIN, END = "<!-- The table is made from results/leaderboard.yaml. -->", "<!-- End of the table. -->"
NOT_RUN = "not run"
AMBIGUITY = "container"
_HEADER = ("method", "given", "success, % [95 %]", *KINDS, "seeds", "training", "commit", "command")


class LeaderboardError(PageTableError):
    """The rows cannot be made into a table; the message says why."""


@dataclass(frozen=True)
class Row:
    """A method of the leaderboard.

    Attributes:
        method: Name of the method.
        given: Inputs of the policy that specify the task.
        command: Command that trains and evaluates it.
        records: Folder of its records in `results`; None if it was not run.
        training: Data, steps and cost of one training.
        commit: Commit that added the records.
    """

    method: str
    given: str
    command: str
    records: str | None = None
    training: str | None = None
    commit: str | None = None


def read_rows(path: Path) -> tuple[str, list[Row]]:
    """Reads the file of the rows.

    Returns:
        The selection of tasks that all records are of, and the rows.

    Raises:
        LeaderboardError: The file does not have the fields of `Row`.
    """
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    try:
        tasks, found = content["tasks"], [Row(**row) for row in content["rows"]]
    except (TypeError, KeyError) as error:
        raise LeaderboardError(
            f"{path} must have `tasks`, and `rows` with {', '.join(field.name for field in fields(Row))}: "
            f"{error}."
        ) from None
    for row in found:
        for name, kind in type_hints(Row).items():
            if not is_a(getattr(row, name), kind):
                raise LeaderboardError(
                    f"{path}: `{name}` of {row.method!r} must be {in_words(kind)}. Got "
                    f"{getattr(row, name)!r}."
                )
        if row.records is not None and None in (row.training, row.commit):
            raise LeaderboardError(
                f"{path}: {row.method!r} has records; it also needs `training` and `commit`."
            )
    return tasks, found


def table(root: Path) -> str:
    """The leaderboard as a table in Markdown: first what was run, by success; then what was not.

    Args:
        root: Folder of the repository.

    Raises:
        LeaderboardError: A row's records are of other tasks, of another ambiguity scheme, or of several
            experiments.
        ReportError: A row's folder has no records, or they do not belong together.
        RecordError: A record is damaged.
    """
    tasks, rows = read_rows(root / ROWS_FILE)
    ranked = [(row, None if row.records is None else _series(row, root)) for row in rows]
    ranked.sort(key=_rank)  # stable: what was not run keeps its order
    return markdown_table(_HEADER, [_cells(row, series, tasks) for row, series in ranked])


def updated(page: str, root: Path) -> str:
    """The page with its table made anew.

    Raises:
        PageTableError: The page has no place for it.
    """
    return replaced(page, BEGIN, END, table(root))


def _series(row: Row, root: Path) -> Series:
    assert row.records is not None
    report = make_report(find_records([root / "results" / row.records]))
    if len(report.regular) != 1:
        names = ", ".join(series.experiment for series in report.regular) or "none"
        raise LeaderboardError(
            f"The records of {row.method!r} must be of a single experiment. They are of {names}."
        )
    return report.regular[0]


def _rank(item: tuple[Row, Series | None]) -> float:
    _, series = item
    return 1.0 if series is None else -(series.last.rate or 0.0)


def _cells(row: Row, series: Series | None, tasks: str) -> Sequence[str]:
    command = f"`{row.command}`"
    if series is None:
        return [row.method, row.given, NOT_RUN, *("" for _ in KINDS), "", "", "", command]
    recorded = series.sets[-1].record
    if recorded.tasks != tasks:
        raise LeaderboardError(
            f"The records of {row.method!r} are of the tasks {recorded.tasks!r}. The leaderboard is of "
            f"{tasks!r}."
        )
    if recorded.ambiguity != AMBIGUITY:
        raise LeaderboardError(
            f"The records of {row.method!r} are of the ambiguity scheme {recorded.ambiguity!r}. The "
            f"leaderboard is of {AMBIGUITY!r}."
        )
    success = estimate_text(mean_rate(series.last_task_rates))
    rates: dict[str, Any] = {
        item.kind: item.outcomes["success"].rate
        for item in breakdown(series.last_episodes)
        if item.word == "all"
    }
    kinds = ["–" if rates[kind] is None else f"{100 * rates[kind]:.1f}" for kind in KINDS]
    n_seeds = str(len(series.seeds))
    assert row.training is not None
    assert row.commit is not None
    return [row.method, row.given, success, *kinds, n_seeds, row.training, row.commit, command]
