"""`deltaco-experiment`: a row of the tables, from its data to its evaluation."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_deltaco.evaluation.record import RecordError
from lerobot_deltaco.evaluation.report import write_report
from lerobot_deltaco.evaluation.series import ReportError
from lerobot_deltaco.experiments.rows import RowError, read_row
from lerobot_deltaco.experiments.run import Experiment, ExperimentError


def main(arguments: list[str] | None = None) -> None:
    """Runs what of the row is not done yet."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        rows = [read_row(options.experiments, name, options.settings) for name in options.rows]
    except RowError as error:
        parser.error(str(error))
    try:
        experiments = [Experiment(row, seed, options.out) for seed in options.seed for row in rows]
        for n_done, experiment in enumerate(experiments, start=1):
            experiment.do()
            if options.report is not None:
                # After each, so that there is a report however far it comes.
                write_report([done.run for done in experiments[:n_done]], options.report)
    except (ExperimentError, ReportError, RecordError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command goes on from here.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-experiment",
        description="Collects the data of rows, trains, and evaluates every checkpoint. Interrupted, it "
        "goes on when the same command is given again.",
    )
    parser.add_argument("rows", nargs="+", metavar="ROW", help="such as scenario_a/deltaco")
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], metavar="SEED", help="one or more, of the training (0)"
    )
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="SECTION.NAME=VALUE",
        help="what differs from the rows' files, such as training.steps=2000; may be given several times",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="also write the report of these rows, as deltaco-report does",
    )
    parser.add_argument(
        "--experiments",
        type=Path,
        default=Path("experiments"),
        metavar="DIR",
        help="with the rows' files (%(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/experiments"), metavar="DIR", help="where to (%(default)s)"
    )
    return parser


if __name__ == "__main__":
    main()
