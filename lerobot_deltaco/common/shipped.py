"""Folders that come with the project: inside the package in an installed wheel, beside it in a clone."""

from __future__ import annotations

from pathlib import Path


def shipped_folder(inside: str, beside: str) -> Path:
    """A folder that comes with the project.

    Args:
        inside: Its name in the package, in an installed wheel.
        beside: Its name next to the package, in a clone.
    """
    package = Path(__file__).parents[1]
    installed = package / inside
    return installed if installed.is_dir() else package.parent / beside
