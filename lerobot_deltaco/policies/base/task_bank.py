"""The task bank of a checkpoint: `tasks.safetensors` beside the weights.

It holds embeddings of instructions, so that these need no language encoder, and the demonstrations for
evaluation, so that these need no dataset:

    embeddings     (instructions, embedding) float32, unit vectors; none without a language encoder
    frames         (demonstrations, frames, 3, H, W) uint8
    episodes       (demonstrations,) int64, indices in their dataset
    first_images   (demonstrations, 3, H', W') uint8, at the camera's own resolution; optional
    pick_states    (demonstrations, state) float32, NaN where there is none; optional
    states         (steps of all demonstrations, state) float32; optional
    actions        (steps of all demonstrations, action) float32; with states
    n_steps        (demonstrations,) int64, steps of each; with states
    features       (demonstrations, features) float32, by a frozen image encoder; optional
    metadata       as JSON: instructions, tasks and target_objects
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from lerobot_deltaco.data.demonstrations import DemonstrationBank, RobotData
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.instructions import InstructionEmbeddings

TASK_BANK = "tasks.safetensors"
_HUB_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")
# A single key: safetensors writes several in a random order, and equal banks would be unequal files.
_KEY = "deltaco_tasks"


def write_task_bank(
    path: Path,
    instructions: InstructionEmbeddings | None,
    demonstrations: DemonstrationBank | None,
) -> None:
    """Writes a task bank.

    Args:
        path: The file.
        instructions: Embeddings of instructions; None if the policy has no language encoder.
        demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
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
        if demonstrations.spans is not None:
            states, actions = zip(*map(demonstrations.trajectory, range(len(demonstrations))), strict=True)
            tensors |= {"states": torch.cat(states).float(), "actions": torch.cat(actions).float()}
            tensors["n_steps"] = torch.tensor([len(each) for each in states])
        if demonstrations.features is not None:
            tensors["features"] = demonstrations.features[:, 0].float()
        texts |= {"tasks": demonstrations.tasks, "target_objects": demonstrations.target_objects}
    tensors = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
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


def read_task_bank(path: Path, instructions: InstructionEmbeddings | None) -> DemonstrationBank | None:
    """Reads a task bank.

    Args:
        path: The file.
        instructions: Cache that gets the embeddings; None if the policy has no language encoder.

    Returns:
        The demonstrations; None if there are none.

    Raises:
        ValueError: The file is missing, damaged, or not a task bank.
    """
    try:
        with safe_open(path, framework="pt") as file:
            texts = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if instructions is not None:
            instructions.put(texts["instructions"], tensors["embeddings"])
        if "frames" not in tensors:
            return None
        bank = DemonstrationBank(
            tensors["frames"],
            texts["tasks"],
            tensors["episodes"].tolist(),
            texts["target_objects"],
            tensors.get("first_images"),
            tensors.get("pick_states"),
            _trajectories(tensors),
        )
    except (OSError, SafetensorError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise UserError(
            f"The task bank {path} cannot be used: {error}. Fetch or copy all files of the checkpoint "
            "again, or save it again."
        ) from error
    if "features" in tensors:
        bank.features = tensors["features"][:, None].half()
    return bank


def _trajectories(tensors: dict[str, torch.Tensor]) -> RobotData | None:
    """Returns the states and actions of a bank's demonstrations; None if it has none."""
    if "states" not in tensors:
        return None
    ends = tensors["n_steps"].cumsum(dim=0).tolist()
    spans = list(zip([0, *ends[:-1]], [end - 1 for end in ends], strict=True))
    return RobotData(tensors["states"], tensors["actions"], spans)
