"""The frames of a LeRobotDataset in memory: decoded once, fetched by index in whole batches."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import psutil
import pyarrow as pa
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import get_delta_indices
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torchvision.io import ImageReadMode, decode_image
from tqdm import tqdm

from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.lerobot_internals import single_frames
from lerobot_deltaco.policy.demonstrations import (
    DemonstrationSet,
    RobotData,
    kept_frame_indices,
    resize_images,
    shorter_side,
    to_uint8,
)
from lerobot_deltaco.policy.goals.keyframes import release_frames

# Rows that are decoded at a time, and those of them that a thread takes at a time.
CHUNK, PART = 1024, 32
# Of a memory's free bytes, the share that frames may take: the rest is for training.
GREATEST_SHARE = {"cuda": 0.6, "cpu": 0.8}


class FramesInMemory:
    """All frames that a dataset has selected, by their place in it.

    A batch has the windows of frames that the dataset's `delta_timestamps` ask for, as LeRobot's has.

    Args:
        dataset: The dataset; its `episodes` are those that are held.
        device: Device of the batches, and of the frames if they fit.
        image_size: Height and width to which images are scaled, None for their own.
        may_use_gpu: Whether frames may be held on a GPU, next to a policy that needs little of its memory.
        reserved_bytes: Memory that is left free beside the frames, for larger demonstrations.

    Raises:
        MemoryError: The frames do not fit into the memory of this machine.
        ValueError: The dataset changes images when they are read.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        device: torch.device | str = "cpu",
        image_size: int | None = None,
        may_use_gpu: bool = True,
        reserved_bytes: int = 0,
    ) -> None:
        if dataset.image_transforms is not None:
            raise ValueError(
                "Frames in memory are decoded once and cannot be transformed at random each time. Leave out "
                "--dataset.image_transforms (`--policy.type=deltaco` has `crop_padding`), or train with "
                "`lerobot-train`."
            )
        self.device, self._dataset = torch.device(device), dataset
        self.held_on = self._choose_device(needed_bytes(dataset, image_size) + reserved_bytes, may_use_gpu)
        cameras = dataset.meta.camera_keys
        self.columns: dict[str, Tensor] = {}
        self.texts: dict[str, list[str]] = {}
        for name in dataset.hf_dataset.column_names:
            if name in cameras:
                continue
            values = _column(dataset, name)
            if values.dtype.kind in "OUS":
                self.texts[name] = [str(value) for value in values]
            else:
                self.columns[name] = torch.from_numpy(values).to(self.held_on)
        self.task_names = list(dataset.meta.tasks.sort_values("task_index").index)
        self._task_of = self.columns["task_index"].reshape(-1).tolist()
        for camera in cameras:
            self.columns[camera] = _camera_images(dataset, camera, image_size, self.held_on)
        # Where each episode lies here: rows of an episode follow one another.
        episodes = self.columns["episode_index"].reshape(-1).cpu().numpy()
        numbers, first = np.unique(episodes, return_index=True)
        last = len(episodes) - 1 - np.unique(episodes[::-1], return_index=True)[1]
        self.spans = {int(n): (int(a), int(b)) for n, a, b in zip(numbers, first, last, strict=True)}
        self._first, self._last = (
            torch.from_numpy(rows[np.searchsorted(numbers, episodes)]).to(self.held_on)
            for rows in (first, last)
        )
        # Of each feature of which a sample has a window of frames: their distances from the sample's frame.
        self._videos = set(dataset.meta.video_keys)
        deltas = get_delta_indices(dataset.delta_timestamps or {}, dataset.fps)
        self._windows = {name: torch.tensor(delta, device=self.held_on) for name, delta in deltas.items()}

    def __len__(self) -> int:
        return len(self._task_of)

    @property
    def tasks(self) -> np.ndarray:
        """The task of each frame, (frames,) int64, as `task_index`."""
        return np.array(self._task_of)

    def batch(self, indices: Tensor) -> dict[str, Any]:
        """What LeRobot's data loader would give for these frames, with images as uint8.

        Args:
            indices: Places of frames in the dataset, (batch,) int64.

        Returns:
            Every feature, (batch, ...), on the device; "task" and other texts as lists. A feature with a
            window of frames is (batch, window, ...), where frames beyond the episode repeat its first or
            last one, and "<feature>_is_pad", (batch, window) bool, says which do.
        """
        places = indices.tolist()
        rows = indices.to(self.held_on)
        found: dict[str, Any] = {}
        for name, values in self.columns.items():
            chosen = rows
            if name in self._windows:
                wanted = rows[:, None] + self._windows[name]  # (batch, window)
                chosen = wanted.clamp(self._first[rows][:, None], self._last[rows][:, None])
                found[f"{name}_is_pad"] = (chosen != wanted).to(self.device, non_blocking=True)
                if name in self._videos:
                    chosen = chosen.squeeze(1)  # as LeRobot, if the window is one frame
            found[name] = values[chosen].to(self.device, non_blocking=True)
        for name, texts in self.texts.items():
            found[name] = [texts[place] for place in places]
        found["task"] = [self.task_names[self._task_of[place]] for place in places]
        return found

    def demonstrations(self, camera: str, image_size: int, n_demo_frames: int) -> DemonstrationSet:
        """All episodes as demonstrations.

        Args:
            camera: Key of the images.
            image_size: Height and width to which they are scaled.
            n_demo_frames: Frames of a demonstration.
        """
        episodes = list(self.spans)
        rows = torch.stack([kept_frame_indices(*self.spans[episode], n_demo_frames) for episode in episodes])
        images = self.columns[camera]
        stored_side = shorter_side(self._dataset.meta.features[camera]["shape"])
        if image_size > min(images.shape[-2:]) < stored_side:
            # They are larger in the dataset than they are held.
            images = _camera_images(
                self._dataset, camera, image_size, self.held_on, rows.flatten().tolist(), "demonstrations, "
            )
            images = images.unflatten(0, rows.shape)
        else:
            images = images[rows.to(self.held_on)]  # (episodes, kept, 3, h, w)
        tasks = [self.task_names[self._task_of[self.spans[episode][0]]] for episode in episodes]
        return DemonstrationSet(resize_images(images, image_size), tasks, episodes).to(self.device)

    def robot_data(self) -> RobotData:
        """The robot's states and actions in all frames."""
        return RobotData(self.columns[OBS_STATE], self.columns[ACTION], list(self.spans.values()))

    def until_release(self, gripper: Tensor, n_after: int) -> NDArray[np.bool_]:
        """Which frames come before the gripper's last opening in their episode, or soon after it.

        Args:
            gripper: Commands to the gripper in all frames, greater for more open, (frames,).
            n_after: Number of frames after the opening that count as well.

        Returns:
            (frames,) bool. All frames of an episode without an opening count.
        """
        spans = list(self.spans.values())
        use = np.ones(len(self), dtype=bool)
        for release, (_, last) in zip(release_frames(gripper, spans), spans, strict=True):
            if release is not None:
                use[release + 1 + n_after : last + 1] = False
        return use

    def _choose_device(self, needed: int, may_use_gpu: bool) -> torch.device:
        allowed = {"cpu": int(psutil.virtual_memory().available * GREATEST_SHARE["cpu"])}
        if self.device.type == "cuda" and may_use_gpu:
            allowed["cuda"] = int(torch.cuda.mem_get_info(self.device)[0] * GREATEST_SHARE["cuda"])
        if needed <= allowed.get(self.device.type, 0):
            return self.device
        if needed <= allowed["cpu"]:
            return torch.device("cpu")
        raise MemoryError(
            f"The {self._dataset.num_frames:,} frames take {needed / 1e9:.1f} GB of memory, and "
            f"{allowed['cpu'] / 1e9:.1f} GB may be used here. Train on fewer episodes (--dataset.episodes), "
            "or with `lerobot-train`, which reads them from the disk."
        )


def needed_bytes(dataset: LeRobotDataset, image_size: int | None = None) -> int:
    """Bytes that the frames of a dataset take, images as uint8."""
    per_frame = 0
    for name, feature in dataset.meta.features.items():
        if name not in dataset.meta.camera_keys:
            per_frame += 8 * int(np.prod(feature["shape"]))
        elif image_size is None:
            per_frame += int(np.prod(feature["shape"]))
        else:
            per_frame += 3 * image_size**2
    return per_frame * dataset.num_frames


def _column(dataset: LeRobotDataset, name: str) -> NDArray[Any]:
    """All values of a feature, (frames, ...)."""
    table = dataset.hf_dataset.select_columns([name])
    values = table.with_format("arrow")[:][name].combine_chunks()
    array = _flat_numbers(values)
    if array is None:
        array = np.array(table.with_format("numpy")[:][name])
    elif len(array) != len(values):
        array = array.reshape(len(values), *dataset.meta.features[name]["shape"])
    elif pa.types.is_nested(values.type):
        array = array[:, None]
    # As LeRobot, which makes tensors of Python's numbers.
    if np.issubdtype(array.dtype, np.floating):
        return array.astype(np.float32)
    return array.astype(np.int64) if np.issubdtype(array.dtype, np.integer) else array.copy()


def _flat_numbers(values: pa.Array) -> NDArray[Any] | None:
    """Numbers and vectors of numbers, one after another; None of what is something else.

    `datasets` makes arrays row by row, and takes ten seconds for a hundred thousand.
    """
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        if values.null_count:
            return None
        values = values.flatten()
    is_number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
    if values.null_count or not (is_number or pa.types.is_boolean(values.type)):
        return None
    return values.to_numpy(zero_copy_only=False)


def _camera_images(
    dataset: LeRobotDataset,
    camera: str,
    image_size: int | None,
    device: torch.device,
    wanted: Sequence[int] | None = None,
    what: str = "",
) -> Tensor:
    """Images of a camera, (frames, 3, H, W) uint8, of the wanted rows of a dataset or of all."""
    is_image = dataset.meta.features[camera]["dtype"] == "image"
    read = _stored_images(dataset, camera) if is_image else _read_images(dataset, camera)
    wanted = range(dataset.num_frames) if wanted is None else wanted
    n_frames = len(wanted)
    images: Tensor | None = None
    with (
        ThreadPoolExecutor(available_cores()) as threads,
        tqdm(total=n_frames, desc=f"Decoding {what}{camera}", unit="frame") as progress,
    ):
        for start in range(0, n_frames, CHUNK):
            rows = wanted[start : start + CHUNK]
            parts = [range(first, min(first + PART, len(rows))) for first in range(0, len(rows), PART)]
            chunk = torch.cat(list(threads.map(read(rows), parts)))
            if image_size is not None:
                chunk = resize_images(chunk, image_size)
            if images is None:
                images = torch.empty(n_frames, *chunk.shape[1:], dtype=torch.uint8, device=device)
            images[start : start + len(rows)] = chunk.to(device)
            progress.update(len(rows))
    assert images is not None
    return images


# For rows of a dataset, a function that gives the images of some of them, (images, 3, H, W) uint8.
Reader = Callable[[Sequence[int]], Callable[[range], Tensor]]


def _stored_images(dataset: LeRobotDataset, camera: str) -> Reader:
    """Reads images of an `image` feature: the stored files are decoded."""
    table = dataset.hf_dataset.with_format("arrow")

    def read(rows: Sequence[int]) -> Callable[[range], Tensor]:
        chosen = slice(rows.start, rows.stop) if isinstance(rows, range) else list(rows)
        files = table[chosen][camera].to_pylist()

        return lambda part: torch.stack([decoded(files[number]["bytes"]) for number in part])

    return read


def decoded(file: bytes) -> Tensor:
    """The image in a file, (3, H, W) uint8."""
    try:
        # Unlike Pillow's, this decoder leaves Python to the other threads; it knows fewer formats.
        image = decode_image(torch.frombuffer(bytearray(file), dtype=torch.uint8), ImageReadMode.RGB)
    except RuntimeError:
        image = None
    if image is not None and image.dtype == torch.uint8:
        return image
    return torch.from_numpy(np.array(Image.open(io.BytesIO(file)).convert("RGB"))).permute(2, 0, 1)


def _read_images(dataset: LeRobotDataset, camera: str) -> Reader:
    """Reads images of a `video` feature, as LeRobot does."""

    def read(rows: Sequence[int]) -> Callable[[range], Tensor]:
        # One after another: a decoder is not to be shared by threads.
        with single_frames(dataset):
            images = [to_uint8(dataset[row][camera]) for row in rows]
        return lambda part: torch.stack([images[number] for number in part])

    return read
