"""The frames of a LeRobotDataset in memory: decoded once, gathered by index in whole batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import get_delta_indices
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.data.images import read_images, resize_images
from lerobot_deltaco.data.reading import (
    check_dataset,
    column,
    dimension_names,
    episode_spans,
)
from lerobot_deltaco.errors import UserError

_CHUNK = 1024  # rows decoded at a time
_MEMORY_FRACTION = 0.8  # of the free memory, that frames may take


class FramesInMemory(torch.utils.data.Dataset):
    """All frames that a dataset has selected, by their index in it.

    It replaces the dataset in LeRobot's training loop. A batch equals that of LeRobot's data loader,
    including the windows of frames that `delta_timestamps` ask for. For a policy, it is `Episodes`.

    Args:
        dataset: The dataset; its `episodes` are kept in memory.
        image_size: Height and width to which images are scaled; None for their own.
        rename_map: A policy's names of features, by the dataset's names.

    Raises:
        MemoryError: The frames do not fit into the memory of this machine.
        ValueError: The dataset transforms images when they are read.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        image_size: int | None = None,
        rename_map: Mapping[str, str] | None = None,
    ) -> None:
        if dataset.image_transforms is not None:
            raise UserError(
                "Frames in memory are decoded once and cannot be transformed at random each time. Leave out "
                "--dataset.image_transforms, or train with `lerobot-train`."
            )
        self._dataset = dataset
        self._names = {new: old for old, new in (rename_map or {}).items()}
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
        # First images of the episodes at their own resolution, where the others are scaled, and their places.
        self._first_rows = {row: n for n, row in enumerate(first.tolist())}
        self._first_images: dict[str, Tensor] = {}
        for camera in cameras:
            first_images: list[Tensor] = []
            self.columns[camera] = _camera_images(
                dataset, camera, image_size, set(first.tolist()), first_images
            )
            if first_images:
                self._first_images[camera] = torch.stack(first_images)
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

    def __getitem__(self, index: int) -> int:
        """Returns the index: LeRobot's data loader carries indices, of which `batch` makes batches."""
        return index

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

    # As `Episodes` of a policy

    def episode_tasks(self) -> list[str]:
        """Returns the task string of each episode."""
        return [self.task_names[self.tasks[first]] for first, _ in self.spans.values()]

    def values(self, feature: str) -> Tensor | None:
        """Returns the numbers of a feature in all rows, (rows, ...); None without that feature."""
        return self.columns.get(self._source(feature))

    def names(self, feature: str) -> list[str]:
        """Returns the names of a feature's dimensions; none if the dataset does not name them."""
        return dimension_names(self.meta.features.get(self._source(feature), {}), feature)

    def images(self, camera: str, rows: Sequence[int], size: int | None) -> Tensor:
        """Returns images of a camera, (images, 3, H, W) uint8. See `Episodes.images`."""
        name = self._source(camera)
        if name not in self.meta.camera_keys:
            raise UserError(
                f"{self.repo_id} has no camera {camera!r}, only {', '.join(self.meta.camera_keys)}. If it "
                "has another name there, pass --rename_map."
            )
        if size is None and name in self._first_images:
            return self._first_images[name][[self._first_rows[row] for row in rows]]
        images = self.columns[name][torch.as_tensor(rows)]
        return images if size is None else resize_images(images, size)

    def _source(self, feature: str) -> str:
        """Returns the dataset's name of a policy's feature."""
        return feature if feature in self.columns else self._names.get(feature, feature)


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
    dataset: LeRobotDataset, camera: str, image_size: int | None, first: set[int], first_images: list[Tensor]
) -> Tensor:
    """Returns all images of a camera, (frames, 3, H, W) uint8.

    Args:
        dataset: The dataset.
        camera: Key of the images.
        image_size: Height and width to which they are scaled; None for their own.
        first: Rows of the first images of episodes.
        first_images: If images are scaled, gets those of `first` at their own resolution.
    """
    n_frames = dataset.num_frames
    images: Tensor | None = None
    with tqdm(total=n_frames, desc=f"Decoding {camera}", unit="frame") as progress:
        for start in range(0, n_frames, _CHUNK):
            rows = range(start, min(start + _CHUNK, n_frames))
            chunk = read_images(dataset, camera, rows)
            if image_size is not None and chunk.shape[-2:] != (image_size, image_size):
                first_images.extend(chunk[row - start].clone() for row in rows if row in first)
                chunk = resize_images(chunk, image_size)
            if images is None:
                images = torch.empty(n_frames, *chunk.shape[1:], dtype=torch.uint8)
            images[rows.start : rows.stop] = chunk
            progress.update(len(chunk))
    assert images is not None
    return images
