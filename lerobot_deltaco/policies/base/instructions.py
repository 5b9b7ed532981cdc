"""Instructions in training and evaluation: a cache of their embeddings, and paraphrases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policies.base import language

_UNIT_TOLERANCE = 1e-6  # deviation from length 1 below which a vector is left as it is


class InstructionEmbeddings:
    """A cache of the embeddings of instructions, each computed once.

    Args:
        encoder_name: One of `LANGUAGE_ENCODERS`; loaded when the first instruction is embedded.

    Attributes:
        rows: Row of each known instruction.
        embeddings: Unit vectors of the known instructions, (instructions, embedding).
    """

    def __init__(self, encoder_name: str) -> None:
        self.encoder_name = encoder_name
        self.rows: dict[str, int] = {}
        self.embeddings = torch.empty(0, language.LANGUAGE_ENCODERS[encoder_name].embedding_dim)
        self._encode: language.LanguageEncoder | None = None

    def __call__(self, instructions: Sequence[str], device: torch.device | str) -> Tensor:
        """Returns unit vectors of instructions, (instructions, embedding); zeros for an empty one."""
        not_empty = [n for n, text in enumerate(instructions) if text]
        self.add([instructions[n] for n in not_empty])
        self.embeddings = self.embeddings.to(device)
        embeddings = self.embeddings.new_zeros(len(instructions), self.embeddings.shape[1])
        embeddings[not_empty] = self.embeddings[[self.rows[instructions[n]] for n in not_empty]]
        return embeddings

    def add(self, instructions: Sequence[str]) -> None:
        """Embeds instructions that are not known yet.

        Raises:
            LanguageEncoderError: The encoder cannot be loaded.
        """
        new = [text for text in dict.fromkeys(instructions) if text not in self.rows]
        if not new:
            return
        if self._encode is None:
            self._encode = language.load_language_encoder(self.encoder_name)
        self.put(new, self._encode(new))

    def put(self, instructions: Sequence[str], embeddings: Tensor) -> None:
        """Adds instructions whose embeddings, (instructions, embedding), have been computed."""
        is_unit = (embeddings.norm(dim=1) - 1).abs() < _UNIT_TOLERANCE
        embeddings = torch.where(is_unit[:, None], embeddings, F.normalize(embeddings, dim=1))
        for text in instructions:
            self.rows.setdefault(text, len(self.rows))
        self.embeddings = torch.cat([self.embeddings, embeddings.to(self.embeddings)])


class Paraphrases:
    """Sentences that replace the task strings of a dataset in training; other tasks keep theirs.

    Args:
        sentences: Sentences by task string.
        probability: Probability that a sentence replaces the task string.
    """

    def __init__(self, sentences: Mapping[str, Sequence[str]], probability: float = 1.0) -> None:
        self.sentences, self.probability = dict(sentences), probability

    def of(self, task: str) -> Sequence[str]:
        """Returns the sentences of a task; none if it has none."""
        return self.sentences.get(task, ())

    def left_out_of(self, instructions: InstructionEmbeddings) -> InstructionEmbeddings:
        """Returns a cache of instructions without these sentences."""
        sentences = set().union(*self.sentences.values()) - self.sentences.keys()
        others = [text for text in instructions.rows if text not in sentences]
        remaining = InstructionEmbeddings(instructions.encoder_name)
        remaining.put(others, instructions.embeddings[[instructions.rows[text] for text in others]])
        return remaining

    def draw(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """Draws an instruction for each sample: its task string, or a sentence.

        Args:
            tasks: Task string of each sample.
            generator: Source of the draws, on the CPU.
        """
        draws = torch.rand(len(tasks), generator=generator).tolist()
        instructions = []
        for task, draw in zip(tasks, draws, strict=True):
            sentences = self.of(task)
            is_replaced = bool(sentences) and draw < self.probability
            sentence = sentences[int(draw / self.probability * len(sentences))] if is_replaced else task
            instructions.append(sentence)
        return instructions
