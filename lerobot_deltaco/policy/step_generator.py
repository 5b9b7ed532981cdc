"""The random draws of a training step."""

from __future__ import annotations

import numpy as np
import torch


def process_rank() -> int:
    """Number of this process among those that train together, from 0."""
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def step_generator(seed: int, step: int, rank: int) -> torch.Generator:
    """A generator that depends on its arguments alone: a resumed training repeats an uninterrupted one.

    Args:
        seed: Seed of the training, at least 0.
        step: Number of the training step, from 0.
        rank: Number of the process among those that train together, from 0.

    Returns:
        A generator on the CPU. Those of neighboring seeds, steps and ranks are independent.
    """
    (state,) = np.random.SeedSequence((seed, step, rank)).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))
