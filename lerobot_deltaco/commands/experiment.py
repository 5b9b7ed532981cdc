"""`deltaco-experiment`: runs experiments, from collecting the data to the evaluation."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_deltaco.evaluation.record import RecordError
from lerobot_deltaco.experiments.command_runner import ExperimentError
from lerobot_deltaco.experiments.config import ExperimentConfigError, read_experiment
from lerobot_deltaco.experiments.run import ExperimentRun
from lerobot_deltaco.experiments.side_by_side import run_side_by_side
from lerobot_deltaco.reporting.report import write_report
from lerobot_deltaco.reporting.series import ReportError


def main(arguments: list[str] | None = None) -> None:
    """Runs the steps of the experiments that are not finished yet."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1. Got {options.jobs}.")
    try:
        names = dict.fromkeys(options.names)
        configs = [read_experiment(options.experiments, name, options.settings) for name in names]
    except ExperimentConfigError as error:
        parser.error(str(error))
    try:
        experiments = [
            ExperimentRun(config, seed, options.out)
            for seed in dict.fromkeys(options.seed)
            for config in configs
        ]
        done: list[Path] = []

        def report(run: Path) -> None:
            """After each, so that there is a report however far it comes."""
            done.append(run)
            if options.report is not None:
                write_report(done, options.report)

        if options.jobs > 1:
            run_side_by_side(experiments, options.jobs, report)
        else:
            for experiment in experiments:
                experiment.run()
                report(experiment.folder)
    except (ExperimentError, ReportError, RecordError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command goes on from here.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-experiment",
        description="Collects the data of experiments, trains, and evaluates every checkpoint. After an "
        "interruption, the same command continues.",
    )
    parser.add_argument("names", nargs="+", metavar="EXPERIMENT", help="such as scenario_a/deltaco")
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], metavar="SEED", help="one or more, of the training (0)"
    )
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="SECTION.NAME=VALUE",
        help="a setting that overrides the experiments' files, such as training.steps=2000; may be repeated",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="train and evaluate N runs at a time (%(default)s). Each has its share of the processor's cores "
        "and its own copy of the frames in memory; those on a GPU are all on the same.",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="also write the report on these experiments, as deltaco-report does",
    )
    parser.add_argument(
        "--experiments",
        type=Path,
        default=Path("experiments"),
        metavar="DIR",
        help="folder of the experiments' files (%(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/experiments"), metavar="DIR", help="where to (%(default)s)"
    )
    return parser


if __name__ == "__main__":
    main()
