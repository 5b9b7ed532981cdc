"""The file `tasks.safetensors` beside a policy's weights: what the policy knows about tasks.

It holds embeddings of instructions, so that no language encoder is needed for those, and the demonstrations
for evaluation, so that their dataset is not needed. Checkpoints may come from strangers: the whole file is
checked before anything of it is used.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from huggingface_hub import hf_hub_download
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lerobot_deltaco.common.typed_fields import is_a
from lerobot_deltaco.policy.language.encoder_names import LANGUAGE_ENCODERS

TASK_FILE = "tasks.safetensors"
_DOWNLOAD_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")
# Of a unit vector's length, in single precision.
LENGTH_TOLERANCE = 1e-3
_EMBEDDINGS, _LENGTHS = "embeddings", "lengths"
_FRAMES, _EPISODES, _FEATURES = "frames", "episodes", "features"
_GRASP_STATES = "grasp_states"
_NAMES = (_EMBEDDINGS, _LENGTHS, _FRAMES, _EPISODES, _FEATURES, _GRASP_STATES)


class TaskFileError(ValueError):
    """A file of embeddings and demonstrations cannot be used; the message says why, and what to do."""


class StoredDemonstrations(NamedTuple):
    """Demonstrations, as a file has them."""

    frames: Tensor  # (demonstrations, kept frames, 3, height, width) uint8
    episodes: Tensor  # (demonstrations,) int64, indices in their dataset
    tasks: list[str]  # of each demonstration
    target_objects: list[int] | None  # index of the object that each moves; None if it is not known
    features: Tensor | None = None  # (demonstrations, features) float32, by a frozen image encoder
    # The robot's state at each grasp, (demonstrations, state) float32; NaN where there is none.
    grasp_states: Tensor | None = None


class TaskFile(NamedTuple):
    """Contents of a task file."""

    language_encoder: str
    instructions: list[str]
    embeddings: Tensor  # (instructions, embedding), unit vectors
    demonstrations: StoredDemonstrations | None
    # The lengths of the embeddings as the encoder gives them, (instructions,); None in files of version 0.1.
    lengths: Tensor | None = None
    # Sentences that people wrote for task strings.
    paraphrases: Mapping[str, Sequence[str]] = MappingProxyType({})


def hub_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Of the arguments of `PreTrainedPolicy.from_pretrained`, those that concern the Hub."""
    return {name: options[name] for name in _DOWNLOAD_OPTIONS if name in options}


def find_task_file(pretrained_name_or_path: str | Path, **options: Any) -> Path:
    """Path of a checkpoint's file, which is downloaded if the checkpoint is on the Hugging Face Hub.

    Args:
        pretrained_name_or_path: Folder of the checkpoint, or its repository's id on the Hub.
        options: Arguments of `PreTrainedPolicy.from_pretrained`; those that concern the Hub are used.
    """
    folder = Path(pretrained_name_or_path)
    if folder.is_dir():
        return folder / TASK_FILE
    return Path(hf_hub_download(str(pretrained_name_or_path), TASK_FILE, **hub_options(options)))


def write_task_file(path: Path, contents: TaskFile) -> None:
    """Writes a file, which `read_task_file` reads."""
    tensors = {_EMBEDDINGS: contents.embeddings.cpu().contiguous()}
    known = {
        "language_encoder": contents.language_encoder,
        "instructions": json.dumps(contents.instructions),
    }
    if contents.demonstrations is not None:
        frames, episodes, tasks, target_objects, features, grasp_states = contents.demonstrations
        tensors |= {_FRAMES: frames.cpu().contiguous(), _EPISODES: episodes.cpu().contiguous()}
        if features is not None:
            tensors[_FEATURES] = features.float().cpu().contiguous()
        if grasp_states is not None:
            tensors[_GRASP_STATES] = grasp_states.float().cpu().contiguous()
        known["tasks"] = json.dumps(tasks)
        known["target_objects"] = json.dumps(target_objects)
    if contents.lengths is not None:
        tensors[_LENGTHS] = contents.lengths.float().cpu().contiguous()
    if contents.paraphrases:
        known["paraphrases"] = json.dumps({task: list(own) for task, own in contents.paraphrases.items()})
    save_file(tensors, path, metadata=known)


def read_task_file(path: Path) -> TaskFile:
    """Reads a file, and checks it whole.

    Raises:
        TaskFileError: The file is missing, is no such file, or its content is not valid.
    """
    try:
        with safe_open(path, framework="pt") as file:
            known: Mapping[str, str] = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys() if name in _NAMES}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise _error(path, error) from error
    if _EMBEDDINGS not in tensors:
        raise _error(path, f"the tensor `{_EMBEDDINGS}` is missing")
    encoder = known.get("language_encoder")
    if encoder is None or encoder not in LANGUAGE_ENCODERS:
        known_encoders = ", ".join(LANGUAGE_ENCODERS)
        raise _error(path, f"`language_encoder` must be one of {known_encoders}, not {encoder!r}")
    instructions = _strings(path, known, "instructions")
    if len(set(instructions)) < len(instructions):
        raise _error(path, "`instructions` has an instruction twice")
    embeddings = tensors[_EMBEDDINGS]
    _check(path, _EMBEDDINGS, embeddings, torch.float32, (len(instructions), _dim(encoder)))
    # Not finite, a number has no distance below the tolerance.
    lengths = embeddings.norm(dim=1)
    if not bool(((lengths - 1).abs() < LENGTH_TOLERANCE).all()):
        raise _error(path, f"`{_EMBEDDINGS}` must be unit vectors of finite numbers")
    as_computed = tensors.pop(_LENGTHS, None)
    if as_computed is not None:
        _check(path, _LENGTHS, as_computed, torch.float32, (len(instructions),))
        if not bool((as_computed.isfinite() & (as_computed > 0)).all()):
            raise _error(path, f"`{_LENGTHS}` must be finite and greater than 0")
    demonstrations = _demonstrations(path, tensors, known) if set(tensors) > {_EMBEDDINGS} else None
    return TaskFile(encoder, instructions, embeddings, demonstrations, as_computed, _paraphrases(path, known))


def check_demonstrations(
    path: Path, demonstrations: StoredDemonstrations, image_size: int, n_kept: int
) -> None:
    """Checks that demonstrations of a file are those of a policy.

    Args:
        path: The file.
        demonstrations: Demonstrations of the file.
        image_size: Height and width of the policy's images of demonstrations, px.
        n_kept: Number of frames that the policy keeps of each demonstration.

    Raises:
        TaskFileError: They have other numbers of frames or pixels.
    """
    shape = (len(demonstrations.tasks), n_kept, 3, image_size, image_size)
    _check(path, _FRAMES, demonstrations.frames, torch.uint8, shape)


def check_features(path: Path, demonstrations: StoredDemonstrations, feature_dim: int | None) -> None:
    """Checks that features of a file are those of a policy's image encoder.

    Args:
        path: The file.
        demonstrations: Demonstrations of the file, with features.
        feature_dim: Number of the encoder's features; None if it is not known.

    Raises:
        TaskFileError: Their number is another one.
    """
    assert demonstrations.features is not None
    if feature_dim is not None:
        shape = (len(demonstrations.tasks), feature_dim)
        _check(path, _FEATURES, demonstrations.features, torch.float32, shape)


def check_grasp_states(path: Path, demonstrations: StoredDemonstrations, state_dim: int) -> None:
    """Checks that the grasps of a file are those of a policy's robot.

    Args:
        path: The file.
        demonstrations: Demonstrations of the file, with grasps.
        state_dim: Size of the robot's state.

    Raises:
        TaskFileError: The states have another size.
    """
    assert demonstrations.grasp_states is not None
    shape = (len(demonstrations.tasks), state_dim)
    _check(path, _GRASP_STATES, demonstrations.grasp_states, torch.float32, shape)


def _demonstrations(
    path: Path, tensors: Mapping[str, Tensor], known: Mapping[str, str]
) -> StoredDemonstrations:
    if missing := [name for name in (_FRAMES, _EPISODES) if name not in tensors]:
        raise _error(path, f"demonstrations need the tensor `{missing[0]}`")
    frames, episodes = tensors[_FRAMES], tensors[_EPISODES]
    tasks = _strings(path, known, "tasks")
    _check(path, _EPISODES, episodes, torch.int64, (len(tasks),))
    if not tasks:
        raise _error(path, "it has demonstrations, but none of a task")
    if int(episodes.min()) < 0 or len(episodes.unique()) < len(episodes):
        raise _error(path, f"`{_EPISODES}` must be different, and at least 0")
    if frames.ndim != 5 or frames.shape[1] < 2:
        shape = tuple(frames.shape)
        raise _error(path, f"`{_FRAMES}` must have the shape (n, 2 or more, 3, h, w), not {shape}")
    _check(path, _FRAMES, frames, torch.uint8, (len(tasks), frames.shape[1], 3, *frames.shape[3:]))
    features = _rows(path, tensors, _FEATURES, "features", len(tasks))
    if features is not None and not bool(features.isfinite().all()):
        raise _error(path, f"`{_FEATURES}` must be finite")
    grasp_states = _rows(path, tensors, _GRASP_STATES, "state", len(tasks))
    if grasp_states is not None:
        is_known, is_none = grasp_states.isfinite().all(dim=1), grasp_states.isnan().all(dim=1)
        if not bool((is_known | is_none).all()):
            raise _error(path, f"`{_GRASP_STATES}` must be finite, or NaN where there is no grasp")
    target_objects = _target_objects(path, known, len(tasks))
    return StoredDemonstrations(frames, episodes, tasks, target_objects, features, grasp_states)


def _rows(path: Path, tensors: Mapping[str, Tensor], name: str, columns: str, n_rows: int) -> Tensor | None:
    """A table with a row of numbers for each demonstration; None if the file has none."""
    rows = tensors.get(name)
    if rows is None:
        return None
    if rows.ndim != 2:
        raise _error(path, f"`{name}` must have the shape (n, {columns}), not {tuple(rows.shape)}")
    _check(path, name, rows, torch.float32, (n_rows, rows.shape[1]))
    return rows


def _target_objects(path: Path, known: Mapping[str, str], n_demonstrations: int) -> list[int] | None:
    """Index of the object that each demonstration moves; None in files of earlier versions."""
    try:
        indices = json.loads(known.get("target_objects", "null"))
    except ValueError as error:
        raise _error(path, f"`target_objects` must be a list in JSON: {error!r}") from error
    if indices is None:
        return None
    if not is_a(indices, list[int]) or len(indices) != n_demonstrations or min(indices) < 0:
        raise _error(path, "`target_objects` must have an integer of at least 0 for each demonstration")
    return list(indices)


def _paraphrases(path: Path, known: Mapping[str, str]) -> dict[str, list[str]]:
    try:
        found = json.loads(known.get("paraphrases", "{}"))
    except ValueError as error:
        raise _error(path, f"`paraphrases` must be JSON: {error!r}") from error
    is_valid = isinstance(found, dict) and all(
        isinstance(own, list) and all(isinstance(sentence, str) for sentence in own) for own in found.values()
    )
    if not is_valid:
        raise _error(path, "`paraphrases` must have a list of strings for each task string")
    return found


def _strings(path: Path, known: Mapping[str, str], name: str) -> list[str]:
    try:
        strings = json.loads(known[name])
    except (KeyError, ValueError) as error:
        raise _error(path, f"`{name}` must be a list in JSON: {error!r}") from error
    if not isinstance(strings, list) or not all(isinstance(item, str) for item in strings):
        raise _error(path, f"`{name}` must be a list of strings")
    return strings


def _check(path: Path, name: str, tensor: Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    if tensor.dtype != dtype or tuple(tensor.shape) != shape:
        raise _error(
            path,
            f"`{name}` must be of the type {str(dtype).removeprefix('torch.')} and the shape {shape}, not "
            f"{str(tensor.dtype).removeprefix('torch.')} and {tuple(tensor.shape)}",
        )


def _dim(encoder: str) -> int:
    return LANGUAGE_ENCODERS[encoder].embedding_dim


def _error(path: Path, reason: object) -> TaskFileError:
    return TaskFileError(
        f"{path} cannot be used: {reason}. It must be a checkpoint's tasks.safetensors, or a file that "
        "deltaco-embed wrote."
    )
