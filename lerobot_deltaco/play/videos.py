"""Files of the videos that the page shows: its own, in a temporary folder, for an hour."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from pathlib import Path

LIFETIME = 3600  # s


class VideoFiles:
    """Videos in a temporary folder, from which Gradio takes those that it serves into its own cache.

    The folder goes when the page ends.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="deltaco-play-")

    def put(self, video: bytes) -> str:
        """The file of a video, which is named by what is in it.

        Args:
            video: An MP4 file's contents.
        """
        folder = Path(self._folder.name)
        self._forget(folder)
        path = folder / f"{hashlib.sha256(video).hexdigest()}.mp4"
        try:
            os.utime(path)
        except FileNotFoundError:  # it is new, or was forgotten
            number, part = tempfile.mkstemp(suffix=".part", dir=folder)
            with os.fdopen(number, "wb") as file:
                file.write(video)
            Path(part).rename(path)
        return str(path)

    @staticmethod
    def _forget(folder: Path) -> None:
        """Deletes what nobody has looked at for long."""
        oldest = time.time() - LIFETIME
        for path in folder.iterdir():
            try:
                if path.stat().st_mtime < oldest:
                    path.unlink()
            except FileNotFoundError:  # another user's visit was quicker
                continue
