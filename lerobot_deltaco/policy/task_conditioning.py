"""The tasks of the running episodes: what conditions the policy's network while an episode lasts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from torch import Tensor, nn

from lerobot_deltaco.policy.demonstrations import Demonstrated
from lerobot_deltaco.policy.goals.conditioning import FoundGoals


class DemonstrationTurn(NamedTuple):
    """Which demonstration an episode uses.

    Attributes:
        task: Task string whose demonstrations are used.
        turn: Number of the demonstration among those of the task, which begin again after the last one.
    """

    task: str
    turn: int


class TaskConditioning(NamedTuple):
    """Inputs of the policy's network that specify the tasks of a batch, computed once per episode."""

    tasks: tuple[str, ...]
    film: Tensor | None  # (batch, film_dim)
    concat: Tensor | None  # (batch, concatenated embeddings)
    model: nn.Module  # the network that acts
    goals: FoundGoals | None = None  # with demo_encoder=correspondence


class EpisodeTasks:
    """The conditioning of the running episodes, and the number of episodes that each task has had.

    With `--env.max_parallel_tasks` above 1, several threads run episodes of different tasks with one policy:
    each thread has a conditioning of its own.

    Attributes:
        replaced: For instructions that get another task's demonstrations, its task string.
        turns: Demonstration of each sample of the episodes; None to choose it by the sample's instruction, in
            turn.
    """

    def __init__(self) -> None:
        self._conditioning: dict[int, TaskConditioning] = {}  # by thread
        self._demonstrated: dict[int, list[tuple[Demonstrated, ...]]] = {}  # by thread
        self._n_episodes: dict[str, int] = {}  # by task
        self.replaced: Mapping[str, str] = {}
        self.turns: tuple[DemonstrationTurn, ...] | None = None

    def begin_episode(self) -> None:
        """Forgets the conditioning and the demonstrations of this thread's last episode."""
        self._conditioning.pop(threading.get_ident(), None)
        self._demonstrated.pop(threading.get_ident(), None)

    def begin_evaluation(self) -> None:
        """Counts the episodes of each task from 0 again."""
        self._n_episodes.clear()

    def conditioning(
        self, tasks: tuple[str, ...], encode: Callable[[tuple[str, ...]], TaskConditioning]
    ) -> TaskConditioning:
        """The conditioning of this thread's episode.

        Args:
            tasks: Instruction of each sample of the batch.
            encode: Computes the conditioning of tasks; called at the episode's first step.
        """
        current = self._conditioning.get(threading.get_ident())
        if current is None or current.tasks != tasks:
            current = self._conditioning[threading.get_ident()] = encode(tasks)
        return current

    def note_demonstrations(self, demonstrated: tuple[Demonstrated, ...]) -> None:
        """Remembers the demonstration of each sample of this thread's episode; of several, one at a time."""
        self._demonstrated.setdefault(threading.get_ident(), []).append(demonstrated)

    def demonstrated(self, sample: int) -> list[Demonstrated]:
        """The demonstrations of a sample of this thread's episode."""
        return [each[sample] for each in self._demonstrated.get(threading.get_ident(), [])]

    @contextmanager
    def demonstrated_as(self, tasks: Mapping[str, str]) -> Iterator[None]:
        """Uses other tasks' demonstrations with some instructions, while the context is open.

        Args:
            tasks: For an instruction, the task string whose demonstrations are used.
        """
        previous, self.replaced = self.replaced, tasks
        try:
            yield
        finally:
            self.replaced = previous

    @contextmanager
    def with_turns(self, turns: Sequence[DemonstrationTurn]) -> Iterator[None]:
        """Uses the given demonstration for each sample, while the context is open.

        Args:
            turns: The demonstrations, one for each sample.
        """
        previous, self.turns = self.turns, tuple(turns)
        try:
            yield
        finally:
            self.turns = previous

    def count_trials(self, tasks: Sequence[str]) -> list[int]:
        """Number of each sample's episode among those of its task, from 0, whichever thread runs them.

        If `turns` are given, their numbers, and nothing is counted.
        """
        if self.turns is not None:
            return [each.turn for each in self.turns]
        trials = []
        for task in tasks:
            trials.append(self._n_episodes.get(task, 0))
            self._n_episodes[task] = trials[-1] + 1
        return trials
