"""The command `deltaco evaluate`: evaluates checkpoints, and records each evaluation once.

What imports torch is imported where it is needed: help does not wait for it.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro

from gym_deltaco import ENV_ID
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.atomic_files import parse_json
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import OWN_TYPES, Checkpoint, find_checkpoints, load_policy
from lerobot_deltaco.evaluation.records import EvaluationPlan, EvaluationRecord, read_records, write_records

_PACKAGES = ("lerobot_policy_deltaco", "lerobot", "torch", "gymnasium", "numpy", "pybullet")
# Options of a policy that come from the training data, or say where they were.
_NOT_RECORDED = (
    "input_features",
    "output_features",
    "one_hot_tasks",
    "known_words",
    "trained_tasks",
    "held_out_episodes",
    "n_dataset_frames",
    "gripper_range",
    "paraphrases",
    "demo_repo_id",
    "demo_root",
    "demo_episodes",
)


@dataclass(frozen=True)
class EvaluateArguments:
    """Arguments of `deltaco evaluate`. The defaults are the leaderboard's protocol.

    Args:
        checkpoint: Output folder of a training run, or folder of a policy.
        plan: Episodes to run.
        steps: Checkpoints of a training run to evaluate: all, last, or steps such as 4000,8000.
        out: Folder of the records; by default, that of the training run, or outputs/evaluate/NAME.
        processes: Number of processes that share the episodes; by default, one for each core.
        device: Device of the policy, such as cpu.
        demo_repo_id: Dataset of demonstrations, in place of the checkpoint's own.
        demo_root: Folder of that dataset, if it is not in LeRobot's cache.
        experiment: Name of the policy in tables; by default, the job name of its training run.
        rename_map: Names under which the policy knows the environment's observations, as JSON.

    Raises:
        UserError: An argument is invalid; the message says what is valid.
    """

    checkpoint: tyro.conf.Positional[Path]
    plan: Annotated[EvaluationPlan, tyro.conf.arg(name="")] = EvaluationPlan()  # noqa: RUF009
    steps: str = "all"
    out: Path | None = None
    processes: int = len(os.sched_getaffinity(0))
    device: str | None = None
    demo_repo_id: str | None = None
    demo_root: Path | None = None
    experiment: str | None = None
    rename_map: str | None = None

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise UserError(f"`processes` must be at least 1. Got {self.processes}.")
        if self.demo_root is not None and self.demo_repo_id is None:
            raise UserError("--demo-root is the folder of the dataset --demo-repo-id. Name that, too.")
        if not isinstance(self.renaming, dict | None):
            raise UserError(f"--rename-map must be a JSON object, {{...}}. Got {self.rename_map}.")

    @property
    def renaming(self) -> dict[str, str] | None:
        """The policy's names of observations by those of the environment; None for those of the training."""
        return None if self.rename_map is None else parse_json(self.rename_map, "--rename-map")


def evaluate_checkpoints(arguments: EvaluateArguments) -> str:
    """Evaluates a policy, or the checkpoints of a training run, that have no record of the plan yet.

    Returns:
        A line for each checkpoint, with its success rate.

    Raises:
        UserError: There is no such checkpoint, a record is of another policy, the plan does not fit, or its
            scenes are sealed.
    """
    path, task_ids = arguments.checkpoint, arguments.plan.task_ids
    arguments.plan.scene_seed(task_ids[0], trial=0)  # fails now, and not after minutes, if they are sealed
    checkpoints = _select(find_checkpoints(path), arguments.steps)
    for checkpoint in checkpoints:
        if arguments.demo_repo_id is not None and checkpoint.policy_type not in OWN_TYPES:
            raise UserError(
                f"--demo-repo-id is for {' and '.join(OWN_TYPES)}. A policy of another type, such as "
                f"{checkpoint.policy_type}, gets the expert's demonstrations without it."
            )
    is_run = (path / "checkpoints").is_dir()
    folder = arguments.out or (path if is_run else Path("outputs/evaluate") / path.resolve().name)
    digest = None
    if arguments.demo_repo_id is not None:
        digest = _metadata_digest(arguments.demo_repo_id, arguments.demo_root)
    lines = []
    for checkpoint in checkpoints:
        plan = replace(arguments.plan, scene=_fit_scene(arguments.plan.scene, checkpoint))
        file = folder / "evaluations" / _record_name(checkpoint, plan, arguments, digest)
        if file.exists():
            (record,) = read_records(file)
            if record.weights != checkpoint.weights_digest:
                raise UserError(
                    f"{file} is the record of another policy: its weights are not those of "
                    f"{checkpoint.folder}. Name another folder with --out, or move that record away."
                )
        else:
            record = _evaluate(checkpoint, plan, arguments, digest)
            write_records(file, [record])
        lines.append(
            f"{checkpoint.folder}, step {record.step}: {record.success_rate:.1%} of {len(record.episodes)} "
            f"episodes of {record.plan.tasks} succeeded. Record: {file}"
        )
    return "\n".join(lines)


def _select(checkpoints: Sequence[Checkpoint], steps: str) -> Sequence[Checkpoint]:
    """Returns the checkpoints of `steps`.

    Raises:
        UserError: There is no checkpoint of a step.
    """
    if steps in ("all", "last"):
        return checkpoints if steps == "all" else checkpoints[-1:]
    available = {str(checkpoint.step): checkpoint for checkpoint in checkpoints}
    for step in steps.split(","):
        if step not in available:
            raise UserError(
                f"There is no checkpoint of step {step!r}. Valid are all, last and {', '.join(available)}."
            )
    return [available[step] for step in steps.split(",")]


def _fit_scene(scene: SceneConfig, checkpoint: Checkpoint) -> SceneConfig:
    """Returns settings with the control and image size of a policy's training, unless others are set."""
    if scene.control == SceneConfig.control:
        scene = replace(scene, control=checkpoint.control or scene.control)
    if scene.image_size == SceneConfig.image_size:
        scene = replace(scene, image_size=checkpoint.image_size)
    return scene


def _record_name(
    checkpoint: Checkpoint, plan: EvaluationPlan, arguments: EvaluateArguments, demonstrations: str | None
) -> str:
    """Returns the file name of a record: the step, and a digest of everything else that it depends on."""
    settings = (
        plan,
        (arguments.demo_repo_id, demonstrations),
        arguments.device,
        arguments.rename_map,
        arguments.experiment,
    )
    return f"{checkpoint.step:07d}_{hashlib.sha256(repr(settings).encode()).hexdigest()[:8]}.parquet"


def _evaluate(
    checkpoint: Checkpoint, plan: EvaluationPlan, arguments: EvaluateArguments, demonstrations: str | None
) -> EvaluationRecord:
    import draccus
    from lerobot.configs import PreTrainedConfig

    from lerobot_deltaco.evaluation.evaluate import evaluate

    given: dict[str, Any] = {
        name: getattr(arguments, name) for name in ("device", "demo_repo_id", "demo_root")
    }
    overrides = [f"--{name}={value}" for name, value in given.items() if value is not None]
    loaded = load_policy(checkpoint.folder, overrides, arguments.renaming)
    config, start = loaded.policy.config, time.monotonic()
    episodes = evaluate(loaded, plan, arguments.processes if config.device == "cpu" else 1)
    options = draccus.encode(config, PreTrainedConfig)
    return EvaluationRecord(
        experiment=arguments.experiment or checkpoint.experiment,
        policy_type=config.type,
        train_seed=checkpoint.seed,
        step=checkpoint.step,
        plan=plan,
        wording=plan.wording,
        policy={name: value for name, value in options.items() if name not in _NOT_RECORDED},
        versions={"benchmark": ENV_ID, **{name: version(name) for name in _PACKAGES}},
        command=shlex.join(["deltaco", *sys.argv[1:]]),
        seconds=time.monotonic() - start,
        weights=checkpoint.weights_digest,
        demonstrations=arguments.demo_repo_id,
        demonstrations_digest=demonstrations,
        episodes=episodes,
    )


def _metadata_digest(repo_id: str, root: Path | None) -> str:
    """Returns the SHA-256 of a dataset's metadata, which hold the statistics of all its frames."""
    from lerobot.utils.constants import HF_LEROBOT_HOME

    folder = root if root is not None else HF_LEROBOT_HOME / repo_id
    digest = hashlib.sha256()
    for path in sorted(path for path in (folder / "meta").rglob("*") if path.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()
