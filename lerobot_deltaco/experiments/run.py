"""Runs a row: collects its data, trains, evaluates every checkpoint. What is done is not done again."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_deltaco.experiments.rows import Row

LAST = Path("checkpoints", "last", "pretrained_model")


class ExperimentError(RuntimeError):
    """A step of an experiment failed; the message says which."""


class _Place(NamedTuple):
    """Where a command prints to, and how much of the processor it takes."""

    log: Path | None = None  # this terminal
    n_threads: int | None = None  # as many as there are cores


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
        self.log = self.run.with_name(f"{self.run.name}.log")  # where it is told to write to one

    def do(self) -> None:
        """Everything that is not done yet.

        Raises:
            ExperimentError: A step failed, or the run was begun with other settings.
        """
        self.check_settings()
        self.collect()
        self.train_and_evaluate()

    def check_settings(self) -> None:
        """Keeps the settings beside the run, and refuses others for it.

        Raises:
            ExperimentError: The run was begun with other settings.
        """
        file = self.run.with_name(f"{self.run.name}.json")
        settings = {
            "data": dict(self.row.data),
            "demonstrations": dict(self.row.demonstrations),
            "policy": dict(self.row.policy),
            "training": dict(self.row.training),
            "start_from": self.row.start_from,
        }
        there = json.loads(file.read_text()) if file.exists() else settings
        for section, values in settings.items():
            if there[section] != values:
                raise ExperimentError(
                    f"{self.run} was begun with other settings: {section} was {there[section]}, and now is "
                    f"{values}. Ask for the same, name another --out, or move the run and {file.name} away."
                )
        file.parent.mkdir(parents=True, exist_ok=True)
        unfinished = file.with_suffix(".unfinished")
        unfinished.write_text(json.dumps(settings, indent=2) + "\n")
        unfinished.replace(file)

    def collect(self) -> None:
        """Collects the datasets that the row needs and that are not there."""
        for plan in (self.row.data, self.row.demonstrations):
            options = [f"--{key.replace('_', '-')}={value}" for key, value in plan.items()]
            _do("collect", [*options, f"--root={dataset_folder(self.outputs, plan)}"])

    def train_and_evaluate(self, n_threads: int | None = None) -> None:
        """Trains on the datasets that were collected, and evaluates.

        Args:
            n_threads: To leave processor cores to others. If given, what it prints goes to the file `log`.
        """
        place = _Place() if n_threads is None else _Place(self.log, n_threads)
        self._train(place)
        self._evaluate(place)

    def _train(self, place: _Place) -> None:
        """Trains, from the last checkpoint if there is one."""
        last = self.run / LAST / "train_config.json"
        if last.exists():
            if _steps_done(self.run) >= self.row.training["steps"]:
                return
            _do("train", [f"--config_path={last}", "--resume=true"], place)
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
        _do("train", [f"--{name}={_text(value)}" for name, value in options.items()], place)

    def _evaluate(self, place: _Place) -> None:
        """Evaluates the checkpoints that were not evaluated in training."""
        options = [f"--{name}={value}" for name, value in self.row.evaluation.items()]
        _do("evaluate", [str(self.run), *options, f"--experiment={self.row.name}"], place)


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


def _do(command: str, arguments: list[str], place: _Place | None = None) -> None:
    """Runs one of this project's commands, with this Python."""
    words = [sys.executable, "-m", f"lerobot_deltaco.commands.{command}", *arguments]
    log, n_threads = place or _Place()
    environment = os.environ | ({"OMP_NUM_THREADS": str(n_threads)} if n_threads else {})
    with log.open("a", encoding="utf-8") if log else nullcontext(sys.stdout) as output:
        output.write(f"\ndeltaco-{command} {shlex.join(arguments)}\n")
        output.flush()
        streams = {"stdout": output, "stderr": subprocess.STDOUT} if log else {}
        code = subprocess.run(words, check=False, env=environment, **streams).returncode
    if code != 0:
        raise ExperimentError(
            f"deltaco-{command} failed (exit status {code}); see {log or 'above'} for why. The same command "
            "goes on from here."
        )
