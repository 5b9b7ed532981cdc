"""Videos of episodes."""

from __future__ import annotations

import io
from collections.abc import Sequence

import av
import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.pages.html import data_uri

VIDEO_FPS = 8  # a third of the nominal frame rate, which is too fast to watch
_HELD_SECONDS = 1.0  # for which the last frame of a video stays


def video_uri(frames: Sequence[NDArray[np.uint8]]) -> str:
    """Returns a video of images (H, W, 3) as a data URI."""
    return data_uri("video/mp4", encode_video(frames))


def encode_video(frames: Sequence[NDArray[np.uint8]], fps: int = VIDEO_FPS) -> bytes:
    """Encodes an H.264 video in MP4, which browsers play. The last frame stays for a second.

    Args:
        frames: Images, (H, W, 3); an odd row or column is cut off.
        fps: Frames per second.

    Returns:
        The content of the file.
    """
    content = io.BytesIO()
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])
    with av.open(content, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for image in (*frames, *[frames[-1]] * round(_HELD_SECONDS * fps)):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return content.getvalue()
