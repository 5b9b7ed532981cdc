"""Videos of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video
from numpy.typing import NDArray

_HELD_SECONDS = 1.0  # for which the last image of a video stays


def write_episode_video(path: Path, frames: Sequence[NDArray[np.uint8]], fps: int) -> None:
    """Writes an MP4 file that browsers play, and whose end can be seen before it begins again.

    Args:
        path: File to write.
        frames: Images, (H, W, 3) each, of even height and width.
        fps: Frames per second.
    """
    images = list(frames)
    write_video(path, images + images[-1:] * round(_HELD_SECONDS * fps), fps)
