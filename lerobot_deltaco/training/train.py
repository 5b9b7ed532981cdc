"""`deltaco train`: LeRobot's own training loop, over frames in memory and batches of tasks.

Arguments, loop, optimizer, logging and checkpoints are LeRobot's. The dataset, the sampler and the policy are
made here, so that the policy is given the training episodes before the first step.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import (
    ACTION,
    OBS_STATE,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
    PRETRAINED_MODEL_DIR,
)
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.utils.utils import cycle
from numpy.typing import NDArray
from safetensors.numpy import load_file

from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.data.grasps import Grasp, find_grasps
from lerobot_deltaco.data.pauses import paused_frames
from lerobot_deltaco.data.reading import check_dataset_folder, missing_files_named
from lerobot_deltaco.data.training_data import read_robot_data
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.lerobot_versions import replaced
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig, check_image_shapes
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy
from lerobot_deltaco.processes import disable_malloc_trim
from lerobot_deltaco.training.task_batches import TaskBatchSampler

_FPS_OF_OPTION = 24  # frames per second of `frames_after_release`


def train(config: TrainPipelineConfig | None = None) -> None:
    """Trains a policy.

    Args:
        config: What `lerobot-train` would be given; None for the options on the command line.
    """
    disable_malloc_trim()
    training = _InMemoryTraining()
    with replaced(
        make_card=training.make_card,
        make_train_eval_datasets=training.make_datasets,
        make_policy=training.make_policy,
        EpisodeAwareSampler=training.make_sampler,
        cycle=training.batches,
    ):
        if config is None:
            lerobot_train.main()
        else:
            lerobot_train.train(config)


class _InMemoryTraining:
    """Replacements for what LeRobot's loop makes during one training run."""

    def __init__(self) -> None:
        self._config: TrainPipelineConfig | None = None
        self._frames: FramesInMemory | None = None
        self._policy: PreTrainedPolicy | None = None

    def make_datasets(self, config: TrainPipelineConfig) -> tuple[FramesInMemory, LeRobotDataset | None]:
        """Makes LeRobot's datasets, the first of them in memory."""
        policy = config.policy
        if policy is None or config.dataset.streaming:
            raise UserError(
                "`deltaco train` trains policies on frames in memory. For reward models and "
                "--dataset.streaming, use `lerobot-train`."
            )
        # Fail before the slow decoding.
        check_dataset_folder("--dataset.root", config.dataset.root)
        if isinstance(policy, TaskConditionedConfig):
            check_dataset_folder("--policy.demo_root", policy.demo_root)
        config.num_workers = 0
        with missing_files_named(config.dataset.repo_id, config.dataset.root, config.dataset.episodes):
            dataset, held_back = make_train_eval_datasets(config)
        if config.resume and config.checkpoint_path is not None:
            check_statistics(config.checkpoint_path / PRETRAINED_MODEL_DIR, dataset.meta.stats)
        image_size = image_size_in_memory(dataset, policy)
        self._config, self._frames = config, FramesInMemory(dataset, image_size, config.rename_map)
        return self._frames, held_back

    def make_policy(self, **options: Any) -> PreTrainedPolicy:
        """Makes LeRobot's policy, and gives it the training episodes."""
        assert self._frames is not None
        policy = self._policy = make_policy(**options)
        if isinstance(policy, TaskConditionedPolicy) and policy.config.uses_demonstrations:
            policy.prepare_training(self._frames)
        return policy

    def make_card(
        self,
        own: Callable[..., Any],
        model_cfg: PreTrainedConfig,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> Any:
        """Returns the policy's card. The arguments are LeRobot's, after its own function."""
        if cfg is None or not isinstance(self._policy, TaskConditionedPolicy):
            return own(model_cfg, cfg, dataset_meta)
        described = model_cfg.type, model_cfg.license, model_cfg.tags
        return self._policy.generate_model_card(cfg.dataset.repo_id, *described, cfg, dataset_meta)

    def batches(self, indices: Iterator[torch.Tensor]) -> Iterator[dict[str, Any]]:
        """Yields the batches of the indices that LeRobot's data loader gives, without an end."""
        assert self._frames is not None
        for rows in cycle(indices):
            yield self._frames.batch(rows.cpu())

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
        data = read_robot_data(self._frames, policy.demonstration_format) if policy.trim_pauses else None
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
        raise UserError(
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
    if n_after is None or policy.gripper_command is None:
        return use
    spans = list(frames.spans.values())
    gripper = policy.gripper_command.opening(frames.columns[ACTION])
    n_after = round(n_after * frames.fps / _FPS_OF_OPTION)
    grasps = find_grasps(gripper, spans, policy.gripper_command.usual_range, frames.columns.get(OBS_STATE))
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
        raise UserError(
            f"`upsampled_tasks` is {pattern!r}, which is found in no task of the dataset. They are such as "
            f"{task_names[0]!r}."
        )
    return found


def check_statistics(checkpoint: Path, stats: Mapping[str, Mapping[str, Any]]) -> None:
    """Checks that a training resumes on the data that it began with.

    LeRobot keeps the checkpoint's processors, which would normalize other data by the old statistics.

    Raises:
        ValueError: The statistics of the dataset differ.
    """
    saved: dict[str, NDArray] = {}
    for path in checkpoint.glob(f"{POLICY_PREPROCESSOR_DEFAULT_NAME}*.safetensors"):
        saved |= load_file(path)
    for feature in (OBS_STATE, ACTION):
        for name, values in stats.get(feature, {}).items():
            known = saved.get(f"{feature}.{name}")
            if known is not None and not np.allclose(known, np.asarray(values), rtol=1e-5):
                raise UserError(
                    f"The dataset is not the one that the training began with: its statistics of `{feature}` "
                    "differ. Resume on the same data, or begin a new training from the checkpoint with "
                    "--policy.path."
                )
