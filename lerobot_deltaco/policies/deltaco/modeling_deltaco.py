"""The policy of DeL-TaCo (Yu & Mooney, ICLR 2023), and the baselines and ablations of the paper.

    demonstration ---> demonstration encoder ---> z_demo ---- FiLM ------+
                                                    |                    |
                                     encoder loss (training)    image ---> policy network ---> action
                                                    |                    |
    instruction ----> language encoder --------> z_lang ---- concat -----+--- proprioception

A method chooses what goes through FiLM and what is concatenated (`METHODS`).
"""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration, DemonstrationBank, sample_frames
from lerobot_deltaco.data.reading import warn_of_equal_instructions
from lerobot_deltaco.data.training_data import TrainingData
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.augmentation import random_shift
from lerobot_deltaco.policies.base.instructions import InstructionEmbeddings
from lerobot_deltaco.policies.base.losses import contrastive_logits, contrastive_loss, cosine_loss
from lerobot_deltaco.policies.base.modeling import DemonstrationsOfTasks, TaskConditionedPolicy
from lerobot_deltaco.policies.base.networks import (
    BACKBONES,
    NormalizedProjection,
    PolicyNetwork,
    initialize_as_authors,
    uniform_linear_layers,
)
from lerobot_deltaco.policies.deltaco.configuration_deltaco import DEMO_COLUMNS, DeltacoConfig
from lerobot_deltaco.policies.deltaco.demo_encoders import (
    AttentionEncoder,
    FrameGridEncoder,
    encode_bank,
    shift_demonstrations,
)
from lerobot_deltaco.policies.deltaco.vision import VISION_ENCODERS, load_vision_encoder

# The paper's alpha_d (equation 3) and temperature of the contrastive loss.
_ENCODER_LOSS_WEIGHT, _TEMPERATURE = 10.0, 0.1
_AUTHORS_ENCODER_BOUND = 1e-4  # of the initial weights of the paper's demonstration encoder


class RunningEpisode(NamedTuple):
    """The conditioning of the running episode, computed once."""

    instructions: tuple[str, ...]
    film: Tensor | None  # (batch, film_dim)
    concat: Tensor | None  # (batch, embedding)
    network: PolicyNetwork


class DeltacoPolicy(TaskConditionedPolicy):
    """The paper's policy. See `TaskConditionedPolicy` for its arguments.

    Attributes:
        demo_encoder: Encoder of demonstrations, or the layers after a frozen one; None without them.
        language_head: Layers after the language encoder; None without them.
    """

    config_class = DeltacoConfig
    name = "deltaco"

    def __init__(
        self,
        config: DeltacoConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        self.instructions: InstructionEmbeddings = InstructionEmbeddings(config.language_encoder)
        self.config: DeltacoConfig = config
        if config.method == "one_hot" and not config.one_hot_tasks:
            if dataset_meta is None:
                raise UserError("A one-hot policy needs the tasks that it knows: set `one_hot_tasks`.")
            config.one_hot_tasks = list(dataset_meta.tasks.index)
        self.policy_network = _make_network(config)
        self.demo_encoder = _make_demo_encoder(config)
        self.language_head = _make_language_head(config)
        if config.backbone == "paper":
            initialize_as_authors(self.policy_network)
            if isinstance(self.demo_encoder, FrameGridEncoder):
                uniform_linear_layers(self.demo_encoder, _AUTHORS_ENCODER_BOUND)

    # The loss

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Returns the loss of a batch: L = L_pi + alpha_d L_demo (the paper's equation 3).

        Args:
            batch: Batch from the preprocessor; it is not changed.
                `observation.image`, or any cameras: (batch, 3, H, W) float in 0..1.
                `observation.state`, if there is one: (batch, state), normalized.
                `action`: (batch, action), -1..1.
                `task`: list of task strings, (batch,).
                `episode_index`, if demonstrations are used: (batch,) int64.
            reduction: "mean", or "none" for the loss of each sample.

        Returns:
            The loss, () or (batch,), and the scalars to log.

        Raises:
            ValueError: A task has no demonstration, or is not known to a one-hot policy.
            TrainingDivergedError: The loss is not finite.
        """
        generator, tasks = self._step_generator(), list(batch["task"])
        with self._autocast(batch[ACTION].device):
            loss, logged = self._loss(batch, tasks, generator)
        return self._finish_step(batch, loss, logged, reduction)

    def _loss(
        self, batch: dict[str, Any], tasks: list[str], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the loss of each sample, (batch,), and its parts to log."""
        config = self.config
        images = self._images(batch)
        if self.training and config.shift_padding:
            images = random_shift(images, config.shift_padding, generator)
        distinct = {task: n for n, task in enumerate(dict.fromkeys(tasks))}
        column = torch.tensor([distinct[task] for task in tasks], device=images.device)
        demo = language = known = None
        if config.uses_demonstrations:
            demo = self._embed_training_demonstrations(batch["episode_index"], tasks, generator)
        if config.uses_language:
            if self._meta is not None and self.paraphrases is None:
                self._embed_all_tasks(list(self._meta.tasks.index), images.device)
            # With paraphrases, one sentence is drawn for each task, and one for each sample.
            known = self._embed_instructions(
                self._draw_instructions(list(distinct), generator), images.device
            )
            language = known[column]
            if self.paraphrases is not None:
                language = self._embed_instructions(self._draw_instructions(tasks, generator), images.device)
        if config.method == "mcil":
            # The mean of the losses with the instruction's embedding and with the demonstration's.
            parts = [self._acting_loss(batch, images, film, None) for film in (language, demo)]
            loss = torch.stack([part[0] for part in parts]).mean(dim=0)
            logged = {name: torch.stack([part[1][name] for part in parts]).mean() for name in parts[0][1]}
        else:
            film, concat = self._conditioning_inputs(tasks, demo, language, images.device)
            loss, logged = self._acting_loss(batch, images, film, concat)
        if config.conditioning.encoder_loss != "none":
            assert demo is not None
            assert language is not None
            assert known is not None
            logits = contrastive_logits(demo.float(), known, _TEMPERATURE)  # (batch, distinct)
            if config.conditioning.encoder_loss == "contrastive":
                encoder_loss = contrastive_loss(logits, column)
            else:
                encoder_loss = cosine_loss(demo.float(), language)
            loss = loss + _ENCODER_LOSS_WEIGHT * encoder_loss
            logged["encoder_loss"] = encoder_loss.mean()
            logged["demo_accuracy"] = (logits.argmax(dim=1) == column).float().mean()
        return loss, logged

    def _acting_loss(
        self, batch: dict[str, Any], images: Tensor, film: Tensor | None, concat: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the imitation loss L_pi (equation 2) of each sample, (batch,), and its parts to log."""
        predicted, gripper = self.policy_network(images, film, self._fuse_inputs(batch, concat))
        return self._imitation_loss(batch, predicted, gripper, self.config.gripper_loss)

    # Acting

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Returns the actions of a chunk, (batch, steps, action). See `select_action`."""
        images = self._images(batch)
        if self._begins_episode(batch):
            self._start(self._begin_episode(*self._tasks_of(batch), images.device))
        episode: RunningEpisode = self._episode
        concat = self._fuse_inputs(batch, episode.concat)
        return self._sample_action(batch, *episode.network(images, episode.film, concat))

    def _begin_episode(
        self,
        instructions: tuple[str, ...],
        demonstrations: DemonstrationsOfTasks | None,
        device: torch.device,
    ) -> RunningEpisode:
        """Encodes the instructions and demonstrations of an episode."""
        config = self.config
        demo: Tensor | None = None
        language: Tensor | None = None
        if config.uses_demonstrations and demonstrations is None:
            demonstrations = self.banked_demonstrations(instructions)
        self._check_given(instructions, demonstrations)
        if config.uses_demonstrations and demonstrations is not None:
            demo = self._embed_demonstrations(demonstrations, device)
        if any("language" in part for part in config.conditioning[:2]):
            language = self._embed_instructions(instructions, device)
        film: Tensor | None
        concat: Tensor | None = None
        if config.method == "mcil":
            # The samples of a batch use the instruction and the demonstration in turn, if both are there.
            by_language = [
                bool(text) and (not own or n % 2 == 0)
                for n, (text, own) in enumerate(zip(instructions, demonstrations or (), strict=True))
            ]
            assert demo is not None
            assert language is not None
            film = torch.where(torch.tensor(by_language, device=device)[:, None], language, demo)
        else:
            film, concat = self._conditioning_inputs(instructions, demo, language, device)
        return RunningEpisode(instructions, film, concat, self._inference_network())

    def _check_given(self, instructions: Sequence[str], demonstrations: DemonstrationsOfTasks | None) -> None:
        """Checks that no input of the method is left out; MCIL needs only one of the two."""
        if self.config.method == "mcil":
            missing = not all(map(any, zip(instructions, demonstrations or (), strict=True)))
        else:
            film, concat, _ = self.config.conditioning
            needs_instruction = any("language" in part or part == "one_hot" for part in (film, concat))
            missing = needs_instruction and not all(instructions)
            missing |= self.config.uses_demonstrations and not all(demonstrations or ())
        if missing:
            raise UserError(
                f"The method {self.config.method!r} is missing an input. Pass an instruction and a "
                "demonstration of each sample's task, whichever the method takes."
            )

    # Embeddings

    def _embed_all_tasks(self, tasks: list[str], device: torch.device) -> None:
        """Embeds the tasks of the training dataset once, for the checkpoint, and warns of equal ones."""
        if not self.instructions.rows.keys() >= set(tasks):
            warn_of_equal_instructions(tasks, self.instructions(tasks, device))

    def _embed_instructions(self, instructions: Sequence[str], device: torch.device) -> Tensor:
        """Returns embeddings of instructions, (instructions, embedding)."""
        embeddings = self.instructions(instructions, device)
        return embeddings if self.language_head is None else self.language_head(embeddings)

    def _embed_demonstrations(self, demonstrations: DemonstrationsOfTasks, device: torch.device) -> Tensor:
        """Returns embeddings of the first demonstration of each sample, (batch, embedding)."""
        assert self.demo_encoder is not None
        present = [each for own in demonstrations for each in own[:1] if isinstance(each, Demonstration)]
        embeddings = torch.zeros(len(demonstrations), self.config.demo_dim, device=device)
        if not present:
            return embeddings
        if self.config.demo_encoder == "pretrained":
            embedded = self.demo_encoder(torch.stack([self._features(each) for each in present]).to(device))
        else:
            generator = torch.Generator().manual_seed(self.seed)
            frames = torch.stack([each.frames for each in present]).to(device)
            embedded = self.demo_encoder(sample_frames(frames, self.config.n_demo_frames, generator))
        embeddings[torch.tensor([bool(own) for own in demonstrations], device=device)] = embedded.float()
        return embeddings

    def _features(self, demonstration: Demonstration) -> Tensor:
        """Returns the features of a demonstration from the frozen encoder, (features,)."""
        if demonstration.features is not None:
            return demonstration.features
        bank = DemonstrationBank(demonstration.frames[None], [demonstration.task], [0])
        return self._encode_bank(bank, n_variants=0)[0, 0].float()

    def _embed_training_demonstrations(
        self, episodes: Tensor, tasks: Sequence[str], generator: torch.Generator
    ) -> Tensor:
        """Returns embeddings of other episodes of the samples' tasks, (batch, embedding)."""
        self._training_rows(episodes)
        assert self.training_data is not None
        assert self.demo_encoder is not None
        bank, config = self.training_data.demonstrations, self.config
        rows = bank.draw_other_episodes(episodes, tasks, generator)
        if config.demo_encoder == "pretrained":
            is_random = config.demo_shift_padding > 0 or config.n_demo_frames > 2
            if bank.features is None:
                bank.features = self._encode_bank(bank, config.demo_variants if is_random else 0)
            variant = torch.zeros_like(rows)
            if self.training and is_random:
                drawn = torch.randint(1, bank.features.shape[1], (len(rows),), generator=generator)
                variant = drawn.to(rows.device)
            return self.demo_encoder(bank.features[rows, variant].float())
        frames = sample_frames(bank.frames[rows], config.n_demo_frames, generator)
        if self.training:
            grid_rows = config.demo_rows if config.demo_encoder == "cnn" else None
            frames = shift_demonstrations(frames, config.demo_shift_padding, grid_rows, generator)
        return self.demo_encoder(frames)

    def _encode_bank(self, bank: DemonstrationBank, n_variants: int) -> Tensor:
        config = self.config
        encoder = load_vision_encoder(config.vision_encoder, config.vision_image_size)
        padding, frames, rows = config.demo_shift_padding, config.n_demo_frames, config.demo_rows
        # The features do not depend on the precision of the training.
        with torch.autocast(bank.frames.device.type, enabled=False):
            return encode_bank(bank, encoder, frames, rows, n_variants, padding, self.seed)

    def _check_demonstrations(self, data: TrainingData) -> None:
        if self.config.demo_encoder == "pretrained":
            data.demonstrations.features = self._encode_bank(data.demonstrations, n_variants=0)

    def _conditioning_inputs(
        self, tasks: Sequence[str], demo: Tensor | None, language: Tensor | None, device: torch.device
    ) -> tuple[Tensor | None, Tensor | None]:
        """Returns the embeddings that go through FiLM, and those that are concatenated.

        Args:
            tasks: Instruction of each sample.
            demo: Embeddings of demonstrations, (batch, embedding); None if they are not used.
            language: Embeddings of instructions, (batch, embedding); None if they are not used.
            device: Device of one-hot tasks.
        """

        def source(name: str) -> Tensor | None:
            if name == "none":
                return None
            if name == "one_hot":
                return one_hot(tasks, self.config.one_hot_tasks, device)
            used = [demo if part == "demo" else language for part in name.split("+")]
            return torch.cat([embedding for embedding in used if embedding is not None], dim=-1)

        film, concat, _ = self.config.conditioning
        return source(film), source(concat)

    def _fuse_inputs(self, batch: dict[str, Any], embedding: Tensor | None) -> Tensor | None:
        """Concatenates an embedding and the robot's state, which join the feature points."""
        parts = [] if embedding is None else [embedding]
        if self.config.state_dim:
            parts.append(self.state_limits(batch[OBS_STATE]))
        return torch.cat(parts, dim=-1) if parts else None


def _make_network(config: DeltacoConfig) -> PolicyNetwork:
    film, concat, _ = config.conditioning
    dims = {
        "none": 0,
        "demo": config.demo_dim,
        "language": config.embedding_dim,
        "demo+language": config.demo_dim + config.embedding_dim,
        "language_or_demo": config.embedding_dim,
        "one_hot": len(config.one_hot_tasks),
    }
    backbone = BACKBONES[config.backbone]
    assert config.action_feature is not None
    return PolicyNetwork(
        n_cameras=len(config.image_features),
        film_dim=dims[film],
        concat_dim=dims[concat] + config.state_dim,
        action_dim=config.action_feature.shape[0] - (config.gripper_index is not None),
        has_gripper=config.gripper_index is not None,
        channels=backbone.channels,
        stem_stride=backbone.stem_stride,
        num_components=config.num_mixture_components,
        chunk_size=config.chunk_size or 1,
    )


def _make_demo_encoder(
    config: DeltacoConfig,
) -> FrameGridEncoder | AttentionEncoder | NormalizedProjection | None:
    if not config.uses_demonstrations:
        return None
    if config.demo_encoder == "pretrained":
        return NormalizedProjection(
            VISION_ENCODERS[config.vision_encoder].feature_dim, config.demo_head, config.demo_dim
        )
    if config.demo_encoder == "attention":
        return AttentionEncoder(config.n_demo_frames, config.embedding_dim)
    size, stride = config.image_size, BACKBONES[config.backbone].demo_stride
    return FrameGridEncoder(size, size, config.demo_rows, DEMO_COLUMNS, config.embedding_dim, stride)


def _make_language_head(config: DeltacoConfig) -> NormalizedProjection | None:
    """Makes the layers after the language encoder; in MCIL, they map both inputs into one space."""
    hidden_dims = config.language_head
    if config.method == "mcil" and hidden_dims is None:
        hidden_dims = [config.embedding_dim]
    if hidden_dims is None or not config.uses_language:
        return None
    return NormalizedProjection(config.embedding_dim, hidden_dims, config.embedding_dim)


def one_hot(tasks: Sequence[str], known: Sequence[str], device: torch.device) -> Tensor:
    """Returns one-hot vectors of tasks, (batch, known tasks).

    Raises:
        ValueError: A task is not known.
    """
    unknown = next((task for task in tasks if task not in known), None)
    if unknown is not None:
        raise UserError(
            f"This one-hot policy does not know the task {unknown!r}. It knows the {len(known)} tasks of its "
            f"training dataset, such as {known[0]!r}."
        )
    index = {task: n for n, task in enumerate(known)}
    return F.one_hot(torch.tensor([index[task] for task in tasks], device=device), len(known)).float()
