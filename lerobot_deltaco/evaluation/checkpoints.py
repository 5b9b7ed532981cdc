"""The checkpoints of a training run, as LeRobot's training loop writes them, and the policies in them."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gym_deltaco.control import control_of
from lerobot_deltaco.atomic_files import read_json
from lerobot_deltaco.errors import UserError

if TYPE_CHECKING:
    from lerobot.policies import PreTrainedPolicy
    from lerobot.processor import PolicyProcessorPipeline

WEIGHTS = "model.safetensors"
CONFIG, TRAIN_CONFIG = "config.json", "train_config.json"
OWN_TYPES = ("deltaco", "deltaco_match")  # of this project's policies
_RENAMING_STEP = "rename_observations_processor"


class Checkpoint(NamedTuple):
    """A checkpoint of a training run, or a policy published without its run.

    Attributes:
        folder: Folder of the policy.
        step: Training step.
        experiment: Job name of the run.
        seed: Seed of the training.
        policy_type: Type of the policy, such as "deltaco_match" or "act".
        image_size: Height and width of the images that it was trained on, px.
        control: Control of the benchmark's arm that it was trained with; None if unknown.
    """

    folder: Path
    step: int
    experiment: str
    seed: int
    policy_type: str
    image_size: int
    control: str | None

    @property
    def weights_digest(self) -> str:
        """SHA-256 of the weights, in hexadecimal."""
        with (self.folder / WEIGHTS).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


def find_checkpoints(path: Path) -> list[Checkpoint]:
    """Returns the checkpoints of a run, ascending by step, or the one in a folder.

    Args:
        path: Output folder of a training run, or folder of a policy.

    Raises:
        UserError: There are none, or one is damaged.
    """
    if (path / WEIGHTS).is_file() and (path / CONFIG).is_file():
        return [_read_checkpoint(path)]
    # LeRobot sets the link `last` when a checkpoint is complete; later checkpoints are still being written.
    last = (path / "checkpoints" / "last").resolve().name
    found = [
        _read_checkpoint(folder / "pretrained_model")
        for folder in (path / "checkpoints").glob("*")
        if folder.name.isdecimal() and (folder / "pretrained_model" / WEIGHTS).is_file()
        if not last.isdecimal() or int(folder.name) <= int(last)
    ]
    if not found:
        raise UserError(
            f"{path} has no checkpoints. Name the `--output_dir` of a training run, or a policy's folder "
            f"({CONFIG}, {WEIGHTS})."
        )
    return sorted(found, key=lambda checkpoint: checkpoint.step)


def _read_checkpoint(folder: Path) -> Checkpoint:
    try:
        policy = read_json(folder / CONFIG)
        run: dict[str, Any] = {}
        if (folder / TRAIN_CONFIG).is_file():
            run = read_json(folder / TRAIN_CONFIG)
        inputs = policy["input_features"].items()
        images = {name: item["shape"] for name, item in inputs if item["type"] == "VISUAL"}
        return Checkpoint(
            folder,
            _step(folder),
            run.get("job_name") or folder.resolve().name,
            run.get("seed") or policy.get("seed") or 0,
            policy["type"],
            next(iter(images.values()))[-1],
            control_of(images),
        )
    except (OSError, ValueError, KeyError, StopIteration, TypeError, AttributeError) as error:
        raise UserError(f"The configuration of the policy in {folder} cannot be read: {error!r}.") from error


def _step(folder: Path) -> int:
    """Returns the training step of a policy: of its folder in a run, or of its weights; else 0."""
    from safetensors import safe_open

    parent = folder.resolve().parent.name
    if parent.isdecimal():
        return int(parent)
    with safe_open(folder / WEIGHTS, framework="numpy") as file:
        return int(file.get_tensor("step")) if "step" in file.keys() else 0  # noqa: SIM118


class LoadedPolicy(NamedTuple):
    """A policy in evaluation mode, with its processors."""

    policy: PreTrainedPolicy
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline

    @property
    def rename_map(self) -> Mapping[str, str]:
        """Renaming of observations by the preprocessor."""
        return next((step.rename_map for step in self.preprocessor.steps if hasattr(step, "rename_map")), {})


def load_policy(
    folder: Path, overrides: Sequence[str] = (), rename_map: Mapping[str, str] | None = None
) -> LoadedPolicy:
    """Loads a policy of any LeRobot type and its processors.

    Args:
        folder: Folder with the policy's configuration and weights.
        overrides: Options of the policy, as on LeRobot's command line but without `policy.`:
            "--device=cpu", "--demo_root=DIR".
        rename_map: Names under which the policy knows the environment's observations, by the environment's
            names; None for those used in training.

    Raises:
        UserError: The overrides do not fit the policy, or packages that its type needs are missing.
    """
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=list(overrides))
    if getattr(config, "pretrained_backbone_weights", None) is not None:
        # The checkpoint's weights replace them, so they need not be downloaded.
        config.pretrained_backbone_weights = None
    try:
        policy_class = get_policy_class(config.type)
        # If it has processor steps of its own, they are registered there.
        importlib.import_module(type(config).__module__.replace("configuration_", "processor_"))
    except ImportError as error:
        raise UserError(
            f"{folder} holds a policy of the type {config.type!r}, whose packages are missing: {error}."
        ) from error
    policy = policy_class.from_pretrained(folder, config=config)
    policy.to(config.device)
    policy.eval()
    replaced: dict[str, Any] = {"device_processor": {"device": str(config.device)}}
    if rename_map is not None:
        replaced[_RENAMING_STEP] = {"rename_map": dict(rename_map)}
    processors = make_pre_post_processors(
        config, pretrained_path=str(folder), preprocessor_overrides=replaced
    )
    return LoadedPolicy(policy, *processors)
