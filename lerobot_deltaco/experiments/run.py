"""Experiments: the paper's rows and the project's own, from data collection to the report.

    recipe -> collect -> train -> evaluate -> report

Each step is a `deltaco` command. Finished steps are skipped, so the same command continues after an
interruption.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gym_deltaco.atomic_files import read_json, write_json
from lerobot_deltaco.arguments import EvaluateArguments
from lerobot_deltaco.collection.collect import CollectionPlan, is_finished
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints
from lerobot_deltaco.evaluation.records import EvaluationPlan, EvaluationRecord, read_records
from lerobot_deltaco.experiments.recipes import (
    ExperimentError,
    Recipe,
    Scale,
    experiment_names,
    experiments_named,
    read_recipe,
)


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
        self.settings_file = self.folder.with_name(f"seed_{seed}.json")

    def __str__(self) -> str:
        return f"{self.recipe.name} {self.seed}"

    def dataset(self, plan: CollectionPlan) -> Path:
        """Returns the folder of a dataset, named after its plan."""
        name = "_".join(f"{key.rpartition('.')[2]}-{value}" for key, value in plan_options(plan))
        return self.out / "data" / re.sub(r"[^\w.,-]", "-", name)

    def commands(self) -> Iterator[list[str]]:
        """Yields the commands that are still to be run, as arguments of `deltaco`.

        Raises:
            ExperimentError: The experiment that this one starts from was not trained and evaluated.
        """
        for plan in dict.fromkeys((self.recipe.data, self.recipe.demonstrations)):
            if not is_finished(self.dataset(plan)):
                yield ["collect", *_flags(plan), "--root", str(self.dataset(plan))]
        step = last_step(self.folder)
        trains = step < self.recipe.training.steps
        if trains:
            yield self._resume_command() if step else self._train_command()
        if trains or self.unevaluated_steps():
            yield self.evaluate_command()

    def _resume_command(self) -> list[str]:
        config = last_checkpoint(self.folder) / "train_config.json"
        return ["train", f"--config_path={config}", "--resume=true"]

    def _train_command(self) -> list[str]:
        policy = dict(self.recipe.policy)
        start = {"policy.type": policy.pop("type")}
        if self.recipe.start_from is not None:
            start = {"policy.path": last_checkpoint(self.best_start())}
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

    def execute(self, command: Sequence[str]) -> None:
        """Runs one of the commands.

        Raises:
            ExperimentError: It failed.
        """
        if command[0] == "train" and last_step(self.folder) == 0:
            # A run that stopped before its first checkpoint has left a folder.
            shutil.rmtree(self.folder, ignore_errors=True)
            write_json(self.settings_file, self._settings())
        call(command)

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

    def _settings(self) -> dict[str, Any]:
        settings = asdict(self.recipe)
        del settings["evaluation"]
        return json.loads(json.dumps(settings))

    def best_start(self) -> Path:
        """Returns the run of `start_from` with the highest success rate at its last step.

        Raises:
            ExperimentError: None was trained and evaluated.
        """
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


def call(arguments: Sequence[str]) -> None:
    """Runs a `deltaco` command in its own process; an evaluation in this one, to import LeRobot once.

    Args:
        arguments: Subcommand and its arguments.

    Raises:
        ExperimentError: The command failed in another process.
    """
    sys.stdout.write(f"\n{command_line(arguments)}\n")
    sys.stdout.flush()
    if arguments[0] == "evaluate":
        from lerobot_deltaco.evaluation.evaluate import evaluate_checkpoints  # slow

        sys.argv = ["deltaco", *arguments]  # which records hold
        lines = evaluate_checkpoints(tyro.cli(EvaluateArguments, args=arguments[1:]))
        sys.stdout.write(f"{lines}\n")
        return
    status = subprocess.run([sys.executable, "-m", "lerobot_deltaco.cli", *arguments], check=False).returncode
    if status != 0:
        raise ExperimentError(
            f"`deltaco {arguments[0]}` failed (exit status {status}); see above for the reason. The same "
            "command continues."
        )


def command_line(arguments: Sequence[str]) -> str:
    """Returns a `deltaco` command as a user would type it."""
    return shlex.join(["deltaco", *arguments])


def run_experiments(
    names: tyro.conf.Positional[Sequence[str]] = (),
    scale: Scale = "small",
    seed: Sequence[int] = (0,),
    out: Path = Path("outputs/experiments"),
    settings: Annotated[Sequence[str], tyro.conf.arg(name="set")] = (),
    dry_run: bool = False,
) -> str | None:
    """Runs the steps of experiments that are not finished yet.

    Args:
        names: Experiments, such as scenario_a/deltaco, or whole families, such as folds. Without any, the
            names of all experiments are printed.
        scale: Size of data, networks and training: small for a CPU, or the paper's.
        seed: Seeds of the training; each is a separate run.
        out: Folder of all outputs.
        settings: Settings that override the recipe, such as training.steps=2000.
        dry_run: Print the commands without running them.

    Raises:
        ExperimentError: A setting is invalid, a run began with other settings, or a step failed.
    """
    if not names:
        return "\n".join(experiment_names())
    names = experiments_named(names)
    recipes = [read_recipe(name, scale, settings) for name in names]
    # Fine-tuning starts once the runs that it may start from are done.
    recipes.sort(key=lambda recipe: recipe.start_from in names)
    runs = [Run(recipe, each, out) for recipe in recipes for each in dict.fromkeys(seed)]
    for run in runs:
        run.check_settings()
        if run.recipe.start_from not in (None, *names) and last_step(run.folder) == 0:
            run.best_start()  # or an error, before anything is collected
    report = ["report", *(str(run.folder) for run in runs), "--out", str(out / "report")]
    if dry_run:
        lines = []
        for run in runs:
            if run.recipe.start_from in names:
                lines.append(f"# then {run}, from its best start")
            else:
                lines += map(command_line, run.commands())
        return "\n".join(dict.fromkeys([*lines, command_line(report)]))
    for run in runs:
        for command in run.commands():
            run.execute(command)
    call(report)
    return None
