"""Tables of docs/leaderboard.md and docs/paper.md, made from the records in `results/`.

`python scripts/update_docs.py`, in a clone of the repository, writes them into the pages.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd

from gym_deltaco.tasks import get_task
from lerobot_deltaco.paper_results import PAPER_RESULTS, small_scale_experiment, title_of
from lerobot_deltaco.records import read_records
from lerobot_deltaco.report import markdown_table
from lerobot_deltaco.report_tables import KINDS, ReportError, Series, make_series
from lerobot_deltaco.statistics import Estimate, paired_difference

LEADERBOARD_PAGE, PAPER_PAGE = Path("docs", "leaderboard.md"), Path("docs", "paper.md")
ROWS_FILE = Path("results", "leaderboard.csv")
TASKS, AMBIGUITY = "scenario_a_test", "container"  # of the leaderboard
NOT_RUN = "not run"
BEGIN, END = "<!-- Made from the records in results/. -->", "<!-- End of what is made from records. -->"
# DeL-TaCo's row, the reference for the other rows of a table of the paper.
_REFERENCES = {
    "scenario_a": "scenario_a/deltaco",
    "scenario_b": "scenario_b/deltaco",
    "ambiguity_object": "ambiguity_object/deltaco",
    "ablations": "scenario_a/deltaco",
}


def replace_section(page: str, begin: str, end: str, text: str) -> str:
    """Returns a page with new text between two of its lines.

    Raises:
        ValueError: The page lacks one of the lines.
    """
    before, found_begin, rest = page.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found_begin or not found_end:
        raise ValueError(f"The page needs the lines {begin!r} and {end!r}, between which the text stands.")
    return f"{before}{begin}\n\n{text}\n{end}{after}"


def leaderboard(root: Path) -> str:
    """Returns the leaderboard in Markdown, best first.

    Args:
        root: Folder of the repository, with the rows in `results/leaderboard.csv`: name of the method, its
            inputs, file and experiment of its records, and its training.

    Raises:
        RecordError: A file has no valid records.
        ReportError: A file lacks the experiment, or has it for other tasks.
    """
    rows = []
    for row in pd.read_csv(root / ROWS_FILE).itertuples():
        series = _find(root / "results" / row.records, row.experiment)
        if (series.settings["tasks"], series.settings["ambiguity"]) != (TASKS, AMBIGUITY):
            raise ReportError(
                f"The leaderboard is of the tasks {TASKS!r} with the ambiguity scheme {AMBIGUITY!r}. "
                f"{row.experiment!r} in {row.records} has {series.settings['tasks']!r} and "
                f"{series.settings['ambiguity']!r}."
            )
        kinds = series.episodes["task_id"].map(lambda task_id: get_task(task_id).kind)
        by_kind = series.episodes["success"].groupby(kinds).mean()
        rows.append(
            {
                "rate": series.success.value,
                "method": row.method,
                "given": row.given,
                "success, % [95 %]": _text(series.success),
                **{kind: f"{100 * by_kind[kind]:.1f}" for kind in KINDS if kind in by_kind},
                "seeds": str(len(series.seeds)),
                "training": row.training,
                "experiment": f"`{row.experiment}`",
            }
        )
    table = pd.DataFrame(rows).sort_values("rate", ascending=False, kind="stable")
    return markdown_table(table.drop(columns="rate"))


def paper_tables(root: Path) -> str:
    """Returns the paper's tables in Markdown, with this project's rates at a small scale.

    Args:
        root: Folder of the repository.
    """
    experiments = {name: small_scale_experiment(name) for name in PAPER_RESULTS}
    folders = {experiment.rpartition("/")[0] for experiment in experiments.values()}
    files = [root / "results" / folder / "records.parquet" for folder in folders]
    measured = {series.experiment: series for file in files for series in _read(file)}
    sections = []
    for group, reference in _REFERENCES.items():
        rows = [
            _paper_row(name, reference, measured.get(experiment), measured[experiments[reference]])
            for name, experiment in experiments.items()
            if name.startswith(f"{group}/")
        ]
        sections.append(f"### {title_of(group)}\n\n{markdown_table(pd.DataFrame(rows))}")
    return "\n".join(sections)


def _paper_row(name: str, reference: str, series: Series | None, deltaco: Series) -> dict[str, str]:
    published = PAPER_RESULTS[name]
    difference = published.rate - PAPER_RESULTS[reference].rate
    paired = series and paired_difference(series.episodes, deltaco.episodes)
    is_reference = name == reference
    return {
        "row": published.label,
        "paper, % (SD)": f"{100 * published.rate:.1f} ({100 * published.sd:.1f})",
        "here, % [95 %]": _text(series.success) if series else NOT_RUN,
        "seeds": str(len(series.seeds)) if series else "",
        "paper: less DeL-TaCo": "" if is_reference else f"{100 * difference:+.1f}",
        "here: less DeL-TaCo [95 %]": "" if is_reference or not paired else _text(paired, "+"),
    }


@cache
def _read(file: Path) -> tuple[Series, ...]:
    return tuple(series for series in make_series(read_records(file)) if not series.is_counterfactual)


def _find(file: Path, experiment: str) -> Series:
    found = [series for series in _read(file) if series.experiment == experiment]
    if len(found) != 1:
        raise ReportError(f"{file} must have {experiment!r} in one setting. It has {len(found)}.")
    return found[0]


def _text(estimate: Estimate, sign: str = "") -> str:
    value, low, high = (f"{100 * number:{sign}.1f}" for number in estimate)
    return f"{value} [{low}, {high}]"
