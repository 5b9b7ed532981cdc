"""Tasks as data: an object specification and a container.

`add_tasks` gives each kind of task its indices; nothing else depends on them. docs/benchmark.md shows how to
add a kind.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from numbers import Integral
from types import MappingProxyType

from gym_deltaco.containers import CONTAINER_COLORS, CONTAINER_WORDS, ContainerWord
from gym_deltaco.objects.labels import (
    COLOR_SHAPE_PAIRS,
    COLORS,
    FIRST_MESH_INDEX,
    MESHES,
    OBJECTS,
    SHAPES,
    ObjectLabel,
)
from gym_deltaco.objects.object_sets import FOLDS, OBJECT_SETS


@dataclass(frozen=True)
class ObjectSpec:
    """The object that a task asks for.

    A kind with a rule of its own about one object overrides `describes`. A kind with a rule about all objects
    of a scene, such as "the largest", overrides `meant`.

    Attributes:
        kind: Kind of the task, such as "color", by which reports group results.
        phrase: Object in the words of the instruction, such as "blue colored object".
        name: Name that the object must have; None for any.
        color: Color that the object must have; None for any.
        shape: Shape that the object must have; None for any.
        index: Index of the object, if only a demonstration shows which one is meant; None otherwise.
    """

    kind: str
    phrase: str
    name: str | None = None
    color: str | None = None
    shape: str | None = None
    index: int | None = None

    def describes(self, label: ObjectLabel) -> bool:
        """Returns whether an object fits the specification, whatever else is in the scene."""
        return (
            self.name in (None, label.name)
            and self.color in (None, label.color)
            and self.shape in (None, label.shape)
            and self.index in (None, label.index)
        )

    def meant(self, labels: Sequence[ObjectLabel]) -> list[int]:
        """Returns the numbers of the objects of a scene that are meant: one, if it is unambiguous.

        Args:
            labels: The objects of the scene, or of a part of it.
        """
        return [number for number, label in enumerate(labels) if self.describes(label)]

    def distractors(self, target: ObjectLabel, labels: Sequence[ObjectLabel]) -> list[ObjectLabel]:
        """Returns the objects beside which a target is meant, and which are not meant beside it.

        Args:
            target: An object that fits.
            labels: Objects to choose from.
        """
        return [label for label in labels if self.meant((target, label)) == [0]]


@dataclass(frozen=True)
class Task:
    """A task: put an object into a container.

    Attributes:
        index: Index of the task, by which datasets and records refer to it.
        object: Specification of the object.
        container: Word by which the instruction describes the container.
    """

    index: int
    object: ObjectSpec
    container: ContainerWord

    @property
    def kind(self) -> str:
        """Kind of the task, such as "color"."""
        return self.object.kind

    @property
    def instruction(self) -> str:
        """Template sentence, such as "Put blue colored object in front bin."."""
        return f"Put {self.object.phrase} in {self.container} bin."

    @property
    def is_position_task(self) -> bool:
        """Whether the container is described by its position (front, back, left, right), not its color."""
        return self.container not in CONTAINER_COLORS

    @cached_property
    def targets(self) -> tuple[int, ...]:
        """Indices of the paper's objects that fit the task."""
        return tuple(label.index for label in OBJECTS if self.object.describes(label))


_TASKS: dict[int, Task] = {}
_BY_INSTRUCTION: dict[str, Task] = {}
ALL_TASKS: Mapping[int, Task] = MappingProxyType(_TASKS)
"""Every task, by its index."""


def add_tasks(first: int, objects: Sequence[ObjectSpec], stride: int | None = None) -> tuple[Task, ...]:
    """Adds a task for each object and each of the six containers.

    The task of object `row` and container `column` (an index into `CONTAINER_WORDS`) has the index
    `first + stride * column + row`. Indices must never change, since datasets and records contain them.

    Args:
        first: Index of the first task.
        objects: Specifications of the objects.
        stride: Distance of the indices of an object's tasks; None for the number of objects.

    Returns:
        The tasks, container by container.

    Raises:
        ValueError: A task has an index or an instruction that another one has.
    """
    stride = len(objects) if stride is None else stride
    tasks = tuple(
        Task(first + stride * column + row, specification, container)
        for column, container in enumerate(CONTAINER_WORDS)
        for row, specification in enumerate(objects)
    )
    instructed = {task.instruction: task for task in tasks if task.object.index is None}
    if taken := {task.index for task in tasks} & _TASKS.keys():
        raise ValueError(
            f"Other tasks have the indices {min(taken)} to {max(taken)}. Choose another `first`."
        )
    if repeated := instructed.keys() & _BY_INSTRUCTION.keys():
        raise ValueError(f"Another task has the instruction {min(repeated)!r}. Choose another `phrase`.")
    _TASKS.update((task.index, task) for task in tasks)
    _BY_INSTRUCTION.update(instructed)
    return tasks


# The paper's table (appendix A): a row for each object specification, a column for each container
_TABLE = (
    *(
        ObjectSpec(
            "name",
            f"{label.color} colored, {label.shape} shaped {label.name}",
            label.name,
            label.color,
            label.shape,
        )
        for label in OBJECTS
    ),
    *(ObjectSpec("color", f"{color} colored object", color=color) for color in COLORS),
    *(ObjectSpec("shape", f"{shape} shaped object", shape=shape) for shape in SHAPES),
)
TASKS = add_tasks(0, _TABLE)
# Random objects have no names.
COLOR_SHAPE_TASKS = add_tasks(
    1000,
    [
        ObjectSpec("color_shape", f"{color} colored, {shape} shaped object", color=color, shape=shape)
        for color in COLORS
        for shape in SHAPES
    ],
)
# Only a demonstration shows which object is meant: index 2000 + 1000 * column + mesh.
MESH_TASKS = add_tasks(
    2000 + MESHES.start,
    [ObjectSpec("out_of_distribution", "thing", index=FIRST_MESH_INDEX + mesh) for mesh in MESHES],
    stride=1000,
)


def get_task(index: int) -> Task:
    """Returns the task of an index.

    Raises:
        ValueError: The index is not an integer, or no task has it.
    """
    if isinstance(index, Integral) and not isinstance(index, bool) and int(index) in _TASKS:
        return _TASKS[int(index)]
    raise ValueError(f"`task_id` must be an integer {_valid_indices()}. Got {index!r}.")


def find_task(instruction: str) -> Task | None:
    """Returns the task of a template sentence; None if no task has it, or it leaves open which object."""
    return _BY_INSTRUCTION.get(instruction)


def task_kinds() -> tuple[str, ...]:
    """Returns the kinds of all tasks."""
    return tuple(dict.fromkeys(task.kind for task in _TASKS.values()))


def _valid_indices() -> str:
    """Returns the ranges of valid indices in words."""
    ranges: list[list[int]] = []
    for index in sorted(_TASKS):
        if ranges and index == ranges[-1][1] + 1:
            ranges[-1][1] = index
        else:
            ranges.append([index, index])
    return "from " + ", ".join(f"{low} to {high}" for low, high in ranges)


# Scenarios


@dataclass(frozen=True)
class Scenario:
    """A split of the rows of the paper's table; every row comes with all six containers.

    Attributes:
        name: Name of the split.
        train_rows: Rows of the training tasks.
        test_rows: Rows of the test tasks.
    """

    name: str
    train_rows: tuple[int, ...]
    test_rows: tuple[int, ...]

    @property
    def train_tasks(self) -> tuple[int, ...]:
        """Indices of the training tasks, ascending."""
        return _tasks_of_rows(self.train_rows)

    @property
    def test_tasks(self) -> tuple[int, ...]:
        """Indices of the test tasks, ascending."""
        return _tasks_of_rows(self.test_rows)


def _tasks_of_rows(rows: Iterable[int]) -> tuple[int, ...]:
    objects = {_TABLE[row] for row in rows}
    return tuple(task.index for task in TASKS if task.object in objects)


SCENARIOS = MappingProxyType(
    {
        # Novel objects, colors and shapes
        "a": Scenario(
            "a", train_rows=(*range(24), *range(36, 45)), test_rows=(*range(24, 36), *range(45, 50))
        ),
        # All objects are trained on by name; colors and shapes are novel.
        "b": Scenario(
            "b", train_rows=(*range(32), *range(36, 45)), test_rows=(*range(32, 36), *range(45, 50))
        ),
    }
)

# Training rows of scenario A that are held out for choosing settings; see `VALIDATION`
_VALIDATION_ROWS = (6, 10, 12, 16, 36, 38, 40, 44)

VALIDATION = Scenario(
    "a_validation",
    train_rows=tuple(row for row in SCENARIOS["a"].train_rows if row not in _VALIDATION_ROWS),
    test_rows=_VALIDATION_ROWS,
)
"""Scenario A's 198 training tasks, split once more, so that settings are never chosen on test tasks.

The 48 validation tasks are four names (narrow tray, pacifier vase, crooked lid trash can, modern canoe), two
colors (white, orange) and two shapes (vase, canoe). Settings are chosen by training on the other 150 tasks;
the final model trains on all 198. The rows were chosen from the table alone, before any result, so that
validation tasks resemble the test tasks:

1. A held-out object is never a target in training: no other training row describes it. It is still a
   distractor in training scenes, as the test objects are.
2. Each held-out color and shape has at least two objects. At least one of them is held out by name as well,
   and at least one remains a target by name.
3. The four objects have four different colors and shapes. One of the shapes (cylinder) is in no training
   instruction, as "round hole" is in none of scenario A.
4. Two of the objects are low and oblong (tray and canoe), two upright.

Scenario A itself breaks the first rule: its test object 29 is the target of the six yellow training tasks.
"""

# Scenario A without its yellow tasks, whose target is a test object. With the objects "scenario_a_train", no
# training scene shows a test object.
_YELLOW_ROW = len(OBJECTS) + COLORS.index("yellow")
CLEAN = Scenario(
    "a_clean",
    train_rows=tuple(row for row in SCENARIOS["a"].train_rows if row != _YELLOW_ROW),
    test_rows=SCENARIOS["a"].test_rows,
)

# Sets of tasks

_RANDOM_TRAIN = (
    *SCENARIOS["a"].train_tasks,
    *(
        task.index
        for task in COLOR_SHAPE_TASKS
        if (task.object.color, task.object.shape) in COLOR_SHAPE_PAIRS
    ),
)


def _fold_train_tasks(fold: int) -> tuple[int, ...]:
    """Returns the training tasks of a fold: those of `random_train` that do not need its objects.

    Tasks by color or by shape alone have other objects, too.
    """
    return tuple(
        task.index
        for task in map(get_task, _RANDOM_TRAIN)
        if None in (task.object.color, task.object.shape) or not set(task.targets) & set(FOLDS[fold])
    )


def _fold_validation_tasks(fold: int) -> tuple[int, ...]:
    """Returns the paper's tasks that ask for a fold's objects."""
    return tuple(task.index for task in TASKS if set(task.targets) & set(FOLDS[fold]))


def _mesh_tasks(objects: str) -> tuple[int, ...]:
    """Returns a task for each mesh of a set, with one container after another.

    With more than one task for each, a target would be more likely than the distractors beside it.
    """
    indices = {(task.object.index, task.container): task.index for task in MESH_TASKS}
    containers = cycle(CONTAINER_WORDS)
    return tuple(indices[label.index, next(containers)] for label in OBJECT_SETS[objects])


TASK_SETS = MappingProxyType(
    {
        "all": tuple(task.index for task in TASKS),
        **{f"scenario_{name}_train": scenario.train_tasks for name, scenario in SCENARIOS.items()},
        **{f"scenario_{name}_test": scenario.test_tasks for name, scenario in SCENARIOS.items()},
        "scenario_a_selection_train": VALIDATION.train_tasks,
        "scenario_a_validation": VALIDATION.test_tasks,
        "scenario_a_clean_train": CLEAN.train_tasks,
        # For the objects "random:N": scenario A's training tasks, and tasks by color and shape
        "random_train": _RANDOM_TRAIN,
        # For the objects "fold_K:N", and for "scenario_a_train"
        **{f"scenario_a_fold_{fold}_train": _fold_train_tasks(fold) for fold in range(len(FOLDS))},
        **{f"scenario_a_fold_{fold}_validation": _fold_validation_tasks(fold) for fold in range(len(FOLDS))},
        "out_of_distribution": _mesh_tasks("out_of_distribution"),
        "out_of_distribution_validation": _mesh_tasks("out_of_distribution_validation"),
    }
)
# Task sets that policies are not trained on: their episodes are demonstrations
HELD_OUT = (
    "scenario_a_test",
    "scenario_a_validation",
    "scenario_b_test",
    "out_of_distribution",
    "out_of_distribution_validation",
)
# Default objects of task sets that do not draw their scenes from all objects
_OBJECTS_OF_TASK_SETS = MappingProxyType(
    {
        "scenario_a_clean_train": "scenario_a_train",
        "out_of_distribution": "out_of_distribution",
        "out_of_distribution_validation": "out_of_distribution_validation",
    }
)


def default_objects(tasks: str) -> str:
    """Returns the default set of objects for a selection of tasks, such as "scenario_a_test"."""
    return _OBJECTS_OF_TASK_SETS.get(tasks.strip(), "all")


def select_tasks(selection: str) -> tuple[int, ...]:
    """Parses a selection of tasks.

    Args:
        selection: Names of task sets, indices and inclusive ranges, separated by commas: "scenario_a_test",
            "4,50-73", "scenario_b_test,0-9".

    Returns:
        Indices of the selected tasks in the order of the selection, each once; at least one.

    Raises:
        ValueError: A part of the selection is not a task set, an index or a range; an index is out of range;
            or the selection is empty.
    """
    valid = (
        f"Valid are the task sets {', '.join(TASK_SETS)}, and indices and ranges {_valid_indices()}, "
        "separated by commas, such as '4,50-73'."
    )
    selected: list[int] = []
    for term in filter(None, (part.strip() for part in selection.split(","))):
        span = re.fullmatch(r"(\d+)(?:\s*-\s*(\d+))?", term)
        if term in TASK_SETS:
            selected.extend(TASK_SETS[term])
        elif span is None:
            raise ValueError(f"Unknown task selection {term!r}. {valid}")
        else:
            first, last = int(span[1]), int(span[2] or span[1])
            if last < first:
                raise ValueError(f"The range {term!r} is empty. Write the smaller index first.")
            selected.extend(get_task(index).index for index in range(first, last + 1))
    if not selected:
        raise ValueError(f"The task selection {selection!r} is empty. {valid}")
    return tuple(dict.fromkeys(selected))
