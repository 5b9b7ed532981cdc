"""The folder of a training run: its checkpoints and settings, as LeRobot's training loop writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

CHECKPOINTS = "checkpoints"
LAST = "last"
PRETRAINED_MODEL = "pretrained_model"
TRAINING_STEP = Path("training_state", "training_step.json")
WEIGHTS = "model.safetensors"
TRAIN_CONFIG = "train_config.json"


class RunError(ValueError):
    """A folder is not a training run that can be evaluated; the message says what is wrong with it."""


class Checkpoint(NamedTuple):
    """A checkpoint of a training run."""

    step: int
    folder: Path  # of the policy


class RunDescription(NamedTuple):
    """The name and the seed of a training run."""

    experiment: str
    seed: int


def checkpoints(run: Path) -> list[Checkpoint]:
    """The complete checkpoints of a run, ascending by step.

    Raises:
        RunError: There are none.
    """
    found = [
        Checkpoint(int(folder.name), folder / PRETRAINED_MODEL)
        for folder in sorted((run / CHECKPOINTS).glob("*"))
        if folder.name.isdecimal() and (folder / PRETRAINED_MODEL / WEIGHTS).is_file()
    ]
    if not found:
        raise RunError(
            f"{run} has no checkpoints. Name the `--output_dir` of a training with `lerobot-train` or "
            "`deltaco-train`."
        )
    return sorted(found)


def last_policy(run: Path) -> Path:
    """Folder of the policy in the last checkpoint of a run, whether it exists or not."""
    return run / CHECKPOINTS / LAST / PRETRAINED_MODEL


def last_train_config(run: Path) -> Path:
    """File from which the training of a run resumes, whether it exists or not."""
    return last_policy(run) / TRAIN_CONFIG


def last_step(run: Path) -> int:
    """Training step of the last checkpoint of a run."""
    state = run / CHECKPOINTS / LAST / TRAINING_STEP
    return int(json.loads(state.read_text(encoding="utf-8"))["step"])


def describe(checkpoint: Checkpoint) -> RunDescription:
    """The job name and the seed of a checkpoint's run."""
    config = json.loads((checkpoint.folder / TRAIN_CONFIG).read_text(encoding="utf-8"))
    return RunDescription(config["job_name"], config["seed"] if config["seed"] is not None else 0)
