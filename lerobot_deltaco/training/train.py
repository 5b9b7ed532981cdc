"""`deltaco train`: LeRobot's own training loop, over frames in memory and batches of tasks.

Two names that the loop looks up are replaced during training: the function that makes its datasets, and the
sampler. Everything else, from the arguments to the checkpoints, is LeRobot's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from numpy.typing import NDArray

from gym_deltaco import CONTROL_FPS
from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.data.grasps import Grasp, find_grasps
from lerobot_deltaco.data.pauses import paused_frames
from lerobot_deltaco.data.reading import check_dataset_folder, missing_files_named
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig, check_image_shapes
from lerobot_deltaco.policies.base.optimization import keep_freed_memory
from lerobot_deltaco.training.task_batches import TaskBatchSampler


def train() -> None:
    """Trains as the command line says, with the arguments of `lerobot-train`."""
    keep_freed_memory()
    training = _InMemoryTraining()
    with (
        patch.object(lerobot_train, "make_train_eval_datasets", training.make_datasets),
        patch.object(lerobot_train, "EpisodeAwareSampler", training.make_sampler),
    ):
        lerobot_train.main()


class _InMemoryTraining:
    """Replacements for LeRobot's dataset and sampler during one training run."""

    def __init__(self) -> None:
        self._make_datasets = lerobot_train.make_train_eval_datasets
        self._config: TrainPipelineConfig | None = None
        self._frames: FramesInMemory | None = None

    def make_datasets(self, config: TrainPipelineConfig) -> tuple[FramesInMemory, LeRobotDataset | None]:
        """Makes LeRobot's datasets, the first of them in memory."""
        policy = config.policy
        if policy is None or config.dataset.streaming:
            raise ValueError(
                "`deltaco train` trains policies on frames in memory. For reward models and "
                "--dataset.streaming, use `lerobot-train`."
            )
        # Fail before the slow decoding.
        check_dataset_folder("--dataset.root", config.dataset.root)
        if isinstance(policy, TaskConditionedConfig):
            check_dataset_folder("--policy.demo_root", policy.demo_root)
        config.num_workers = 0
        with missing_files_named(config.dataset.repo_id, config.dataset.root, config.dataset.episodes):
            dataset, held_back = self._make_datasets(config)
        image_size = image_size_in_memory(dataset, policy)
        self._config, self._frames = config, FramesInMemory(dataset, image_size)
        # The policy, which gets the metadata, draws its demonstrations from these frames.
        dataset.meta.frames_in_memory = self._frames
        return self._frames, held_back

    def make_sampler(self, *arguments: Any, **options: Any) -> EpisodeAwareSampler | TaskBatchSampler:
        """Makes a sampler of batches of tasks if the policy wants them, else LeRobot's."""
        assert self._config is not None
        assert self._frames is not None
        stock = _ResumableSampler(*arguments, **options)
        policy = self._config.policy
        if not isinstance(policy, TaskConditionedConfig) or not policy.tasks_per_batch:
            return stock
        tasks = self._frames.tasks
        use = np.zeros(len(tasks), dtype=bool)
        use[stock.indices] = True
        use &= _until_release(self._frames, policy)
        data = self._frames.robot_data(policy.cameras[0]) if policy.trim_pauses else None
        if data is not None:
            paused = paused_frames(data, self._frames.fps)
            self._frames.skip(paused)
            use &= ~paused
        return TaskBatchSampler(
            tasks,
            self._config.batch_size,
            _tasks_per_batch(policy.tasks_per_batch, self._config.batch_size, len(np.unique(tasks[use]))),
            _upsampled(policy.upsampled_tasks, self._frames.task_names, set(tasks[use].tolist())),
            policy.upsampled_fraction,
            seed=options.get("seed", 0),
            use=use,
        )


def image_size_in_memory(dataset: LeRobotDataset, policy: PreTrainedConfig) -> int | None:
    """Returns the size to which images are scaled in memory; None for their own.

    Raises:
        ValueError: The dataset cannot be held in memory.
    """
    if isinstance(policy, TaskConditionedConfig):
        features = dataset_to_policy_features(dataset.meta.features)
        check_image_shapes({name: features[name].shape for name in dataset.meta.camera_keys})
    if dataset.meta.depth_keys or dataset.meta.has_language_columns:
        raise ValueError(
            "The dataset has depth images or columns of messages, which only `lerobot-train` prepares."
        )
    if isinstance(policy, TaskConditionedConfig):
        # Scale images beforehand if that takes less memory.
        shapes = [dataset.meta.features[camera]["shape"] for camera in dataset.meta.camera_keys]
        if any(3 * policy.image_size**2 < np.prod(shape) for shape in shapes):
            return policy.image_size
    return None


class _ResumableSampler(EpisodeAwareSampler):
    """LeRobot's sampler, but it counts its epochs itself, even in a resumed run.

    accelerate 1.15 counts the epochs of a process from 0, and sets them in the sampler: with LeRobot's own, a
    resumed run begins with the order of the first epoch, wherever it was interrupted.
    """

    def set_epoch(self, epoch: int) -> None:
        """Does nothing: the epoch is that of `load_state_dict`, or follows the last one."""


def _until_release(frames: FramesInMemory, policy: TaskConditionedConfig) -> NDArray[np.bool_]:
    """Returns which frames come before the gripper's last opening in their episode, or soon after it."""
    use = np.ones(len(frames), dtype=bool)
    n_after = getattr(policy, "frames_after_release", None)
    if n_after is None or policy.gripper_index is None:
        return use
    spans = list(frames.spans.values())
    gripper = policy.gripper_opening(frames.columns[ACTION])
    n_after = round(n_after * frames.fps / CONTROL_FPS)
    grasps = find_grasps(gripper, spans, states=frames.columns.get(OBS_STATE))
    for grasp, (_, last) in zip(grasps, spans, strict=True):
        if isinstance(grasp, Grasp):
            use[grasp.opened + 1 + n_after : last + 1] = False
    return use


def _tasks_per_batch(wanted: int, batch_size: int, n_tasks: int) -> int:
    """Returns the largest number of tasks up to the wanted one that divides the batch."""
    return max(n for n in range(1, min(wanted, n_tasks) + 1) if batch_size % n == 0)


def _upsampled(pattern: str | None, task_names: Sequence[str], present: set[int]) -> list[int]:
    """Returns the tasks whose instructions match a regular expression."""
    if pattern is None:
        return []
    found = [n for n, name in enumerate(task_names) if n in present and re.search(pattern, name)]
    if not found:
        raise ValueError(
            f"`upsampled_tasks` is {pattern!r}, which is found in no task of the dataset. They are such as "
            f"{task_names[0]!r}."
        )
    return found
