"""Which episodes of a dataset LeRobot trains on."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_deltaco.lerobot_internals import dataset_option


def training_episodes(meta: LeRobotDatasetMetadata) -> list[int]:
    """The episodes of a dataset that the running `lerobot-train` trains on.

    They are those of `--dataset.episodes`, less the last share of each task that `--dataset.eval_split` holds
    back; all of them if neither is given, or outside of that command.

    Raises:
        ValueError: The command's configuration is not on this machine.
    """
    # As numbers, since YAML takes "1e-1" for a text.
    return kept_episodes(meta, dataset_option("episodes"), float(dataset_option("eval_split") or 0))


def kept_episodes(
    meta: LeRobotDatasetMetadata, episodes: Sequence[int] | None, eval_split: float
) -> list[int]:
    """The episodes that remain for training.

    Args:
        meta: Metadata of their dataset.
        episodes: Episodes of the dataset; None or an empty sequence for all.
        eval_split: Share of each task that is held back, the last ones.
    """
    tasks = meta.episodes["tasks"][:]  # at once: one after another takes long
    by_task: dict[str, list[int]] = defaultdict(list)
    for episode in episodes or range(meta.total_episodes):
        by_task[tasks[episode][0]].append(episode)
    kept = (task[: len(task) - math.ceil(len(task) * eval_split)] for task in by_task.values())
    return [episode for task in kept for episode in task]
