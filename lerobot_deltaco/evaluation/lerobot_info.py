"""The results of an evaluation set as `lerobot-eval` writes them: `eval_info.json`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gym_deltaco.atomic_files import write_json
from gym_deltaco.tasks import get_task
from lerobot_deltaco.evaluation.evaluate import EpisodeOutcome

EVAL_INFO = "eval_info.json"
# LeRobot's keys of the files of videos, of which there are none here.
_NO_FILES: dict[str, list[str]] = {"video_paths": [], "predicted_video_paths": []}


def lerobot_info(outcomes: Sequence[EpisodeOutcome], seconds: float) -> dict[str, Any]:
    """Rewards and successes under LeRobot's keys: by task, by kind of task, and of all.

    Args:
        outcomes: The episodes of an evaluation set.
        seconds: Duration of the set, s.
    """
    by_task: dict[int, list[EpisodeOutcome]] = defaultdict(list)
    groups: dict[str, list[EpisodeOutcome]] = defaultdict(list)
    for outcome in outcomes:
        task_id = outcome.result.task_id
        by_task[task_id].append(outcome)
        groups[get_task(task_id).kind].append(outcome)
    return {
        "per_task": [
            {
                "task_group": get_task(task_id).kind,
                "task_id": task_id,
                "metrics": {
                    "sum_rewards": [outcome.sum_reward for outcome in found],
                    "max_rewards": [outcome.max_reward for outcome in found],
                    "successes": [outcome.result.success for outcome in found],
                    **_NO_FILES,
                },
            }
            for task_id, found in by_task.items()
        ],
        "per_group": {kind: _aggregated(found) for kind, found in groups.items()},
        "overall": {
            **_aggregated(outcomes),
            "eval_s": seconds,
            "eval_ep_s": seconds / len(outcomes),
        },
    }


def write_lerobot_info(outcomes: Sequence[EpisodeOutcome], seconds: float, folder: Path) -> None:
    """Writes `eval_info.json` into a folder."""
    write_json(folder / EVAL_INFO, lerobot_info(outcomes, seconds), indent=2)


def _aggregated(outcomes: Sequence[EpisodeOutcome]) -> dict[str, Any]:
    return {
        "avg_sum_reward": float(np.mean([outcome.sum_reward for outcome in outcomes])),
        "avg_max_reward": float(np.mean([outcome.max_reward for outcome in outcomes])),
        "pc_success": 100 * float(np.mean([outcome.result.success for outcome in outcomes])),
        "n_episodes": len(outcomes),
        **_NO_FILES,
    }
