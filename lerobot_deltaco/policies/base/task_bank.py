"""The task bank of a checkpoint: `tasks.safetensors` beside the weights.

It holds embeddings of instructions, so that these need no language encoder, and the demonstrations for
evaluation, so that these need no dataset:

    embeddings     (instructions, embedding) float32, unit vectors; none without a language encoder
    frames         (demonstrations, frames, 3, H, W) uint8
    episodes       (demonstrations,) int64, indices in their dataset
    first_images   (demonstrations, 3, H', W') uint8, at the camera's own resolution; optional
    pick_states    (demonstrations, state) float32, NaN where there is none; optional
    features       (demonstrations, features) float32, by a frozen image encoder; optional
    metadata       as JSON: instructions, tasks and target_objects, and SHA-256 digests of the bank itself and
                   of what it was saved with: the configuration's options that say what the numbers of
                   observations and actions mean, and the processors with their statistics

So a checkpoint is refused if its files are not those that were saved together.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.language import InstructionEmbeddings

TASK_BANK = "tasks.safetensors"
PROCESSORS = "processors and statistics"
_HUB_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")
# A single key: safetensors writes several in a random order, and equal banks would be unequal files.
_KEY = "deltaco_tasks"
_OPTIONS = (
    "gripper",
    "gripper_closed",
    "image_size",
    "n_demo_frames",
    "demo_camera",
    "one_hot_tasks",
    "known_words",
    "language_encoder",
)
_OF_THE_MACHINE = ("device", "rename_map")  # options of processor steps, which may differ


def write_task_bank(
    path: Path,
    instructions: InstructionEmbeddings | None,
    demonstrations: DemonstrationBank | None,
    digests: Mapping[str, str],
) -> None:
    """Writes a task bank.

    Args:
        path: The file.
        instructions: Embeddings of instructions; None if the policy has no language encoder.
        demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
        digests: Digests of what the bank is saved with, by name.
    """
    tensors: dict[str, torch.Tensor] = {}
    texts: dict[str, Any] = {}
    if instructions is not None:
        tensors["embeddings"] = instructions.embeddings
        texts["instructions"] = list(instructions.rows)
    if demonstrations is not None:
        tensors |= {"frames": demonstrations.frames, "episodes": demonstrations.episodes}
        if demonstrations.first_images is not None:
            tensors["first_images"] = demonstrations.first_images
        if demonstrations.pick_states is not None:
            tensors["pick_states"] = demonstrations.pick_states.float()
        if demonstrations.features is not None:
            tensors["features"] = demonstrations.features[:, 0].float()
        texts |= {"tasks": demonstrations.tasks, "target_objects": demonstrations.target_objects}
    tensors = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    texts |= {"digests": dict(digests), "digest": _digest(texts, tensors)}
    save_file(tensors, path, metadata={_KEY: json.dumps(texts)})


def checkpoint_file(pretrained: str | Path, name: str, **options: Any) -> Path:
    """Returns the path of a file of a checkpoint, downloading it if the checkpoint is on the Hub.

    Args:
        pretrained: Folder of the checkpoint, or its repository's id on the Hub.
        name: Name of the file.
        options: Arguments of `PreTrainedPolicy.from_pretrained`; those that concern the Hub are used.
    """
    if Path(pretrained).is_dir():
        return Path(pretrained) / name
    hub_options = {name: options[name] for name in _HUB_OPTIONS if name in options}
    return Path(hf_hub_download(str(pretrained), name, **hub_options))


def read_task_bank(
    path: Path, instructions: InstructionEmbeddings | None, digests: Mapping[str, str]
) -> tuple[DemonstrationBank | None, dict[str, str]]:
    """Reads a task bank, and checks that it belongs to a checkpoint.

    Args:
        path: The file.
        instructions: Cache that gets the embeddings; None if the policy has no language encoder.
        digests: Digests of the checkpoint's other parts, by name; those that are missing are not checked.

    Returns:
        The demonstrations, None if there are none; and the digests with which it was saved.

    Raises:
        TaskBankError: The file is missing, is not a task bank, or was saved with other parts.
    """
    try:
        with safe_open(path, framework="pt") as file:
            texts = json.loads((file.metadata() or {}).get(_KEY, "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        digest, saved_with = texts.pop("digest", None), texts.pop("digests", {})
    except (OSError, SafetensorError, ValueError, RecursionError) as error:
        raise _error(path, str(error)) from error
    if digest != _digest(texts, tensors):
        raise _error(path, "it is damaged, or of another version")
    for name, found in digests.items():
        if found != saved_with.get(name):
            raise _error(path, f"it was not saved with this checkpoint's {name}")
    if instructions is not None:
        instructions.put(texts["instructions"], tensors["embeddings"])
    if "frames" not in tensors:
        return None, saved_with
    bank = DemonstrationBank(
        tensors["frames"],
        texts["tasks"],
        tensors["episodes"].tolist(),
        texts["target_objects"],
        tensors.get("first_images"),
    )
    bank.pick_states = tensors.get("pick_states")
    if "features" in tensors:
        bank.features = tensors["features"][:, None].half()
    return bank, saved_with


def _error(path: Path, reason: str) -> ValueError:
    return ValueError(
        f"The task bank {path} cannot be used: {reason}. Fetch or copy all files of the checkpoint again, or "
        "save it again."
    )


# Digests


def configuration_digests(config: PreTrainedConfig) -> dict[str, str]:
    """Returns a digest of each option that says what the numbers of observations and actions mean."""
    options = {name: getattr(config, name) for name in _OPTIONS if hasattr(config, name)}
    for name in ("input_features", "output_features"):
        features = (getattr(config, name) or {}).items()
        options[name] = [[key, feature.type.name, list(feature.shape)] for key, feature in features]
    options["normalization_mapping"] = {key: mode.name for key, mode in config.normalization_mapping.items()}
    return {name: _digest(value, {}) for name, value in options.items()}


def made_processors_digest(config: PreTrainedConfig, stats: Any) -> str | None:
    """Returns the digest of the processors that LeRobot makes with statistics of a dataset."""
    with TemporaryDirectory() as folder:
        for processor in make_pre_post_processors(config, dataset_stats=stats):
            processor.save_pretrained(folder)
        return processors_digest(folder)


def processors_digest(pretrained: str | Path, **options: Any) -> str | None:
    """Returns the digest of a checkpoint's processors and their statistics; None if there are none.

    Args:
        pretrained: Folder of the checkpoint, or its repository's id on the Hub.
        options: Arguments of `PreTrainedPolicy.from_pretrained`.

    Raises:
        UserError: They are damaged.
    """
    found = []
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME):
        try:
            path = checkpoint_file(pretrained, f"{name}.json", **options)
            text = path.read_text(encoding="utf-8")
        except (FileNotFoundError, EntryNotFoundError):
            return None  # a policy alone; LeRobot itself needs both
        try:
            for step in json.loads(text)["steps"]:
                kept = {key: value for key, value in step["config"].items() if key not in _OF_THE_MACHINE}
                state = step.get("state_file")
                tensors = load_file(checkpoint_file(pretrained, state, **options)) if state else {}
                found.append(_digest([step["registry_name"], kept], tensors))
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise UserError(
                f"{path} is damaged: {error!r}. Fetch or copy all files of the checkpoint again."
            ) from error
    return _digest(found, {})


def _digest(value: Any, tensors: Mapping[str, torch.Tensor]) -> str:
    """Returns the SHA-256 of a value of JSON and of tensors by name, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.view(torch.uint8).numpy() if tensor.dim() else tensor.numpy().tobytes())
    return digest.hexdigest()
