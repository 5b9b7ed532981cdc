"""The folder of a training run: its checkpoints and settings, as LeRobot's training loop writes them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError, safe_open

from gym_deltaco import EPISODE_STEPS
from lerobot_deltaco.common.typed_fields import in_words, is_a, type_hints

CHECKPOINTS = "checkpoints"
LAST = "last"
PRETRAINED_MODEL = "pretrained_model"
TRAINING_STEP = Path("training_state", "training_step.json")
WEIGHTS = "model.safetensors"
TRAIN_CONFIG = "train_config.json"
POLICY_CONFIG = "config.json"


# The weight in which policies of this project keep their training step.
_STEP = "step"


class RunError(ValueError):
    """A folder is not a training run that can be evaluated; the message says what is wrong with it."""


class Checkpoint(NamedTuple):
    """A checkpoint of a training run."""

    step: int
    folder: Path  # of the policy


@dataclass(frozen=True)
class RunDescription:
    """Description of a training run.

    Attributes:
        experiment: Job name of the run.
        seed: Seed of the training.
        image_size: Height and width of the images that it was trained on, px.
        episode_length: Steps of an episode in the training's environment; the benchmark's without one.
        policy_type: Type of its policy, such as "deltaco" or "act".
    """

    experiment: str
    seed: int
    image_size: int
    episode_length: int
    policy_type: str


def checkpoints(run: Path) -> list[Checkpoint]:
    """The complete checkpoints of a run, ascending by step.

    What is beyond the link `last`, which LeRobot sets when a checkpoint is complete, is being written, or was
    when the training was killed.

    Raises:
        RunError: There are none.
    """
    last = (run / CHECKPOINTS / LAST).resolve().name
    found = [
        Checkpoint(int(folder.name), folder / PRETRAINED_MODEL)
        for folder in sorted((run / CHECKPOINTS).glob("*"))
        if folder.name.isdecimal() and (folder / PRETRAINED_MODEL / WEIGHTS).is_file()
        if not last.isdecimal() or int(folder.name) <= int(last)
    ]
    if not found and is_checkpoint(run):
        return [Checkpoint(_step_of(run), run)]
    if not found:
        raise RunError(
            f"{run} has no checkpoints. Name the `--output_dir` of a training with `lerobot-train` or "
            f"`deltaco-train`, or the folder of a checkpoint ({POLICY_CONFIG}, {WEIGHTS})."
        )
    return sorted(found)


def is_checkpoint(folder: Path) -> bool:
    """Whether a folder is itself a checkpoint, such as `checkpoints/012000/pretrained_model` of a run."""
    return (folder / POLICY_CONFIG).is_file() and (folder / WEIGHTS).is_file()


def weights_digest(checkpoint: Path) -> str:
    """SHA-256 of the weights of a checkpoint, in hexadecimal."""
    with (checkpoint / WEIGHTS).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _step_of(checkpoint: Path) -> int:
    """The training step of a checkpoint without its run: of its folder's name, or of its weights, else 0."""
    folder = checkpoint.resolve()
    if folder.name == PRETRAINED_MODEL and folder.parent.name.isdecimal():
        return int(folder.parent.name)
    try:
        with safe_open(checkpoint / WEIGHTS, framework="numpy") as file:
            return int(file.get_tensor(_STEP)) if _STEP in file.keys() else 0  # noqa: SIM118
    except (SafetensorError, TypeError, ValueError) as error:
        raise RunError(f"{checkpoint / WEIGHTS} is damaged: {error}") from None


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


def _train_config(folder: Path) -> dict[str, Any]:
    """Settings of a checkpoint's training; of one that was published without them, its name and seed."""
    path = folder / TRAIN_CONFIG
    if not path.exists() and is_checkpoint(folder) and folder.name != PRETRAINED_MODEL:
        policy = json.loads((folder / POLICY_CONFIG).read_text(encoding="utf-8"))
        return {"job_name": folder.resolve().name, "seed": policy.get("seed", 0), "env": None}
    return json.loads(path.read_text(encoding="utf-8"))


def describe(checkpoint: Checkpoint) -> RunDescription:
    """The run's job name and seed, and its environment.

    Raises:
        RunError: What the run has written down of itself is damaged, or it was not trained on the benchmark.
    """
    try:
        run = _train_config(checkpoint.folder)
        policy = json.loads((checkpoint.folder / POLICY_CONFIG).read_text(encoding="utf-8"))
        cameras = [name for name, item in policy["input_features"].items() if item["type"] == "VISUAL"]
        env = run["env"] if (run.get("env") or {}).get("type") == "deltaco" else {}
        description = RunDescription(
            experiment=run["job_name"],
            seed=run["seed"] if run["seed"] is not None else 0,
            image_size=policy["input_features"][cameras[0]]["shape"][-1],
            episode_length=env.get("episode_length", EPISODE_STEPS),
            policy_type=policy["type"],
        )
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise RunError(
            f"{checkpoint.folder} has no description of its training that can be read ({error!r}): its "
            "train_config.json or config.json is damaged, or of another version of LeRobot."
        ) from None
    for name, kind in type_hints(RunDescription).items():
        if not is_a(getattr(description, name), kind):
            raise RunError(
                f"{checkpoint.folder} says of its training that `{name}` is {getattr(description, name)!r}, "
                f"which must be {in_words(kind)}."
            )
    return description
