"""Tables of docs/leaderboard.md and docs/paper.md, made from the records in `results/`.

`python scripts/update_docs.py`, in a clone of the repository, writes them into the pages.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from gym_deltaco.tasks import get_task
from lerobot_deltaco.paper_results import PAPER_RESULTS, small_scale_experiment, title_of
from lerobot_deltaco.records import read_records
from lerobot_deltaco.report import markdown_table
from lerobot_deltaco.report_tables import KINDS, ReportError, Series, make_series
from lerobot_deltaco.statistics import Estimate, paired_difference, wilson_interval

LEADERBOARD_PAGE, PAPER_PAGE = Path("docs", "leaderboard.md"), Path("docs", "paper.md")
ROWS_FILE = Path("results", "leaderboard.csv")
# Title of each section, and a sentence about its rows
_SECTIONS = {
    "paper": (
        "Trained on the paper's 198 tasks",
        "Scenario A's test tasks. The test objects are distractors in training scenes, as in the paper.",
    ),
    "without": (
        "Trained without the test objects",
        "Scenario A's test tasks. No training scene shows their objects.",
    ),
    "single": ("Single inputs", "Scenario A's test tasks. The policy receives one of the two inputs."),
    "bounds": ("Upper bounds", "Scenario A's test tasks, on which these policies were trained."),
    "foreign": (
        "Foreign objects",
        "The 96 tasks of `foreign`, 384 episodes. No policy was trained on such objects.",
    ),
}
_FEW = 5  # successes, with fewer of which the bootstrap's interval is too narrow
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
    """Returns the sections of the leaderboard in Markdown, the rows of each best first.

    Args:
        root: Folder of the repository, with the rows in `results/leaderboard.csv`: section, name of the
            method, its inputs, file and experiment of its records, and its training data.

    Raises:
        RecordError: A file has no valid records.
        ReportError: A file lacks the experiment, or has it for other tasks.
    """
    rows: dict[str, list[tuple[Any, Series]]] = {name: [] for name in _SECTIONS}
    for row in pd.read_csv(root / ROWS_FILE).itertuples():
        rows[row.section].append((row, _find(root / "results" / row.records, row.experiment)))
    return "\n".join(_section(name, rows[name]) for name in _SECTIONS)


def _section(name: str, rows: Sequence[tuple[Any, Series]]) -> str:
    tasks = "foreign" if name == "foreign" else "scenario_a_test"
    cells = []
    for row, series in sorted(rows, key=lambda pair: -pair[1].success.value):
        if (series.settings["tasks"], series.settings["ambiguity"]) != (tasks, "container"):
            raise ReportError(
                f"The section {name!r} of the leaderboard is of the tasks {tasks!r} in ambiguity scheme "
                f"container. {row.experiment!r} in {row.records} has {series.settings['tasks']!r} and "
                f"{series.settings['ambiguity']}."
            )
        kinds = series.episodes["task_id"].map(lambda task_id: get_task(task_id).kind)
        by_kind = series.episodes["success"].groupby(kinds).mean()
        n_seeds = len(series.seeds)
        cells.append(
            {
                "method": row.method,
                "given": row.given,
                "success, % [95 %]": _success(series),
                "name / color / shape": " / ".join(f"{100 * by_kind[k]:.0f}" for k in KINDS if k in by_kind),
                "training": row.data + (f"; {n_seeds} seeds" if n_seeds > 1 else ""),
                "experiment": f"`{row.experiment}` ({_scenes(series)})",
            }
        )
    table = pd.DataFrame(cells)
    if name == "foreign":
        table = table.drop(columns="name / color / shape")
    title, text = _SECTIONS[name]
    scenes = ", ".join(sorted({_scenes(series) for _, series in rows}))
    return f"## {title}\n\n{text} Scenes: {scenes}.\n\n{markdown_table(table)}"


def _scenes(series: Series) -> str:
    """Returns the scenes of an evaluation as the page abbreviates them."""
    plan = series.last[0].plan
    return f"{plan.seed}" if plan.scene_set is None else f"{plan.seed}/{plan.scene_set}"


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
        "here, % [95 %]": _success(series) if series else NOT_RUN,
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


def _success(series: Series) -> str:
    """Returns a success rate with its interval: Wilson's if few episodes succeeded, else by bootstrap."""
    success, n_episodes = series.episodes["success"], len(series.episodes)
    if success.sum() < _FEW:
        return _text(Estimate(success.mean(), *wilson_interval(int(success.sum()), n_episodes)))
    return _text(series.success)


def _text(estimate: Estimate, sign: str = "") -> str:
    value, low, high = (f"{100 * number:{sign}.1f}" for number in estimate)
    return f"{value} [{low}, {high}]"
