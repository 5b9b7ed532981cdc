r"""Collects a dataset, and evaluates a policy, on many machines, by LeRobot's engine for datasets.

    pip install datatrove
    python examples/cluster.py collect --root data/tasks --tasks scenario_a_train --episodes-per-task 50 \
        --jobs 32 --partition cpu
    python examples/cluster.py evaluate --policy outputs/match --out outputs/seeds --seeds 1000 2000 3000 \
        --partition cpu
    deltaco report outputs/seeds

Without `--partition`, the same jobs run on this machine. With it, Slurm runs them; all machines have to share
the folders. After a failure, run the same command again: what is finished is kept.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path

import tyro
from datatrove.executor import LocalPipelineExecutor, SlurmPipelineExecutor

from lerobot_deltaco.collection.collect import CollectionPlan, collect_part
from lerobot_deltaco.collection.collect import collect as finish_collection
from lerobot_deltaco.evaluation.command import EvaluateArguments, evaluate_checkpoints
from lerobot_deltaco.evaluation.records import EvaluationPlan

Executor = LocalPipelineExecutor | SlurmPipelineExecutor


def make_executor(
    step: Callable[..., None], jobs: int, logs: Path, partition: str | None, after: Executor | None = None
) -> Executor:
    """Returns what runs a step in some jobs, each of one core and thread.

    Args:
        step: Function of (data, rank, world_size).
        jobs: Number of jobs.
        logs: Folder of the logs.
        partition: Partition of Slurm; None for this machine.
        after: What has to be finished before.
    """
    if partition is None:
        return LocalPipelineExecutor([step], jobs, logging_dir=str(logs), depends=after, skip_completed=False)
    return SlurmPipelineExecutor(
        [step],
        jobs,
        time="04:00:00",
        partition=partition,
        job_name=logs.name,
        mem_per_cpu_gb=4,
        venv_path=str(Path(sys.prefix) / "bin" / "activate"),
        logging_dir=str(logs),
        depends=after,
        skip_completed=False,  # Steps skip what is finished themselves.
    )


def collect(
    root: Path,
    tasks: str = "scenario_a_train",
    episodes_per_task: int = 6,
    jobs: int = 4,
    partition: str = "",
) -> None:
    """Collects a dataset: each job some shards, and a last one the metadata.

    Args:
        root: Folder of the dataset.
        tasks: Tasks: a task set, or indices and ranges.
        episodes_per_task: Number of episodes of each task.
        jobs: Number of jobs.
        partition: Partition of Slurm; empty for this machine.
    """
    plan, logs = CollectionPlan(tasks, episodes_per_task), root.with_name(f"{root.name}_logs")
    parts = make_executor(
        functools.partial(_collect_part, root, plan), jobs, logs / "parts", partition or None
    )
    finish = functools.partial(_finish, root, plan)
    make_executor(finish, 1, logs / "finish", partition or None, after=parts).run()


def evaluate(
    policy: Path, out: Path, seeds: tuple[int, ...] = (1000,), trials: int = 4, partition: str = ""
) -> None:
    """Evaluates all checkpoints of a policy, each seed of the scenes in a job.

    Args:
        policy: Output folder of a training run, or folder of a policy.
        out: Folder of the records.
        seeds: Seeds of the scenes.
        trials: Number of episodes of each task.
        partition: Partition of Slurm; empty for this machine.
    """
    step = functools.partial(_evaluate, policy, out, seeds, trials)
    make_executor(step, len(seeds), out.with_name(f"{out.name}_logs"), partition or None).run()


def _collect_part(root: Path, plan: CollectionPlan, _: object, rank: int = 0, world_size: int = 1) -> None:
    collect_part(root, plan, rank, world_size)


def _finish(root: Path, plan: CollectionPlan, *_: object) -> None:
    print(finish_collection(root, plan))  # noqa: T201


def _evaluate(
    policy: Path, out: Path, seeds: tuple[int, ...], trials: int, _: object, rank: int = 0, __: int = 1
) -> None:
    plan = EvaluationPlan(trials=trials, seed=seeds[rank])
    print(evaluate_checkpoints(EvaluateArguments(policy, plan, out=out, processes=1)))  # noqa: T201


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"collect": collect, "evaluate": evaluate}, description=__doc__)
