"""The episodes of an evaluation set: their scenes, and what the policy is given in each."""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from gymnasium.utils import seeding

from gym_deltaco.layout import sample_layout
from gym_deltaco.object_sets import find_label, select_objects
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import CONTAINER_COLORS, Task, get_task, select_tasks
from gym_deltaco.workspace import Quadrant, container_matches
from lerobot_deltaco.evaluation.plan import EvaluationPlan

# Most episodes that are run at the same time. A policy's step costs little more for 8 than for 2, and each
# episode needs a simulator of 50 MB, in each process.
MOST_AT_ONCE = 8
# Batches are what processes share, so that small sets have some, too.
FEWEST_BATCHES = 4


class Episode(NamedTuple):
    """An episode before it is run.

    Attributes:
        task_id: Index of the scene's task.
        trial: Number of the episode among those of its task, from 0.
        seed: Seed of the environment's reset.
        instruction: Instruction that the policy receives.
        demonstrated: Task string of the demonstration that the policy receives, if it takes one. The trials
            use the demonstrations of that task in turn.
    """

    task_id: int
    trial: int
    seed: int
    instruction: str
    demonstrated: str


def draw_episodes(
    plan: EvaluationPlan, set_number: int, demonstrated: Collection[str] | None = None
) -> list[Episode]:
    """Draws the episodes of an evaluation set: the first trial of each task, then the second ones, and so on.

    Args:
        plan: Plan of the set.
        set_number: Number of the set of scenes, unless the plan names one. Different sets share no scene.
        demonstrated: Task strings of which there are demonstrations; None if that is not known.
            Counterfactual demonstrations are of these tasks.

    Raises:
        ValueError: There is no other task for a counterfactual demonstration or instruction.
    """
    if plan.scene_set is not None:
        set_number = plan.scene_set
    task_ids, sentences = select_tasks(plan.tasks), plan.sentences
    tasks = [get_task(task_id) for task_id in task_ids]
    if plan.counterfactual == "demo" and demonstrated is not None:
        candidates = [task for task in tasks if task.instruction in demonstrated]
    else:
        candidates = tasks
    episodes = []
    for trial in range(plan.trials):
        for task in tasks:
            seed = episode_seed(plan.seed, "evaluation", task.index, set_number, trial)
            own = (task.instruction,) if sentences is None else sentences[task.index]
            episode = Episode(task.index, trial, seed, own[trial % len(own)], task.instruction)
            if plan.counterfactual != "none":
                others = [other for other in candidates if other.index != task.index]
                scene = scene_info(plan, task, seed)
                other = counterfactual_task(others, scene, random.Random(seed)).instruction
                if plan.counterfactual == "demo":
                    episode = episode._replace(demonstrated=other)
                else:
                    episode = episode._replace(instruction=other)
            episodes.append(episode)
    return episodes


def split_into_batches(episodes: Sequence[Episode]) -> list[list[Episode]]:
    """Splits episodes into batches that are run at the same time, in their order."""
    size = min(MOST_AT_ONCE, math.ceil(len(episodes) / FEWEST_BATCHES))
    return [list(episodes[start : start + size]) for start in range(0, len(episodes), size)]


def counterfactual_task(others: Sequence[Task], info: Mapping[str, Any], rng: random.Random) -> Task:
    """Another task whose demonstration or instruction fits a scene.

    If there is one, it asks for another object that stands there, and for the other container; else, at least
    for the other container.

    Args:
        others: Tasks to choose from.
        info: Info of the scene.
        rng: Source of the choice.

    Raises:
        ValueError: There is no other task.
    """
    if not others:
        raise ValueError(
            "A counterfactual evaluation needs at least two tasks that the policy can perform. Evaluate more "
            "tasks, and give demonstrations of them."
        )
    labels = [find_label(int(index)) for index in info["objects"]]

    def wants(task: Task) -> tuple[bool, bool]:
        objects = [n for n, label in enumerate(labels) if task.describes(label)]
        containers = [
            n
            for n, color in enumerate(CONTAINER_COLORS)
            if container_matches(task.container, color, Quadrant(*info["container_quadrants"][n]))
        ]
        is_other_container = containers == [1 - info["target_container"]]
        is_other_object = len(objects) == 1 and objects != [info["target_object"]]
        return is_other_container, is_other_object

    ranked = [(wants(task), task) for task in others]
    best = max(rank for rank, _ in ranked)
    return rng.choice([task for rank, task in ranked if rank == best])


def scene_info(plan: EvaluationPlan, task: Task, seed: int) -> dict[str, Any]:
    """What the environment will say of a scene, as far as it is drawn, without building the scene."""
    rng, _ = seeding.np_random(seed)
    labels = select_objects(plan.object_set)
    layout = sample_layout(
        task, plan.ambiguity, rng, labels, plan.adversarial_probability, plan.adversarial_draw
    )
    return {
        "objects": [item.label.index for item in layout.objects],
        "container_quadrants": [item.quadrant for item in layout.containers],
        "target_object": layout.target_object,
        "target_container": layout.target_container,
    }
