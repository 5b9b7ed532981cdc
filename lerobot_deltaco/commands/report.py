"""`deltaco-report`: writes the paper's tables and curves from the records of evaluations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_deltaco.commands.command_errors import exit_on_error

if TYPE_CHECKING:
    from lerobot_deltaco.reporting.series import Report


def main(arguments: list[str] | None = None) -> None:
    """Writes the report, and prints its success rates."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder. {options.out} is a file.")
    from lerobot_deltaco.evaluation.record import RecordError
    from lerobot_deltaco.reporting.report import write_report
    from lerobot_deltaco.reporting.series import ReportError

    with exit_on_error(parser, ReportError, RecordError, OSError, interrupted="Interrupted."):
        report = write_report(options.runs, options.out, options.authors_levels)
    sys.stdout.write(_text(report, options.out))


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
    return parser


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
