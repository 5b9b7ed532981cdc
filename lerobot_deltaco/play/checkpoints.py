"""Which checkpoints may be loaded, and whether their files are what they should be, before they are loaded.

LeRobot imports and calls any class that a checkpoint's processors name. So the files of a checkpoint are
checked here first: a page must not run code because someone typed the name of a repository.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_deltaco.common.shipped import shipped_folder
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.sources import CHECKPOINT, find_folder, read_json
from lerobot_deltaco.policy.options import FILE_OPTIONS
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS

DEFAULT_NAME = "pick_place"

_CONFIG = "config.json"
_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_REQUIRED = (_CONFIG, "model.safetensors", "tasks.safetensors", *_PROCESSORS)
# The steps that the policy's processors have. Each is LeRobot's own, known by a name.
_STEPS = {
    "rename_observations_processor",
    "to_batch_processor",
    "device_processor",
    "normalizer_processor",
    "unnormalizer_processor",
}
# Image encoders that come as Python packages. The others would be downloaded, whatever their size.
_PACKAGED_ENCODERS = tuple(
    name for name, spec in VISION_ENCODERS.items() if spec.kind == "efficientnet_lite0"
)


def checkpoints_folder() -> Path:
    """Folder of the checkpoints that come with the project."""
    return shipped_folder("checkpoints", "checkpoints")


def find_checkpoint(name: str, roots: Sequence[Path], is_hub_allowed: bool) -> Path:
    """The folder of a checkpoint, whose files are checked.

    Args:
        name: Folder of a checkpoint, or its repository's id on the Hugging Face Hub.
        roots: Folders in which checkpoints may lie, at any depth.
        is_hub_allowed: Whether checkpoints may be downloaded.

    Raises:
        PlayError: There is no such checkpoint, it may not be loaded, or its files are not a policy's.
    """
    folder = find_folder(name, CHECKPOINT, roots, is_hub_allowed)
    check_files(folder, name.strip())
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
    config = read_json(folder / _CONFIG, name)
    if config.get("type") != "deltaco":
        raise PlayError(f"{name!r} holds a policy of the type {config.get('type')!r}, not 'deltaco'.")
    # A checkpoint brings its own. Files of this machine would be read, shown in a message or written.
    named = [option for option in FILE_OPTIONS if config.get(option) is not None]
    if named:
        raise PlayError(f"{name!r} names files of another place in `{named[0]}`. Save the policy again.")
    _check_image_encoder(config, name)
    for file in _PROCESSORS:
        steps = read_json(folder / file, name).get("steps")
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


def _check_image_encoder(config: dict[str, Any], name: str) -> None:
    """Checks that a policy's frozen image encoder is one that comes with the project.

    Raises:
        PlayError: It is not.
    """
    encoder = config.get("vision_encoder")
    # A list, since what a file says may not be hashable.
    if encoder is not None and encoder not in list(VISION_ENCODERS):
        raise PlayError(
            f"{name!r} is refused: its `vision_encoder` is {encoder!r}, not one of "
            f"{', '.join(VISION_ENCODERS)}."
        )
    if config.get("demo_encoder") == "pretrained" and encoder not in _PACKAGED_ENCODERS:
        raise PlayError(
            f"{name!r} is refused: its image encoder {encoder!r} would have to be downloaded. Of policies "
            f"with a pretrained image encoder, this page loads those with {' or '.join(_PACKAGED_ENCODERS)} "
            "alone."
        )
