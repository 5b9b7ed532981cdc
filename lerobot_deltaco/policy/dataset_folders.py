"""The folders of datasets: missing ones are found before LeRobot makes them, and others are told apart.

Given a folder without a dataset, LeRobot makes the folder and downloads the dataset into it. Without a
network, a mistyped folder ends in a network error and an empty folder of that name.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from huggingface_hub import constants
from lerobot.utils.constants import HF_LEROBOT_HOME

INFO_FILE = Path("meta/info.json")


def check_dataset_folder(option: str, root: str | Path | None) -> None:
    """Checks, without a network, that a folder has a dataset.

    Args:
        option: Command-line option that names the folder, for the message.
        root: The folder; None is LeRobot's cache.

    Raises:
        FileNotFoundError: It has none. Nothing was made.
    """
    if root is None or not constants.HF_HUB_OFFLINE or (Path(root) / INFO_FILE).exists():
        return
    reason = f"{INFO_FILE} is missing in it" if Path(root).is_dir() else "the folder does not exist"
    raise FileNotFoundError(
        f"{option} is {root}, but there is no dataset: {reason}. Check the spelling. (HF_HUB_OFFLINE is set, "
        "so that nothing can be downloaded into it.)"
    )


def metadata_digest(repo_id: str, root: str | Path | None) -> str | None:
    """SHA-256 of a dataset's metadata, which hold the statistics of all its frames, in hexadecimal.

    Args:
        repo_id: Id of the dataset.
        root: Folder of the dataset; None is LeRobot's cache.

    Returns:
        The digest; None if the dataset has not been downloaded yet.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if not (folder / INFO_FILE).is_file():
        return None
    digest = hashlib.sha256()
    for path in sorted(path for path in (folder / INFO_FILE.parent).rglob("*") if path.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()
