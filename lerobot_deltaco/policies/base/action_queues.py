"""Which actions of the predicted chunks are carried out before the next chunks are predicted."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor


class ActionQueues:
    """The actions that the samples of a batch are still to carry out.

    Of a chunk, the first `n_action_steps` actions are carried out; but all, if one of these opens or closes
    the gripper. Predicting anew while only the gripper moves, a policy could not tell when it has moved.

    Args:
        n_action_steps: Number of actions of a chunk that are carried out; None for all.
        gripper_index: The gripper's dimension of the action; None without a gripper.
    """

    def __init__(self, n_action_steps: int | None, gripper_index: int | None) -> None:
        self.n_action_steps = n_action_steps
        self.gripper_index = gripper_index
        self._queues: list[deque[Tensor]] = []
        self._last_action: Tensor | None = None  # (batch, action)

    @property
    def need_chunks(self) -> bool:
        """Whether a sample has no action left."""
        return not self._queues or not all(self._queues)

    def clear(self) -> None:
        """Drops all actions, at an episode's start or end."""
        self._queues, self._last_action = [], None

    def refill(self, chunks: Tensor) -> None:
        """Gives the actions of a new chunk to each sample that has none left.

        Args:
            chunks: A chunk of each sample, (batch, steps, action), normalized: the gripper is in -1..1.
        """
        self._queues = self._queues or [deque() for _ in chunks]
        for queue, chunk, n_steps in zip(self._queues, chunks, self._n_steps(chunks), strict=True):
            if not queue:
                queue.extend(chunk[:n_steps])

    def pop(self) -> Tensor:
        """Returns the next action of each sample, (batch, action)."""
        self._last_action = torch.stack([queue.popleft() for queue in self._queues])
        return self._last_action

    def _n_steps(self, chunks: Tensor) -> list[int]:
        """Returns how many actions of each sample's chunk are carried out."""
        n_chunks, chunk_size = chunks.shape[:2]
        n_steps = min(self.n_action_steps or chunk_size, chunk_size)
        if self.gripper_index is None or n_steps == chunk_size:
            return [n_steps] * n_chunks
        before = chunks[:, 0] if self._last_action is None else self._last_action
        is_open = torch.cat([before[:, None], chunks[:, :n_steps]], dim=1)[..., self.gripper_index] > 0
        moves = (is_open != is_open[:, :1]).any(dim=1)
        return torch.where(moves, chunk_size, n_steps).tolist()
