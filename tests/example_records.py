"""Records of evaluations that were not run."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from gym_deltaco import ENV_ID
from lerobot_deltaco.records import EvaluationPlan, EvaluationRecord

TASKS = "24,32,45,124,132,145"  # names, colors and shapes; a color word and position words


def make_record(
    experiment: str = "scenario_a/deltaco",
    seed: int = 0,
    step: int = 10_000,
    succeeds: Callable[[int, int], bool] = lambda task_id, trial: task_id < 50,
    columns: dict[str, Any] | None = None,
    plan: dict[str, Any] | None = None,
    **fields: Any,
) -> EvaluationRecord:
    """Makes a record in which an episode of a task and trial succeeds or nothing happens."""
    full_plan = EvaluationPlan(**({"tasks": TASKS, "trials": 2} | (plan or {})))
    rows = [
        {
            "task_id": task_id,
            "trial": trial,
            "success": succeeds(task_id, trial),
            "instruction": None,
            "demonstration_task": task_id,
            "demonstration_episodes": [task_id],
            "demonstrated_objects": [24],
        }
        for task_id in full_plan.task_ids
        for trial in range(full_plan.trials)
    ]
    episodes = pd.DataFrame(rows)
    success = episodes["success"]
    episodes["grasped_object"] = success.map({True: 0, False: -1})
    episodes["object_containers"] = [[1, -1, -1] if item else [-1, -1, -1] for item in success]
    episodes["right_object"] = success
    episodes["right_container"] = success
    episodes["p_pick"] = np.nan
    for name, values in (columns or {}).items():
        episodes[name] = values
    other = {
        "policy_type": "deltaco",
        "wording": full_plan.wording,
        "policy": {"seed": seed},
        "versions": {"benchmark": ENV_ID},
        "command": f"deltaco evaluate {experiment}",
        "seconds": 1.0,
        "weights": None,
        "demonstrations": None,
        "demonstrations_digest": None,
    }
    return EvaluationRecord(
        experiment, train_seed=seed, step=step, plan=full_plan, episodes=episodes, **(other | fields)
    )
