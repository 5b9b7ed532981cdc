"""How many tasks of a batch are upsampled ones."""

from __future__ import annotations

_SHARE_TOLERANCE = 1e-3  # in tasks: a third may be written as 0.3333


def count_upsampled_tasks(share: float, tasks_per_batch: int) -> int:
    """Number of the upsampled tasks in a batch.

    Args:
        share: Share of the batch for them.
        tasks_per_batch: Number of tasks in a batch.

    Raises:
        ValueError: It is not a whole number, or no other task is left.
    """
    n_upsampled = round(share * tasks_per_batch)
    if abs(n_upsampled - share * tasks_per_batch) > _SHARE_TOLERANCE or not 0 < n_upsampled < tasks_per_batch:
        nearest = min(max(n_upsampled, 1), tasks_per_batch - 1)
        raise ValueError(
            f"`upsampled_share` must be the share of a whole number of tasks, 1 to {tasks_per_batch - 1} of "
            f"the {tasks_per_batch} in a batch, such as {nearest / tasks_per_batch:g} for {nearest}. Got "
            f"{share}, which is {share * tasks_per_batch:g} tasks."
        )
    return n_upsampled
