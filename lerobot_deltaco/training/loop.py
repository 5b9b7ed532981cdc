"""LeRobot's own training loop, over frames in memory.

While a training runs, some functions that LeRobot's loop calls are replaced: those that make the datasets,
the sampler, the batches and the policy, and, on the benchmark, the evaluation. All else, from the arguments
to the checkpoints, is LeRobot's.
"""

from __future__ import annotations

import logging
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from itertools import chain, cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from huggingface_hub import HfApi
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import check_policy_fits
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.sets import run_set
from lerobot_deltaco.lerobot_internals import (
    remote_command,
    replaced_in_training_loop,
    run_training_loop,
    step_of_videos,
    training_loop,
)
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.dataset_folders import check_dataset_folder
from lerobot_deltaco.policy.demonstrations import kept_frame_indices
from lerobot_deltaco.policy.goals.keyframes import warn_if_inverted
from lerobot_deltaco.policy.vision import load_efficientnet_lite0
from lerobot_deltaco.training.frames import FramesInMemory
from lerobot_deltaco.training.remote_job import check_remote_job
from lerobot_deltaco.training.task_batches import TaskBatchSampler

logger = logging.getLogger(__name__)


class TrainingSetupError(ValueError):
    """A training cannot begin; the message says why."""


def _names_what_is_wrong[**P, R](set_up: Callable[P, R]) -> Callable[P, R]:
    """Tells errors of a training that cannot begin from those of one that runs, which are bugs."""

    @wraps(set_up)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return set_up(*args, **kwargs)
        except (ValueError, OSError, MemoryError) as error:
            logger.debug("The training cannot begin.", exc_info=error)
            raise TrainingSetupError(str(error) or repr(error)) from error

    return checked


class FrameIndexDataset(torch.utils.data.Dataset):
    """Stands for a dataset where LeRobot loads batches: what it gives are places of frames, no frames."""

    def __init__(self, dataset: LeRobotDataset) -> None:
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, place: int) -> int:
        return place

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)


class ResumableSampler(EpisodeAwareSampler):
    """LeRobot's sampler, which counts its epochs itself, also where a resumed training has begun.

    accelerate 1.15 counts the epochs of a process from 0, and sets them in the sampler: with LeRobot's own,
    a resumed training begins with the order of the first epoch, wherever it was interrupted.

    Several processes take batches in turn. Where the last turn of an epoch is not complete, accelerate fills
    it up with the first batches that it has seen; after a resume, these are not the epoch's first. So the
    epoch is filled up here, with the same frames.

    Args:
        arguments: Those of LeRobot's sampler.
        samples_per_turn: Samples that all processes take in a turn; 1 for a single process, whose last batch
            may be smaller.
        options: Those of LeRobot's sampler.
    """

    def __init__(self, *arguments: Any, samples_per_turn: int = 1, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._n_filled_up = -super().__len__() % samples_per_turn

    def __len__(self) -> int:
        return super().__len__() + self._n_filled_up

    def __iter__(self) -> Iterator[int]:
        state = self.state_dict()
        self.load_state_dict({**state, "start_index": 0})
        first = super().__iter__()
        self.load_state_dict(state)
        return chain(super().__iter__(), islice(cycle(first), self._n_filled_up))

    def set_epoch(self, epoch: int) -> None:
        """Does nothing: the epoch is that of `load_state_dict`, or follows the last one."""


class InMemoryTraining:
    """What stands for LeRobot's functions during one training."""

    def __init__(self) -> None:
        self._config: TrainPipelineConfig | None = None
        self._frames: FramesInMemory | None = None
        loop = training_loop()
        self._make_datasets = loop.make_train_eval_datasets
        self._make_policy = loop.make_policy
        self._cycle = loop.cycle
        self._make_envs = loop._make_eval_envs
        self._evaluate = loop.eval_policy_all
        self._submit = loop.submit_to_hf

    @contextmanager
    def active(self) -> Iterator[None]:
        """Lets LeRobot's loop run over frames in memory."""
        functions: dict[str, Callable[..., Any]] = {
            "make_train_eval_datasets": self.make_datasets,
            "make_policy": self.make_policy,
            "EpisodeAwareSampler": self.make_sampler,
            "cycle": self.batches,
            "_make_eval_envs": self.make_envs,
            "eval_policy_all": self.evaluate,
            "submit_to_hf": self.submit,
        }
        with replaced_in_training_loop(functions):
            yield

    @_names_what_is_wrong
    def make_datasets(self, config: TrainPipelineConfig) -> tuple[FrameIndexDataset, LeRobotDataset | None]:
        """LeRobot's datasets, the first of them read into memory.

        Raises:
            TrainingSetupError: No policy is trained, there is no such dataset, or the data cannot be held in
                memory.
            VisionEncoderError: The weights that pretrained matching needs are missing.
        """
        policy = config.policy
        if policy is None:
            raise ValueError("`deltaco-train` trains policies. Use `lerobot-train` for reward models.")
        if config.dataset.streaming:
            raise ValueError("`deltaco-train` holds all frames in memory: leave out --dataset.streaming.")
        # Both before hours of decoding.
        check_dataset_folder("--dataset.root", config.dataset.root)
        if isinstance(policy, DeltacoConfig):
            check_dataset_folder("--policy.demo_root", policy.demo_root)
            if policy.pretrained_matching and policy.pretrained_path is None:
                load_efficientnet_lite0()  # for its errors: the weights are needed after the decoding
        self._config = config
        # The loader has nothing to do: it gives places, and the frames are gathered on the device.
        config.num_workers = 0
        train, evaluation = self._make_datasets(config)
        if train.meta.depth_keys or train.meta.has_language_columns:
            raise ValueError(
                "The dataset has depth images or columns of messages, which only `lerobot-train` prepares."
            )
        image_size = None
        if isinstance(policy, DeltacoConfig):
            # Scaled beforehand where that takes less memory than the images as they are.
            shapes = [train.meta.features[camera]["shape"] for camera in train.meta.camera_keys]
            if any(3 * policy.image_size**2 < np.prod(shape) for shape in shapes):
                image_size = policy.image_size
        larger = 0
        if isinstance(policy, DeltacoConfig) and policy.goal_image_size is not None:
            n_kept = len(kept_frame_indices(0, 0, policy.n_demo_frames))
            larger = train.num_episodes * n_kept * 3 * policy.goal_image_size**2
        # Other policies may need all of a GPU's memory.
        self._frames = FramesInMemory(
            train,
            self._device(policy),
            image_size,
            may_use_gpu=isinstance(policy, DeltacoConfig),
            reserved_bytes=larger,
        )
        return FrameIndexDataset(train), evaluation

    @_names_what_is_wrong
    def make_policy(self, **arguments: Any) -> PreTrainedPolicy:
        """LeRobot's policy; ours draws its demonstrations from the frames in memory.

        Raises:
            TrainingSetupError: The policy's options do not fit each other, the dataset or the environment.
        """
        policy = self._make_policy(**arguments)
        config, frames = policy.config, self._frames
        assert self._config is not None
        if isinstance(self._config.env, DeltacoEnv):
            # Now, and not at the first evaluation.
            check_policy_fits(config, self._config.env, self._config.rename_map)
        if not isinstance(config, DeltacoConfig):
            return policy
        if not isinstance(policy, DeltacoPolicy):
            raise ValueError(
                "`deltaco-train` does not train adapters (PEFT) of this policy. Use `lerobot-train`."
            )
        policy.has_task_batches = True
        assert frames is not None
        if (config.uses_demo or config.locates_goals) and config.demo_episodes is None:
            policy.set_train_demonstrations(
                frames.demonstrations(config.cameras[0], config.demo_image_size, config.n_demo_frames),
                frames.robot_data() if config.locates_goals else None,
            )
        return policy

    @_names_what_is_wrong
    def make_sampler(self, from_indices: Any, to_indices: Any, **options: Any) -> Any:
        """Batches of tasks if they are wanted, else LeRobot's sampler.

        Raises:
            TrainingSetupError: There are no such batches.
        """
        assert self._config is not None
        n_processes = _n_processes()
        stock = ResumableSampler(
            from_indices,
            to_indices,
            samples_per_turn=self._config.batch_size * n_processes if n_processes > 1 else 1,
            **options,
        )
        assert self._frames is not None
        config = self._config.policy
        if not isinstance(config, DeltacoConfig):
            return stock
        if not config.tasks_per_batch:
            if config.frames_after_release is not None:
                raise ValueError(
                    "`frames_after_release` chooses frames for batches of tasks. Set `tasks_per_batch`, or "
                    "choose frames by `drop_n_last_frames`."
                )
            return stock
        tasks = self._frames.tasks
        use = np.zeros(len(tasks), dtype=bool)
        use[stock.indices] = True
        if config.frames_after_release is not None:
            if config.gripper_index is None:
                raise ValueError(
                    "`frames_after_release` needs a gripper among the action's dimensions, which `gripper` "
                    "names."
                )
            gripper = config.gripper_opening(self._frames.columns[ACTION])
            if not config.locates_goals:  # which warns itself
                warn_if_inverted(gripper, list(self._frames.spans.values()))
            use &= self._frames.until_release(gripper, config.frames_after_release)
        upsampled = []
        if config.upsampled_tasks is not None:
            names = self._frames.task_names
            upsampled = [n for n, name in enumerate(names) if re.search(config.upsampled_tasks, name)]
            if not set(upsampled) & set(tasks[use].tolist()):
                raise ValueError(
                    f"`upsampled_tasks` is {config.upsampled_tasks!r}, which is found in no task of the "
                    f"dataset. They are such as {names[0]!r}."
                )
        return TaskBatchSampler(
            tasks,
            self._config.batch_size,
            config.tasks_per_batch,
            upsampled,
            config.upsampled_share,
            seed=options.get("seed", 0),
            use=use,
            n_processes=n_processes,
        )

    def batches(self, loader: Any) -> Iterator[dict[str, Any]]:
        """Batches without end, for a loader of places."""
        assert self._frames is not None
        places: Tensor
        for places in self._cycle(loader):
            yield self._frames.batch(places)

    @contextmanager
    def make_envs(self, config: TrainPipelineConfig) -> Iterator[dict[str, Any]]:
        """LeRobot's environments for an evaluation, or none if they are not needed."""
        if self._records(config):
            yield {}
        else:
            with self._make_envs(config) as envs:
                yield envs

    def evaluate(self, **arguments: Any) -> dict[str, Any]:
        """An evaluation in training: on the benchmark, an evaluation set with a record of every episode."""
        config = self._config
        assert config is not None
        if not self._records(config):
            return self._evaluate(**arguments)
        step = step_of_videos(arguments["videos_dir"])
        policy: DeltacoPolicy = arguments["policy"]
        policy.eval()
        record = run_set(
            Path(config.output_dir),
            step,
            policy,
            arguments["preprocessor"],
            arguments["postprocessor"],
            EvaluationPlan(
                config.env.task,
                arguments["n_episodes"],
                ambiguity=config.env.ambiguity,
                image_size=config.env.image_size,
                episode_length=config.env.episode_length,
                objects=config.env.objects,
                adversarial_probability=config.env.adversarial_probability,
                adversarial_draw=config.env.adversarial_draw,
                instructions=config.env.instructions,
                instructions_split=config.env.instructions_split,
                instruction=config.env.instruction,
            ),
            experiment=config.job_name,
            run_seed=config.seed if config.seed is not None else 0,
            command=shlex.join(["deltaco-train", *sys.argv[1:]]),
        )
        rate = record.success_rate
        # Rewards are not in the record.
        overall = {"avg_sum_reward": float("nan"), "pc_success": 100 * rate, "eval_s": record.seconds}
        return {"overall": overall}

    def submit(self, config: TrainPipelineConfig) -> None:
        """Submits the training to Hugging Face Jobs, where `deltaco-train` runs it.

        Raises:
            RemoteJobError: It needs something that only this machine has.
        """
        check_remote_job(config, lambda repo_id: HfApi().repo_exists(repo_id, repo_type="dataset"))
        with remote_command("deltaco-train"):
            self._submit(config)

    @staticmethod
    def _records(config: TrainPipelineConfig) -> bool:
        # With wandb, LeRobot's own evaluation, since its videos are uploaded there.
        is_ours = isinstance(config.env, DeltacoEnv) and isinstance(config.policy, DeltacoConfig)
        return is_ours and not config.wandb.enable

    @staticmethod
    def _device(config: PreTrainedConfig) -> torch.device:
        if config.device == "cpu":
            return torch.device("cpu")
        # The one that accelerate gives to this process.
        from accelerate import PartialState

        return PartialState().device


def _n_processes() -> int:
    """How many processes train together."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def train() -> None:
    """Trains as the command line says: `lerobot-train`, over frames in memory."""
    with InMemoryTraining().active():
        run_training_loop()
