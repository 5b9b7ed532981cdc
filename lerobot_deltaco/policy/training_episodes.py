"""Which episodes LeRobot trains on. No object hands that to a policy; it is read where LeRobot reads it."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.datasets import LeRobotDatasetMetadata


def training_episodes(meta: LeRobotDatasetMetadata) -> list[int]:
    """The episodes of a dataset that the running `lerobot-train` trains on.

    They are those of `--dataset.episodes`, less the last share of each task that `--dataset.eval_split` holds
    back; all of them if neither is given, or outside of that command.
    """
    episodes = _dataset_option("episodes") or list(range(meta.total_episodes))
    share = _dataset_option("eval_split") or 0.0
    by_task: dict[str, list[int]] = defaultdict(list)
    for episode in episodes:
        by_task[meta.episodes[episode]["tasks"][0]].append(episode)
    kept = (task[: len(task) - math.ceil(len(task) * share)] for task in by_task.values())
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
