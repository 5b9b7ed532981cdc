"""Sets of objects that scenes are made of, by name."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from gym_deltaco.objects import ObjectModel, object_model
from gym_deltaco.random_objects import FIRST_INDEX, random_label, random_model
from gym_deltaco.tasks import OBJECTS, SCENARIOS, ObjectLabel, Task, get_task

OBJECT_SETS = MappingProxyType(
    {
        # Test objects stand as distractors in training scenes, as in the authors' code:
        # https://github.com/Alacarter/roboverse-deltaco, commit d6d407b.
        "all": OBJECTS,
        # Without the 8 test objects of scenario A.
        "scenario_a_train": tuple(label for label in OBJECTS if label.index in SCENARIOS["a"].train_rows),
    }
)
ADVERSARIAL_PROBABILITY = 0.6  # that a distractor shares the target's color or shape, in the paper's data
AdversarialDraw = Literal["each", "scene"]
ADVERSARIAL_DRAWS: tuple[str, ...] = get_args(AdversarialDraw)
MAX_OBJECTS = 10_000
N_INDICES = (
    FIRST_INDEX + MAX_OBJECTS - len(OBJECT_SETS["scenario_a_train"])
)  # of objects, random ones included
# Task sets whose scenes are made of other objects than all, unless something else is asked for.
_OBJECTS_OF_TASK_SETS = MappingProxyType({"scenario_a_clean_train": "scenario_a_train"})


def select_objects(name: str) -> tuple[ObjectLabel, ...]:
    """The objects of a set.

    Args:
        name: One of `OBJECT_SETS`; or "random:N": N objects, 24..10000, of which 24 are scenario A's training
            objects and the others random ones. A greater set holds a smaller one.

    Raises:
        ValueError: There is no such set.
    """
    count = re.fullmatch(r"random:(\d+)", name) if isinstance(name, str) else None
    if count is not None:
        return _with_random_objects(int(count[1]))
    if not isinstance(name, str) or name not in OBJECT_SETS:
        raise ValueError(f"`objects` must be one of {', '.join(OBJECT_SETS)}, random:N. Got {name!r}.")
    return OBJECT_SETS[name]


@cache
def _with_random_objects(n_objects: int) -> tuple[ObjectLabel, ...]:
    paper = OBJECT_SETS["scenario_a_train"]
    n_random = n_objects - len(paper)
    if not 0 <= n_random <= MAX_OBJECTS - len(paper):
        raise ValueError(
            f"`objects` must be random:N with N from {len(paper)} to {MAX_OBJECTS}. Got 'random:{n_objects}'."
        )
    return (*paper, *(random_label(FIRST_INDEX + number) for number in range(n_random)))


def find_label(index: int) -> ObjectLabel:
    """Name, shape and color of an object, one of the paper's or a random one.

    Raises:
        ValueError: There is no such object.
    """
    _check_index(index)
    return OBJECTS[index] if index < FIRST_INDEX else random_label(index)


def find_model(index: int) -> ObjectModel:
    """The model of an object, one of the paper's or a random one.

    Raises:
        ValueError: There is no such object.
    """
    _check_index(index)
    return object_model(index) if index < FIRST_INDEX else random_model(index)


def _check_index(index: int) -> None:
    if not isinstance(index, (int, np.integer)) or index < 0:
        raise ValueError(
            f"An object's index must be an integer of at least 0: 0 to {FIRST_INDEX - 1} are the paper's, "
            f"{FIRST_INDEX} and above random ones. Got {index!r}."
        )


def default_objects(tasks: str) -> str:
    """Name of the set of objects for a selection of tasks, unless another one is asked for."""
    return _OBJECTS_OF_TASK_SETS.get(tasks.strip(), "all")


def check_scenes(
    task_ids: Iterable[int], objects: str, adversarial_probability: float, adversarial_draw: str = "each"
) -> None:
    """Checks that scenes can be drawn for tasks.

    Args:
        task_ids: Indices of the tasks.
        objects: Name of the set of objects, as `select_objects` takes it.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.

    Raises:
        ValueError: There is no such set, a task asks for none of its objects, or the probability or its draw
            is not valid.
    """
    try:
        is_probability = 0 <= adversarial_probability <= 1
    except TypeError:
        is_probability = False
    if not is_probability:
        raise ValueError(
            f"`adversarial_probability` must be between 0 and 1. Got {adversarial_probability!r}."
        )
    if adversarial_draw not in ADVERSARIAL_DRAWS:
        raise ValueError(
            f"`adversarial_draw` must be one of {', '.join(ADVERSARIAL_DRAWS)}. Got {adversarial_draw!r}."
        )
    tasks_by_row = {task.row: task for task in map(get_task, task_ids)}
    for task in tasks_by_row.values():
        check_task(task, objects)


def check_task(task: Task, name: str) -> None:
    """Checks that a set has an object that a task asks for.

    Args:
        task: The task.
        name: Name of the set, as `select_objects` takes it.

    Raises:
        ValueError: There is no such set, or it has no such object.
    """
    if not any(task.describes(label) for label in select_objects(name)):
        raise ValueError(
            f"Task {task.index} asks for a {task.object_phrase}, of which the objects {name!r} have none. "
            "Choose other tasks, or other `objects`."
        )
