"""Runs an experiment: collects its data, trains, evaluates every checkpoint. Finished steps are skipped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gym_deltaco.atomic_files import write_json
from lerobot_deltaco.experiments.command_runner import CommandRunner, ExperimentError
from lerobot_deltaco.experiments.config import ExperimentConfig

LAST = Path("checkpoints", "last", "pretrained_model")


class ExperimentRun:
    """An experiment with a seed, in a folder for the outputs of experiments.

    Args:
        config: The experiment.
        seed: Of the training: the weights, the order of the data, the draws.
        outputs: Folder of all outputs: experiments share `data/`; a run's folder is `EXPERIMENT/seed_SEED`.
    """

    def __init__(self, config: ExperimentConfig, seed: int, outputs: Path) -> None:
        self.config = config
        self.seed = seed
        self.outputs = outputs
        self.folder = run_folder(outputs, config.name, seed)
        self.log = self.folder.with_name(f"{self.folder.name}.log")  # where several run at a time

    def run(self) -> None:
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
                    f"{self.folder} was started with other settings: {section} was {there[section]}, now "
                    f"{values}. Use the same settings or another --out, or move the run and {file.name} away."
                )

    def collect(self) -> None:
        """Collects the datasets that the experiment needs and that are missing."""
        for plan in (self.config.data, self.config.demonstrations):
            options = [f"--{key.replace('_', '-')}={value}" for key, value in plan.items()]
            CommandRunner().run("collect", [*options, f"--root={dataset_folder(self.outputs, plan)}"])

    def train_and_evaluate(self, commands: CommandRunner) -> None:
        """Trains on the datasets that were collected, and evaluates."""
        self._keep_settings()
        self._train(commands)
        self._evaluate(commands)

    def _settings_file(self) -> Path:
        return self.folder.with_name(f"{self.folder.name}.json")

    def _settings(self) -> dict[str, Any]:
        return {
            "data": dict(self.config.data),
            "demonstrations": dict(self.config.demonstrations),
            "policy": dict(self.config.policy),
            "training": dict(self.config.training),
            "start_from": self.config.start_from,
        }

    def _keep_settings(self) -> None:
        write_json(self._settings_file(), self._settings())

    def _train(self, commands: CommandRunner) -> None:
        """Trains, from the last checkpoint if there is one."""
        last = self.folder / LAST / "train_config.json"
        if last.exists():
            if _steps_done(self.folder) >= self.config.training["steps"]:
                return
            commands.run("train", [f"--config_path={last}", "--resume=true"])
            return
        # What an interrupted training left before its first checkpoint.
        shutil.rmtree(self.folder, ignore_errors=True)
        options = {
            **{f"policy.{name}": value for name, value in self.config.policy.items() if value is not None},
            "policy.seed": self.seed,
            "policy.demo_repo_id": "deltaco/demonstrations",
            "policy.demo_root": dataset_folder(self.outputs, self.config.demonstrations),
            "dataset.repo_id": "deltaco/training",
            "dataset.root": dataset_folder(self.outputs, self.config.data),
            **self.config.training,
            "seed": self.seed,
            "job_name": self.config.name,
            "output_dir": self.folder,
        }
        if self.config.training.get("env_eval_freq"):
            options |= {
                "env.type": "deltaco",
                "env.task": self.config.evaluation["tasks"],
                "env.ambiguity": self.config.evaluation.get("ambiguity", "container"),
                "eval.n_episodes": self.config.evaluation["trials"],
            }
        if self.config.start_from is None:
            options = {"policy.type": "deltaco", **options}
        else:
            start = run_folder(self.outputs, self.config.start_from, self.seed)
            if not (start / LAST).exists():
                raise ExperimentError(
                    f"{self.config.name} starts from {self.config.start_from}, which was not trained with "
                    f"seed {self.seed}. Run that experiment first."
                )
            options = {"policy.path": start / LAST, **options}
        commands.run("train", [f"--{name}={_text(value)}" for name, value in options.items()])

    def _evaluate(self, commands: CommandRunner) -> None:
        """Evaluates the checkpoints that were not evaluated in training."""
        options = [f"--{name}={value}" for name, value in self.config.evaluation.items()]
        commands.run("evaluate", [str(self.folder), *options, f"--experiment={self.config.name}"])


def run_folder(outputs: Path, experiment_name: str, seed: int) -> Path:
    """The folder of an experiment's run with a seed."""
    return outputs / experiment_name / f"seed_{seed}"


def dataset_folder(outputs: Path, plan: Mapping[str, Any]) -> Path:
    """Where the dataset of a collection is, which experiments share."""
    return outputs / "data" / "_".join(f"{key}-{value}" for key, value in sorted(plan.items()))


def _steps_done(run: Path) -> int:
    state = run / "checkpoints" / "last" / "training_state" / "training_step.json"
    return int(json.loads(state.read_text())["step"])


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, bool | list) else str(value)
