"""Experiments on a Slurm cluster, from shards of the data to the report, by datatrove's executors.

Five kinds of jobs, each of which waits for the one before it: an array collects shards of the datasets, a job
joins them, an array trains (each run on a GPU of its own), an array evaluates, and a job writes the report.
All run `deltaco-experiment --only ...`, and after an interruption the same command continues:

    python examples/slurm_experiments.py small_a/deltaco small_a/language_only --seed 0 1 2 \
        --shards 32 --partition cpu --gpu-partition gpu --out /shared/experiments

With --local, it does the same on this machine, one job after the other. The idea is that of LeRobot's
examples for porting large datasets. Needs `pip install '.[slurm]'`, and a folder that all nodes share.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from datatrove.executor import LocalPipelineExecutor
from datatrove.executor.slurm import SlurmPipelineExecutor
from datatrove.pipeline.base import PipelineStep

from lerobot_deltaco.experiments.command_runner import CommandRunner
from lerobot_deltaco.experiments.config import ExperimentConfigError, default_folder, read_experiment


class ExperimentCommands(PipelineStep):
    """Runs `deltaco-experiment`, with other arguments in each job of an array.

    Args:
        commands: Arguments of each job.
    """

    name = "deltaco-experiment"
    type = "experiment"

    def __init__(self, commands: Sequence[Sequence[str]]) -> None:
        super().__init__()
        self.commands = [list(command) for command in commands]

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> None:
        """Runs the command of a job. If it fails, so does the job, and what depends on it does not begin."""
        CommandRunner().run("experiment", self.commands[rank])


class Stage(NamedTuple):
    """An array of jobs."""

    name: str
    commands: list[list[str]]
    uses_gpu: bool = False


def stages(options: argparse.Namespace) -> list[Stage]:
    """The arrays of jobs, in the order in which they depend on each other."""
    common = [f"--experiments={options.experiments}", f"--out={options.out}"]
    common += [f"--set={setting}" for setting in options.settings]
    seeds = [str(seed) for seed in options.seed]
    every_name = [*options.names, *common]
    configs = [read_experiment(options.experiments, name, options.settings) for name in options.names]

    def runs(step: str, starts_from_another: bool) -> list[list[str]]:
        return [
            [config.name, f"--seed={seed}", f"--only={step}", *common]
            for config in configs
            if (config.start_from in options.names) == starts_from_another
            for seed in seeds
        ]

    shards = [f"--shard={number}/{options.shards}" for number in range(1, options.shards + 1)]
    found = [
        Stage("collect", [[*every_name, "--only=collect", shard] for shard in shards]),
        Stage("join", [[*every_name, "--only=collect", "--join"]]),
        Stage("train", runs("train", False), uses_gpu=True),
        # Those that are fine-tuned wait for what they start from.
        Stage("finetune", runs("train", True), uses_gpu=True),
        Stage("evaluate", [*runs("evaluate", False), *runs("evaluate", True)], uses_gpu=True),
        Stage("report", [[*every_name, "--seed", *seeds, "--only=report", f"--report={options.report}"]]),
    ]
    return [stage for stage in found if stage.commands]


def make_executor(stage: Stage, options: argparse.Namespace, before: Any) -> Any:
    """The executor of a stage, which begins when the one before has ended well."""
    shared = {
        "pipeline": [ExperimentCommands(stage.commands)],
        "tasks": len(stage.commands),
        "logging_dir": str(options.logs / stage.name),
        "depends": before,
    }
    if options.local:
        return LocalPipelineExecutor(workers=1, **shared)
    return SlurmPipelineExecutor(
        job_name=f"deltaco_{stage.name}",
        time=options.time,
        partition=options.gpu_partition if stage.uses_gpu else options.partition,
        cpus_per_task=options.cpus_per_task,
        mem_per_cpu_gb=options.mem_per_cpu_gb,
        gpus_per_task=options.gpus_per_task if stage.uses_gpu else 0,
        workers=options.workers,
        venv_path=options.venv_path,
        env_command=options.env_command,
        sbatch_args=dict(argument.split("=", 1) for argument in options.sbatch),
        mail_type="NONE",
        **shared,
    )


def main(arguments: list[str] | None = None) -> None:
    """Submits all stages, or runs them here."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if not options.local and not (options.partition and options.gpu_partition):
        parser.error("Slurm needs --partition and --gpu-partition. --local runs everything here.")
    if options.shards < 1:
        parser.error(f"--shards must be at least 1. Got {options.shards}.")
    for argument in options.sbatch:
        if not argument.partition("=")[1]:
            parser.error(f"--sbatch must be NAME=VALUE, or NAME= for one without a value. Got {argument!r}.")
    # Jobs start in folders of their own.
    for name in ("out", "report", "logs", "experiments"):
        setattr(options, name, getattr(options, name).resolve())
    try:
        planned = stages(options)
    except ExperimentConfigError as error:
        parser.error(str(error))
    executor = None
    for stage in planned:
        executor = make_executor(stage, options, executor)
        if options.dry_run:
            for command in stage.commands:
                print(f"{stage.name}: deltaco-experiment {shlex.join(command)}")  # noqa: T201
        elif options.local:
            executor.depends = None  # it has been run
            executor.run()
    if not options.dry_run and not options.local:
        executor.run()  # submits those that it depends on first


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="+", metavar="EXPERIMENT", help="such as small_a/deltaco")
    parser.add_argument("--seed", type=int, nargs="+", default=[0], metavar="SEED", help="(default: 0)")
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="SECTION.NAME=VALUE",
        help="setting that overrides the experiments' files; may be repeated",
    )  # fmt: skip
    parser.add_argument("--shards", type=int, default=8, help="of each dataset (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("outputs/experiments"), help="shared by all nodes")
    parser.add_argument("--report", type=Path, default=Path("outputs/report"), help="folder for the report")
    parser.add_argument("--logs", type=Path, default=Path("outputs/slurm"), help="folder of datatrove's logs")
    parser.add_argument("--experiments", type=Path, default=default_folder(), help="the experiments' files")
    parser.add_argument("--local", action="store_true", help="run the jobs here, without Slurm")
    parser.add_argument("--dry-run", action="store_true", help="print the commands of all jobs, and run none")
    slurm = parser.add_argument_group("Slurm")
    slurm.add_argument("--partition", help="of the jobs without a GPU")
    slurm.add_argument("--gpu-partition", help="of the jobs that train and evaluate")
    slurm.add_argument("--time", default="24:00:00", help="limit of a job (default: %(default)s)")
    slurm.add_argument("--cpus-per-task", type=int, default=8, help="(default: %(default)s)")
    slurm.add_argument("--mem-per-cpu-gb", type=int, default=2, help="(default: %(default)s)")
    slurm.add_argument("--gpus-per-task", type=int, default=1, help="of training (default: %(default)s)")
    slurm.add_argument("--workers", type=int, default=-1, help="jobs of an array at a time (default: all)")
    slurm.add_argument("--venv-path", help="virtual environment to activate in a job, up to bin/activate")
    slurm.add_argument("--env-command", help="other command that a job begins with")
    slurm.add_argument(
        "--sbatch",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="more arguments of sbatch, such as qos=high or exclusive=; may be repeated",
    )
    return parser


if __name__ == "__main__":
    main()
