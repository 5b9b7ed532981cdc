"""`deltaco-experiment`: runs experiments, from collecting the data to evaluating every checkpoint."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.experiments.command_runner import ExperimentError
from lerobot_deltaco.experiments.config import (
    ExperimentConfigError,
    default_folder,
    experiment_names,
    read_experiment,
)
from lerobot_deltaco.experiments.run import STEPS, ExperimentRun, missing_records


def main(arguments: list[str] | None = None) -> None:
    """Runs the steps of the experiments that are not finished yet."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1. Got {options.jobs}.")
    if options.list:
        sys.stdout.write("".join(f"{name}\n" for name in experiment_names(options.experiments)))
        return
    if options.only == "report" and options.report is None:
        parser.error("--only report needs --report DIR, the folder for the report.")
    if options.only != "collect" and _shard_options(options):
        parser.error("--shard and --join need --only collect.")
    if not options.names:
        parser.error("Name at least one experiment. --list prints their names.")
    try:
        configs = [
            read_experiment(options.experiments, name, options.settings)
            for name in dict.fromkeys(options.names)
        ]
    except ExperimentConfigError as error:
        parser.error(str(error))
    runs = [
        ExperimentRun(config, seed, options.out) for seed in dict.fromkeys(options.seed) for config in configs
    ]
    if options.dry_run:
        with exit_on_error(parser, ExperimentError, OSError):
            _print_commands(runs, options.only, _shard_options(options))
        return
    # Only here, since they take a second to import.
    from lerobot_deltaco.evaluation.record import RecordError
    from lerobot_deltaco.experiments.side_by_side import collect_once, run_side_by_side
    from lerobot_deltaco.reporting.report import write_report
    from lerobot_deltaco.reporting.series import ReportError

    finished: list[Path] = []

    def report(run: Path) -> None:
        """Writes the report after each run, so that there is one after an interruption, too."""
        finished.append(run)
        if options.report is not None and options.only != "train":
            write_report(finished, options.report)

    with exit_on_error(parser, ExperimentError, ReportError, RecordError, OSError):
        if options.only == "report":
            _report(runs, options.report)
        elif options.only == "collect":
            for run in runs:
                run.check_settings()
            collect_once(runs, _shard_options(options))
        elif options.jobs > 1:
            run_side_by_side(runs, options.jobs, report, options.only)
        else:
            for run in runs:
                run.run(options.only)
                report(run.folder)


def _shard_options(options: argparse.Namespace) -> list[str]:
    """The options that are passed on to `deltaco-collect`."""
    return ["--join"] if options.join else [f"--shard={options.shard}"] if options.shard else []


def _report(runs: list[ExperimentRun], folder: Path) -> None:
    """Writes the report of runs that have been evaluated, and runs nothing."""
    from lerobot_deltaco.reporting.report import write_report

    problem = missing_records(runs)
    if problem is not None:
        raise ExperimentError(problem)
    write_report([run.folder for run in runs], folder)


def _print_commands(runs: list[ExperimentRun], only: str | None, shard_options: list[str]) -> None:
    """Prints each command that the runs would run, once."""
    for run in runs:
        run.check_settings()
    commands = [command for run in runs for command in run.commands() if only in (None, command.name)]
    lines = dict.fromkeys(
        shlex.join([f"deltaco-{name}", *arguments, *(shard_options if name == "collect" else ())])
        for name, arguments in commands
    )
    sys.stdout.write("".join(f"{line}\n" for line in lines))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-experiment",
        description="Collects the data of experiments, trains, and evaluates every checkpoint. After an "
        "interruption, the same command continues.",
    )
    parser.add_argument(
        "names", nargs="*", metavar="EXPERIMENT", help="name of an experiment, such as scenario_a/deltaco"
    )
    parser.add_argument("--list", action="store_true", help="print the names of all experiments and end")
    parser.add_argument(
        "--dry-run", action="store_true", help="print the commands that would be run, and run none"
    )
    parser.add_argument(
        "--seed",
        type=int,
        nargs="+",
        default=[0],
        metavar="SEED",
        help="one or more seeds of the training (default: 0)",
    )
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="SECTION.NAME=VALUE",
        help="setting that overrides the experiments' files, such as training.steps=2000; may be repeated",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="number of runs at a time (default: %(default)s). Each gets an equal share of the processor's "
        "cores, holds its own copy of the frames in memory, and gets a GPU of its own; where there are fewer "
        "GPUs than runs, they share them.",
    )
    parser.add_argument(
        "--only",
        choices=(*STEPS, "report"),
        metavar="STEP",
        help="run only this step: collect, train, evaluate or report; the steps before it must be finished. "
        "With it, the jobs of a cluster can share datasets.",
    )
    shards = parser.add_mutually_exclusive_group()
    shards.add_argument(
        "--shard", metavar="I/N", help="with --only collect: collect the I-th of N parts of each dataset"
    )
    shards.add_argument(
        "--join", action="store_true", help="with --only collect: join the parts of each dataset"
    )
    parser.add_argument(
        "--report", type=Path, metavar="DIR", help="folder for the report, as deltaco-report writes it"
    )
    parser.add_argument(
        "--experiments",
        type=Path,
        default=default_folder(),
        metavar="DIR",
        help="folder of the experiments' files (default: those of this project)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/experiments"),
        metavar="DIR",
        help="folder for all outputs (default: %(default)s)",
    )
    return parser


if __name__ == "__main__":
    main()
