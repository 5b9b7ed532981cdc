"""The file `tasks.safetensors` beside a policy's weights: what the policy knows about tasks.

It holds embeddings of instructions, so that no language encoder is needed for those, and the demonstrations
for evaluation, so that their dataset is not needed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from safetensors import safe_open
from safetensors.torch import save_file

from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.language import InstructionTable

TASK_FILE = "tasks.safetensors"
_DOWNLOAD_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")


def write_task_file(
    path: Path, instructions: InstructionTable, demonstrations: DemonstrationSet | None = None
) -> None:
    """Writes instructions and demonstrations.

    Args:
        path: File to write.
        instructions: Embeddings of instructions.
        demonstrations: Demonstrations for evaluation, if any.
    """
    tensors, metadata = instructions.state()
    if demonstrations is not None:
        tensors |= {"frames": demonstrations.frames.cpu(), "episodes": demonstrations.episodes.cpu()}
        metadata["tasks"] = json.dumps(demonstrations.tasks)
    save_file(tensors, path, metadata=metadata)


def read_demonstrations(path: Path) -> DemonstrationSet | None:
    """Reads the demonstrations of a file; None if it has none."""
    with safe_open(path, framework="pt") as file:
        if "frames" not in file.keys():  # noqa: SIM118  (no dictionary)
            return None
        tasks = json.loads(file.metadata()["tasks"])
        return DemonstrationSet(file.get_tensor("frames"), tasks, file.get_tensor("episodes").tolist())


def find_task_file(pretrained_name_or_path: str | Path, **options: Any) -> Path:
    """Path of a checkpoint's file, which is downloaded if the checkpoint is on the Hugging Face Hub.

    Args:
        pretrained_name_or_path: Folder of the checkpoint, or its repository's id on the Hub.
        options: Arguments of `PreTrainedPolicy.from_pretrained`; those that concern the Hub are used.
    """
    folder = Path(pretrained_name_or_path)
    if folder.is_dir():
        return folder / TASK_FILE
    given = {name: options[name] for name in _DOWNLOAD_OPTIONS if name in options}
    return Path(hf_hub_download(str(pretrained_name_or_path), TASK_FILE, **given))
