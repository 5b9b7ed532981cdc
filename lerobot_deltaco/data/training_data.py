"""The road from the episodes of a LeRobotDataset to what a policy learns from before its first step.

    LeRobotDataset -> DatasetEpisodes --+
                                        +--> TrainingData: demonstrations, states, actions, grasps
    FramesInMemory ---------------------+

`lerobot-train` reads the episodes from the dataset, `deltaco train` from the frames that it keeps in memory.
Demonstrations for evaluation take the same road.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.data.demonstrations import DemonstrationBank, RobotData, kept_frames
from lerobot_deltaco.data.grasps import GraspStates, find_grasp_states
from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.data.images import read_images, resize_images
from lerobot_deltaco.data.reading import check_episode_numbers, column, dimension_names, episode_spans
from lerobot_deltaco.errors import UserError

# Index of the object that an episode moves, in datasets of the benchmark.
TARGET_OBJECT = "benchmark.target_object"
_EPISODES_AT_A_TIME = 64


class Episodes(Protocol):
    """Episodes under the feature names of a policy, wherever they are stored.

    Attributes:
        repo_id: Repository id of their dataset, for messages.
        spans: First and last row of each episode, by the episode's index in the dataset.
    """

    repo_id: str
    spans: dict[int, tuple[int, int]]

    def episode_tasks(self) -> list[str]:
        """Returns the task string of each episode."""

    def values(self, feature: str) -> Tensor | None:
        """Returns the numbers of a feature in all rows, (rows, ...); None without that feature."""

    def names(self, feature: str) -> list[str]:
        """Returns the names of a feature's dimensions; none if the dataset does not name them."""

    def images(self, camera: str, rows: Sequence[int], size: int | None) -> Tensor:
        """Returns images of a camera, (images, 3, H, W) uint8.

        Args:
            camera: The policy's name of the camera.
            rows: Rows of the images.
            size: Height and width to which they are scaled, px; None for their own, which may be known for
                the first rows of episodes only.

        Raises:
            ValueError: There is no such camera.
        """


class DatasetEpisodes:
    """Episodes of a LeRobotDataset, read when they are asked for. See `Episodes`.

    Args:
        dataset: The dataset.
        episodes: Indices of the episodes; None for all that the dataset has selected.
        rename_map: The policy's names of features, by the dataset's names.

    Raises:
        ValueError: The dataset has no such episode.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        episodes: Sequence[int] | None = None,
        rename_map: Mapping[str, str] | None = None,
    ) -> None:
        self.repo_id, self._dataset = dataset.repo_id, dataset
        self._names = {new: old for old, new in (rename_map or {}).items()}
        self.spans = episode_spans(dataset)
        if episodes is not None:
            check_episode_numbers(dataset.repo_id, dataset.meta.total_episodes, episodes)
            self.spans = {episode: self.spans[episode] for episode in episodes}

    def episode_tasks(self) -> list[str]:
        """Returns the task string of each episode."""
        names = self._dataset.meta.tasks.index
        tasks = column(self._dataset, "task_index").reshape(-1)
        return [names[tasks[first]] for first, _ in self.spans.values()]

    def values(self, feature: str) -> Tensor | None:
        """Returns the numbers of a feature in all rows, (rows, ...); None without that feature."""
        name = self._source(feature, self._dataset.hf_dataset.column_names)
        if name not in self._dataset.hf_dataset.column_names:
            return None
        return torch.from_numpy(column(self._dataset, name))

    def names(self, feature: str) -> list[str]:
        """Returns the names of a feature's dimensions; none if the dataset does not name them."""
        features = self._dataset.meta.features
        return dimension_names(features.get(self._source(feature, list(features)), {}), feature)

    def images(self, camera: str, rows: Sequence[int], size: int | None) -> Tensor:
        """Returns images of a camera, (images, 3, H, W) uint8. See `Episodes.images`."""
        cameras = self._dataset.meta.camera_keys
        name = self._source(camera, cameras)
        if name not in cameras:
            raise UserError(
                f"{self.repo_id} has no camera {camera!r}, only {', '.join(cameras)}. If it has another name "
                "there, pass --rename_map to `deltaco train`."
            )
        images = read_images(self._dataset, name, rows)
        return images if size is None else resize_images(images, size)

    def _source(self, feature: str, available: Sequence[str]) -> str:
        """Returns the dataset's name of a policy's feature."""
        return feature if feature in available else self._names.get(feature, feature)


class DemonstrationFormat(NamedTuple):
    """What a policy takes from an episode as a demonstration.

    Attributes:
        camera: The policy's name of the camera.
        image_size: Height and width to which images are scaled, px.
        n_frames: Number of frames; 2 are the first and the last.
        gripper: The gripper; None if grasps are not needed.
    """

    camera: str
    image_size: int
    n_frames: int = 2
    gripper: Gripper | None = None


@dataclass(frozen=True)
class TrainingData:
    """Everything that a policy is given of its training episodes, beside the batches.

    Attributes:
        demonstrations: The episodes as demonstrations.
        robot: States and actions of the robot; None without states.
        grasps: Grasp and release of each episode; None without states, or if they are not needed.
    """

    demonstrations: DemonstrationBank
    robot: RobotData | None
    grasps: GraspStates | None

    @classmethod
    def read(cls, episodes: Episodes, form: DemonstrationFormat) -> TrainingData:
        """Reads episodes.

        Args:
            episodes: The episodes.
            form: What to take from each.

        Raises:
            ValueError: There is no such camera, or an image cannot be decoded.
        """
        robot, grasps = read_robot_data(episodes, form), None
        if robot is not None and form.gripper is not None:
            opening = form.gripper.opening(robot.actions)
            grasps = find_grasp_states(robot.states, opening, robot.spans, form.gripper.usual_range)
        frames, first_images = _read_frames(episodes, form)
        objects = episodes.values(TARGET_OBJECT)
        first_rows = [first for first, _ in episodes.spans.values()]
        bank = DemonstrationBank(
            frames,
            episodes.episode_tasks(),
            list(episodes.spans),
            None if objects is None else objects.reshape(-1)[first_rows].tolist(),
            first_images,
            None if grasps is None else grasps.pick_states,
            None if grasps is None else robot,
        )
        return cls(bank, robot, grasps)

    def to(self, device: torch.device) -> TrainingData:
        """Returns the data on a device."""
        robot, grasps = self.robot, self.grasps
        return TrainingData(
            self.demonstrations.to(device),
            None if robot is None else robot.to(device),
            None if grasps is None else grasps.to(device),
        )


def _read_frames(episodes: Episodes, form: DemonstrationFormat) -> tuple[Tensor, Tensor | None]:
    """Reads the frames of demonstrations, and first images if the camera has another resolution."""
    frames, first_images, spans = [], [], list(episodes.spans.values())
    with tqdm(total=len(spans), desc="Reading demonstrations", unit="episode", leave=False) as progress:
        for n in range(0, len(spans), _EPISODES_AT_A_TIME):
            some = spans[n : n + _EPISODES_AT_A_TIME]
            rows = torch.stack([kept_frames(*span, form.n_frames) for span in some])
            images = episodes.images(form.camera, rows.flatten().tolist(), form.image_size)
            frames.append(images.unflatten(0, rows.shape))
            first_images.append(episodes.images(form.camera, rows[:, 0].tolist(), None))
            progress.update(len(some))
    is_scaled = first_images[0].shape[2:] != frames[0].shape[3:]
    return torch.cat(frames), torch.cat(first_images) if is_scaled else None


def read_robot_data(episodes: Episodes, form: DemonstrationFormat) -> RobotData | None:
    """Returns the robot's states and actions, and a way to its images; None without states."""
    states, actions = episodes.values(OBS_STATE), episodes.values(ACTION)
    if states is None or actions is None:
        return None
    states, actions = states.float(), actions.float()
    spans = list(episodes.spans.values())
    return RobotData(
        states,
        actions,
        spans,
        lambda rows: episodes.images(form.camera, rows, form.image_size),
        episodes.names(OBS_STATE),
    )


def read_demonstrations(episodes: Episodes, form: DemonstrationFormat) -> DemonstrationBank:
    """Returns episodes as demonstrations. See `TrainingData.read`."""
    return TrainingData.read(episodes, form).demonstrations
