"""Finds missing dataset folders before LeRobot makes them.

Given a folder without a dataset, LeRobot makes the folder and downloads the dataset into it. Without a
network, a mistyped folder ends in a network error and an empty folder of that name.
"""

from __future__ import annotations

from pathlib import Path

from huggingface_hub import constants

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
