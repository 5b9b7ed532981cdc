"""The frames of a LeRobotDataset in memory: decoded once, gathered by index in whole batches."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import get_delta_indices
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map
from torchvision.io import ImageReadMode, decode_image
from tqdm import tqdm

from lerobot_deltaco.data.demonstrations import (
    TARGET_OBJECT,
    DemonstrationBank,
    RobotData,
    as_uint8,
    kept_frames,
    resize_images,
)
from lerobot_deltaco.data.reading import (
    check_dataset,
    column,
    decoding,
    episode_spans,
    frame_name,
    read_frame,
    source_of,
)
from lerobot_deltaco.errors import UserError

# Number of rows decoded at a time, and number of these that a thread takes at a time.
_CHUNK, _PART = 1024, 32
_MEMORY_FRACTION = 0.8  # of the free memory, that frames may take


class FramesInMemory(torch.utils.data.Dataset):
    """All frames that a dataset has selected, by their index in it.

    It replaces the dataset in LeRobot's training loop. A batch equals that of LeRobot's data loader,
    including the windows of frames that `delta_timestamps` ask for.

    Args:
        dataset: The dataset; its `episodes` are kept in memory.
        image_size: Height and width to which images are scaled; None for their own.

    Raises:
        MemoryError: The frames do not fit into the memory of this machine.
        UserError: The dataset transforms images when they are read.
    """

    def __init__(self, dataset: LeRobotDataset, image_size: int | None = None) -> None:
        if dataset.image_transforms is not None:
            raise UserError(
                "Frames in memory are decoded once and cannot be transformed at random each time. Leave out "
                "--dataset.image_transforms, or train with `lerobot-train`."
            )
        self._dataset = dataset
        memory_for_frames(dataset, image_size)
        check_dataset(dataset)
        cameras = dataset.meta.camera_keys
        self.columns: dict[str, Tensor] = {}
        self.texts: dict[str, list[str]] = {}
        for name in dataset.hf_dataset.column_names:
            if name in cameras:
                continue
            values = column(dataset, name)
            if values.dtype.kind in "OUS":
                self.texts[name] = [str(value) for value in values]
            else:
                self.columns[name] = torch.from_numpy(values)
        self.task_names = list(dataset.meta.tasks.index)
        self.tasks: NDArray[np.int64] = self.columns["task_index"].reshape(-1).numpy()
        self.spans = episode_spans(dataset)
        first, last = np.array(list(self.spans.values())).T
        # First images of the episodes at their own resolution, where the others are scaled.
        self._first_images: dict[str, Tensor] = {}
        for camera in cameras:
            native: list[Tensor] = []
            self.columns[camera] = _camera_images(dataset, camera, image_size, set(first.tolist()), native)
            if native:
                self._first_images[camera] = torch.stack(native)
        self._first, self._last = (
            torch.from_numpy(np.repeat(rows, last - first + 1)) for rows in (first, last)
        )
        # For each feature with a window of frames: the frames' distances from the sample's frame.
        deltas = get_delta_indices(dataset.delta_timestamps or {}, dataset.fps)
        self._windows = {name: torch.tensor(delta) for name, delta in deltas.items()}
        self.skip(np.zeros(len(self), dtype=bool))

    def skip(self, frames: NDArray[np.bool_]) -> None:
        """Leaves frames out of the windows of others, as if they had not been recorded.

        Args:
            frames: Which frames to leave out, (frames,); the ends of an episode must not be among them.
        """
        self._kept = torch.from_numpy(np.flatnonzero(~frames))  # rows
        # Where a row, or the next one that is kept, is among those.
        self._position = torch.from_numpy(np.cumsum(~frames) - ~frames)

    def __len__(self) -> int:
        return len(self.tasks)

    def __getitem__(self, index: int) -> _Frame:
        return _Frame(self, index)

    def __getitems__(self, indices: Sequence[int]) -> list[_Frame]:
        return [_Frame(self, index) for index in indices]

    def __getattr__(self, name: str) -> Any:
        # LeRobot's loop asks for the metadata, the episodes and the number of frames.
        if "_dataset" not in self.__dict__:  # a copy that is being made
            raise AttributeError(name)
        return getattr(self._dataset, name)

    def batch(self, indices: Sequence[int] | Tensor) -> dict[str, Any]:
        """Returns what LeRobot's data loader would give for some frames, with images as uint8.

        Args:
            indices: Indices of the frames in the dataset, (batch,).

        Returns:
            Every feature, (batch, ...); "task" and other texts as lists. A feature with a window of frames is
            (batch, window, ...), where frames beyond the episode repeat its first or last one, and
            "<feature>_is_pad", (batch, window) bool, says which do.
        """
        rows = torch.as_tensor(indices)
        found: dict[str, Any] = {}
        for name, values in self.columns.items():
            chosen = rows
            if name in self._windows:
                wanted = self._position[rows][:, None] + self._windows[name]  # (batch, window)
                first, last = (self._position[ends[rows]][:, None] for ends in (self._first, self._last))
                inside = wanted.clamp(first, last)
                found[f"{name}_is_pad"] = inside != wanted
                chosen = self._kept[inside]
                if name in self._dataset.meta.video_keys:
                    chosen = chosen.squeeze(1)  # as LeRobot, if the window is one frame
            found[name] = values[chosen]
        for name, texts in self.texts.items():
            found[name] = [texts[row] for row in rows.tolist()]
        found["task"] = [self.task_names[task] for task in self.tasks[rows.numpy()]]
        return found

    def demonstrations(self, camera: str, image_size: int, n_frames: int) -> DemonstrationBank:
        """Returns all episodes as demonstrations.

        Args:
            camera: Key of the images.
            image_size: Height and width to which they are scaled, px.
            n_frames: Number of frames of a demonstration.
        """
        camera = source_of(camera, list(self.columns))
        rows = torch.stack([kept_frames(*span, n_frames) for span in self.spans.values()])
        images = resize_images(self.columns[camera][rows], image_size)  # (episodes, kept, 3, S, S)
        tasks = [self.task_names[self.tasks[first]] for first, _ in self.spans.values()]
        objects = None
        if TARGET_OBJECT in self.columns:
            objects = self.columns[TARGET_OBJECT].reshape(-1)[rows[:, 0]].tolist()
        native = self._first_images.get(camera)
        if native is None and self.columns[camera].shape[-2:] != images.shape[-2:]:
            native = self.columns[camera][rows[:, 0]]
        return DemonstrationBank(images, tasks, list(self.spans), objects, native)

    def robot_data(self, camera: str) -> RobotData | None:
        """Returns the robot's states and actions, and a camera's images; None without states."""
        names = [source_of(name, list(self.columns)) for name in (OBS_STATE, ACTION, camera)]
        if names[0] not in self.columns:
            return None
        states, actions, images = (self.columns[name] for name in names)
        return RobotData(states, actions, list(self.spans.values()), lambda rows: images[rows])


@dataclass
class _Frame:
    """A frame that is gathered with the others of its batch when the data loader collates them."""

    frames: FramesInMemory
    index: int


def _collate(batch: Sequence[_Frame], *, collate_fn_map: Any = None) -> dict[str, Any]:
    return batch[0].frames.batch([frame.index for frame in batch])


default_collate_fn_map[_Frame] = _collate


def memory_for_frames(dataset: LeRobotDataset, image_size: int | None) -> int:
    """Returns the memory that the frames of a dataset take, bytes.

    Raises:
        MemoryError: They do not.
    """
    per_frame = 0
    for name, feature in dataset.meta.features.items():
        n_numbers = int(np.prod(feature["shape"]))
        if name not in dataset.meta.camera_keys:
            per_frame += 8 * n_numbers
        else:
            per_frame += n_numbers if image_size is None else 3 * image_size**2
    needed = per_frame * dataset.num_frames
    allowed = int(psutil.virtual_memory().available * _MEMORY_FRACTION)
    if needed > allowed:
        raise MemoryError(
            f"The {dataset.num_frames:,} frames take {needed / 1e9:.1f} GB of memory, and "
            f"{allowed / 1e9:.1f} GB may be used here. Train on fewer episodes (--dataset.episodes), or with "
            "`lerobot-train`, which reads them from the disk."
        )
    return needed


def _camera_images(
    dataset: LeRobotDataset, camera: str, image_size: int | None, first: set[int], native: list[Tensor]
) -> Tensor:
    """Returns all images of a camera, (frames, 3, H, W) uint8.

    Args:
        dataset: The dataset.
        camera: Key of the images.
        image_size: Height and width to which they are scaled; None for their own.
        first: Rows of the first images of episodes.
        native: If images are scaled, gets those of `first` at their own resolution.
    """
    read = _stored_images if dataset.meta.features[camera]["dtype"] == "image" else _video_images
    n_frames = dataset.num_frames
    images: Tensor | None = None
    with (
        ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads,
        tqdm(total=n_frames, desc=f"Decoding {camera}", unit="frame") as progress,
    ):
        for start in range(0, n_frames, _CHUNK):
            rows = range(start, min(start + _CHUNK, n_frames))
            chunk = read(dataset, camera, rows, threads)
            if image_size is not None and chunk.shape[-2:] != (image_size, image_size):
                native.extend(chunk[row - start].clone() for row in rows if row in first)
                chunk = resize_images(chunk, image_size)
            if images is None:
                images = torch.empty(n_frames, *chunk.shape[1:], dtype=torch.uint8)
            images[rows.start : rows.stop] = chunk
            progress.update(len(chunk))
    assert images is not None
    return images


def _stored_images(dataset: LeRobotDataset, camera: str, rows: range, threads: ThreadPoolExecutor) -> Tensor:
    """Decodes the stored files of an `image` feature, (rows, 3, H, W) uint8."""
    files = dataset.hf_dataset.with_format("arrow")[rows.start : rows.stop][camera].to_pylist()
    shape = dataset.meta.features[camera]["shape"]

    def decode(row: int) -> Tensor:
        with decoding(dataset, row, camera):
            image = _decoded(files[row - rows.start]["bytes"])
        if sorted((*image.shape[1:], min(shape))) != sorted(shape):
            raise UserError(
                f"The image {camera} in {frame_name(dataset, row)} has {image.shape[2]} x {image.shape[1]} "
                f"pixels, but by meta/info.json the shape is {shape}. Record the episode again, or leave it "
                "out with --dataset.episodes."
            )
        return image

    parts = [rows[first : first + _PART] for first in range(0, len(rows), _PART)]
    return torch.cat(list(threads.map(lambda part: torch.stack([decode(row) for row in part]), parts)))


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


def _video_images(dataset: LeRobotDataset, camera: str, rows: range, _: ThreadPoolExecutor) -> Tensor:
    """Reads images of a `video` feature, (rows, 3, H, W) uint8; threads must not share its decoder."""
    with patch.object(dataset.reader, "delta_indices", None):  # single frames instead of windows
        return torch.stack([as_uint8(read_frame(dataset, row, camera)[camera]) for row in rows])
