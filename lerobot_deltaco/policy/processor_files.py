"""Processor files of a checkpoint, checked before LeRobot loads them.

LeRobot 0.6.1 imports and calls the class that a processor's file names before it checks that it is a step of
a processor: {"class": "os.system", "config": ...} runs a command. Steps by registered names are safe.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.constants import is_offline_mode
from huggingface_hub.errors import LocalEntryNotFoundError, RemoteEntryNotFoundError
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

PROCESSOR_FILES = (f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json")


class ProcessorFileError(ValueError):
    """A processor's file must not be loaded; the message says why."""


def check_processor_files(pretrained: str | Path, **hub_options: Any) -> None:
    """Checks that the processors of a checkpoint consist of registered steps alone.

    Args:
        pretrained: Folder of the checkpoint, or its name on the Hub.
        hub_options: Arguments of `hf_hub_download`, such as `revision`.

    Raises:
        ProcessorFileError: A file is not that of a processor, or names a class of its own.
        LocalEntryNotFoundError: The Hub could not be asked for a file.
    """
    for name in PROCESSOR_FILES:
        path = Path(pretrained) / name
        if not Path(pretrained).is_dir():
            try:
                path = Path(hf_hub_download(str(pretrained), name, **hub_options))
            except RemoteEntryNotFoundError:
                continue
            except LocalEntryNotFoundError:
                # Without a network, LeRobot finds no file either. But one that fails may be back when LeRobot
                # asks, which would then load what was never checked.
                if is_offline_mode() or hub_options.get("local_files_only"):
                    continue
                raise
        if path.exists():
            _check_file(path)


def _check_file(path: Path) -> None:
    try:
        contents = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ProcessorFileError(f"{path} is no file of a processor: it is no JSON ({error}).") from None
    steps = contents.get("steps") if isinstance(contents, dict) else None
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise ProcessorFileError(f"{path} is no file of a processor: `steps` must be a list of steps.")
    known = ProcessorStepRegistry.list()
    for step in steps:
        if "class" in step:
            raise ProcessorFileError(
                f"{path} names the class {step['class']!r}, which LeRobot would import and call. Only steps "
                "by registered names are loaded. Do not use this checkpoint unless you trust its author and "
                "have read that class; then register it, and write its `registry_name` there."
            )
        if step.get("registry_name") not in known:
            raise ProcessorFileError(
                f"{path} names the step {step.get('registry_name')!r}, which is not registered. Import the "
                f"package that registers it first. Registered are {', '.join(sorted(known))}."
            )
