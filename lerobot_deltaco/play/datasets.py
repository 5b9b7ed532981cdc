"""Datasets whose episodes are demonstrations. Nothing is read from anywhere but the dataset itself.

LeRobot downloads what a folder lacks, reads files wherever a dataset's `info.json` says, and opens paths and
addresses that its images name: those of the data, and of any column of its metadata that declares itself as
images. So a dataset is checked here before LeRobot reads its episodes.
"""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from gym_deltaco.sheets import enlarged
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.play.demonstrations import Demonstration, check_number, demonstration_of
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.sources import DATASET, find_folder, read_json
from lerobot_deltaco.policy.dataset_folders import INFO_FILE
from lerobot_deltaco.policy.demonstrations import check_robot_features, shorter_side, to_uint8

logger = logging.getLogger(__name__)

MAX_FRAMES = 1000  # of an episode
# Types of columns that hold what is in them.
_PLAIN_TYPES = {"Value", "Sequence", "List", "LargeList"}
_VIDEO_SIZE = 192  # px, at least, of the longer side of a video
# No repository can have this name, so that LeRobot cannot download what a folder lacks.
_NO_REPOSITORY = "a/local/folder"


class EpisodeDataset:
    """A LeRobotDataset. Images are read when an episode is chosen, so it may be of any size.

    Args:
        name: Folder of the dataset, or its repository's id on the Hugging Face Hub.
        roots: Folders in which datasets may lie, at any depth.
        is_hub_allowed: Whether datasets may be downloaded.

    Attributes:
        counts: Number of episodes by task string.

    Raises:
        PlayError: There is none, it may not be loaded, or it is not a LeRobotDataset.
    """

    def __init__(self, name: str, roots: Sequence[Path], is_hub_allowed: bool) -> None:
        folder = find_folder(name, DATASET, roots, is_hub_allowed)
        self._name = name.strip()
        _check_info(folder, self._name)
        _check_columns(folder, self._name)
        try:
            self._dataset = LeRobotDataset(_NO_REPOSITORY, root=folder, return_uint8=True)
            _check_images(self._dataset, self._name)
            episodes = self._dataset.meta.episodes.select_columns(
                ["tasks", "dataset_from_index", "dataset_to_index"]
            )[:]
            self._tasks = [str(tasks[0]) for tasks in episodes["tasks"]]
            self._spans = [
                (int(start), int(end))
                for start, end in zip(
                    episodes["dataset_from_index"], episodes["dataset_to_index"], strict=True
                )
            ]
        except PlayError:
            raise
        # Whatever is wrong with files that come from anywhere: the page says so and goes on.
        except Exception as error:
            raise self._unreadable(error) from error
        if not self._tasks:
            raise PlayError(f"The dataset {self._name!r} has no episodes.")
        self._rows: dict[str, list[int]] = defaultdict(list)
        for episode, task in enumerate(self._tasks):
            self._rows[task].append(episode)
        self.counts = {task: len(rows) for task, rows in self._rows.items()}

    def check_fits(self, config: DeltacoConfig) -> None:
        """Checks that the episodes can be demonstrations for a policy.

        Raises:
            PlayError: The policy takes none, or expects another camera, state or action.
        """
        if not config.uses_demo:
            raise PlayError(f"This checkpoint takes no demonstrations: its method is {config.method}.")
        camera, meta = config.cameras[0], self._dataset.meta
        if camera not in meta.camera_keys:
            raise PlayError(
                f"The dataset {self._name!r} has no camera {camera!r}, which the checkpoint expects. Its "
                f"cameras are {', '.join(meta.camera_keys) or 'none'}."
            )
        side = shorter_side(meta.features[camera]["shape"])
        if config.goal_image_size is not None and side < config.goal_image_size:
            raise PlayError(
                f"The dataset {self._name!r} has images of {side} pixels. The checkpoint finds goals in "
                f"images of {config.goal_image_size}."
            )
        if not _needs_robot(config):
            return
        features = {OBS_STATE: config.robot_state_feature, ACTION: config.action_feature}
        expected = {name: feature.shape for name, feature in features.items() if feature is not None}
        try:
            check_robot_features(self._name, meta.features, expected)
        except ValueError as error:
            raise PlayError(str(error)) from None

    def demonstration(self, task: str, number: int, config: DeltacoConfig) -> Demonstration:
        """An episode as a demonstration for a policy.

        Args:
            task: Task string.
            number: Number of the episode among those of the task, from 1.
            config: The policy's.

        Raises:
            PlayError: There is none, or it does not fit the policy.
        """
        check_number(self.counts, task, number, "dataset")
        self.check_fits(config)
        episode = self._rows[task][number - 1]
        start, end = self._spans[episode]
        if not 2 <= end - start <= MAX_FRAMES:
            raise PlayError(
                f"A demonstration has 2 to {MAX_FRAMES} frames. Episode {episode} has {end - start}."
            )
        try:
            items = [self._dataset[index] for index in range(start, end)]
            images = to_uint8(torch.stack([item[config.cameras[0]] for item in items]))  # (frames, 3, H, W)
            robot = self._robot(items, config)
        except Exception as error:
            raise self._unreadable(error) from error
        title = f"{task} ({number} of {self.counts[task]} in {self._name})"
        video_images = _video_images(images)
        return demonstration_of(title, images, robot, config, video_images, round(self._dataset.meta.fps))

    @staticmethod
    def _robot(items: Sequence[dict[str, Any]], config: DeltacoConfig) -> tuple[Tensor, Tensor] | None:
        """States of the robot and its gripper's commands, greater for more open, if needed."""
        if not _needs_robot(config):
            return None
        states, actions = (
            torch.stack([item[name] for item in items]).float() for name in (OBS_STATE, ACTION)
        )
        return states, config.gripper_opening(actions)

    def _unreadable(self, error: Exception) -> PlayError:
        # The details, which name files of this machine, are for the terminal.
        logger.warning("The dataset %r cannot be read.", self._name, exc_info=error)
        return PlayError(
            f"The dataset {self._name!r} cannot be read: files are missing, damaged or of another version of "
            "LeRobot."
        )


def _needs_robot(config: DeltacoConfig) -> bool:
    """Whether a policy needs the robot's state at the grasp of a demonstration."""
    return config.locates_goals and config.grasp_depth and config.gripper_index is not None


def _check_info(folder: Path, name: str) -> None:
    """Checks that a folder holds a dataset whose files are all within it.

    Raises:
        PlayError: It does not.
    """
    if not (folder / INFO_FILE).is_file():
        raise PlayError(
            f"{name!r} is not a LeRobotDataset: {INFO_FILE} is missing. Enter the folder that has `meta`, "
            "`data` and, for videos, `videos` in it."
        )
    info = read_json(folder / INFO_FILE, name)
    features = info.get("features")
    if not isinstance(features, dict) or not all(isinstance(value, dict) for value in features.values()):
        raise PlayError(f"{name!r} is not a LeRobotDataset: {INFO_FILE} has no features.")
    for option, valid in (("data_path", DEFAULT_DATA_PATH), ("video_path", DEFAULT_VIDEO_PATH)):
        if info.get(option) not in (None, valid):
            raise PlayError(f"{name!r} is refused: its `{option}` is {info[option]!r}, not {valid!r}.")
    odd = next((key for key in features if "/" in key or "\\" in key or ".." in key), None)
    if odd is not None:
        raise PlayError(f"{name!r} is refused: the feature {odd!r} may lead out of the dataset.")


def _check_columns(folder: Path, name: str) -> None:
    """Checks that no column of the metadata declares itself as images or other files, which would be opened.

    Raises:
        PlayError: One does, or a file cannot be read.
    """
    for path in sorted((folder / "meta").rglob("*.parquet")):
        file = path.relative_to(folder).as_posix()
        try:
            declared = json.loads((pq.read_schema(path).metadata or {}).get(b"huggingface", b"{}"))
        except (OSError, ValueError, RecursionError, pa.ArrowException) as error:
            raise PlayError(f"{name!r} is damaged: {file} cannot be read.") from error
        odd = sorted(_declared_types(declared) - _PLAIN_TYPES)
        if odd:
            raise PlayError(f"{name!r} is refused: {file} has a column of the type {odd[0]!r}.")


def _declared_types(declared: Any) -> set[str]:
    """The types of columns anywhere in a declaration of them."""
    if isinstance(declared, list):
        return set().union(*map(_declared_types, declared))
    if not isinstance(declared, dict):
        return set()
    own = {str(declared["_type"])} if "_type" in declared else set()
    return own.union(*map(_declared_types, declared.values()))


def _check_images(dataset: LeRobotDataset, name: str) -> None:
    """Checks that the images are in the dataset's files, rather than named by paths or addresses.

    Raises:
        PlayError: They are not.
    """
    for key, feature in dataset.meta.features.items():
        if feature.get("dtype") == "image":
            column = dataset.hf_dataset.data.column(key)
            if sum(pc.struct_field(chunk, "bytes").null_count for chunk in column.chunks):
                raise PlayError(f"{name!r} is refused: some images of {key!r} lie in other files.")


def _video_images(images: Tensor) -> list[np.ndarray]:
    """Images (frames, 3, H, W) for people: small ones with visible pixels, and of even height and width."""
    height, width = images.shape[-2:]
    factor = 1
    if max(height, width) < _VIDEO_SIZE:
        factor = 2 * -(-_VIDEO_SIZE // (2 * max(height, width)))
    images = images[..., : height * factor // 2 * 2 // factor, : width * factor // 2 * 2 // factor]
    return [np.asarray(enlarged(image, factor)) for image in images.permute(0, 2, 3, 1).numpy()]
