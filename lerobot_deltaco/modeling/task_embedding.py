"""How the policy knows its task: demonstrations and instructions become inputs of its network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.demo_encoders import crop_demonstrations
from lerobot_deltaco.policy.demonstration_choice import choose_training_demonstrations
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.frozen_features import FrozenFeatures
from lerobot_deltaco.policy.language.instruction_table import InstructionTable
from lerobot_deltaco.policy.language.paraphrases import Paraphrases


class TaskEmbedder:
    """Embeds instructions and demonstrations as a configuration says.

    It is no module: the networks are the policy's, which trains and saves them.

    Args:
        config: Configuration of the policy.
        instructions: Embeddings of instructions.
        paraphrases: Sentences that people wrote; None to train on the task strings.
        language_head: Layers behind the language encoder; None for none.
        demo_encoder: Encoder of demonstrations, or the layers behind the frozen one; None without a task
            embedding.
        frozen: Pretrained image encoder; None without one.
    """

    def __init__(
        self,
        config: DeltacoConfig,
        instructions: InstructionTable,
        paraphrases: Paraphrases | None,
        language_head: nn.Module | None,
        demo_encoder: nn.Module | None,
        frozen: FrozenFeatures | None,
    ) -> None:
        self.config, self.instructions, self.paraphrases = config, instructions, paraphrases
        self._language_head, self._demo_encoder, self._frozen = language_head, demo_encoder, frozen

    def draw_instructions(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """The instruction of each training sample: its task string, or a paraphrase.

        Args:
            tasks: Task string of each sample.
            generator: Source of the draws, on the CPU. Without sentences, nothing is drawn.

        Raises:
            ValueError: There is no sentence for a task.
        """
        if self.paraphrases is None or not self.paraphrases.drawn or not self.config.uses_language:
            return list(tasks)
        # All at once, the first time.
        self.instructions.add(self.paraphrases.drawn_sentences)
        return self.paraphrases.draw(tasks, generator)

    def embed_instructions(self, instructions: Sequence[str], device: torch.device) -> Tensor:
        """Embeddings of instructions, (instructions, embedding)."""
        embeddings = self.instructions(instructions, device, unit=self.config.has_unit_language)
        return embeddings if self._language_head is None else self._language_head(embeddings)

    def embed_training_tasks(
        self, distinct: list[str], tasks: list[str], column: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Embeddings of the instructions of a training batch.

        With paraphrases, one is drawn for each sample, and one for each task.

        Args:
            distinct: Task strings of the batch, each once.
            tasks: Task string of each sample.
            column: Place of each sample's task in `distinct`, (batch,) int64.
            generator: Source of the draws, on the CPU.

        Returns:
            Embeddings of the tasks, (distinct, embedding), and of the samples, (batch, embedding).

        Raises:
            ValueError: There is no sentence for a task.
        """
        if self.paraphrases is None or not self.paraphrases.drawn:
            known = self.embed_instructions(distinct, column.device)
            return known, known[column]
        known = self.embed_instructions(self.draw_instructions(distinct, generator), column.device)
        return known, self.embed_instructions(self.draw_instructions(tasks, generator), column.device)

    def embed_training_demonstrations(
        self,
        demonstrations: DemonstrationSet,
        episodes: Tensor,
        tasks: Sequence[str],
        column: Tensor,
        generator: torch.Generator,
        training: bool,
        check: bool,
    ) -> Tensor:
        """Embeddings of demonstrations of a training batch: episodes other than the samples' own.

        Args:
            demonstrations: The training episodes.
            episodes: The samples' own, (batch,), as indices of the dataset.
            tasks: Task string of each sample.
            column: The samples' tasks, (batch,), numbered from 0.
            generator: Source of the draws, on the CPU.
            training: Whether this is a training step, and not a validation loss.
            check: Whether to check that all episodes are among the demonstrations, which waits for a GPU.

        Returns:
            Unit vectors, (batch, embedding).

        Raises:
            ValueError: An episode is not among the demonstrations, or no episode of its task.
        """
        if not training:
            # The episodes of a validation loss may be held back from the demonstrations.
            rows = demonstrations.sample_other_episodes(episodes, generator, tasks=tasks)
            return self.embed_demonstrations(demonstrations, rows, generator, training)
        n_tasks, n_each = len(set(tasks)), self.config.demos_per_task
        rows, which = choose_training_demonstrations(
            demonstrations, episodes, column, n_tasks, n_each, generator, check
        )
        embeddings = self.embed_demonstrations(demonstrations, rows, generator, training)
        return embeddings if which is None else embeddings[which]

    def embed_demonstrations(
        self, demonstrations: DemonstrationSet, rows: Tensor, generator: torch.Generator, training: bool
    ) -> Tensor:
        """Embeddings of demonstrations.

        Args:
            demonstrations: The set.
            rows: Rows of the demonstrations in the set, (batch,).
            generator: Source of the draws of frames and crops, on the CPU.
            training: Whether images are cropped at random.

        Returns:
            Unit vectors, (batch, embedding).
        """
        assert self._demo_encoder is not None
        if self._frozen is not None:
            if training:
                return self._demo_encoder(self._frozen.drawn(demonstrations, rows, generator))
            return self._demo_encoder(self._frozen.plain(demonstrations, rows))
        config = self.config
        frames = demonstrations.sample_frames(
            rows, config.n_demo_frames, generator, config.demo_frames_between == "spread"
        )
        if training:
            is_array = config.demo_encoder == "cnn" and config.demo_crop == "array"
            array_rows = config.demo_rows if is_array else None
            frames = crop_demonstrations(frames, config.demo_crop_padding, array_rows, generator)
        return self._demo_encoder(frames)

    def conditioning_inputs(
        self, tasks: Sequence[str], demo: Tensor | None, language: Tensor | None, device: torch.device
    ) -> tuple[Tensor | None, Tensor | None]:
        """The embeddings that go through FiLM, and those that are concatenated to the feature points.

        Args:
            tasks: Instruction of each sample.
            demo: Embeddings of demonstrations, (batch, embedding); None if they are not used.
            language: Embeddings of instructions, (batch, embedding); None if they are not used.
            device: Device of one-hot tasks.

        Raises:
            ValueError: A one-hot policy does not know a task.
        """

        def source(name: str) -> Tensor | None:
            if name == "none":
                return None
            if name == "one_hot":
                return self._one_hot(tasks, device)
            used = [demo if part == "demo" else language for part in name.split("+")]
            return torch.cat([embedding for embedding in used if embedding is not None], dim=-1)

        film, concat, _ = self.config.conditioning
        return source(film), source(concat)

    def goal_condition(self, instructions: Sequence[str], device: torch.device) -> Tensor | None:
        """The condition of the locator of goals, for `demo_encoder=correspondence`.

        Args:
            instructions: Instructions, or task strings for a one-hot policy.
            device: Device of the result.

        Returns:
            (instructions, condition); None if demonstrations alone say the task.

        Raises:
            ValueError: A one-hot policy does not know a task.
        """
        if self.config.method == "one_hot":
            return self._one_hot(instructions, device)
        return self.embed_instructions(instructions, device) if self.config.uses_language else None

    def _one_hot(self, tasks: Sequence[str], device: torch.device) -> Tensor:
        unknown = next((task for task in tasks if task not in self.config.one_hot_tasks), None)
        if unknown is not None:
            raise ValueError(
                f"This one-hot policy does not know the task {unknown!r}. It knows the "
                f"{len(self.config.one_hot_tasks)} tasks of its training and demonstration datasets."
            )
        places = {task: n for n, task in enumerate(self.config.one_hot_tasks)}
        indices = torch.tensor([places[task] for task in tasks], device=device)
        return F.one_hot(indices, len(places)).float()
