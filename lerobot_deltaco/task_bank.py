"""The task bank of a checkpoint: `tasks.safetensors` beside the weights.

It holds embeddings of instructions, so that these need no language encoder, and the demonstrations for
evaluation, so that these need no dataset:

    embeddings     (instructions, embedding) float32, unit vectors; none without a language encoder
    frames         (demonstrations, frames, 3, H, W) uint8
    episodes       (demonstrations,) int64, indices in their dataset
    first_images   (demonstrations, 3, H', W') uint8, at the camera's own resolution; optional
    pick_states    (demonstrations, state) float32, NaN where there is none; optional
    features       (demonstrations, features) float32, by a frozen image encoder; optional
    metadata       language_encoder; instructions, tasks and target_objects as JSON
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from lerobot_deltaco.demonstrations import DemonstrationBank
from lerobot_deltaco.language import InstructionEmbeddings

TASK_BANK = "tasks.safetensors"
_HUB_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")
_FORMAT = "deltaco_tasks"
_TEXTS = ("instructions", "tasks", "target_objects")
_UNIT_TOLERANCE = 1e-3
_DTYPES = {
    "embeddings": torch.float32,
    "frames": torch.uint8,
    "episodes": torch.int64,
    "first_images": torch.uint8,
    "pick_states": torch.float32,
    "features": torch.float32,
}
_DIMS = {"embeddings": 2, "frames": 5, "episodes": 1, "first_images": 4, "pick_states": 2, "features": 2}


class TaskBankError(ValueError):
    """Raised when a task bank cannot be used; the message says why."""


def write_task_bank(
    path: Path, instructions: InstructionEmbeddings | None, demonstrations: DemonstrationBank | None
) -> None:
    """Writes a task bank.

    Args:
        path: The file.
        instructions: Embeddings of instructions; None if the policy has no language encoder.
        demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
    """
    tensors: dict[str, torch.Tensor] = {}
    known = {"format": _FORMAT}  # a file without anything else is not valid
    if instructions is not None:
        tensors["embeddings"] = instructions.embeddings
        known["language_encoder"] = instructions.encoder_name
        known["instructions"] = json.dumps(list(instructions.rows))
    if demonstrations is not None:
        tensors |= {"frames": demonstrations.frames, "episodes": demonstrations.episodes}
        if demonstrations.first_images is not None:
            tensors["first_images"] = demonstrations.first_images
        if demonstrations.pick_states is not None:
            tensors["pick_states"] = demonstrations.pick_states.float()
        if demonstrations.features is not None:
            tensors["features"] = demonstrations.features[:, 0].float()
        known["tasks"] = json.dumps(demonstrations.tasks)
        known["target_objects"] = json.dumps(demonstrations.target_objects)
    save_file({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, path, metadata=known)


def find_task_bank(pretrained: str | Path, **options: Any) -> Path:
    """Returns the path of a checkpoint's task bank, downloading it if the checkpoint is on the Hub.

    Args:
        pretrained: Folder of the checkpoint, or its repository's id on the Hub.
        options: Arguments of `PreTrainedPolicy.from_pretrained`; those that concern the Hub are used.
    """
    if Path(pretrained).is_dir():
        return Path(pretrained) / TASK_BANK
    hub_options = {name: options[name] for name in _HUB_OPTIONS if name in options}
    return Path(hf_hub_download(str(pretrained), TASK_BANK, **hub_options))


def read_task_bank(
    path: Path, instructions: InstructionEmbeddings | None, frames_shape: tuple[int, ...], state_dim: int
) -> DemonstrationBank | None:
    """Reads a task bank, and checks that it belongs to a policy.

    Args:
        path: The file.
        instructions: Cache that gets the embeddings; None if the policy has no language encoder.
        frames_shape: Shape of the policy's demonstrations, (frames, 3, H, W).
        state_dim: Size of the robot's state, for states at grasps.

    Returns:
        The demonstrations; None if there are none.

    Raises:
        TaskBankError: The file is missing, is not a task bank, or belongs to another policy.
    """
    try:
        with safe_open(path, framework="pt") as file:
            known = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        texts = {name: json.loads(known[name]) for name in _TEXTS if name in known}
    except (OSError, SafetensorError, ValueError) as error:
        raise _error(path, str(error)) from error
    for name, tensor in tensors.items():
        if (
            name not in _DTYPES
            or (tensor.dtype, tensor.ndim) != (_DTYPES[name], _DIMS[name])
        ):  # fmt: skip
            raise _error(
                path, f"it has the tensor `{name}` of {tensor.dtype} and shape {tuple(tensor.shape)}"
            )
    if instructions is not None:
        _add_embeddings(path, instructions, tensors.get("embeddings"), texts.get("instructions"), known)
    if "frames" not in tensors:
        return None
    return _demonstrations(path, tensors, texts, frames_shape, state_dim)


def _add_embeddings(
    path: Path,
    instructions: InstructionEmbeddings,
    embeddings: torch.Tensor | None,
    names: Any,
    known: Mapping[str, str],
) -> None:
    if known.get("language_encoder") != instructions.encoder_name:
        raise _error(
            path,
            f"its instructions were embedded by {known.get('language_encoder')}, and `language_encoder` is "
            f"{instructions.encoder_name}",
        )
    if embeddings is None or not _are_strings(names) or len(set(names)) != len(embeddings):
        raise _error(path, "its instructions and embeddings differ in number")
    lengths = embeddings.norm(dim=1)
    if not bool(((lengths - 1).abs() < _UNIT_TOLERANCE).all()):
        raise _error(path, "its embeddings are not unit vectors")
    new = [n for n, name in enumerate(names) if name not in instructions.rows]
    instructions.put([names[n] for n in new], embeddings[new])


def _demonstrations(
    path: Path,
    tensors: dict[str, torch.Tensor],
    texts: dict[str, Any],
    frames_shape: tuple[int, ...],
    state_dim: int,
) -> DemonstrationBank:
    frames, tasks, objects = tensors["frames"], texts.get("tasks"), texts.get("target_objects")
    if tuple(frames.shape[1:]) != frames_shape:
        raise _error(path, f"its demonstrations have the shape {tuple(frames.shape[1:])}, not {frames_shape}")
    rows = {name: len(tensor) for name, tensor in tensors.items() if name != "embeddings"}
    if not _are_strings(tasks) or not tasks or set(rows.values()) != {len(tasks)} or "episodes" not in rows:
        raise _error(path, f"its demonstrations differ in number: {rows}")
    if objects is not None and len(objects) != len(tasks):
        raise _error(path, "its target objects and demonstrations differ in number")
    bank = DemonstrationBank(
        frames, tasks, tensors["episodes"].tolist(), objects, tensors.get("first_images")
    )
    states = tensors.get("pick_states")
    if states is not None:
        if states.shape[1] != state_dim or bool(states.isinf().any()):
            raise _error(
                path, f"its grasps have {states.shape[1]} numbers, and the robot's state {state_dim}"
            )
        bank.pick_states = states
    if "features" in tensors:
        if not bool(tensors["features"].isfinite().all()):
            raise _error(path, "its features are not finite")
        bank.features = tensors["features"][:, None].half()
    return bank


def _are_strings(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _error(path: Path, reason: str) -> TaskBankError:
    return TaskBankError(
        f"The task bank {path} cannot be used: {reason}. Save or fetch the checkpoint again."
    )
