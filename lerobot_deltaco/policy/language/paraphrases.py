"""Sentences that people wrote for the tasks of a dataset, whose own task strings are templates."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence

import torch

logger = logging.getLogger(__name__)


class Paraphrases:
    """Sentences that replace task strings.

    Args:
        known: Sentences by task string; each finds the task's demonstrations.
        drawn: Sentences by task string, from which training draws; none by default.
        with_templates: Whether training also draws the task string itself, as often as each sentence.
    """

    def __init__(
        self,
        known: Mapping[str, Sequence[str]],
        drawn: Mapping[str, Sequence[str]] | None = None,
        with_templates: bool = False,
    ) -> None:
        self.known = {task: list(sentences) for task, sentences in known.items()}
        self.drawn = {task: list(sentences) for task, sentences in (drawn or {}).items()}
        self._with_templates = with_templates
        self._tasks: dict[str, list[str]] = defaultdict(list)
        for task, sentences in self.known.items():
            for sentence in sentences:
                self._tasks[_key(sentence)].append(task)
        self._ambiguous: set[str] = set()

    @property
    def drawn_sentences(self) -> list[str]:
        """Every sentence that training may draw, task strings excepted."""
        return [sentence for sentences in self.drawn.values() for sentence in sentences]

    def draw(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """Draws a sentence for each sample.

        Args:
            tasks: Task string of each sample.
            generator: Source of the draws, on the CPU.

        Raises:
            ValueError: There is no sentence for a task.
        """
        draws = torch.rand(len(tasks), generator=generator).tolist()
        sentences = []
        for task, draw in zip(tasks, draws, strict=True):
            choice = self.drawn.get(task, [])
            if self._with_templates:
                choice = [*choice, task]
            if not choice:
                raise ValueError(
                    f"`instructions` has no sentence for the task {task!r} in its split for training. Add "
                    "some, choose another `instructions_split`, or set `instructions_templates` to train on "
                    "the task strings, too."
                )
            sentences.append(choice[int(draw * len(choice))])
        return sentences

    def tasks_of(self, instructions: Sequence[str], demonstrated: Collection[str]) -> dict[str, str]:
        """The task strings that instructions stand for.

        Args:
            instructions: Instructions, task strings among them.
            demonstrated: Task strings that have demonstrations.

        Returns:
            For each sentence that is no such task string itself, the task string. For a sentence that several
            tasks share, it is the first one that has a demonstration.
        """
        found = {}
        for instruction in instructions:
            if instruction in demonstrated:
                continue
            tasks = [task for task in self._tasks.get(_key(instruction), ()) if task in demonstrated]
            if len(tasks) > 1 and instruction not in self._ambiguous:
                self._ambiguous.add(instruction)
                logger.warning(
                    "%r may mean %d tasks, such as %r and %r; demonstrations of the first one are used. "
                    "`deltaco-evaluate` knows which task is meant.",
                    instruction,
                    len(tasks),
                    *tasks[:2],
                )
            if tasks:
                found[instruction] = tasks[0]
        return found


def _key(sentence: str) -> str:
    """Equal for sentences that differ in nothing but spaces and capital letters."""
    return " ".join(sentence.split()).casefold()
