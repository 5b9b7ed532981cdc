"""Records of evaluations that were not run."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from gym_deltaco import ENV_ID
from lerobot_deltaco.evaluation.records import EvaluationPlan, EvaluationRecord

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
    trials = [(task_id, trial) for task_id in full_plan.task_ids for trial in range(full_plan.trials)]
    success = [succeeds(*each) for each in trials]
    task_ids = [task_id for task_id, _ in trials]
    episodes = pd.DataFrame(
        {
            "task_id": task_ids,
            "trial": [trial for _, trial in trials],
            "success": success,
            "instruction": None,
            "demonstration_task": task_ids,
            "demonstration_episodes": [[task_id] for task_id in task_ids],
            "demonstrated_objects": [[24]] * len(trials),
            "grasped_object": [0 if each else -1 for each in success],
            "object_containers": [[1 if each else -1, -1, -1] for each in success],
            "right_object": success,
            "right_container": success,
            "pick_confidence": np.nan,
            "pick_error": np.nan,
            "place_error": np.nan,
            "failure": None,
        }
    ).assign(**(columns or {}))
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
