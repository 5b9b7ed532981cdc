"""Runs a row: collects its data, trains, evaluates every checkpoint. What is done is not done again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_deltaco.experiments.command_runner import CommandRunner, ExperimentError
from lerobot_deltaco.experiments.rows import Row

LAST = Path("checkpoints", "last", "pretrained_model")


class Experiment:
    """A row with a seed, in a folder of experiments' outputs.

    Args:
        row: The row.
        seed: Of the training: the weights, the order of the data, the draws.
        outputs: Where everything goes: `data/` is shared by all rows, `ROW/seed_SEED` is the run's.
    """

    def __init__(self, row: Row, seed: int, outputs: Path) -> None:
        self.row = row
        self.seed = seed
        self.outputs = outputs
        self.run = run_folder(outputs, row.name, seed)
        self.log = self.run.with_name(f"{self.run.name}.log")  # where several run at a time

    def do(self) -> None:
        """Everything that is not done yet.

        Raises:
            ExperimentError: A step failed, or the run was begun with other settings.
        """
        self.check_settings()
        self.collect()
        self.train_and_evaluate(CommandRunner())

    def check_settings(self) -> None:
        """Checks that the run, if there is one, was begun with the same settings.

        Raises:
            ExperimentError: It was begun with others.
        """
        file, settings = self._settings_file(), self._settings()
        there = json.loads(file.read_text()) if file.exists() else settings
        for section, values in settings.items():
            if there[section] != values:
                raise ExperimentError(
                    f"{self.run} was begun with other settings: {section} was {there[section]}, and now is "
                    f"{values}. Ask for the same, name another --out, or move the run and {file.name} away."
                )

    def collect(self) -> None:
        """Collects the datasets that the row needs and that are not there."""
        for plan in (self.row.data, self.row.demonstrations):
            options = [f"--{key.replace('_', '-')}={value}" for key, value in plan.items()]
            CommandRunner().run("collect", [*options, f"--root={dataset_folder(self.outputs, plan)}"])

    def train_and_evaluate(self, commands: CommandRunner) -> None:
        """Trains on the datasets that were collected, and evaluates."""
        self._keep_settings()
        self._train(commands)
        self._evaluate(commands)

    def _settings_file(self) -> Path:
        return self.run.with_name(f"{self.run.name}.json")

    def _settings(self) -> dict[str, Any]:
        return {
            "data": dict(self.row.data),
            "demonstrations": dict(self.row.demonstrations),
            "policy": dict(self.row.policy),
            "training": dict(self.row.training),
            "start_from": self.row.start_from,
        }

    def _keep_settings(self) -> None:
        file = self._settings_file()
        file.parent.mkdir(parents=True, exist_ok=True)
        unfinished = file.with_suffix(".unfinished")
        unfinished.write_text(json.dumps(self._settings(), indent=2) + "\n")
        unfinished.replace(file)

    def _train(self, commands: CommandRunner) -> None:
        """Trains, from the last checkpoint if there is one."""
        last = self.run / LAST / "train_config.json"
        if last.exists():
            if _steps_done(self.run) >= self.row.training["steps"]:
                return
            commands.run("train", [f"--config_path={last}", "--resume=true"])
            return
        # What an interrupted training left before its first checkpoint.
        shutil.rmtree(self.run, ignore_errors=True)
        options = {
            **{f"policy.{name}": value for name, value in self.row.policy.items() if value is not None},
            "policy.seed": self.seed,
            "policy.demo_repo_id": "deltaco/demonstrations",
            "policy.demo_root": dataset_folder(self.outputs, self.row.demonstrations),
            "dataset.repo_id": "deltaco/training",
            "dataset.root": dataset_folder(self.outputs, self.row.data),
            **self.row.training,
            "seed": self.seed,
            "job_name": self.row.name,
            "output_dir": self.run,
        }
        if self.row.training.get("env_eval_freq"):
            options |= {
                "env.type": "deltaco",
                "env.task": self.row.evaluation["tasks"],
                "env.ambiguity": self.row.evaluation.get("ambiguity", "container"),
                "eval.n_episodes": self.row.evaluation["trials"],
            }
        if self.row.start_from is None:
            options = {"policy.type": "deltaco", **options}
        else:
            start = run_folder(self.outputs, self.row.start_from, self.seed)
            if not (start / LAST).exists():
                raise ExperimentError(
                    f"{self.row.name} starts from {self.row.start_from}, which was not trained with the seed "
                    f"{self.seed}. Run that row first."
                )
            options = {"policy.path": start / LAST, **options}
        commands.run("train", [f"--{name}={_text(value)}" for name, value in options.items()])

    def _evaluate(self, commands: CommandRunner) -> None:
        """Evaluates the checkpoints that were not evaluated in training."""
        options = [f"--{name}={value}" for name, value in self.row.evaluation.items()]
        commands.run("evaluate", [str(self.run), *options, f"--experiment={self.row.name}"])


def run_folder(outputs: Path, row_name: str, seed: int) -> Path:
    """Where a row's run with a seed is."""
    return outputs / row_name / f"seed_{seed}"


def dataset_folder(outputs: Path, plan: Mapping[str, Any]) -> Path:
    """Where the dataset of a collection is, which rows share."""
    return outputs / "data" / "_".join(f"{key}-{value}" for key, value in sorted(plan.items()))


def _steps_done(run: Path) -> int:
    state = run / "checkpoints" / "last" / "training_state" / "training_step.json"
    return int(json.loads(state.read_text())["step"])


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, bool | list) else str(value)
