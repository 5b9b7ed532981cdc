"""`deltaco-report`: the paper's tables and curves from the records of evaluations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.evaluation.record import RecordError
from lerobot_deltaco.reporting.report import REPORT_FILE, last_text, rate_text, write_report
from lerobot_deltaco.reporting.series import Report, ReportError, counted
from lerobot_deltaco.reporting.statistics import paper_rate


def main(arguments: list[str] | None = None) -> None:
    """Writes the report, and shows its rates."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder. {options.out} is a file.")
    try:
        report = write_report(options.runs, options.out, options.authors_levels)
    except (ReportError, RecordError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted.\n")
    sys.stdout.write(_text(report, options.out))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-report",
        description="Reports on evaluations of training runs: the paper's success rates, learning curves, "
        "what happened in the episodes, and what behavior followed when demonstration and instruction "
        "differed. Runs of one experiment that differ in their seeds are taken together.",
    )
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="a training run's folder, in which deltaco-evaluate has written evaluations/*.json, or a folder "
        "with several runs in it",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="the report's folder; its files are replaced"
    )
    parser.add_argument(
        "--authors-levels",
        action="store_true",
        help="draw the authors' rates, which are another simulation's, into the curves as dashed lines",
    )
    return parser


def _text(report: Report, out: Path) -> str:
    lines = [f"{out / REPORT_FILE}: success in %, as the paper reports it (SD); at the last step [95 %]"]
    for series in report.regular:
        lines.append(
            f"  {series.experiment}: {rate_text(paper_rate(series.rates))}; {last_text(series.last)} at step "
            f"{series.steps[-1]:,}; {counted('seed', series.seeds)}"
        )
    lines += [f"Note: {note}" for note in report.notes]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
