"""Sets of objects that scenes are made of, by name."""

from __future__ import annotations

from types import MappingProxyType

from gym_deltaco.tasks import OBJECTS, SCENARIOS, ObjectLabel, Task

OBJECT_SETS = MappingProxyType(
    {
        # Test objects stand as distractors in training scenes, as in the authors' code:
        # https://github.com/Alacarter/roboverse-deltaco, commit d6d407b.
        "all": OBJECTS,
        # Without the 8 test objects of scenario A.
        "scenario_a_train": tuple(label for label in OBJECTS if label.index in SCENARIOS["a"].train_rows),
    }
)
# Task sets whose scenes are made of other objects than all, unless something else is asked for.
_OBJECTS_OF_TASK_SETS = MappingProxyType({"scenario_a_clean_train": "scenario_a_train"})


def select_objects(name: str) -> tuple[ObjectLabel, ...]:
    """The objects of a set.

    Args:
        name: One of `OBJECT_SETS`.

    Raises:
        ValueError: There is no such set.
    """
    if name not in OBJECT_SETS:
        raise ValueError(f"`objects` must be one of {', '.join(OBJECT_SETS)}. Got {name!r}.")
    return OBJECT_SETS[name]


def default_objects(tasks: str) -> str:
    """Name of the set of objects for a selection of tasks, unless another one is asked for."""
    return _OBJECTS_OF_TASK_SETS.get(tasks.strip(), "all")


def check_task(task: Task, name: str) -> None:
    """Checks that a set has an object that a task asks for.

    Args:
        task: The task.
        name: One of `OBJECT_SETS`.

    Raises:
        ValueError: There is no such set, or it has no such object.
    """
    if not any(task.describes(label) for label in select_objects(name)):
        raise ValueError(
            f"Task {task.index} asks for a {task.object_phrase}, of which the objects {name!r} have none. "
            "Choose other tasks, or other `objects`."
        )
