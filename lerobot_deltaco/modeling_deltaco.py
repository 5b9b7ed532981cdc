"""The policy of DeL-TaCo (Yu & Mooney, ICLR 2023), and the baselines and ablations of the paper."""

# No `from __future__ import annotations`: LeRobot's tests expect the annotation of `config` to be a class.

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

import torch
from huggingface_hub import ModelCard
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling.checkpoint_files import (
    check_loaded_weights,
    check_stored_frames,
    check_weight_names,
    stored_demonstrations,
    task_contents,
    without_sources,
)
from lerobot_deltaco.modeling.demonstration_use import choose_demonstrations
from lerobot_deltaco.modeling.goal_learning import (
    GoalSamples,
    find_goals,
    fit_goals,
    learn_goals,
    validation_goals,
)
from lerobot_deltaco.modeling.network_factory import (
    make_demo_encoder,
    make_frozen_encoder,
    make_goal_conditioning,
    make_language_head,
    make_policy_network,
)
from lerobot_deltaco.modeling.task_embedding import TaskEmbedder
from lerobot_deltaco.modeling.task_sources import (
    one_hot_vocabulary,
    read_eval_demonstrations,
    read_sentences,
    read_training_demonstrations,
    warn_of_plain_batches,
)
from lerobot_deltaco.policy.actions import join_action, policy_loss
from lerobot_deltaco.policy.demo_encoders import ArrayEncoder
from lerobot_deltaco.policy.demonstrations import Demonstrated, DemonstrationSet, RobotData
from lerobot_deltaco.policy.finite_loss import FiniteLoss, check_weights_to_save
from lerobot_deltaco.policy.goals.conditioning import FoundGoals
from lerobot_deltaco.policy.goals.training import GoalTrainer
from lerobot_deltaco.policy.goals.words import vocabulary_of
from lerobot_deltaco.policy.inference import FoldedPolicy
from lerobot_deltaco.policy.initial_weights import initialize_demo_encoder, initialize_policy
from lerobot_deltaco.policy.language.instruction_table import InstructionTable
from lerobot_deltaco.policy.language.paraphrases import Paraphrases
from lerobot_deltaco.policy.losses import contrastive_logits, contrastive_loss, cosine_loss
from lerobot_deltaco.policy.memory import keep_freed_memory
from lerobot_deltaco.policy.networks import random_crop
from lerobot_deltaco.policy.observations import instructions_of, stacked_images
from lerobot_deltaco.policy.precision import autocast, warn_if_emulated
from lerobot_deltaco.policy.processor_files import check_processor_files
from lerobot_deltaco.policy.scalars import LoggedScalars
from lerobot_deltaco.policy.step_generator import process_rank, step_generator
from lerobot_deltaco.policy.task_conditioning import DemonstrationTurn, EpisodeTasks, TaskConditioning
from lerobot_deltaco.policy.task_file import (
    TASK_FILE,
    TaskFile,
    find_task_file,
    hub_options,
    read_task_file,
    write_task_file,
)
from lerobot_deltaco.policy_card import policy_card


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
        has_task_batches: Whether the training loop draws batches of tasks, as `deltaco-train` does.
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
        config.resolve(dataset_meta.features if dataset_meta else None, dataset_stats)
        if dataset_meta is not None:
            config.check_episodes(dataset_meta.total_episodes)
        self.instructions = InstructionTable(config.language_encoder)
        if config.instruction_embeddings is not None:
            self.instructions.read(Path(config.instruction_embeddings))
        self.train_demonstrations: DemonstrationSet | None = None
        self.has_task_batches = False
        self._has_checked_batches = False
        self.goal_trainer: GoalTrainer | None = None
        paraphrases = read_sentences(config)
        self.eval_demonstrations: DemonstrationSet | None = read_eval_demonstrations(config)
        self._train_demonstrations_are_complete = False  # whether they surely include every training episode
        self._episode_tasks = EpisodeTasks()
        if config.method == "one_hot" and not config.one_hot_tasks:
            demonstrated = self.eval_demonstrations.rows if self.eval_demonstrations else ()
            config.one_hot_tasks = one_hot_vocabulary(dataset_meta, demonstrated)

        if config.pretrained_matching and config.uses_language and dataset_meta is not None:
            config.known_words = config.known_words or vocabulary_of(dataset_meta.tasks.index)

        self._frozen = make_frozen_encoder(config)
        self.model = make_policy_network(config)
        self.demo_encoder = make_demo_encoder(config)
        self.goals = make_goal_conditioning(config)
        self.language_head = make_language_head(config)
        self._embedder = TaskEmbedder(
            config, self.instructions, paraphrases, self.language_head, self.demo_encoder, self._frozen
        )
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

    # The loss

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

        Raises:
            ValueError: An episode is not among the demonstrations, or a task is not known.
            TrainingDivergedError: The loss of the last training step is not finite.
        """
        if self.training:
            self._finite_loss.check()
            if not (self.has_task_batches or self._has_checked_batches):
                warn_of_plain_batches(self.config)
                self._has_checked_batches = True
            warn_if_emulated(self.config.dtype, batch[ACTION].device.type)
            if batch[ACTION].device.type == "cpu":
                keep_freed_memory()
        step = int(self.step) if self.training else 0
        generator = step_generator(self.config.seed, step, process_rank())
        tasks = list(batch["task"])
        if self.goals is None:
            loss, logged = self._embedding_loss(batch, tasks, generator)
        else:
            loss, logged = self._goal_loss(batch, tasks, generator)
        if self.training:
            self.step += 1
            names = (ACTION, OBS_STATE) if self.config.robot_state_feature else (ACTION,)
            self._finite_loss.remember(loss, {name: batch[name] for name in names}, self.step)
        return loss.mean() if reduction == "mean" else loss, LoggedScalars(logged)

    def _embedding_loss(
        self, batch: dict[str, Any], tasks: list[str], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of each sample, (batch,), of a policy that is conditioned on task embeddings."""
        images = self._images(batch)
        if self.training and self.config.crop_padding:
            images = random_crop(images, self.config.crop_padding, generator)
        demo = language = None
        distinct = {task: n for n, task in enumerate(dict.fromkeys(tasks))}
        column = torch.tensor([distinct[task] for task in tasks], device=batch[ACTION].device)
        if self.config.uses_demo:
            demonstrations = self._training_demonstrations(column.device)
            is_checked = not self._train_demonstrations_are_complete
            demo = self._embedder.embed_training_demonstrations(
                demonstrations, batch["episode_index"], tasks, column, generator, self.training, is_checked
            )
        if self.config.uses_language:
            known, language = self._embedder.embed_training_tasks(list(distinct), tasks, column, generator)

        if self.config.method == "mcil":
            # The mean of the losses with the instruction's embedding and with the demonstration's.
            parts = [self._imitation_loss(batch, images, film, None) for film in (language, demo)]
            loss = torch.stack([part[0] for part in parts]).mean(dim=0)
            logged = {name: torch.stack([part[1][name] for part in parts]).mean() for name in parts[0][1]}
        else:
            film, concat = self._embedder.conditioning_inputs(tasks, demo, language, images.device)
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
        return loss, logged

    def _goal_loss(
        self, batch: dict[str, Any], tasks: list[str], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of each sample, (batch,), of a policy that is given goals, which it learns to find."""
        images, language = self._images(batch), None
        instructions = self._embedder.draw_instructions(tasks, generator)
        if self.config.language_is_input:
            language = self._embedder.embed_instructions(instructions, images.device)
        film, concat = self._embedder.conditioning_inputs(tasks, None, language, images.device)
        demonstrations = self._training_demonstrations(images.device)
        assert self.goal_trainer is not None
        episodes = batch["episode_index"]
        rows = demonstrations.episode_rows(episodes)
        samples = GoalSamples(images, episodes, rows, tasks, instructions)
        if not self.training:
            inputs = validation_goals(
                self.goal_trainer,
                samples,
                lambda: self._find_goals(
                    self.scenes(batch), tasks, [0] * len(tasks), self._choose_demonstrations
                ),
            )
            return self._imitation_loss(batch, inputs.images, film, concat, inputs.places, inputs.depths)
        if not self._train_demonstrations_are_complete:
            demonstrations.check_episodes(episodes, rows)
        inputs, known, locator_loss = learn_goals(
            self.config, self.goal_trainer, self._embedder, samples, generator
        )
        loss, logged = self._imitation_loss(batch, inputs.images, film, concat, inputs.places, inputs.depths)
        loss = torch.where(known, loss, 0.0)
        return locator_loss.added_to(loss), logged | locator_loss.logged()

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
        index, weight, kind = self.config.gripper_index, self.config.gripper_weight, self.config.gripper_loss
        return policy_loss(predicted, gripper, self.model.log_std, batch[ACTION], index, weight, kind)

    # Acting

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
        tasks = instructions_of(batch)
        images = self._images(batch)
        with autocast(self.config.dtype, images.device):
            task = self._episode_tasks.conditioning(
                tasks, lambda tasks: self.encode_task(tasks, self.scenes(batch))
            )
            places, depths = (None, None) if task.goals is None else task.goals[:2]
            concatenated = self._concatenated(batch, task.concat, places, depths)
            motion, gripper = task.model(images, task.film, concatenated, places)
        if gripper is not None:
            gripper = torch.sigmoid(gripper.float())
        return join_action(motion.mean.float(), gripper, self.config.gripper_index)

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """The action as a chunk of one, (batch, 1, action)."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def encode_task(self, tasks: tuple[str, ...], scenes: Tensor) -> TaskConditioning:
        """Encodes the demonstrations and instructions of the tasks of a batch, at the start of an episode.

        Args:
            tasks: Instruction of each sample.
            scenes: First images of the episodes, as `scenes` gives them, in which goals are found.

        Returns:
            The inputs of the network that specify the tasks, and the network that acts.

        Raises:
            ValueError: A task has no demonstration.
        """
        trials = self._episode_tasks.count_trials(tasks)
        demo = language = goals = None
        if self.goals is not None:
            goals = self._find_goals(scenes, tasks, trials, self._demonstrate)
        elif self.config.uses_demo:
            demonstrations, rows = self._demonstrate(tasks, trials)
            generator = torch.Generator().manual_seed(self.config.seed)
            demo = self._embedder.embed_demonstrations(demonstrations, rows, generator, self.training)
        if self.config.language_is_input:
            language = self._embedder.embed_instructions(tasks, scenes.device)
        if self.config.method == "mcil":
            assert language is not None
            assert demo is not None
            # The trials of a task use the instruction and the demonstration in turn.
            by_language = torch.tensor(trials, device=scenes.device) % 2 == 0
            either = torch.where(by_language[:, None], language, demo)
            return TaskConditioning(tasks, either, None, self._acting_model())
        film, concat = self._embedder.conditioning_inputs(tasks, demo, language, scenes.device)
        return TaskConditioning(tasks, film, concat, self._acting_model(), goals)

    def _acting_model(self) -> nn.Module:
        """The network that acts: in evaluation mode, a copy that is faster for small batches."""
        return self.model if self.training else self._folded.network()

    # Inputs of the network

    def scenes(self, batch: dict[str, Any]) -> Tensor:
        """Images of the first camera as goals are found in them, (batch, 3, size, size) in 0..1.

        Args:
            batch: As in `select_action`. The size is `goal_image_size`, or `image_size` without it.
        """
        return stacked_images(batch, self.config.cameras[:1], self.config.demo_image_size)[:, 0]

    def _images(self, batch: dict[str, Any]) -> Tensor:
        """Images of all cameras, that of the demonstrations first, (batch, cameras, 3, size, size)."""
        return stacked_images(batch, self.config.cameras, self.config.image_size)

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

    # Demonstrations and instructions

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

    @property
    def _ddp_params_and_buffers_to_ignore(self) -> list[str]:
        """Names of the buffers that PyTorch would otherwise send from process to process at every step.

        Each of several processes has its own copy of the demonstrations.
        """
        sets = ("train_demonstrations.", "eval_demonstrations.")
        return [name for name, _ in self.named_buffers() if name.startswith(sets)]

    def _training_demonstrations(self, device: torch.device) -> DemonstrationSet:
        if self.train_demonstrations is None:
            loaded, robot_data = read_training_demonstrations(self.config, self._meta)
            self.train_demonstrations = loaded.to(device)
            if robot_data is not None:
                self._fit_goals(robot_data)
        return self.train_demonstrations

    def _fit_goals(self, robot_data: RobotData) -> None:
        """Finds the goals of the training episodes."""
        assert self.train_demonstrations is not None
        assert self.goals is not None
        self.goal_trainer = fit_goals(
            self.config, self.goals, self.train_demonstrations, robot_data, self._stats
        )

    def _find_goals(
        self,
        scenes: Tensor,
        tasks: Sequence[str],
        trials: Sequence[int],
        choose: Callable[[Sequence[str], Sequence[int]], tuple[DemonstrationSet, Tensor]],
    ) -> FoundGoals:
        """Finds the goals of tasks in scenes (batch, 3, H, W), by the demonstrations of these trials."""
        assert self.goals is not None
        n_each = self.config.n_demonstrations

        def choose_one(number: int) -> tuple[DemonstrationSet, Tensor]:
            return choose(tasks, [trial * n_each + number for trial in trials])

        return find_goals(self.config, self.goals, self._embedder, scenes, tasks, choose_one)

    def _demonstrate(self, tasks: Sequence[str], trials: Sequence[int]) -> tuple[DemonstrationSet, Tensor]:
        """The demonstrations of an episode that begins: they are noted, for `demonstrated`."""
        chosen, rows = self._choose_demonstrations(tasks, trials)
        if not self.training:
            self._episode_tasks.note_demonstrations(chosen.describe(rows))
        return chosen, rows

    def _choose_demonstrations(
        self, tasks: Sequence[str], trials: Sequence[int]
    ) -> tuple[DemonstrationSet, Tensor]:
        """The demonstration of each sample: a set, and the row of each in it, (batch,)."""
        candidates = (self.eval_demonstrations, self.train_demonstrations)
        turns = self._episode_tasks.turns
        names, replaced = (
            (tasks, self._episode_tasks.replaced) if turns is None else ([turn.task for turn in turns], {})
        )
        return choose_demonstrations(self.config, candidates, names, trials, replaced, self.paraphrases)

    @property
    def paraphrases(self) -> Paraphrases | None:
        """Sentences that people wrote for task strings; None for the task strings alone."""
        return self._embedder.paraphrases

    @paraphrases.setter
    def paraphrases(self, paraphrases: Paraphrases | None) -> None:
        self._embedder.paraphrases = paraphrases

    # Episodes

    def reset(self) -> None:
        """Starts an episode, of this thread if several threads evaluate tasks at the same time."""
        self._episode_tasks.begin_episode()

    def begin_evaluation(self) -> None:
        """Starts an evaluation: the demonstrations of each task begin with the first again."""
        self._episode_tasks.begin_evaluation()

    def demonstrated(self, sample: int) -> list[Demonstrated]:
        """The demonstrations of a sample in this thread's episode; none before its first action.

        Args:
            sample: Number of the sample in the batch, from 0.
        """
        return self._episode_tasks.demonstrated(sample)

    def demonstrated_as(self, tasks: Mapping[str, str]) -> AbstractContextManager[None]:
        """Uses other tasks' demonstrations with some instructions, while the context is open.

        For example, to perform a task from a demonstration and a sentence of one's own:
        `with policy.demonstrated_as({"fetch the jar": task.instruction}): ...`

        Args:
            tasks: For an instruction, the task string whose demonstrations are used. It is read when an
                episode starts; instructions that it lacks keep their own demonstrations.
        """
        return self._episode_tasks.demonstrated_as(tasks)

    def with_turns(self, turns: Sequence[DemonstrationTurn]) -> AbstractContextManager[None]:
        """Uses the given demonstration for each sample of a batch, while the context is open.

        Unlike `demonstrated_as`, it depends neither on the instructions nor on earlier episodes.

        Args:
            turns: The demonstrations, one for each sample.
        """
        return self._episode_tasks.with_turns(turns)

    # Datasets and checkpoints

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        self._finite_loss.check()
        check_weights_to_save(self, int(self.step))
        # LeRobot 0.6.1 may pass a `state_dict`, later versions do not; it is handed on as it comes.
        with without_sources(self.config):
            super()._save_pretrained(save_directory, *args, **kwargs)
        if process_rank() != 0:
            return  # versions after 0.6.1 call this on every process
        demonstrations = self.eval_demonstrations if self.config.uses_demo else None
        contents = task_contents(self.instructions, self.paraphrases, demonstrations, self._frozen)
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
        check_loaded_weights(policy, model_file)
        return policy

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Loads weights. See `torch.nn.Module.load_state_dict`.

        Raises:
            ValueError: The weights were saved by a version that named them otherwise.
        """
        check_weight_names(state_dict)
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def _take_tasks(self, contents: TaskFile, path: Path) -> None:
        """Takes what the checkpoint knows of tasks."""
        self.instructions.take(contents, path)
        if self.paraphrases is None and contents.paraphrases:
            self.paraphrases = Paraphrases(contents.paraphrases)
        if contents.demonstrations is None:
            return
        check_stored_frames(contents.demonstrations, path, self.config)
        # Demonstrations named on the command line come before those of the checkpoint.
        if self.eval_demonstrations is None:
            known = stored_demonstrations(contents.demonstrations, path, self.config)
            self.eval_demonstrations = known.to(self.config.device)

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
