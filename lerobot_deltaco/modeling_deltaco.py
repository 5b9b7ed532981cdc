"""The policy of DeL-TaCo (Yu & Mooney, ICLR 2023), and the baselines and ablations of the paper."""

# No `from __future__ import annotations`: LeRobot's tests expect the annotation of `config` to be a class.

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F  # noqa: N812
from huggingface_hub import ModelCard
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import NormalizerProcessorStep, TransitionKey, create_transition
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import safe_open
from torch import Tensor, nn

from lerobot_deltaco.cards.policy_card import policy_card
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.data.paraphrases import read_paraphrases
from lerobot_deltaco.network_factory import (
    make_demo_encoder,
    make_frozen_encoder,
    make_goal_conditioning,
    make_language_head,
    make_policy_network,
)
from lerobot_deltaco.policy.correspondence import Given
from lerobot_deltaco.policy.demo_encoders import ArrayEncoder, crop_array
from lerobot_deltaco.policy.demonstration_choice import (
    choose_episode,
    choose_eval_demonstrations,
    choose_training_demonstrations,
)
from lerobot_deltaco.policy.demonstrations import (
    Demonstrated,
    DemonstrationSet,
    RobotData,
    kept_frame_indices,
    load_demonstrations,
    load_robot_data,
)
from lerobot_deltaco.policy.finite_loss import FiniteLoss, check_weights_to_save, non_finite_weight
from lerobot_deltaco.policy.goal_conditioning import Demonstrations, FoundGoals
from lerobot_deltaco.policy.goal_training import GoalBatch, GoalTrainer, draw_given
from lerobot_deltaco.policy.inference import FoldedPolicy
from lerobot_deltaco.policy.initial_weights import initialize_demo_encoder, initialize_policy
from lerobot_deltaco.policy.keyframes import find_keyframes
from lerobot_deltaco.policy.language import InstructionTable
from lerobot_deltaco.policy.losses import (
    contrastive_logits,
    contrastive_loss,
    cosine_loss,
    gripper_loss,
    mixture_negative_log_likelihood,
)
from lerobot_deltaco.policy.memory import keep_freed_memory
from lerobot_deltaco.policy.networks import random_crop, random_shifts, shift_images
from lerobot_deltaco.policy.paraphrases import Paraphrases
from lerobot_deltaco.policy.processor_files import check_processor_files
from lerobot_deltaco.policy.recoloring import random_recolorings, recolor
from lerobot_deltaco.policy.scalars import LoggedScalars
from lerobot_deltaco.policy.step_generator import step_generator
from lerobot_deltaco.policy.task_conditioning import EpisodeTasks, TaskConditioning
from lerobot_deltaco.policy.task_file import (
    TASK_FILE,
    StoredDemonstrations,
    TaskFile,
    check_demonstrations,
    check_features,
    check_grasp_states,
    find_task_file,
    hub_options,
    read_task_file,
    write_task_file,
)
from lerobot_deltaco.policy.training_episodes import training_episodes

logger = logging.getLogger(__name__)

# Prefix that the names of the weights of `DeltacoPolicy.model` had in version 0.1.
OLD_MODEL_PREFIX = "policy."


class DeltacoPolicy(PreTrainedPolicy):
    """A policy that performs the task of a demonstration, an instruction, or both.

    In training, each sample's demonstration is another episode of its task in the training dataset. In
    evaluation, demonstrations come from the dataset that the configuration names, or from the checkpoint.
    The instruction is the batch's `task`.

    Args:
        config: Configuration of the policy. LeRobot fills in its input and output features beforehand.
        dataset_stats: Statistics of the training dataset, by which the processors normalize; None in
            evaluation.
        dataset_meta: Metadata of the training dataset; None in evaluation.

    Attributes:
        model: Network that predicts actions.
        instructions: Embeddings of instructions.
        eval_demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
        train_demonstrations: Demonstrations for training; None until the first training batch.
    """

    config_class = DeltacoConfig
    name = "deltaco"

    def __init__(
        self,
        config: DeltacoConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        self.config: DeltacoConfig = config
        self._meta, self._stats = dataset_meta, dataset_stats
        config.resolve(dataset_meta.features if dataset_meta else None)
        if dataset_meta is not None:
            config.check_episodes(dataset_meta.total_episodes)
        self.instructions = InstructionTable(config.language_encoder)
        if config.instruction_embeddings is not None:
            self.instructions.read(Path(config.instruction_embeddings))
        self.eval_demonstrations: DemonstrationSet | None = None
        self.train_demonstrations: DemonstrationSet | None = None
        self.goal_trainer: GoalTrainer | None = None
        self.paraphrases = _read_paraphrases(config)
        self._train_demonstrations_are_complete = False  # whether they surely include every training episode
        self._demonstrated_as: Mapping[str, str] = {}
        self._episode_tasks = EpisodeTasks()
        if config.demo_repo_id is not None:
            self.eval_demonstrations = self._load_eval_demonstrations(config.demo_repo_id, config.demo_root)
        if config.method == "one_hot" and not config.one_hot_tasks:
            config.one_hot_tasks = self._one_hot_vocabulary()

        self._frozen = make_frozen_encoder(config)
        self.model = make_policy_network(config)
        self.demo_encoder = make_demo_encoder(config)
        self.goals = make_goal_conditioning(config)
        self.language_head = make_language_head(config)
        if config.initial_weights == "authors":
            initialize_policy(self.model)
            if isinstance(self.demo_encoder, ArrayEncoder):
                initialize_demo_encoder(self.demo_encoder)
        # Draws are a function of the seed and the step, so that a resumed run repeats an uninterrupted one.
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        if config.compile:
            for network in (self.model, self.demo_encoder):
                if network is not None:
                    network.compile()
        self._folded = FoldedPolicy(self.model)
        self._finite_loss = FiniteLoss()

    def get_optim_params(self) -> list[nn.Parameter]:
        """All weights. The language encoder is frozen, and not among them."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    # Training

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, LoggedScalars]:
        """The loss of a batch: L = L_pi + alpha_d L_demo (the paper's equation 3).

        Args:
            batch: Batch from the preprocessor; it is not changed.
                `observation.image`, or any cameras: (batch, 3, H, W) float in 0..1.
                `observation.state`, if there is one: (batch, state), normalized.
                `action`: (batch, action), -1..1.
                `task`: list of instructions, (batch,).
                `episode_index`, if demonstrations are used: (batch,) int64.
            reduction: "mean", or "none" for the loss of each sample.

        Returns:
            The loss, () or (batch,), and the scalars to log.
        """
        tasks = list(batch["task"])
        device = batch[ACTION].device
        if self.training:
            self._finite_loss.check()
            if device.type == "cpu":
                keep_freed_memory()
        step = int(self.step) if self.training else 0
        generator = step_generator(self.config.seed, step, _process_rank())
        if self.goals is not None:
            return self._goal_forward(batch, tasks, generator, reduction)
        images = self._images(batch)
        if self.training and self.config.crop_padding:
            images = random_crop(images, self.config.crop_padding, generator)
        demo = language = None
        distinct = {task: n for n, task in enumerate(dict.fromkeys(tasks))}
        column = torch.tensor([distinct[task] for task in tasks], device=device)
        if self.config.uses_demo:
            demo = self._train_demo_embeddings(batch["episode_index"], tasks, column, generator)
        if self.config.uses_language:
            known, language = self._language_embeddings(list(distinct), tasks, column, generator)

        if self.config.method == "mcil":
            # The mean of the losses with the instruction's embedding and with the demonstration's.
            parts = [self._imitation_loss(batch, images, film, None) for film in (language, demo)]
            loss = torch.stack([part[0] for part in parts]).mean(dim=0)
            logged = {name: torch.stack([part[1][name] for part in parts]).mean() for name in parts[0][1]}
        else:
            film, concat = self.conditioning_inputs(tasks, demo, language)
            loss, logged = self._imitation_loss(batch, images, film, concat)

        if self.config.conditioning.encoder_loss != "none":
            assert demo is not None
            assert language is not None
            logits = contrastive_logits(demo.float(), known, self.config.temperature)  # (batch, distinct)
            if self.config.conditioning.encoder_loss == "contrastive":
                encoder_loss = contrastive_loss(logits, column)
            else:
                encoder_loss = cosine_loss(demo.float(), language)
            loss = loss + self.config.encoder_loss_weight * encoder_loss
            logged["encoder_loss"] = encoder_loss.mean()
            logged["demo_accuracy"] = (logits.argmax(dim=1) == column).float().mean()
        if self.training:
            self.step += 1
            self._finite_loss.remember(loss, self._numbers_of(batch), self.step)
        return loss.mean() if reduction == "mean" else loss, LoggedScalars(logged)

    def _language_embeddings(
        self, distinct: list[str], tasks: list[str], column: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Embeddings of the batch's tasks, (distinct, embedding), and of the samples', (batch, embedding).

        With sentences in people's own words, each sample and each task has one drawn for it.
        """
        if self.paraphrases is None or not self.paraphrases.drawn:
            known = self._embed_instructions(distinct, column.device)
            return known, known[column]
        known = self._embed_instructions(self._draw_instructions(distinct, generator), column.device)
        return known, self._embed_instructions(self._draw_instructions(tasks, generator), column.device)

    def _draw_instructions(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """The instruction of each sample: its task string, or a sentence in people's own words."""
        if self.paraphrases is None or not self.paraphrases.drawn or not self.config.uses_language:
            return list(tasks)
        # All at once, the first time.
        self.instructions.add(self.paraphrases.drawn_sentences)
        return self.paraphrases.draw(tasks, generator)

    def _embed_instructions(self, instructions: Sequence[str], device: torch.device) -> Tensor:
        """Embeddings of instructions, (instructions, embedding)."""
        embeddings = self.instructions(instructions, device, unit=self.config.has_unit_language)
        return embeddings if self.language_head is None else self.language_head(embeddings)

    def _goal_forward(
        self, batch: dict[str, Any], tasks: Sequence[str], generator: torch.Generator, reduction: str
    ) -> tuple[Tensor, LoggedScalars]:
        """As `forward`, with goals: the policy loss, and that of finding the goals on a share of the samples.

        The policy's network gets the goals of each sample's own episode, with noise; the locator learns, from
        other episodes' demonstrations, to find them. So neither waits for the other.
        """
        images = self._images(batch)
        n_samples, device = len(images), images.device
        instructions = self._draw_instructions(tasks, generator)
        language = self._embed_instructions(instructions, device) if self.config.uses_language else None
        demonstrations = self._training_demonstrations(device)
        assert self.goals is not None
        assert self.goal_trainer is not None
        goals = self.goal_trainer.goals
        rows = demonstrations.episode_rows(batch["episode_index"])
        known = (rows >= 0) & goals.found[rows]
        places, depths = goals.places[rows], self.goal_trainer.depths  # (batch, 2, 2)
        if depths is not None:
            depths = depths[rows].nan_to_num()
        logged: dict[str, Tensor] = {}
        if self.training:
            if not self._train_demonstrations_are_complete:
                demonstrations.check_episodes(batch["episode_index"], rows)
            recolorings = random_recolorings(n_samples, self.config.recolor_share, generator)
            n_located = max(1, round(self.config.locator_share * n_samples))
            some = torch.arange(n_located) * n_samples // n_located
            locator_losses = self._locator_losses(
                batch, tasks, instructions, rows, some, recolorings, generator
            )
            places = places + self.config.goal_noise * torch.randn(places.shape, generator=generator).to(
                device
            )
            if depths is not None:
                noise = torch.randn(depths.shape, generator=generator).to(device)
                depths = depths + self.config.depth_noise * noise
            if self.config.crop_padding:
                shifts = random_shifts(n_samples, self.config.crop_padding, generator)
                images = shift_images(images, shifts, self.config.crop_padding)
                places = places + (shifts * 2 / self.config.image_size).to(device)[:, None]
            images = recolor(images, recolorings)
        elif not known.all():
            # Of episodes that are held back for a validation loss, no goals are known: those that are found
            # in the present image stand in for them.
            found = self._find_goals(images[:, 0], tasks, [0] * n_samples)
            places = torch.where(known[:, None, None], places, found.places)
            if depths is not None and found.depths is not None:
                depths = torch.where(known, depths, found.depths)
        film, concat = self.conditioning_inputs(tasks, None, language)
        loss, parts = self._imitation_loss(batch, images, film, concat, places, depths)
        logged |= parts
        if self.training:
            share = n_samples / n_located
            loss = loss.index_add(0, some.to(device), share * locator_losses.sum(dim=1))
            names = ("grasp_loss", "release_loss", "depth_loss", "attention_loss")
            logged |= dict(zip(names, locator_losses.mean(dim=0), strict=True))
            self.step += 1
            self._finite_loss.remember(loss, self._numbers_of(batch), self.step)
        return loss.mean() if reduction == "mean" else loss, LoggedScalars(logged)

    def _locator_losses(
        self,
        batch: dict[str, Any],
        tasks: Sequence[str],
        instructions: Sequence[str],
        rows: Tensor,
        some: Tensor,
        recolorings: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """How well the goals of some samples are found, (some, 4): see `GoalTrainer`.

        Args:
            batch: As in `forward`.
            tasks: Task string of each sample.
            instructions: Instruction of each sample, in whatever words.
            rows: Rows of the samples' episodes among the demonstrations, (batch,).
            some: Indices of the samples, on the CPU.
            recolorings: Changes of the samples' colors, (batch, 3, 3), on the CPU.
            generator: Source of the draws, on the CPU.
        """
        assert self.goal_trainer is not None
        config, here, given = self.config, some.to(rows.device), None
        if config.takes_either_modality:
            drawn = draw_given(len(some), config.demo_dropout, config.instruction_dropout, generator)
            given = Given(*(part.to(rows.device) for part in drawn))
        with self._autocast(rows.device):
            chosen = GoalBatch(
                batch["episode_index"][here],
                rows[here],
                [tasks[sample] for sample in some.tolist()],
                self._goal_condition([instructions[sample] for sample in some.tolist()]),
                recolorings[some],
                given,
            )
            return self.goal_trainer.losses(
                chosen, config.uses_demo, config.demo_crop_padding, config.color_blind_tasks, generator
            )

    def _goal_condition(self, tasks: Sequence[str]) -> Tensor | None:
        """The locator's condition for tasks, (tasks, condition)."""
        if self.config.method == "one_hot":
            return self._one_hot(tasks)
        return self._embed_instructions(tasks, self.step.device) if self.config.uses_language else None

    def _find_goals(self, scenes: Tensor, tasks: Sequence[str], trials: Sequence[int]) -> FoundGoals:
        """Finds the goals of tasks in scenes (batch, 3, H, W), by the demonstrations of these trials."""
        assert self.goals is not None
        chosen, left_out = None, self.config.leave_out
        if self.config.uses_demo and left_out != "demo":
            n_each = self.config.n_demonstrations
            ends, depths = [], []
            for number in range(n_each):
                turns = [trial * n_each + number for trial in trials]
                demonstrations, rows = self._choose_eval_demonstrations(tasks, turns)
                ends.append(demonstrations.frames[rows][:, [0, -1]].float() / 255)
                depths.append(self._demonstrated_depths(demonstrations, rows))
            chosen = Demonstrations(
                torch.stack(ends, dim=1).to(scenes.device), torch.stack(depths, dim=1).to(scenes.device)
            )
        condition = None if left_out == "instruction" else self._goal_condition(tasks)
        return self.goals.find(scenes, chosen, condition)

    def _demonstrated_depths(self, demonstrations: DemonstrationSet, rows: Tensor) -> Tensor:
        """Depths of the grasps of demonstrations, (batch,); NaN where they are not known."""
        assert self.goals is not None
        states = demonstrations.grasp_states
        if states is None or self.goals.depth is None:
            return torch.full((len(rows),), torch.nan, device=rows.device)
        return self.goals.states.depths(states[rows])

    def _imitation_loss(
        self,
        batch: dict[str, Any],
        images: Tensor,
        film: Tensor | None,
        concat: Tensor | None,
        goals: Tensor | None = None,
        depths: Tensor | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The policy loss L_pi (equation 2) of each sample, (batch,), and its parts to log."""
        predicted, gripper = self.model(images, film, self._concatenated(batch, concat, goals, depths), goals)
        action = batch[ACTION].float()
        motion, target = self._split_action(action)
        likelihood = mixture_negative_log_likelihood(
            predicted.means.float(), predicted.logits.float(), self.model.log_std.float(), motion
        )
        error = (predicted.mean.float() - motion).square()
        logged = {"motion_nll": likelihood.mean(), "motion_mse": error.mean()}
        if gripper is None:
            return likelihood, logged
        assert target is not None
        assert self.config.gripper_weight is not None
        error = gripper_loss(gripper.float(), target, self.config.gripper_loss)
        logged["gripper_loss"] = error.mean()
        logged["gripper_accuracy"] = ((gripper > 0) == (target > 0.5)).float().mean()
        return likelihood + self.config.gripper_weight * error, logged

    def set_train_demonstrations(
        self, demonstrations: DemonstrationSet, robot_data: RobotData | None = None
    ) -> None:
        """Sets the demonstrations for training, which are otherwise read from the disk with the first batch.

        Args:
            demonstrations: Demonstrations, which include every episode of the training.
            robot_data: States and actions of the robot in them, for `demo_encoder=correspondence`.
        """
        self.train_demonstrations = demonstrations
        self._train_demonstrations_are_complete = True
        if self.goals is not None:
            assert robot_data is not None
            self._fit_goals(robot_data)

    def _fit_goals(self, robot_data: RobotData) -> None:
        """Finds the goals of the training episodes, and the robot's states there."""
        assert self.train_demonstrations is not None
        assert self.goals is not None
        assert self.config.gripper_index is not None
        self.goal_trainer = GoalTrainer(
            self.goals,
            self.train_demonstrations,
            robot_data,
            self.config.gripper_index,
            self._normalize_states,
        )
        states, found = self.goal_trainer.goals.states[:, 0], self.goal_trainer.goals.found
        self.train_demonstrations.grasp_states = torch.where(found[:, None], states, torch.nan)

    def _normalize_states(self, states: Tensor) -> Tensor:
        """Robot states of the dataset (n, state) as the preprocessor makes them, on the CPU."""
        normalize = NormalizerProcessorStep(
            {OBS_STATE: self.config.robot_state_feature}, self.config.normalization_mapping, self._stats
        )
        normalized = normalize(create_transition(observation={OBS_STATE: states.cpu()}))
        return normalized[TransitionKey.OBSERVATION][OBS_STATE]

    def _train_demo_embeddings(
        self, episodes: Tensor, tasks: Sequence[str], column: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Embeddings of the samples' demonstrations, (batch, embedding); `column` numbers their tasks."""
        demonstrations = self._training_demonstrations(episodes.device)
        if not self.training:
            # The episodes of a validation loss may be held back from the demonstrations.
            rows = demonstrations.sample_other_episodes(episodes, generator, tasks=tasks)
            return self._encode_demo(demonstrations, rows, generator)
        rows, which = choose_training_demonstrations(
            demonstrations,
            episodes,
            column,
            len(set(tasks)),
            self.config.demos_per_task,
            generator,
            check=not self._train_demonstrations_are_complete,
        )
        embeddings = self._encode_demo(demonstrations, rows, generator)
        return embeddings if which is None else embeddings[which]

    def _training_demonstrations(self, device: torch.device) -> DemonstrationSet:
        if self.train_demonstrations is None:
            if self._meta is None:
                raise ValueError(
                    "A policy is trained with the metadata of its dataset. Pass them as `dataset_meta`."
                )
            if self.config.tasks_per_batch:
                logger.warning(
                    "`tasks_per_batch` has no effect: this training loop draws samples of any tasks. Train "
                    "with `deltaco-train`, which takes the same arguments."
                )
            chosen = self.config.demo_episodes or training_episodes(self._meta)
            loaded = self._load_demonstrations(self._meta.repo_id, self._meta.root, chosen)
            self.train_demonstrations = loaded.to(device)
            if self.goals is not None:
                self._fit_goals(load_robot_data(self._meta.repo_id, self._meta.root, chosen))
        return self.train_demonstrations

    # Evaluation

    def reset(self) -> None:
        """Starts an episode, of this thread if several threads evaluate tasks at the same time."""
        self._episode_tasks.begin_episode()

    def begin_evaluation(self) -> None:
        """Starts an evaluation: the demonstrations of each task begin with the first again."""
        self._episode_tasks.begin_evaluation()

    def demonstrated(self, sample: int) -> list[Demonstrated]:
        """The demonstrations of a sample in this thread's episode; none before its first action."""
        return self._episode_tasks.demonstrated(sample)

    @contextmanager
    def demonstrated_as(self, tasks: Mapping[str, str]) -> Iterator[None]:
        """Uses other tasks' demonstrations with some instructions, while the context is open.

        For example, to perform a task from a demonstration and a sentence of one's own:
        `with policy.demonstrated_as({"fetch the jar": task.instruction}): ...`

        Args:
            tasks: For an instruction, the task string whose demonstrations are used. It is read when an
                episode starts; instructions that it lacks keep their own demonstrations.
        """
        previous, self._demonstrated_as = self._demonstrated_as, tasks
        try:
            yield
        finally:
            self._demonstrated_as = previous

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """The mean action; with several motion modes, that of the likeliest one.

        Args:
            batch: As in `forward`, without `action` and `episode_index`.

        Returns:
            Actions, (batch, action), normalized as in `forward`.

        Raises:
            ValueError: There is no instruction, or a task has no demonstration.
        """
        tasks = self._instructions_of(batch)
        images = self._images(batch)
        with self._autocast(images.device):
            task = self._episode_tasks.conditioning(tasks, lambda tasks: self.encode_task(tasks, images))
            places, depths = (None, None) if task.goals is None else task.goals[:2]
            concatenated = self._concatenated(batch, task.concat, places, depths)
            motion, gripper = task.model(images, task.film, concatenated, places)
        if gripper is not None:
            gripper = torch.sigmoid(gripper.float())
        return self._join_action(motion.mean.float(), gripper)

    @staticmethod
    def _instructions_of(batch: dict[str, Any]) -> tuple[str, ...]:
        """The instruction of each sample."""
        tasks = batch.get("task")
        if isinstance(tasks, (list, tuple)) and tasks and all(isinstance(task, str) for task in tasks):
            return tuple(tasks)
        raise ValueError(
            "`task` must be a list with an instruction for each sample of the batch. Got "
            f"{'none' if tasks is None else repr(tasks)}. LeRobot takes it from the environment's "
            '`task_description`, or from --task; in Python, set observation["task"] before the preprocessor.'
        )

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """The action as a chunk of one, (batch, 1, action)."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def encode_task(self, tasks: tuple[str, ...], images: Tensor) -> TaskConditioning:
        """Encodes the demonstrations and instructions of the tasks of a batch, at the start of an episode.

        Args:
            tasks: Instruction of each sample.
            images: Images of the scenes, (batch, cameras, 3, size, size) in 0..1, in which goals are found.

        Raises:
            ValueError: A task has no demonstration.
        """
        trials = self._episode_tasks.count_trials(tasks)
        demo = language = goals = None
        if self.goals is not None:
            goals = self._find_goals(images[:, 0], tasks, trials)
        elif self.config.uses_demo:
            demonstrations, rows = self._choose_eval_demonstrations(tasks, trials)
            generator = torch.Generator().manual_seed(self.config.seed)
            demo = self._encode_demo(demonstrations, rows, generator)
        if self.config.uses_language:
            language = self._embed_instructions(tasks, images.device)
        if self.config.method == "mcil":
            assert language is not None
            assert demo is not None
            # The trials of a task use the instruction and the demonstration in turn.
            by_language = torch.tensor(trials, device=images.device) % 2 == 0
            either = torch.where(by_language[:, None], language, demo)
            return TaskConditioning(tasks, either, None, self._acting_model())
        film, concat = self.conditioning_inputs(tasks, demo, language)
        return TaskConditioning(tasks, film, concat, self._acting_model(), goals)

    def _choose_eval_demonstrations(
        self, tasks: Sequence[str], trials: Sequence[int]
    ) -> tuple[DemonstrationSet, Tensor]:
        if self.config.demo_episode is not None and self.eval_demonstrations is not None:
            chosen, rows = choose_episode(self.eval_demonstrations, self.config.demo_episode, len(tasks))
        else:
            candidates = (self.eval_demonstrations, self.train_demonstrations)
            demonstrated_as = dict(self._demonstrated_as)
            if self.config.demo_task is not None:
                demonstrated_as |= dict.fromkeys(tasks, self.config.demo_task)
            if self.paraphrases is not None:
                known = {name for candidate in candidates if candidate is not None for name in candidate.rows}
                demonstrated_as = self.paraphrases.tasks_of(tasks, known) | demonstrated_as
            chosen, rows = choose_eval_demonstrations(candidates, tasks, trials, demonstrated_as)
        if not self.training:
            self._episode_tasks.note_demonstrations(chosen.describe(rows))
        return chosen, rows

    def _acting_model(self) -> nn.Module:
        """The network that acts: in evaluation mode, a copy that is faster for small batches."""
        return self.model if self.training else self._folded.network()

    def _autocast(self, device: torch.device) -> AbstractContextManager:
        if self.config.dtype == "float32":
            return nullcontext()
        return torch.autocast(device.type, torch.bfloat16)

    # Training and evaluation

    def _numbers_of(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The actions and states of a batch, by name."""
        names = (ACTION, OBS_STATE) if self.config.robot_state_feature else (ACTION,)
        return {name: batch[name] for name in names}

    def _images(self, batch: dict[str, Any]) -> Tensor:
        """Images of all cameras, that of the demonstrations first, (batch, cameras, 3, size, size)."""
        size = self.config.image_size
        images = []
        for name in self.config.cameras:
            image = batch[name]  # (batch, 3, H, W)
            if image.shape[-2:] != (size, size):
                image = F.interpolate(image, (size, size), mode="bilinear", antialias=True)
            images.append(image)
        return torch.stack(images, dim=1)

    def _concatenated(
        self,
        batch: dict[str, Any],
        embedding: Tensor | None,
        goals: Tensor | None = None,
        depths: Tensor | None = None,
    ) -> Tensor | None:
        """What is concatenated to the images' features: an embedding, the state, its way to the goals."""
        parts = [embedding] if embedding is not None else []
        if self.config.robot_state_feature:
            parts.append(batch[OBS_STATE])
        if goals is not None:
            assert self.goals is not None
            parts.append(self.goals.offsets(goals, depths, batch[OBS_STATE].float()))
        return torch.cat(parts, dim=-1) if parts else None

    def conditioning_inputs(
        self, tasks: Sequence[str], demo: Tensor | None, language: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        """The embeddings that go through FiLM, and those that are concatenated to the feature points.

        Args:
            tasks: Instruction of each sample.
            demo: Embeddings of demonstrations, (batch, embedding); None if they are not used.
            language: Embeddings of instructions, (batch, embedding); None if they are not used.
        """

        def source(name: str) -> Tensor | None:
            if name == "none":
                return None
            if name == "one_hot":
                return self._one_hot(tasks)
            used = [demo if part == "demo" else language for part in name.split("+")]
            return torch.cat([embedding for embedding in used if embedding is not None], dim=-1)

        film, concat, _ = self.config.conditioning
        return source(film), source(concat)

    def _one_hot(self, tasks: Sequence[str]) -> Tensor:
        unknown = next((task for task in tasks if task not in self.config.one_hot_tasks), None)
        if unknown is not None:
            raise ValueError(
                f"This one-hot policy does not know the task {unknown!r}. It knows the "
                f"{len(self.config.one_hot_tasks)} tasks of its training and demonstration datasets."
            )
        places = {task: n for n, task in enumerate(self.config.one_hot_tasks)}
        indices = torch.tensor([places[task] for task in tasks], device=self.step.device)
        return F.one_hot(indices, len(places)).float()

    def _encode_demo(
        self, demonstrations: DemonstrationSet, rows: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Unit embeddings of demonstrations, (batch, embedding)."""
        assert self.demo_encoder is not None
        if self._frozen is not None:
            if self.training:
                return self.demo_encoder(self._frozen.drawn(demonstrations, rows, generator))
            return self.demo_encoder(self._frozen.plain(demonstrations, rows))
        config = self.config
        frames = demonstrations.sample_frames(
            rows, config.n_demo_frames, generator, config.demo_frames_between == "spread"
        )
        if self.training and config.demo_crop_padding:
            if config.demo_encoder == "cnn" and config.demo_crop == "array":
                frames = crop_array(frames, config.demo_rows, config.demo_crop_padding, generator)
            else:
                frames = random_crop(frames, config.demo_crop_padding, generator)
        return self.demo_encoder(frames)

    def _split_action(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        """The motion of an action, and its gripper in 0..1 if it has one."""
        index = self.config.gripper_index
        if index is None:
            return action, None
        motion = torch.cat([action[:, :index], action[:, index + 1 :]], dim=1)
        return motion, (action[:, index] + 1) / 2

    def _join_action(self, motion: Tensor, gripper: Tensor | None) -> Tensor:
        """The inverse of `_split_action`."""
        index = self.config.gripper_index
        if index is None or gripper is None:
            return motion
        return torch.cat([motion[:, :index], 2 * gripper[:, None] - 1, motion[:, index:]], dim=1)

    # Datasets and checkpoints

    def _load_demonstrations(
        self, repo_id: str, root: str | Path | None, episodes: Sequence[int] | None
    ) -> DemonstrationSet:
        camera = self.config.cameras[0]
        size, n_frames = self.config.image_size, self.config.n_demo_frames
        return load_demonstrations(repo_id, root, episodes, camera, size, n_frames)

    def _load_eval_demonstrations(self, repo_id: str, root: str | Path | None) -> DemonstrationSet:
        demonstrations = self._load_demonstrations(repo_id, root, None)
        index = self.config.gripper_index
        if self.config.locates_goals and self.config.grasp_depth and index is not None:
            data = load_robot_data(repo_id, root, demonstrations.episodes.tolist())
            keyframes = find_keyframes(data.states, data.actions[:, index], data.spans)
            demonstrations.grasp_states = keyframes.grasp_states
        return demonstrations

    def _one_hot_vocabulary(self) -> list[str]:
        """Task strings of the training and demonstration datasets."""
        if self._meta is None:
            raise ValueError(
                "A one-hot policy knows the tasks of its dataset. Pass the metadata as `dataset_meta`."
            )
        return list(
            dict.fromkeys(
                [
                    *self._meta.tasks.index,
                    *(self.eval_demonstrations.rows if self.eval_demonstrations else ()),
                ]
            )
        )

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        self._finite_loss.check()
        check_weights_to_save(self, int(self.step))
        # LeRobot 0.6.1 may pass a `state_dict`, later versions do not; it is handed on as it comes.
        # What was read from these files is saved with the policy, whose next user has other files.
        sources = (
            "demo_repo_id",
            "demo_root",
            "instruction_embeddings",
            "instructions",
            "vision_encoder_weights",
            "demo_features_dir",
        )
        given = {name: getattr(self.config, name) for name in sources}
        try:
            for name in sources:
                setattr(self.config, name, None)
            super()._save_pretrained(save_directory, *args, **kwargs)
        finally:
            for name, value in given.items():
                setattr(self.config, name, value)
        if not _is_main_process():
            return  # versions after 0.6.1 call this on every process
        contents = self.instructions.contents()
        if self.paraphrases is not None:
            contents = contents._replace(paraphrases=self.paraphrases.known)
        known = self.eval_demonstrations
        if known is not None and self.config.uses_demo:
            # With their features, the frozen encoder is not needed for them.
            features = None if self._frozen is None else self._frozen.plain(known)
            frames, episodes = known.frames.cpu(), known.episodes.cpu()
            stored = StoredDemonstrations(
                frames, episodes, known.tasks, known.target_objects, features, known.grasp_states
            )
            contents = contents._replace(demonstrations=stored)
        write_task_file(save_directory / TASK_FILE, contents)

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> Self:
        """Loads a policy with the instructions and demonstrations that were saved with it.

        See `PreTrainedPolicy.from_pretrained` for the arguments.

        Raises:
            ProcessorFileError: The checkpoint's processors would run code of their own when they are loaded.
            ValueError: A file of the checkpoint is damaged, or does not fit the others.
        """
        # Whoever loads a policy loads its processors next.
        check_processor_files(pretrained_name_or_path, **hub_options(kwargs))
        path = find_task_file(pretrained_name_or_path, **kwargs)
        contents = read_task_file(path)
        config = kwargs.get("config")
        if config is not None:
            # Another language encoder is an error of its own, before the weights turn out not to fit.
            InstructionTable(config.language_encoder).take(contents, path)
        policy = super().from_pretrained(pretrained_name_or_path, **kwargs)
        policy._take_tasks(contents, path)
        return policy

    @classmethod
    def _load_as_safetensor(cls, model: Self, model_file: str, map_location: str, strict: bool) -> Self:
        policy = super()._load_as_safetensor(model, model_file, map_location, strict)
        with safe_open(model_file, framework="pt") as file:
            stored = set(file.keys())
        expected = set(policy.state_dict())
        if stored != expected:
            missing, unknown = sorted(expected - stored), sorted(stored - expected)
            raise ValueError(
                f"{model_file} does not have the weights of this policy: it lacks {missing[:3] or 'none'}, "
                f"and has the unknown {unknown[:3] or 'none'}. The config.json beside it belongs to other "
                "weights, or to another version."
            )
        name = non_finite_weight(policy)
        if name is not None:
            raise ValueError(f"{model_file} is damaged: the weight {name} has numbers that are not finite.")
        return policy

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Loads weights. See `torch.nn.Module.load_state_dict`.

        Raises:
            ValueError: The weights were saved by a version that named them otherwise.
        """
        if any(name.startswith(OLD_MODEL_PREFIX) for name in state_dict):
            raise ValueError(
                "An earlier version of lerobot_policy_deltaco saved these weights: those of the policy's "
                f"network are named `{OLD_MODEL_PREFIX}*`. Train the policy again, or rename them in "
                f"model.safetensors: replace the prefix `{OLD_MODEL_PREFIX}` by `model.`."
            )
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card of the policy on the Hugging Face Hub. The arguments are those of LeRobot."""
        demonstrations = list(self.eval_demonstrations.rows) if self.eval_demonstrations is not None else []
        n_known = len(self.instructions.rows)
        return policy_card(
            self.config, demonstrations, n_known, dataset_repo_id, license, tags, cfg, dataset_meta
        )

    def _take_tasks(self, contents: TaskFile, path: Path) -> None:
        """Takes what the checkpoint knows of tasks."""
        self.instructions.take(contents, path)
        if self.paraphrases is None and contents.paraphrases:
            self.paraphrases = Paraphrases(contents.paraphrases)
        if contents.demonstrations is None:
            return
        n_kept = len(kept_frame_indices(0, 0, self.config.n_demo_frames))
        check_demonstrations(path, contents.demonstrations, self.config.image_size, n_kept)
        # Demonstrations named on the command line come before those of the checkpoint.
        if self.eval_demonstrations is None:
            frames, episodes, tasks, target_objects, features, grasp_states = contents.demonstrations
            known = DemonstrationSet(frames, tasks, episodes.tolist(), target_objects)
            if grasp_states is not None and self.config.robot_state_feature is not None:
                check_grasp_states(path, contents.demonstrations, self.config.robot_state_feature.shape[0])
                known.grasp_states = grasp_states
            if features is not None and self._frozen is not None:
                check_features(path, contents.demonstrations, self.config.demo_feature_dim)
                known.features = features[:, None].half()
            self.eval_demonstrations = known.to(self.config.device)


def _read_paraphrases(config: DeltacoConfig) -> Paraphrases | None:
    if config.instructions is None:
        return None
    known = read_paraphrases(config.instructions)
    drawn = read_paraphrases(config.instructions, config.instructions_split)
    return Paraphrases(known, drawn, config.instructions_templates)


def _process_rank() -> int:
    """Number of this process among those that train together."""
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def _is_main_process() -> bool:
    return _process_rank() == 0
