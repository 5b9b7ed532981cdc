"""The base class of both policies: tasks of an episode, demonstration banks, checkpoints."""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

import contextlib
import json
import logging
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import NormalizationMode
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.act.modeling_act import ACTTemporalEnsembler
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_deltaco.data.demonstrations import Demonstration, DemonstrationBank
from lerobot_deltaco.data.files import check_tasks
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.data.reading import compare_robots, open_dataset
from lerobot_deltaco.data.training_data import DatasetEpisodes, Episodes, TrainingData
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.action_queues import ActionQueues
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig
from lerobot_deltaco.policies.base.instructions import InstructionEmbeddings, Paraphrases
from lerobot_deltaco.policies.base.losses import imitation_loss, join_action
from lerobot_deltaco.policies.base.networks import ActionDistribution, PolicyNetwork, fuse_batch_norms
from lerobot_deltaco.policies.base.normalization import StateLimits
from lerobot_deltaco.policies.base.observations import ObservationChecks
from lerobot_deltaco.policies.base.policy_card import policy_card
from lerobot_deltaco.policies.base.sentences import read_sentences
from lerobot_deltaco.policies.base.task_bank import (
    TASK_BANK,
    checkpoint_file,
    read_task_bank,
    write_task_bank,
)

logger = logging.getLogger(__name__)

# Normalized actions are in -1..1; a policy may overshoot, but not by that much.
_ABSURD_ACTION = 100.0

DemonstrationsOfTasks = Sequence[Sequence[Demonstration | ObjectPrompt]]


class TrainingDivergedError(UserError, FloatingPointError):
    """Raised when the loss or a weight is not finite; the message names the likely cause."""


class TaskConditionedPolicy(PreTrainedPolicy):
    """A policy that performs the task of a demonstration, an instruction, or both.

    In training, each sample's demonstration is another episode of its task in the training dataset. In
    evaluation, `set_tasks` passes demonstrations and instructions at the start of an episode; without it, the
    instruction is the batch's `task`, and its demonstration comes from the bank of the checkpoint.

    Args:
        config: Configuration of the policy. LeRobot fills in its input and output features beforehand.
        dataset_stats: Statistics of the training dataset, used for normalization; None in evaluation.
        dataset_meta: Metadata of the training dataset; None in evaluation.

    Attributes:
        seed: Seed of the draws in training.
        policy_network: Network that predicts actions.
        instructions: Embeddings of instructions; None if the policy uses no sentence encoder.
        demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
        training_data: The training episodes; None before `prepare_training`.
    """

    policy_network: PolicyNetwork
    config_class: ClassVar[type] = TaskConditionedConfig
    name = "task_conditioned"
    takes_prompts: ClassVar[bool] = False  # in place of demonstrations

    def __init__(
        self,
        config: TaskConditionedConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        self.config: Any = config
        if config.seed is None:
            config.seed = torch.initial_seed() % 2**63
        self.seed: int = config.seed
        self._meta, self._stats = dataset_meta, dataset_stats
        if dataset_meta is not None:
            # `lerobot-train` opens the dataset itself, without the checks of `open_dataset`.
            check_tasks(dataset_meta.root / "meta/tasks.parquet")
            config.set_dataset_feature_metadata(dataset_meta.features, dataset_stats or dataset_meta.stats)
            config.set_dataset_length(dataset_meta)
        config.validate_features()
        self.state_limits = StateLimits(config.state_dim, dataset_stats)
        self._observation_checks = ObservationChecks(config.cameras)
        self.instructions: InstructionEmbeddings | None = None
        self.paraphrases = None if dataset_meta is None else _read_paraphrases(config, dataset_meta)
        self.demonstrations: DemonstrationBank | None = self._read_evaluation_bank()
        self.training_data: TrainingData | None = None
        self._knows_all_episodes = False  # for it read them itself
        # The tasks of the next episode, if `set_tasks` gave them, and the state of the running one.
        self._tasks: tuple[tuple[str, ...], DemonstrationsOfTasks] | None = None
        self._episode: Any = None
        self._episode_step = 0  # number of actions taken in the running episode
        # The actions of the running chunks that are still to be carried out, and the average of all chunks.
        self._actions = ActionQueues(config.n_action_steps, config.gripper_index)
        self._ensemble: ACTTemporalEnsembler | None = None
        # The network that acts in evaluation mode, and the state of the weights that it was made from.
        self._fused: tuple[list[tuple[int, int]], PolicyNetwork] | None = None
        # Draws are a function of the seed and the step, so that a resumed run repeats an uninterrupted one.
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))

    def get_optim_params(self) -> list[nn.Parameter]:
        """Returns all trained weights, without those of frozen encoders."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    # Episodes

    def reset(self) -> None:
        """Ends the episode. The next action begins a new one."""
        self._tasks = None
        self._start(None)

    def set_tasks(self, instructions: Sequence[str], demonstrations: DemonstrationsOfTasks) -> None:
        """Sets the tasks of the episode that begins with the next action, until `reset`.

        Args:
            instructions: Instruction of each sample; an empty string leaves it out.
            demonstrations: One or more demonstrations of each sample's task; an empty list leaves them out.
                For `deltaco_match`, one `ObjectPrompt` may take their place.

        Raises:
            ValueError: They differ in number, or the policy takes no prompts.
        """
        if not self.takes_prompts and any(isinstance(each, ObjectPrompt) for each in chain(*demonstrations)):
            raise UserError(
                f"A policy of the type {self.name!r} needs demonstrations: a point, box or photo is for "
                "deltaco_match."
            )
        if len(instructions) != len(demonstrations):
            raise UserError(
                f"There must be as many lists of demonstrations as instructions. Got {len(demonstrations)} "
                f"and {len(instructions)}."
            )
        self.reset()
        self._tasks = (tuple(instructions), demonstrations)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Returns the next action of a chunk, the mean of a likely component of its distribution.

        Args:
            batch: As in `forward`, without `action` and `episode_index`. `task` is not needed if `set_tasks`
                gave the instructions. New instructions begin a new episode.

        Returns:
            Actions, (batch, action), normalized as in `forward`.

        Raises:
            ValueError: There is no instruction, or a task has no demonstration.
            ObservationError: The observation has numbers that cannot be.
            FloatingPointError: The action is not finite, or absurdly large.
        """
        self.check_observation(batch)
        # In bfloat16, in which LeRobot's training evaluates, an action would depend on the rest of the batch.
        with torch.autocast(self.step.device.type, enabled=False):
            action = self._next_action(batch)
        self._episode_step += 1
        return action

    def _next_action(self, batch: dict[str, Any]) -> Tensor:
        coefficient = self.config.temporal_ensemble_coeff
        if coefficient is not None:
            chunk = self.predict_action_chunk(batch)
            if self._ensemble is None:
                self._ensemble = ACTTemporalEnsembler(coefficient, chunk.shape[1])
            return self._ensemble.update(chunk)
        if self._begins_episode(batch) or self._actions.need_chunks:
            self._actions.refill(self.predict_action_chunk(batch))
        return self._actions.pop()

    def drop_queued_actions(self) -> None:
        """Drops the rest of the running chunks. LeRobot calls this when the task changes."""
        self._actions.clear()
        self._ensemble = None

    @property
    def pick_confidence(self) -> Tensor | None:
        """Probability that the policy gave what it picks, (batch,); None if it gives none."""
        return None

    def _begins_episode(self, batch: dict[str, Any]) -> bool:
        """Returns whether an action for a batch begins an episode: after a reset, or for other tasks."""
        return self._episode is None or self._episode.instructions != self._tasks_of(batch)[0]

    def _start(self, episode: Any) -> None:
        """Sets the running episode; None for none."""
        self._episode, self._ensemble, self._episode_step = episode, None, 0
        self._actions.clear()

    def _tasks_of(self, batch: dict[str, Any]) -> tuple[tuple[str, ...], DemonstrationsOfTasks | None]:
        """Returns the instructions of a batch, and the demonstrations that `set_tasks` gave, if any."""
        if self._tasks is not None:
            return self._tasks
        tasks = batch.get("task")
        if isinstance(tasks, (list, tuple)) and tasks and all(isinstance(task, str) for task in tasks):
            if not all(task.strip() for task in tasks):
                raise UserError(
                    "`task` is empty. Give a sentence, such as with --task; to act on a demonstration alone, "
                    "pass it to `set_tasks` with an empty instruction."
                )
            return tuple(tasks), None
        raise UserError(
            "`task` must be a list with an instruction for each sample of the batch. Got "
            f"{'none' if tasks is None else repr(tasks)}. LeRobot takes it from the environment's "
            '`task_description`, or from --task; in Python, set observation["task"] before the preprocessor.'
        )

    def banked_demonstrations(self, tasks: Sequence[str], n_each: int = 1) -> list[list[Demonstration]]:
        """Returns demonstrations of tasks from the bank; samples of the same task take different ones.

        Args:
            tasks: Task string of each sample.
            n_each: Number of demonstrations of each sample.

        Raises:
            ValueError: There are too few demonstrations of a task.
        """
        bank = self.demonstrations
        if bank is None and self.training_data is not None:
            bank = self.training_data.demonstrations
        if bank is None:
            raise UserError(
                "The policy has no demonstrations. Name a dataset of them with --policy.demo_repo_id and "
                "--policy.demo_root, or pass some to `set_tasks`."
            )
        if self.config.demo_episode is not None:
            return [[bank.of_episode(self.config.demo_episode)] for _ in tasks]
        found, n_taken = [], dict.fromkeys(tasks, 0)
        for task in tasks:
            known, first = bank.of_task(task), n_taken[task]
            if len(known) < n_each:
                raise UserError(
                    f"`n_demonstrations` is {n_each}, but the task {task!r} has {len(known)}. Set it to at "
                    "most that, or name a dataset that has more with --policy.demo_repo_id and "
                    "--policy.demo_root."
                )
            found.append([known[(first + n) % len(known)] for n in range(n_each)])
            n_taken[task] += n_each
        return found

    # Observations

    def check_observation(self, batch: Mapping[str, Any]) -> None:
        """Checks the numbers of an observation, as in `select_action`.

        Raises:
            ObservationError: One is not finite, or an image is not in 0..1.
        """
        is_normalized = self.config.normalization_mapping.get("STATE") != NormalizationMode.IDENTITY
        states = batch.get(OBS_STATE) if is_normalized and self.config.state_dim else None
        self._observation_checks(batch, None if states is None else states * self.state_limits.scale)

    def _images(self, batch: dict[str, Any]) -> Tensor:
        """Returns the images of all cameras, the demonstration camera first, (batch, cameras, 3, S, S)."""
        return torch.stack([self._camera_image(batch, name) for name in self.config.cameras], dim=1)

    def _camera_image(self, batch: dict[str, Any], name: str) -> Tensor:
        """Returns the image of a camera, (batch, 3, S, S) in 0..1."""
        image, size = batch[name], self.config.image_size
        if image.shape[-2:] == (size, size):
            return image
        return F.interpolate(image, (size, size), mode="bilinear", antialias=True)

    # Actions

    def _imitation_loss(
        self, batch: dict[str, Any], predicted: ActionDistribution, gripper: Tensor | None, gripper_kind: str
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the imitation loss of each sample, (batch,), and its parts to log. See `imitation_loss`."""
        log_std, is_pad = self.policy_network.log_std, batch.get(f"{ACTION}_is_pad")
        return imitation_loss(
            predicted, gripper, log_std, batch[ACTION], is_pad, self.config.gripper_index, gripper_kind
        )

    def _inference_network(self) -> PolicyNetwork:
        """Returns the network that acts: in evaluation mode, a copy that is faster for small batches."""
        if self.training:
            return self.policy_network
        tensors = [*self.policy_network.parameters(), *self.policy_network.buffers()]
        # Copying takes longer than an action. Changes in place count as versions.
        state = [(each.data_ptr(), 0 if each.is_inference() else each._version) for each in tensors]
        if self._fused is None or self._fused[0] != state:
            self._fused = state, fuse_batch_norms(self.policy_network)
        return self._fused[1]

    def _sample_action(
        self, batch: dict[str, Any], predicted: ActionDistribution, gripper: Tensor | None
    ) -> Tensor:
        """Returns the actions of a chunk, (batch, steps, action)."""
        opening = None if gripper is None else torch.sigmoid(gripper.float())
        mean = predicted.likely_mean(self._episode_step).float()
        return self._checked_action(batch, join_action(mean, opening, self.config.gripper_index))

    def _checked_action(self, batch: dict[str, Any], action: Tensor) -> Tensor:
        """Returns actions (batch, steps, action); an absurd one is an error."""
        if bool((action.abs() < _ABSURD_ACTION).all()):  # False for NaN
            return action
        self.check_observation(batch)
        raise FloatingPointError(
            "The policy's action is not finite, or absurdly large. The observation is finite, so the weights "
            "of the checkpoint are damaged. Fetch it again."
        )

    # Training

    def prepare_training(self, episodes: Episodes) -> None:
        """Takes the training episodes, and fits what depends only on them.

        `deltaco train` calls this before the first step. Otherwise the first batch does, with the episodes
        that `training_episodes` names, or all of the dataset.

        Args:
            episodes: The episodes that the policy is trained on.

        Raises:
            ValueError: The episodes do not suffice, or cannot be read.
        """
        # Models that are fitted choose their own precision.
        with torch.autocast(self.step.device.type, enabled=False):
            self.fit(TrainingData.read(episodes, self.config.demonstration_format).to(self.step.device))

    def fit(self, data: TrainingData) -> None:
        """Fits what depends only on the training episodes. See `prepare_training`."""
        self.training_data = data

    def _training_rows(self, episodes: Tensor) -> Tensor:
        """Returns the rows of episodes among the training episodes, (batch,); -1 for those held out.

        Raises:
            ValueError: A sample to train on is of another episode, or one that is held out was trained on.
        """
        if self.training_data is None:
            if self._meta is None:
                raise UserError(
                    "Training needs the episodes: call `prepare_training`, or pass the dataset's metadata as "
                    "`dataset_meta`."
                )
            chosen = self.config.training_episodes
            dataset = open_dataset("--dataset.root", self._meta.repo_id, self._meta.root, chosen)
            self.prepare_training(DatasetEpisodes(dataset, chosen))
            self._knows_all_episodes = chosen is None
        assert self.training_data is not None
        rows = self.training_data.demonstrations.episode_rows(episodes)
        wrong = (rows < 0) if self.training else (rows >= 0) & self._knows_all_episodes
        if bool(wrong.any()):
            episode = int(episodes[wrong][0])
            problem = "to be trained on, but was not" if self.training else "held out, but was"
            raise UserError(
                f"Episode {episode} is {problem} among the training episodes that the policy was "
                "given. `lerobot-train` does not tell a policy of --dataset.episodes and "
                "--dataset.eval_split: train with `deltaco train`, or name the training episodes in "
                "--policy.training_episodes."
            )
        return rows

    def _read_evaluation_bank(self) -> DemonstrationBank | None:
        """Reads the demonstrations for evaluation that the configuration names."""
        if self.config.demo_repo_id is None or not self.config.uses_demonstrations:
            return None
        dataset = open_dataset("--policy.demo_root", self.config.demo_repo_id, self.config.demo_root)
        if self._meta is not None:
            compare_robots(self._meta, dataset.meta)
        data = TrainingData.read(DatasetEpisodes(dataset), self.config.demonstration_format)
        self._check_demonstrations(data)
        return data.demonstrations

    def _check_demonstrations(self, data: TrainingData) -> None:
        """Checks demonstrations for evaluation, and adds what else the policy needs of them."""

    def _step_generator(self) -> torch.Generator:
        """Returns the random generator of a training step, on the CPU."""
        step = int(self.step) if self.training else 0
        rank = torch.distributed.get_rank() if torch.distributed.is_initialized() else 0
        sequence = np.random.SeedSequence((self.seed, step, rank))
        (state,) = sequence.generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state >> np.uint64(1)))

    def _draw_instructions(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """Returns the instruction of each training sample: its task string, or a sentence for it."""
        if self.paraphrases is None:
            return list(tasks)
        return self.paraphrases.draw(tasks, generator)

    def _finish_step(
        self, batch: dict[str, Any], loss: Tensor, logged: dict[str, Tensor], reduction: str
    ) -> tuple[Tensor, dict[str, float]]:
        """Checks and reduces the loss of each sample (batch,), and counts the training step."""
        if self.training:
            if not bool(torch.isfinite(loss).all()):
                raise TrainingDivergedError(_why_not_finite(batch, int(self.step)))
            self.step += 1
        scalars = torch.stack([value.detach().float() for value in logged.values()]).tolist()
        loss = loss.mean() if reduction == "mean" else loss
        return loss, dict(zip(logged, scalars, strict=True))

    def _autocast(self, device: torch.device) -> contextlib.AbstractContextManager:
        """Returns a context in which training uses the configured precision."""
        if self.config.precision == "float32":
            return contextlib.nullcontext()
        return torch.autocast(device.type, torch.bfloat16)

    # Checkpoints

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        damaged = _not_finite(self.state_dict())
        if damaged:
            raise TrainingDivergedError(
                f"After training step {int(self.step)}, the weight {damaged[0]} is not finite, and no "
                "checkpoint is saved. Lower --policy.optimizer_lr, or limit the gradient with "
                "--policy.grad_clip_norm=10, and continue from the last checkpoint with --resume=true."
            )
        # LeRobot 0.6.1 may pass a `state_dict`; later versions do not, and call this on every process.
        super()._save_pretrained(save_directory, *args, **kwargs)
        if not torch.distributed.is_initialized() or torch.distributed.get_rank() == 0:
            bank = self.demonstrations if self.config.uses_demonstrations else None
            known = self.instructions
            if known is not None and self.paraphrases is not None:
                known = self.paraphrases.left_out_of(known)
            write_task_bank(save_directory / TASK_BANK, known, bank)

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> Self:
        """Loads a policy with the instructions and demonstrations that were saved with it.

        See `PreTrainedPolicy.from_pretrained` for the arguments.

        Raises:
            ValueError: A file of the checkpoint is damaged, or does not fit the others.
        """
        if kwargs.get("config") is not None:
            saved = json.loads(checkpoint_file(pretrained_name_or_path, CONFIG_NAME, **kwargs).read_text())
            _check_options(kwargs["config"], saved, kwargs.get("dataset_stats") is not None)
        try:
            policy = super().from_pretrained(pretrained_name_or_path, **{**kwargs, "strict": True})
        except RuntimeError as error:
            raise UserError(
                f"{pretrained_name_or_path} does not have the weights of this policy: "
                f"{str(error).splitlines()[-1].strip()} Its config.json belongs to other weights, or to "
                "another version."
            ) from error
        damaged = _not_finite(policy.state_dict())
        if damaged:
            raise UserError(
                f"{pretrained_name_or_path} is damaged: the weight {damaged[0]} has numbers that are not "
                "finite."
            )
        if policy._stats is not None:
            # Training normalizes states by its own dataset, not by that of the weights that it begins with.
            policy.state_limits = StateLimits(policy.config.state_dim, policy._stats).to(policy.step.device)
        path = checkpoint_file(pretrained_name_or_path, TASK_BANK, **kwargs)
        bank = read_task_bank(path, policy.instructions)
        # Demonstrations named on the command line replace those of the checkpoint.
        if policy.demonstrations is None and bank is not None:
            policy.demonstrations = bank.to(policy.config.device)
        return policy

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> Any:
        """Returns the card of the policy on the Hugging Face Hub. The arguments are those of LeRobot."""
        demonstrated = [] if self.demonstrations is None else list(self.demonstrations.rows)
        return policy_card(self.config, demonstrated, dataset_repo_id, license, tags, cfg, dataset_meta)


def _check_options(config: TaskConditionedConfig, saved: Mapping[str, Any], is_trained: bool) -> None:
    """Checks that no option is changed that says what the numbers of observations and actions mean.

    Args:
        config: The configuration, with options of the command line.
        saved: The checkpoint's configuration.
        is_trained: Whether the policy is trained further, maybe on other data.

    Raises:
        ValueError: One is changed.
    """
    for name in config.trained_options if is_trained else config.trained_options + config.dataset_options:
        if name in saved and getattr(config, name) != saved[name]:
            raise UserError(
                f"The checkpoint was trained with `{name}` {saved[name]!r}, and cannot be used with "
                f"{getattr(config, name)!r}. Leave out --policy.{name}."
            )


def _read_paraphrases(config: TaskConditionedConfig, meta: LeRobotDatasetMetadata) -> Paraphrases | None:
    """Reads the sentences for training, by task string."""
    if config.paraphrases is None:
        return None
    sentences = read_sentences(config.paraphrases)
    if not sentences.keys() & set(meta.tasks.index):
        raise UserError(
            f"{config.paraphrases} has sentences for none of the dataset's tasks, such as "
            f"{meta.tasks.index[0]!r}, but for tasks such as {next(iter(sentences))!r}."
        )
    return Paraphrases(sentences, config.p_paraphrase)


def _not_finite(tensors: Mapping[str, Any]) -> list[str]:
    """Returns the names of the tensors with numbers that are not finite."""
    return [
        name
        for name, values in tensors.items()
        if isinstance(values, Tensor) and values.is_floating_point() and not bool(values.isfinite().all())
    ]


def _why_not_finite(batch: dict[str, Any], step: int) -> str:
    """Returns an error message for a loss that is not finite."""
    damaged = _not_finite(batch)
    cause = (
        f"In its batch, {', '.join(f'`{name}`' for name in damaged)} has numbers that are not finite: the "
        "dataset or its statistics are damaged."
        if damaged
        else "The batch was finite, so the training has diverged: lower --policy.optimizer_lr, or limit the "
        "gradient with --policy.grad_clip_norm=10."
    )
    return (
        f"The loss of training step {step + 1} is not finite. {cause} If a checkpoint was saved "
        "before, continue from it with --resume=true."
    )
