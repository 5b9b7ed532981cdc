"""Experiments: the paper's rows and the project's own, from data collection to the report.

    recipe -> collect -> train -> evaluate -> report

Each step is a `deltaco` command in a process of its own. Finished steps are skipped, so the same command
continues after an interruption.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from gym_deltaco.atomic_files import read_json, write_json
from lerobot_deltaco.checkpoints import find_checkpoints
from lerobot_deltaco.collect import CollectionPlan, is_finished
from lerobot_deltaco.recipes import ExperimentError, Recipe, Scale, read_recipe
from lerobot_deltaco.records import EvaluationPlan, EvaluationRecord, read_records

Step = Literal["collect", "train", "evaluate", "report"]


class Run:
    """A recipe with a seed, in a folder for the outputs of experiments.

    Args:
        recipe: The recipe.
        seed: Training seed.
        out: Folder of all outputs. Experiments share its folder `data`.
    """

    def __init__(self, recipe: Recipe, seed: int, out: Path) -> None:
        self.recipe = recipe
        self.seed = seed
        self.out = out
        self.folder = out / recipe.scale / recipe.name / f"seed_{seed}"
        self.log = self.folder.with_name(f"seed_{seed}.log")
        self.settings_file = self.folder.with_name(f"seed_{seed}.json")

    def __str__(self) -> str:
        return f"{self.recipe.name} {self.seed}"

    def dataset(self, plan: CollectionPlan) -> Path:
        """Returns the folder of a dataset, named after its plan."""
        name = "_".join(f"{key.rpartition('.')[2]}-{value}" for key, value in plan_options(plan))
        return self.out / "data" / re.sub(r"[^\w.,-]", "-", name)

    def collect_commands(self) -> list[list[str]]:
        """Returns the commands that collect the missing datasets."""
        plans = dict.fromkeys((self.recipe.data, self.recipe.demonstrations))
        return [
            ["collect", *_flags(plan), "--root", str(self.dataset(plan))]
            for plan in plans
            if not is_finished(self.dataset(plan))
        ]

    def train_command(self) -> list[str] | None:
        """Returns the command that starts or resumes training; None if it is finished.

        Raises:
            ExperimentError: The experiment that this one starts from was not trained and evaluated.
        """
        step = last_step(self.folder)
        if step >= self.recipe.training.steps:
            return None
        if step > 0:
            return [
                "train",
                f"--config_path={last_checkpoint(self.folder) / 'train_config.json'}",
                "--resume=true",
            ]
        policy = dict(self.recipe.policy)
        start = {"policy.type": policy.pop("type")}
        if self.recipe.start_from is not None:
            start = {"policy.path": last_checkpoint(self._best_start())}
        options = {
            **start,
            **{f"policy.{name}": value for name, value in policy.items()},
            "policy.seed": self.seed,
            "policy.demo_repo_id": "deltaco/demonstrations",
            "policy.demo_root": self.dataset(self.recipe.demonstrations),
            "dataset.repo_id": "deltaco/training",
            "dataset.root": self.dataset(self.recipe.data),
            **asdict(self.recipe.training),
            "seed": self.seed,
            "job_name": f"{self.recipe.scale}/{self.recipe.name}",
            "output_dir": self.folder,
        }
        return ["train", *(f"--{name}={_text(value)}" for name, value in options.items())]

    def evaluate_command(self, plan: EvaluationPlan | None = None) -> list[str]:
        """Returns the command that evaluates the checkpoints, by default as the recipe says."""
        return ["evaluate", str(self.folder), *_flags(plan or self.recipe.evaluation)]

    def unevaluated_steps(self, plan: EvaluationPlan | None = None) -> list[int]:
        """Returns the steps of the checkpoints without a record; by default, of the recipe's plan."""
        if last_step(self.folder) == 0:
            return []
        plan = plan or self.recipe.evaluation
        done = {record.step for record in read_run_records(self.folder) if record.plan == plan}
        return [found.step for found in find_checkpoints(self.folder) if found.step not in done]

    def check_settings(self) -> None:
        """Checks that the run, if it has a checkpoint, began with the same settings.

        Raises:
            ExperimentError: It began with others.
        """
        if last_step(self.folder) == 0 or not self.settings_file.is_file():
            return
        found = read_json(self.settings_file)
        for section, settings in self._settings().items():
            if found.get(section) != settings:
                raise ExperimentError(
                    f"{self.folder} was begun with other settings: {section} was {found.get(section)}, now "
                    f"it is {settings}. Use the same settings or another --out, or move the run away."
                )

    def train(self, log: Path | None = None, n_threads: int | None = None) -> None:
        """Trains unless training is finished.

        Args:
            log: File for the output; None for this terminal.
            n_threads: Number of threads; None for PyTorch's choice.
        """
        command = self.train_command()
        if command is None:
            return
        if last_step(self.folder) == 0:
            # A run that stopped before its first checkpoint has left a folder.
            shutil.rmtree(self.folder, ignore_errors=True)
            write_json(self.settings_file, self._settings())
        call(command, log, n_threads)

    def evaluate(self, log: Path | None = None, n_threads: int | None = None) -> None:
        """Evaluates the checkpoints that have no record; the arguments are those of `train`."""
        if self.unevaluated_steps():
            call(self.evaluate_command(), log, n_threads)

    def check_step(self, only: Step | None) -> None:
        """Checks that the steps before one that is run alone are finished.

        Raises:
            ExperimentError: They are not.
        """
        missing, step, steps = self.collect_commands(), last_step(self.folder), self.recipe.training.steps
        if only == "train" and missing:
            raise ExperimentError(f"{self} needs the dataset {missing[0][-1]}. Run --only collect first.")
        if only == "evaluate" and step < steps:
            raise ExperimentError(f"{self} is at step {step} of {steps}. Run --only train first.")
        if only == "report" and not read_run_records(self.folder):
            raise ExperimentError(f"{self} has no evaluated checkpoint. Run --only evaluate first.")

    def commands(self, only: Step | None = None) -> list[list[str]]:
        """Returns the commands that are still to be run, without the report."""
        train = self.train_command() if only in (None, "train") else None
        evaluates = only in (None, "evaluate") and (train is not None or self.unevaluated_steps())
        return [
            *(self.collect_commands() if only in (None, "collect") else []),
            *([train] if train else []),
            *([self.evaluate_command()] if evaluates else []),
        ]

    def _settings(self) -> dict[str, Any]:
        settings = asdict(self.recipe)
        del settings["evaluation"]
        return json.loads(json.dumps(settings))

    def _best_start(self) -> Path:
        """Returns the run of `start_from` with the highest success rate at its last step."""
        assert self.recipe.start_from is not None
        rates = {}
        folders = self.out / self.recipe.scale / self.recipe.start_from
        for folder in sorted(folders.glob("seed_*/")):
            for record in read_run_records(folder):
                if record.plan == self.recipe.evaluation and record.step == last_step(folder):
                    rates[folder] = record.success_rate
        if not rates:
            raise ExperimentError(
                f"{self} starts from {self.recipe.start_from}, of which {folders} has no evaluated run. "
                "Run that experiment first, or both at once."
            )
        return max(rates, key=lambda folder: rates[folder])


def last_checkpoint(run: Path) -> Path:
    """Returns the folder of the policy in the last checkpoint of a run, whether it exists or not."""
    return run / "checkpoints" / "last" / "pretrained_model"


def last_step(run: Path) -> int:
    """Returns the step of the last checkpoint of a run; 0 without any."""
    path = run / "checkpoints" / "last" / "training_state" / "training_step.json"
    return int(read_json(path)["step"]) if path.is_file() else 0


def read_run_records(run: Path) -> list[EvaluationRecord]:
    """Reads the records of the evaluations of a run; none if it was not evaluated."""
    return read_records(run / "evaluations") if (run / "evaluations").is_dir() else []


def plan_options(plan: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the fields of a plan that differ from their defaults, nested ones as "scene.objects"."""
    for field in fields(plan):
        value = getattr(plan, field.name)
        if is_dataclass(value):
            yield from plan_options(value, f"{prefix}{field.name}.")
        elif value != field.default:
            yield f"{prefix}{field.name}", value


def _flags(plan: Any) -> list[str]:
    flags = []
    for name, value in plan_options(plan):
        flags += [f"--{name.replace('_', '-')}", _text(value)]
    return flags


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, (bool, list, tuple)) else str(value)


# Execution


def call(arguments: Sequence[str], log: Path | None = None, n_threads: int | None = None) -> None:
    """Runs a `deltaco` command in a process of its own.

    Args:
        arguments: Subcommand and its arguments.
        log: File that the output is appended to; None for this terminal.
        n_threads: Number of threads; None for the command's choice.

    Raises:
        ExperimentError: The command failed.
    """
    environment = dict(os.environ)
    if n_threads is not None:
        environment["OMP_NUM_THREADS"] = str(n_threads)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        environment["TQDM_MININTERVAL"] = "10"  # s; a log keeps every state of a progress bar
    with log.open("a", encoding="utf-8") if log else nullcontext(sys.stdout) as output:
        output.write(f"\n{command_line(arguments)}\n")
        output.flush()
        streams: dict[str, Any] = {"stdout": output, "stderr": subprocess.STDOUT} if log else {}
        words = [sys.executable, "-m", "lerobot_deltaco.cli", *arguments]
        status = subprocess.run(words, env=environment, check=False, **streams).returncode
    if status != 0:
        raise ExperimentError(
            f"`deltaco {arguments[0]}` failed (exit status {status}); see {log or 'above'} for the reason. "
            "The same command continues."
        )


def command_line(arguments: Sequence[str]) -> str:
    """Returns a `deltaco` command as a user would type it."""
    return shlex.join(["deltaco", *arguments])


def run_experiments(
    names: Sequence[str],
    scale: Scale = "small",
    seeds: Sequence[int] = (0,),
    out: Path = Path("outputs/experiments"),
    settings: Sequence[str] = (),
    jobs: int = 1,
    only: Step | None = None,
    dry_run: bool = False,
) -> None:
    """Runs the steps of experiments that are not finished.

    Args:
        names: Names of experiments, such as "scenario_a/deltaco".
        scale: Amount of data and training.
        seeds: Training seeds; each is a separate run.
        out: Folder of all outputs.
        settings: Settings that take precedence over the recipes, such as "training.steps=2000".
        jobs: Number of runs at a time. Each has its share of the cores, and its own copy of the frames.
        only: The only step to run; the steps before it must be finished.
        dry_run: Whether to print the commands instead.

    Raises:
        ExperimentError: A setting is invalid, a run began with other settings, or a step failed.
    """
    if jobs < 1 or not names:
        raise ExperimentError(
            f"Name at least one experiment, and at least one job. Got {len(names)} and {jobs}."
        )
    recipes = [read_recipe(name, scale, settings) for name in dict.fromkeys(names)]
    runs = [Run(recipe, seed, out) for seed in dict.fromkeys(seeds) for recipe in recipes]
    for run in runs:
        run.check_settings()
    # Fine-tuning starts once the runs that it may start from are done.
    first = [run for run in runs if run.recipe.start_from not in names]
    second = [run for run in runs if run not in first]
    remaining = [command for run in first for command in run.commands(only)]
    report = ["report", *(str(run.folder) for run in runs), "--out", str(out / "report")]
    if dry_run:
        lines = [*map(command_line, remaining), *(f"# then {run}, from its best start" for run in second)]
        lines += [command_line(report)] if only in (None, "report") else []
        print(*dict.fromkeys(lines), sep="\n")  # noqa: T201
        return
    for run in runs if only in (None, "collect") else []:
        for command in run.collect_commands():
            call(command)
    for wave in (first, second):
        for run in wave:
            run.check_step(only)
        if only in (None, "train", "evaluate"):
            _train_and_evaluate(wave, jobs, only)
    if only in (None, "report"):
        call(report)


def _train_and_evaluate(runs: Sequence[Run], jobs: int, only: Step | None) -> None:
    """Trains and evaluates runs, several at a time. After a failure, those already started are completed."""

    def work(run: Run, log: Path | None = None, n_threads: int | None = None) -> None:
        if only in (None, "train"):
            run.train(log, n_threads)
        if only in (None, "evaluate"):
            run.evaluate(log, n_threads)

    jobs = min(jobs, len(runs))
    if jobs <= 1:
        for run in runs:
            work(run)
        return
    n_threads = max(1, available_cores() // jobs)
    failure: BaseException | None = None
    with ThreadPoolExecutor(jobs) as pool, tqdm(total=len(runs), desc="Runs", dynamic_ncols=True) as progress:
        futures: dict[Future[None], Run] = {pool.submit(work, run, run.log, n_threads): run for run in runs}
        waiting = set(futures)
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=1, return_when=FIRST_COMPLETED)
                for future in done:
                    if not future.cancelled():
                        failure = failure or future.exception()
                        progress.update()
                if failure:
                    pool.shutdown(wait=False, cancel_futures=True)
                states = [
                    f"{futures[item]} {last_progress(futures[item].log)}"
                    for item in waiting
                    if item.running()
                ]
                progress.set_postfix_str("; ".join(sorted(states)))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    if failure:
        raise failure


def available_cores() -> int:
    """Returns the number of the processor's cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def last_progress(log: Path) -> str:
    """Returns the percentage of the last progress bar in a log; "" without any."""
    if not log.is_file():
        return ""
    found = re.findall(r"\d+%(?=\|)", log.read_bytes()[-2000:].decode(errors="replace"))
    return found[-1] if found else ""
