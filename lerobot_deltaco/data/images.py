"""Images of a LeRobotDataset, stored as files or as videos: decoded in order, by several threads."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.video_utils import decode_video_frames
from PIL import Image
from torch import Tensor
from torchvision.io import ImageReadMode, decode_image

from lerobot_deltaco.data.reading import column, decoding, frame_name
from lerobot_deltaco.errors import UserError

_RESIZED_AT_A_TIME = 256
_IMAGES_PER_THREAD = 32
# A video is decoded in runs of frames: from one row to the next if they are close, for decoding starts at a
# keyframe, and not too many, for they are held in memory.
_MAX_GAP, _MAX_RUN = 8, 128


def read_images(dataset: LeRobotDataset, camera: str, rows: Sequence[int]) -> Tensor:
    """Reads images of a dataset, whatever windows of frames it gives.

    Args:
        dataset: The dataset.
        camera: The dataset's name of the camera.
        rows: Rows of the images, ascending within an episode.

    Returns:
        (images, 3, H, W) uint8.

    Raises:
        ValueError: An image cannot be decoded; the message names the frame and its file.
    """
    is_video = camera in dataset.meta.video_keys
    runs = _runs(dataset, rows) if is_video else _parts(rows)
    read: Callable[[LeRobotDataset, str, list[int]], Tensor] = _video_frames if is_video else _stored_images
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
        return torch.cat(list(threads.map(lambda run: read(dataset, camera, run), runs)))


def _parts(rows: Sequence[int]) -> list[list[int]]:
    return [list(rows[n : n + _IMAGES_PER_THREAD]) for n in range(0, len(rows), _IMAGES_PER_THREAD)]


def _runs(dataset: LeRobotDataset, rows: Sequence[int]) -> list[list[int]]:
    """Splits rows where the episode ends, or the next one is far away."""
    episodes = column(dataset, "episode_index").reshape(-1)
    runs: list[list[int]] = []
    for row in rows:
        run = runs[-1] if runs else []
        is_next = bool(run) and episodes[run[-1]] == episodes[row] and 0 <= row - run[-1] <= _MAX_GAP
        if is_next and len(run) < _MAX_RUN:
            run.append(row)
        else:
            runs.append([row])
    return runs


def _stored_images(dataset: LeRobotDataset, camera: str, rows: list[int]) -> Tensor:
    """Decodes stored files, (rows, 3, H, W) uint8."""
    files = dataset.hf_dataset.with_format("arrow")[rows][camera].to_pylist()
    shape = dataset.meta.features[camera]["shape"]
    images = []
    for row, file in zip(rows, files, strict=True):
        with decoding(dataset, row, camera):
            image = _decoded(file["bytes"])
        if sorted((*image.shape[1:], min(shape))) != sorted(shape):
            raise UserError(
                f"The image {camera} in {frame_name(dataset, row)} has {image.shape[2]} x {image.shape[1]} "
                f"pixels, but by meta/info.json the shape is {shape}. Record the episode again, or leave it "
                "out with --dataset.episodes."
            )
        images.append(image)
    return torch.stack(images)


def _decoded(file: bytes) -> Tensor:
    """Decodes an image, (3, H, W) uint8."""
    try:
        # Unlike Pillow's, this decoder releases the interpreter lock; it supports fewer formats.
        image = decode_image(torch.frombuffer(bytearray(file), dtype=torch.uint8), ImageReadMode.RGB)
    except RuntimeError:
        image = None
    if image is not None and image.dtype == torch.uint8:
        return image
    return torch.from_numpy(np.array(Image.open(io.BytesIO(file)).convert("RGB"))).permute(2, 0, 1)


def _video_frames(dataset: LeRobotDataset, camera: str, rows: list[int]) -> Tensor:
    """Decodes frames of one episode from its video, (rows, 3, H, W) uint8.

    PyAV is installed with LeRobot, decodes in threads, and needs no FFmpeg of the system, as torchcodec does.
    A recorded frame is a frame of the video, whatever time a clock gave it: LeRobot's recording encodes them
    at the dataset's rate.
    """
    episode = int(column(dataset, "episode_index").reshape(-1)[rows[0]])
    start = dataset.meta.episodes[episode][f"videos/{camera}/from_timestamp"]
    times = start + column(dataset, "frame_index").reshape(-1)[rows] / dataset.fps
    path = dataset.meta.root / dataset.meta.get_video_file_path(episode, camera)
    with decoding(dataset, rows[0], camera):
        return decode_video_frames(path, times.tolist(), dataset.tolerance_s, "pyav", return_uint8=True)


def as_uint8(images: Tensor) -> Tensor:
    """Returns images, uint8 or in 0..1, as uint8."""
    return images if images.dtype == torch.uint8 else (images * 255).round().clamp(0, 255).to(torch.uint8)


def resize_images(images: Tensor, size: int) -> Tensor:
    """Resizes images (..., 3, H, W), uint8 or in 0..1, to (..., 3, size, size) uint8."""
    images = as_uint8(images)
    if images.shape[-2:] == (size, size):
        return images
    flat = images.flatten(0, -4)
    # A few at a time, since they are floats meanwhile.
    resized = [
        F.interpolate(part.float(), (size, size), mode="bilinear", antialias=True).round().clamp(0, 255)
        for part in flat.split(_RESIZED_AT_A_TIME)
    ]
    return torch.cat([part.to(torch.uint8) for part in resized]).view(*images.shape[:-2], size, size)
