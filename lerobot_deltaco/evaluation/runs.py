"""Training runs as `lerobot-train` and `deltaco-train` leave them: their checkpoints, and loading one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy

CHECKPOINTS = "checkpoints"
PRETRAINED_MODEL = "pretrained_model"


class RunError(ValueError):
    """A folder is not a training run that can be evaluated; the message says what is wrong with it."""


class Checkpoint(NamedTuple):
    """A checkpoint of a run."""

    step: int
    folder: Path  # of the policy


class LoadedPolicy(NamedTuple):
    """A policy that is ready to act."""

    policy: DeltacoPolicy
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline


def checkpoints(run_folder: Path) -> list[Checkpoint]:
    """The whole checkpoints of a run, by step.

    Raises:
        RunError: There are none.
    """
    found = [
        Checkpoint(int(folder.name), folder / PRETRAINED_MODEL)
        for folder in sorted((run_folder / CHECKPOINTS).glob("*"))
        if folder.name.isdecimal() and (folder / PRETRAINED_MODEL / "model.safetensors").is_file()
    ]
    if not found:
        raise RunError(
            f"{run_folder} has no checkpoints. Name the `--output_dir` of a training with `lerobot-train` or "
            "`deltaco-train`."
        )
    return sorted(found)


class RunDescription(NamedTuple):
    """What a run says of itself."""

    experiment: str
    seed: int


def describe(checkpoint: Checkpoint) -> RunDescription:
    """The run's job name and seed."""
    config = json.loads((checkpoint.folder / "train_config.json").read_text(encoding="utf-8"))
    return RunDescription(config["job_name"], config["seed"] if config["seed"] is not None else 0)


def load_policy(folder: Path, overrides: Sequence[str] = ()) -> LoadedPolicy:
    """Loads a policy and its processors, in evaluation mode.

    Args:
        folder: With the policy's config and weights.
        overrides: Options of the policy, as on LeRobot's command line but without `policy.`:
            "--device=cpu", "--demo_root=DIR".

    Raises:
        RunError: It is the folder of another policy.
    """
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=list(overrides))
    if not isinstance(config, DeltacoConfig):
        raise RunError(f"{folder} holds a policy of the type {config.type!r}, not 'deltaco'.")
    policy = DeltacoPolicy.from_pretrained(folder, config=config)
    policy.to(config.device)
    policy.eval()
    preprocessor, postprocessor = make_pre_post_processors(
        config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": str(config.device)}},
    )
    return LoadedPolicy(policy, preprocessor, postprocessor)
