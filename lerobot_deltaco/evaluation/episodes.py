"""The episodes of an evaluation: scene, instruction and demonstration of each."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import NamedTuple

from gymnasium.utils import seeding

from gym_deltaco.layout import sample_layout
from gym_deltaco.paraphrases import choose_instructions
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import Task, get_task
from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.expert_demonstrations import ExpertBank
from lerobot_deltaco.evaluation.records import EvaluationPlan


class EpisodeSpec(NamedTuple):
    """An episode before it is run.

    Attributes:
        task_id: Index of the scene's task.
        trial: Number of the episode among those of its task, from 0.
        seed: Seed of the environment's reset.
        instruction: Instruction that the policy receives; empty without one.
        demonstration_task: Index of the task whose demonstrations the policy receives; -1 without any.
    """

    task_id: int
    trial: int
    seed: int
    instruction: str
    demonstration_task: int


def draw_episodes(
    plan: EvaluationPlan, bank: DemonstrationBank | ExpertBank | None = None
) -> list[EpisodeSpec]:
    """Draws the episodes of an evaluation: the first trial of each task, then the second ones, and so on.

    Args:
        plan: Plan of the evaluation.
        bank: Demonstrations that the policy receives; None if it takes none.

    Raises:
        UserError: There is no other task for a counterfactual demonstration or instruction.
    """
    tasks = [get_task(task_id) for task_id in plan.task_ids]
    try:
        sentences = choose_instructions(
            plan.task_ids, plan.paraphrases, plan.paraphrases_split, plan.instruction
        )
    except ValueError as error:  # of a file
        raise UserError(str(error)) from error
    candidates = tasks
    if plan.counterfactual == "demonstration" and bank is not None:
        candidates = [task for task in tasks if task.instruction in bank.rows]
    episodes = []
    for trial in range(plan.trials):
        for task in tasks:
            seed = plan.scene_seed(task.index, trial)
            own = (task.instruction,) if sentences is None else sentences[task.index]
            instruction, shown = own[trial % len(own)], task.index if bank is not None else -1
            if plan.counterfactual != "none":
                other = _counterfactual_task(candidates, plan.scene, task, seed)
                if plan.counterfactual == "demonstration":
                    shown = other.index
                else:
                    instruction = other.instruction
            if plan.without == "instruction":
                instruction = ""
            elif plan.without == "demonstration":
                shown = -1
            episodes.append(EpisodeSpec(task.index, trial, seed, instruction, shown))
    return episodes


def _counterfactual_task(candidates: Sequence[Task], scene: SceneConfig, task: Task, seed: int) -> Task:
    """Returns another task whose demonstration or instruction fits a scene.

    If possible, it asks for another object in the scene and for the other container; otherwise, at least for
    the other container.
    """
    others = [other for other in candidates if other.index != task.index]
    if not others:
        raise UserError(
            "A counterfactual evaluation needs at least two tasks that the policy can perform. Evaluate more "
            "tasks, and give demonstrations of them."
        )
    layout = sample_layout(task, scene, seeding.np_random(seed)[0])

    def fits(other: Task) -> tuple[bool, bool]:
        objects = other.object.meant([item.label for item in layout.objects])
        containers = [n for n, item in enumerate(layout.containers) if item.satisfies(other.container)]
        is_other_container = containers == [1 - layout.target_container]
        return is_other_container, len(objects) == 1 and objects != [layout.target_object]

    ranked = [(fits(other), other) for other in others]
    best = max(rank for rank, _ in ranked)
    return random.Random(seed).choice([other for rank, other in ranked if rank == best])
