"""`deltaco-report`: writes the paper's tables and curves from the records of evaluations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_deltaco.commands.command_errors import exit_on_error

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lerobot_deltaco.reporting.series import Report
    from lerobot_deltaco.reporting.wordings import WordingResult


def main(arguments: list[str] | None = None) -> None:
    """Writes the report, and prints its success rates."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder. {options.out} is a file.")
    from lerobot_deltaco.evaluation.record import RecordError
    from lerobot_deltaco.reporting.report import write_report
    from lerobot_deltaco.reporting.series import ReportError
    from lerobot_deltaco.reporting.wordings import write_wordings_report

    with exit_on_error(parser, ReportError, RecordError, OSError, interrupted="Interrupted."):
        if options.by_wording:
            text = _wordings_text(write_wordings_report(options.runs, options.out), options.out)
        else:
            text = _text(write_report(options.runs, options.out, options.authors_levels), options.out)
    sys.stdout.write(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-report",
        description="Reports on the evaluations of training runs: success rates as in the paper, learning "
        "curves, outcomes of the episodes, and whether the policy followed the demonstration or the "
        "instruction where they differed. Runs of one experiment that differ in their seeds are combined.",
    )
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="folder of a training run with the records evaluations/*.json that deltaco-evaluate writes, or "
        "folder with several such runs",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the report; its files are replaced"
    )
    parser.add_argument(
        "--authors-levels",
        action="store_true",
        help="draw the rates of the paper, measured in another simulation, into the curves as dashed lines",
    )
    parser.add_argument(
        "--by-wording",
        action="store_true",
        help="report instead how success depends on the wording of the instructions: the evaluations may "
        "differ in their tasks and in --instructions",
    )
    return parser


def _wordings_text(results: Sequence[WordingResult], out: Path) -> str:
    from lerobot_deltaco.reporting.wordings import WORDINGS_REPORT, wording_label

    lines = [f"{out / WORDINGS_REPORT}: success in % at the last step [95 %]"]
    for result in results:
        low, value, high = (100 * rate for rate in (result.rate.low, result.rate.value, result.rate.high))
        lines.append(
            f"  {result.experiment}, {result.tasks}, {wording_label(result.wording)}: "
            f"{value:.1f} [{low:.1f}, {high:.1f}]"
        )
    return "\n".join(lines) + "\n"


def _text(report: Report, out: Path) -> str:
    from lerobot_deltaco.reporting.markdown_page import last_text, rate_text
    from lerobot_deltaco.reporting.report import REPORT_FILE
    from lerobot_deltaco.reporting.series import counted
    from lerobot_deltaco.reporting.statistics import paper_rate

    lines = [f"{out / REPORT_FILE}: success in %, as the paper reports it (SD); at the last step [95 %]"]
    for series in report.regular:
        lines.append(
            f"  {series.experiment}: {rate_text(paper_rate(series.rates))}; {last_text(series)} at step "
            f"{series.steps[-1]:,}; {counted('seed', series.seeds)}"
        )
    lines += [f"Note: {note}" for note in report.notes]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
