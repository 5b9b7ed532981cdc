"""Seeds of episodes: training, validation and evaluation never show the same scene."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Split = Literal["train", "validation", "evaluation"]
SPLITS: tuple[str, ...] = get_args(Split)


def episode_seed(seed: int, split: Split, task_id: int, episode: int, attempt: int = 0) -> int:
    """Derives the seed of an episode from its purpose.

    Args:
        seed: Seed of the dataset or evaluation, at least 0.
        split: "train", "validation" or "evaluation".
        task_id: Index of the task.
        episode: Number of the episode or trial of this task, from 0.
        attempt: Number of failed attempts at this episode.

    Returns:
        Seed for `env.reset(seed=...)`, 0..2**63 - 1.

    Raises:
        ValueError: The split is unknown, or a number is negative.
    """
    entropy = (seed, SPLITS.index(split), task_id, episode, attempt)
    state = np.random.SeedSequence(entropy).generate_state(1, np.uint64)
    return int(state[0] >> np.uint64(1))
