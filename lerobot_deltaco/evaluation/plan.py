"""Which episodes an evaluation set consists of."""

from __future__ import annotations

from dataclasses import dataclass

from gym_deltaco.layout import AMBIGUITIES, Ambiguity
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.common.checks import check_choices, check_minimums
from lerobot_deltaco.evaluation.record import COUNTERFACTUALS, Counterfactual


@dataclass(frozen=True)
class EvaluationPlan:
    """Arguments of an evaluation set; equal plans and set numbers give equal scenes.

    Args:
        tasks: Selection of tasks, as `--env.task` takes it.
        trials: Number of episodes of each task, at least 1.
        seed: Seed of the scenes, at least 0; the number of the set, the task and the trial also determine
            them.
        counterfactual: "none": demonstration and instruction are those of the scene's task. "demo" or
            "instruction": that one is another task's, which asks for another object of the scene and for the
            other container, if there is such a task.
        ambiguity: "container" or "object", the paper's schemes i and ii.

    Raises:
        ValueError: An argument is invalid; the message says what is valid.
    """

    tasks: str = "scenario_a_test"
    trials: int = 2
    seed: int = 0
    counterfactual: Counterfactual = "none"
    ambiguity: Ambiguity = "container"

    def __post_init__(self) -> None:
        select_tasks(self.tasks)
        check_minimums(self, trials=1, seed=0)
        check_choices(self, counterfactual=COUNTERFACTUALS, ambiguity=AMBIGUITIES)
