"""Experiments: the paper's rows and the project's own, from data collection to the report.

    recipe -> collect -> train -> evaluate -> report

Finished steps are skipped, so the same command continues after an interruption.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gym_deltaco.paraphrases import write_training_sentences
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.atomic_files import read_json, write_json
from lerobot_deltaco.collection.collect import CollectionPlan, collect, is_finished
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints
from lerobot_deltaco.evaluation.command import EvaluateArguments, evaluate_checkpoints
from lerobot_deltaco.evaluation.records import EvaluationPlan, EvaluationRecord, read_records
from lerobot_deltaco.experiments.recipes import (
    Recipe,
    Scale,
    expand_families,
    experiment_names,
    make_policy_config,
    read_recipe,
)
from lerobot_deltaco.processes import call_in_new_process
from lerobot_deltaco.reports.report import write_report

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig


@dataclass(frozen=True)
class Step:
    """A step of an experiment.

    Attributes:
        name: "collect", "train" or "evaluate".
        description: What it does, and where, in a line.
        call: Function that does it, and returns what to print.
    """

    name: str
    description: str
    call: Callable[[], str | None]

    def run(self) -> None:
        """Prints the description, runs the step and prints its result."""
        sys.stdout.write(f"\n{self.description}\n")
        sys.stdout.flush()
        if result := self.call():
            sys.stdout.write(f"{result}\n")


class TrainingRun:
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
        name = "_".join(f"{key.rpartition('.')[2]}-{value}" for key, value in _settings_of(plan))
        return self.out / "data" / re.sub(r"[^\w.,-]", "-", name)

    def steps(self) -> Iterator[Step]:
        """Yields the steps that are still to be run.

        Raises:
            UserError: The experiment that this one starts from was not trained and evaluated.
        """
        workers = len(os.sched_getaffinity(0))
        for plan in dict.fromkeys((self.recipe.data, self.recipe.demonstrations)):
            root = self.dataset(plan)
            if not is_finished(root):
                description = f"collect: {plan.n_episodes} episodes in {root}"
                yield Step("collect", description, partial(collect, root, plan, workers))
        step, last = last_step(self.folder), self.recipe.training.steps
        if step < last:
            yield Step("train", f"train: {self.folder}, from step {step} to {last}", self._train)
        if step < last or self.unevaluated_steps():
            yield self.evaluation()

    def evaluation(self, plan: EvaluationPlan | None = None) -> Step:
        """Returns the step that evaluates the checkpoints, by default as the recipe says."""
        plan = plan or self.recipe.evaluation
        settings = ", ".join(f"{name} {value}" for name, value in _settings_of(plan))
        return Step(
            "evaluate",
            f"evaluate: {self.folder}{settings and ', '}{settings}",
            partial(evaluate_checkpoints, EvaluateArguments(self.folder, plan)),
        )

    def unevaluated_steps(self, plan: EvaluationPlan | None = None) -> list[int]:
        """Returns the steps of the checkpoints without a record; by default, of the recipe's plan."""
        if last_step(self.folder) == 0:
            return []
        plan = plan or self.recipe.evaluation
        done = {record.step for record in read_run_records(self.folder) if record.plan == plan}
        return [
            checkpoint.step for checkpoint in find_checkpoints(self.folder) if checkpoint.step not in done
        ]

    def _train(self) -> None:
        """Begins the training, or continues it from its last checkpoint, in a process of its own."""
        if last_step(self.folder) > 0:
            call_in_new_process(_resume_training, last_checkpoint(self.folder))
            return
        # A run that stopped before its first checkpoint has left a folder.
        shutil.rmtree(self.folder, ignore_errors=True)
        write_json(self.settings_file, self._settings())
        call_in_new_process(_train, self.training_config())

    def training_config(self) -> TrainPipelineConfig:
        """Returns the configuration of LeRobot's training loop.

        Raises:
            UserError: The experiment that this one starts from was not trained and evaluated.
        """
        from lerobot.configs.default import DatasetConfig  # slow
        from lerobot.configs.train import TrainPipelineConfig

        options = {
            **self.recipe.policy,
            "seed": self.seed,
            "demo_repo_id": "deltaco/demonstrations",
            "demo_root": str(self.dataset(self.recipe.demonstrations)),
        }
        if options.get("paraphrases") is not None:
            options["paraphrases"] = str(self._write_sentences(options["paraphrases"]))
        start = None if self.recipe.start_from is None else last_checkpoint(self.best_start())
        return TrainPipelineConfig(
            dataset=DatasetConfig("deltaco/training", root=str(self.dataset(self.recipe.data))),
            policy=make_policy_config(options, start),
            output_dir=self.folder,
            job_name=f"{self.recipe.scale}/{self.recipe.name}",
            seed=self.seed,
            **asdict(self.recipe.training),
        )

    def _write_sentences(self, source: str) -> Path:
        """Writes other sentences for the training tasks as a policy reads them, and returns the file."""
        path = self.folder.with_name(f"{self.folder.name}_sentences.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write_training_sentences(path, source, select_tasks(self.recipe.data.tasks))
        except ValueError as error:  # of the file
            raise UserError(str(error)) from error
        return path

    def check_settings(self) -> None:
        """Checks that the run, if it has a checkpoint, began with the same settings.

        Raises:
            UserError: It began with others.
        """
        if last_step(self.folder) == 0 or not self.settings_file.is_file():
            return
        begun = read_json(self.settings_file)
        for section, settings in self._settings().items():
            if begun.get(section) != settings:
                raise UserError(
                    f"{self.folder} was begun with other settings: {section} was {begun.get(section)}, now "
                    f"it is {settings}. Use the same settings or another --out, or move the run away."
                )

    def _settings(self) -> dict[str, Any]:
        settings = asdict(self.recipe)
        del settings["evaluation"]
        return json.loads(json.dumps(settings))

    def best_start(self) -> Path:
        """Returns the run of `start_from` with the highest success rate at its last step.

        Raises:
            UserError: None was trained and evaluated.
        """
        assert self.recipe.start_from is not None
        rates = {}
        folders = self.out / self.recipe.scale / self.recipe.start_from
        for folder in sorted(folders.glob("seed_*/")):
            for record in read_run_records(folder):
                if record.plan == self.recipe.evaluation and record.step == last_step(folder):
                    rates[folder] = record.success_rate
        if not rates:
            raise UserError(
                f"{self} starts from {self.recipe.start_from}, of which {folders} has no evaluated run. "
                "Run that experiment first, or both at once."
            )
        return max(rates, key=lambda folder: rates[folder])


def _train(config: TrainPipelineConfig) -> None:
    from lerobot_deltaco.training.train import train

    train(config)


def _resume_training(checkpoint: Path) -> None:
    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)
    from lerobot_deltaco.training.train import train

    # LeRobot finds the checkpoint to resume in the command line alone.
    sys.argv = ["lerobot-train", f"--config_path={checkpoint / 'train_config.json'}", "--resume=true"]
    train()


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


def _settings_of(plan: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the fields of a plan that differ from their defaults, nested ones as "scene.objects"."""
    for field in fields(plan):
        value = getattr(plan, field.name)
        if is_dataclass(value):
            yield from _settings_of(value, f"{prefix}{field.name}.")
        elif value != field.default:
            yield f"{prefix}{field.name}", value


def run_experiments(
    names: tyro.conf.Positional[Sequence[str]] = (),
    scale: Scale = "small",
    seed: Sequence[int] = (0,),
    out: Path = Path("outputs/experiments"),
    settings: Annotated[Sequence[str], tyro.conf.arg(name="set")] = (),
    dry_run: bool = False,
) -> str | Path:
    """Runs the steps of experiments that are not finished yet.

    Args:
        names: Experiments, such as scenario_a/deltaco, or whole families, such as folds. Without any, the
            names of all experiments are printed.
        scale: Size of data, networks and training: small for a CPU, or the paper's.
        seed: Seeds of the training; each is a separate run.
        out: Folder of all outputs.
        settings: Settings that override the recipe, such as training.steps=2000.
        dry_run: Print the steps without running them.

    Returns:
        The page of the report; or the names or the steps, one a line.

    Raises:
        UserError: A setting is invalid, a run began with other settings, or a step failed.
    """
    if not names:
        return "\n".join(experiment_names())
    names = expand_families(names)
    recipes = [read_recipe(name, scale, settings) for name in names]
    # Fine-tuning starts once the runs that it may start from are done.
    recipes.sort(key=lambda recipe: recipe.start_from in names)
    runs = [TrainingRun(recipe, each, out) for recipe in recipes for each in dict.fromkeys(seed)]
    for run in runs:
        run.check_settings()
        if run.recipe.start_from not in (None, *names) and last_step(run.folder) == 0:
            run.best_start()  # or an error, before anything is collected
    if dry_run:
        lines = [step.description for run in runs for step in run.steps()]
        return "\n".join(dict.fromkeys([*lines, f"report: {out / 'report'}"]))
    for run in runs:
        for step in run.steps():
            step.run()
    return write_report([run.folder for run in runs], out / "report")
