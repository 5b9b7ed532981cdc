"""The report on evaluations: the paper's tables and curves, from the records of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lerobot_deltaco.reporting.beside_paper import PaperComparison, draw_beside_paper
from lerobot_deltaco.reporting.comparisons import title_of
from lerobot_deltaco.reporting.csv_files import csv_files
from lerobot_deltaco.reporting.curves import Curve, draw_curves
from lerobot_deltaco.reporting.markdown_page import BESIDE_PAPER_IMAGE, CURVES_IMAGE, markdown_page
from lerobot_deltaco.reporting.paper_results import label_of, paper_result
from lerobot_deltaco.reporting.report_files import write_files
from lerobot_deltaco.reporting.series import Report, find_records, make_report
from lerobot_deltaco.reporting.task_bootstrap import mean_rate

REPORT_FILE = "report.md"
FILES = (
    CURVES_IMAGE,
    BESIDE_PAPER_IMAGE,
    "curves.csv",
    "rates.csv",
    "breakdown.csv",
    "differences.csv",
    "novelty.csv",
    "objects.csv",
    "counterfactual.csv",
    REPORT_FILE,
)


def write_report(folders: Sequence[Path], out: Path, authors_levels: bool = False) -> Report:
    """Reports on all evaluations of some runs, in Markdown, CSV files and an image.

    All files are written, or none. Those of an earlier report are replaced.

    Args:
        folders: Folders of runs, or folders that contain them at any depth.
        out: The report's folder, which is made.
        authors_levels: Draw the authors' rates into the image.

    Returns:
        What was reported. Without ordinary evaluations, there are no rates and no curves; with a single
        experiment, no `differences.csv`; without counterfactual evaluations, no `counterfactual.csv`.

    Raises:
        ReportError: A folder has no records, or they do not belong together.
        RecordError: A record is damaged.
        OSError: Something cannot be read or written.
    """
    report = make_report(find_records(folders))
    contents = csv_files(report)
    if report.regular:
        panels = [
            (title_of(name), [Curve(series.experiment, series.steps, series.rates) for series in group])
            for name, group in report.comparisons.items()
        ]
        contents[CURVES_IMAGE] = draw_curves(panels, authors_levels)
        compared = _beside_paper(report)
        if compared:
            contents[BESIDE_PAPER_IMAGE] = draw_beside_paper(compared)
    contents[REPORT_FILE] = markdown_page(report).encode()
    write_files(out, contents, FILES)
    return report


def _beside_paper(report: Report) -> list[tuple[str, list[PaperComparison]]]:
    """Titles and rows of the comparisons that have rows of the paper."""
    panels = []
    for name, group in report.comparisons.items():
        rows = [
            PaperComparison(
                label_of(series.experiment),
                mean_rate(series.last_task_rates),
                paper_result(series.experiment),
            )
            for series in group
        ]
        if any(row.published is not None for row in rows):
            panels.append((title_of(name), rows))
    return panels
