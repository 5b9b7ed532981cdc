"""The order in which frames are drawn: batches of k tasks with b samples each (the paper's algorithm 1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.errors import UserError


class TaskBatchSampler:
    """Frames in an order whose successive batches hold the same number of samples of each of a few tasks.

    In an epoch, every task of a group is in the same number of batches, give or take one, and every frame of
    a task is drawn the same number of times, give or take one. The order is a function of the seed and the
    epoch alone, so that a resumed run continues it. It has the interface of LeRobot's `EpisodeAwareSampler`,
    which it replaces.

    Args:
        tasks: The task of each frame, (frames,) int64. Frames are numbered as in the dataset.
        batch_size: Number of samples in a batch, a multiple of `tasks_per_batch`.
        tasks_per_batch: Number of distinct tasks in a batch, k.
        upsampled: Tasks that get a fraction of each batch; none by default.
        upsampled_fraction: That fraction of `tasks_per_batch`, rounded to whole tasks.
        seed: Seed of the order.
        use: Whether each frame may be drawn, (frames,) bool; all by default.

    Raises:
        UserError: The numbers do not fit together; the message says what is valid.
    """

    def __init__(
        self,
        tasks: NDArray[np.int64],
        batch_size: int,
        tasks_per_batch: int,
        upsampled: Sequence[int] = (),
        upsampled_fraction: float = 0.0,
        seed: int = 0,
        use: NDArray[np.bool_] | None = None,
    ) -> None:
        if batch_size % tasks_per_batch:
            raise UserError(
                f"A batch of {batch_size} samples cannot hold {tasks_per_batch} tasks with as many samples "
                f"each. Set `batch_size` to a multiple of `tasks_per_batch`, such as "
                f"{max(1, round(batch_size / tasks_per_batch)) * tasks_per_batch}."
            )
        self.batch_size = batch_size
        self.samples_per_task = batch_size // tasks_per_batch
        self.seed = seed
        frames = np.arange(len(tasks)) if use is None else np.flatnonzero(use)
        self._frames_of = {int(task): frames[tasks[frames] == task] for task in np.unique(tasks[frames])}
        self._groups = self._make_groups(tasks_per_batch, set(upsampled), upsampled_fraction)
        self._n_batches = max(1, len(frames) // batch_size)
        self._epoch = 0
        self._start_index = 0

    def _make_groups(
        self, tasks_per_batch: int, upsampled: set[int], fraction: float
    ) -> list[tuple[list[int], int]]:
        """Returns groups of tasks, and how many of each group are in a batch."""
        present = list(self._frames_of)
        groups = [(present, tasks_per_batch)]
        if upsampled:
            n_upsampled = round(fraction * tasks_per_batch)
            if not 0 < n_upsampled < tasks_per_batch:
                raise UserError(
                    "`upsampled_fraction` must leave at least one of the tasks of a batch to the upsampled "
                    f"ones, and one to the others. Got {fraction} of {tasks_per_batch} tasks."
                )
            groups = [
                ([task for task in present if task in upsampled], n_upsampled),
                ([task for task in present if task not in upsampled], tasks_per_batch - n_upsampled),
            ]
        for members, n_tasks in groups:
            if len(members) < n_tasks:
                kind = "upsampled tasks" if upsampled and members == groups[0][0] else "tasks"
                raise UserError(
                    f"Each batch is to hold {n_tasks} different {kind}, but the dataset has only "
                    f"{len(members)}. Set `tasks_per_batch` to fewer, or to 0 for batches of any tasks."
                )
        return groups

    def __len__(self) -> int:
        """Number of samples in an epoch of whole batches."""
        return self._n_batches * self.batch_size

    def __iter__(self) -> Iterator[int]:
        """Iterates over the frames of one epoch, or over the rest of it after `load_state_dict`."""
        epoch, start = self._epoch, self._start_index
        self._epoch, self._start_index = epoch + 1, 0
        return iter(self.order(epoch)[start:].tolist())

    def state_dict(self) -> dict[str, int]:
        """Returns where the next iteration begins."""
        return {"epoch": self._epoch, "start_index": self._start_index}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Lets the next iteration begin at a sample of an epoch."""
        self._epoch, self._start_index = state["epoch"], state["start_index"]

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Returns the frames of an epoch, (len,): batch after batch, and in each of them task after task."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, epoch]))
        chosen = np.concatenate(
            [_rounds(np.array(members), n_tasks, self._n_batches, rng) for members, n_tasks in self._groups],
            axis=1,
        )  # (batches, tasks per batch)
        order = np.empty((*chosen.shape, self.samples_per_task), dtype=np.int64)
        for task, frames in self._frames_of.items():
            visits = chosen == task
            n_samples = int(visits.sum()) * self.samples_per_task
            n_passes = -(-n_samples // len(frames))
            passes = [rng.permutation(frames) for _ in range(n_passes)]
            drawn = np.concatenate(passes)[:n_samples] if passes else frames[:0]
            order[visits] = drawn.reshape(-1, self.samples_per_task)
        return order.reshape(-1)


def _rounds(
    members: NDArray[np.int64], per_batch: int, n_batches: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draws distinct members for each batch, (batches, per_batch): all in turn, reshuffled each round."""
    n_chosen = n_batches * per_batch
    turns = [rng.permutation(members)]
    n_drawn = len(members)
    while n_drawn < n_chosen:
        turn = rng.permutation(members)
        # The batch that the last round began must not hold a member twice.
        n_begun = n_drawn % per_batch
        begun = turns[-1][len(members) - n_begun :]
        first = np.flatnonzero(~np.isin(turn, begun))[: per_batch - n_begun]
        turns.append(np.concatenate([turn[first], np.delete(turn, first)]))
        n_drawn += len(members)
    return np.concatenate(turns)[:n_chosen].reshape(n_batches, per_batch)
