"""Which episodes LeRobot trains on. No object hands that to a policy; it is read where LeRobot reads it."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.datasets import LeRobotDatasetMetadata


def training_episodes(meta: LeRobotDatasetMetadata) -> list[int]:
    """The episodes of a dataset that the running `lerobot-train` trains on.

    They are those of `--dataset.episodes`, less the last share of each task that `--dataset.eval_split` holds
    back; all of them if neither is given, or outside of that command.
    """
    return kept_episodes(meta, _dataset_option("episodes"), _dataset_option("eval_split") or 0.0)


def kept_episodes(
    meta: LeRobotDatasetMetadata, episodes: Sequence[int] | None, eval_split: float
) -> list[int]:
    """What is left of episodes for training.

    Args:
        meta: Of their dataset.
        episodes: Which ones; None or none is all of them.
        eval_split: Share of each task that is held back, the last ones.
    """
    tasks = meta.episodes["tasks"][:]  # at once: one after another takes long
    by_task: dict[str, list[int]] = defaultdict(list)
    for episode in episodes or range(meta.total_episodes):
        by_task[tasks[episode][0]].append(episode)
    kept = (task[: len(task) - math.ceil(len(task) * eval_split)] for task in by_task.values())
    return [episode for task in kept for episode in task]


def _dataset_option(name: str) -> Any:
    """The value of `--dataset.<name>`, on the command line or else in the file of `--config_path`."""
    text = parser.parse_arg(f"dataset.{name}")
    if text is not None:
        return json.loads(text)
    config_path = parser.parse_arg("config_path")
    if config_path is None or not Path(config_path).is_file():
        return None
    return json.loads(Path(config_path).read_text()).get("dataset", {}).get(name)
