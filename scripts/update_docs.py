"""Writes the tables of docs/leaderboard.md and docs/paper.md anew from the committed records."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import pandas as pd

from gym_deltaco.tasks import get_task
from lerobot_deltaco.atomic_files import write_text
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import EvaluationPlan, read_records
from lerobot_deltaco.reports.leaderboard import PAPER, Result, collect_results, paper_row
from lerobot_deltaco.reports.metrics import paired_difference
from lerobot_deltaco.reports.report import markdown_table

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Writes the tables into the pages."""
    for page, make_tables in PAGES.items():
        write_text(page, fill_tables(page.read_text(encoding="utf-8"), make_tables()))


def fill_tables(page: str, tables: Mapping[str, pd.DataFrame]) -> str:
    """Returns a page with new tables between its marks, `<!-- table NAME -->` and `<!-- end -->`."""
    return re.sub(
        r"(<!-- table (\w+) -->\n).*?(?=\n<!-- end -->)",
        lambda found: f"{found[1]}\n{markdown_table(tables[found[2]])}",
        page,
        flags=re.DOTALL,
    )


def leaderboard_tables() -> dict[str, pd.DataFrame]:
    """Returns the tables of the leaderboard by section: the rows in the protocol's scenes, then the others.

    Raises:
        UserError: A file of records lacks the experiment of a row, or has it for other tasks.
    """
    protocol = str(EvaluationPlan().seed)
    sections: dict[str, list[tuple[tuple[bool, float], dict[str, object]]]] = {}
    for row in pd.read_csv(ROOT / "results/leaderboard.csv").itertuples():
        tasks = "out_of_distribution" if row.section == "out_of_distribution" else "scenario_a_test"
        result = _find(row.records, row.experiment, {"tasks": tasks, "ambiguity": "container"})
        kinds = result.episodes["task_id"].map(lambda task_id: get_task(task_id).kind)
        by_kind = (
            result.episodes["success"].groupby(kinds).mean().reindex(["name", "color", "shape"]).dropna()
        )
        n_seeds = len(result.last)
        cells = {
            "method": row.method,
            "given": row.given,
            "success, % [95 %]": result.success,
            "name / color / shape": " / ".join(f"{100 * rate:.0f}" for rate in by_kind) or None,
            "training": row.data + (f"; {n_seeds} seeds" if n_seeds > 1 else ""),
            "experiment": f"`{row.experiment}` ({result.scenes})",
        }
        rank = (result.scenes != protocol, -result.success.value)
        sections.setdefault(row.section, []).append((rank, cells))
    return {
        section: pd.DataFrame(cells for _, cells in sorted(rows, key=lambda item: item[0])).dropna(
            axis=1, how="all"
        )
        for section, rows in sections.items()
    }


def paper_tables() -> dict[str, pd.DataFrame]:
    """Returns the paper's tables, next to this project's results at a small scale."""
    folders = ("small_a", "small_b", "small_ambiguity")
    results = [result for folder in folders for result in _read(f"{folder}/records.parquet")]
    measured = {paper_row(result.experiment): result for result in results if not result.departures}
    return {
        table: pd.DataFrame(_paper_cells(rows, measured))
        for table, rows in PAPER.groupby("table", sort=False)
    }


def _paper_cells(rows: pd.DataFrame, measured: Mapping[str, Result]) -> Iterable[dict[str, object]]:
    for name, published in rows.iterrows():
        reference = f"{name.partition('/')[0].removesuffix('_finetuned')}/deltaco"
        result, deltaco = measured.get(name), measured[reference]
        yield {
            "row": published.row,
            "paper, %": published.rate,
            "SD": published.sd,
            "here, % [95 %]": result and result.success,
            "seeds": result and str(len(result.last)),
            "paper: less DeL-TaCo": published.rate - PAPER.rate[reference] if name != reference else None,
            "here: less DeL-TaCo [95 %]": (
                paired_difference(result.episodes, deltaco.episodes) if result and name != reference else None
            ),
        }


@cache
def _read(records: str) -> list[Result]:
    return collect_results(read_records(ROOT / "results" / records))


def _find(records: str, experiment: str, settings: Mapping[str, str]) -> Result:
    """Returns the result of an experiment with the fewest departures from the file's main settings."""
    for result in _read(records):
        if result.experiment == experiment and settings.items() <= result.settings.items():
            return result
    raise UserError(f"results/{records} has no evaluation of {experiment!r} with {dict(settings)}.")


PAGES = {ROOT / "docs/leaderboard.md": leaderboard_tables, ROOT / "docs/paper.md": paper_tables}

if __name__ == "__main__":
    main()
