"""Which checkpoints may be loaded, and whether their files are what they should be, before they are loaded.

LeRobot imports and calls any class that a checkpoint's processors name. So the files of a checkpoint are
checked here first: a page must not run code because someone typed the name of a repository.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub import HfApi, constants, snapshot_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

from lerobot_deltaco.play.errors import PlayError

DEFAULT_NAME = "small_a_correspondence"
MAX_HUB_BYTES = 1_000_000_000

_CONFIG = "config.json"
_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_REQUIRED = (_CONFIG, "model.safetensors", "tasks.safetensors", *_PROCESSORS)
_HUB_PATTERNS = ("*.json", "*.safetensors")
# The steps that the policy's processors have. Each is LeRobot's own, known by a name.
_STEPS = {
    "rename_observations_processor",
    "to_batch_processor",
    "device_processor",
    "normalizer_processor",
    "unnormalizer_processor",
}
# Options that name files, which a checkpoint does not need: it brings its own.
_FILE_OPTIONS = ("demo_repo_id", "demo_root", "instruction_embeddings")


def checkpoints_folder() -> Path:
    """Folder of the checkpoints that come with the project: in the package, or beside it in a clone."""
    package = Path(__file__).parents[1]
    inside = package / "checkpoints"
    return inside if inside.is_dir() else package.parent / "checkpoints"


def find_checkpoint(name: str, roots: Sequence[Path], is_hub_allowed: bool) -> Path:
    """The folder of a checkpoint, whose files are checked.

    Args:
        name: Folder of a checkpoint, or its repository's id on the Hugging Face Hub.
        roots: Folders in which checkpoints may lie, at any depth.
        is_hub_allowed: Whether checkpoints may be downloaded.

    Raises:
        PlayError: There is no such checkpoint, it may not be loaded, or its files are not a policy's.
    """
    name = name.strip()
    if not name:
        raise PlayError(f"The name of the checkpoint is empty. Enter {_valid_names(roots, is_hub_allowed)}.")
    folder = _allowed_folder(name, roots)
    if folder is None:
        is_repo_id = re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", name, re.ASCII) is not None
        if not is_repo_id or not is_hub_allowed:
            valid = _valid_names(roots, is_hub_allowed)
            raise PlayError(f"There is no checkpoint {name!r} that this page may load. Enter {valid}.")
        folder = _downloaded(name)
    check_files(folder, name)
    return folder


def check_files(folder: Path, name: str) -> None:
    """Checks that a folder has the files of this project's policy, which name no code and no other files.

    Args:
        folder: Folder of the checkpoint.
        name: Name that the user entered, for the message.

    Raises:
        PlayError: They are not.
    """
    missing = [file for file in _REQUIRED if not (folder / file).is_file()]
    if missing:
        raise PlayError(
            f"{name!r} is not a whole checkpoint: {missing[0]} is missing. A checkpoint is the folder "
            "`pretrained_model` that deltaco-train writes, or a repository with its files."
        )
    config = _read_json(folder / _CONFIG, name)
    if config.get("type") != "deltaco":
        raise PlayError(f"{name!r} holds a policy of the type {config.get('type')!r}, not 'deltaco'.")
    named = [option for option in _FILE_OPTIONS if config.get(option) is not None]
    if named:
        raise PlayError(f"{name!r} names files of another place in `{named[0]}`. Save the policy again.")
    for file in _PROCESSORS:
        steps = _read_json(folder / file, name).get("steps")
        if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
            raise PlayError(f"{name!r} is damaged: {file} has no list of steps.")
        for step in steps:
            if "class" in step or step.get("registry_name") not in _STEPS:
                what = step.get("class", step.get("registry_name"))
                raise PlayError(
                    f"{name!r} is refused: {file} asks for the step {what!r}, which may run any code."
                )
            state_file = step.get("state_file")
            if state_file is not None and (
                not isinstance(state_file, str) or not re.fullmatch(r"[\w-]+\.safetensors", state_file)
            ):
                raise PlayError(f"{name!r} is refused: {file} names the file {state_file!r}.")


def _allowed_folder(name: str, roots: Sequence[Path]) -> Path | None:
    """The folder that a name stands for; None if there is none that lies in one of the roots."""
    try:
        folder = Path(name).expanduser().resolve()
        is_allowed = any(folder.is_relative_to(root.resolve()) for root in roots)
        return folder if is_allowed and folder.is_dir() else None
    except (OSError, ValueError, RuntimeError):  # too long, a null character, no such user
        return None


def _downloaded(repo_id: str) -> Path:
    """The folder of a repository's files, of which only data are fetched."""
    try:
        if not constants.HF_HUB_OFFLINE:
            info = HfApi().model_info(repo_id, files_metadata=True)
            n_bytes = sum(file.size or 0 for file in info.siblings or ())
            if n_bytes > MAX_HUB_BYTES:
                raise PlayError(
                    f"{repo_id!r} has {n_bytes / 1e9:.1f} GB; at most {MAX_HUB_BYTES / 1e9:g} are loaded."
                )
        return Path(snapshot_download(repo_id, allow_patterns=list(_HUB_PATTERNS)))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError) as error:
        reason = " ".join(str(error).split())[:200]
        raise PlayError(f"{repo_id!r} cannot be fetched from the Hugging Face Hub: {reason}") from error
    except (httpx.HTTPError, OSError) as error:
        raise PlayError(f"The Hugging Face Hub cannot be reached to fetch {repo_id!r}: {error}") from error


def _read_json(path: Path, name: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise PlayError(f"{name!r} is damaged: {path.name} cannot be read.") from error
    if not isinstance(content, dict):
        raise PlayError(f"{name!r} is damaged: {path.name} holds no object.")
    return content


def _valid_names(roots: Sequence[Path], is_hub_allowed: bool) -> str:
    folders = " or ".join(str(root) for root in roots)
    hub = "the id USER/NAME of one on the Hugging Face Hub"
    local = f"the folder of a checkpoint in {folders}"
    return " or ".join([*([local] if roots else []), *([hub] if is_hub_allowed else [])])
