"""The 300 tasks and their splits, as data.

Rows of the task table are objects: 32 names (rows 0..31), 8 colors (32..39) and 10 shapes (40..49). Columns
are containers: green, red, front, back, left, right. The index of a task is `50 * column + row` (paper,
appendix A).

Beyond the paper's table, 80 rows (50..129) ask for an object by color and shape, `50 + 10 * color + shape`,
since random objects have no names. The index of such a task is `1000 + 80 * column + row - 50`. Rows 500 to
999 ask for a "thing", which only a demonstration shows: a mesh of `gym_deltaco.objects.foreign_objects` with
that number. The index of such a task is `2000 + 1000 * column + row`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from pathlib import Path
from types import MappingProxyType
from typing import Literal

TaskKind = Literal["name", "color", "shape", "color_shape", "foreign"]
ContainerColor = Literal["green", "red"]
ContainerWord = Literal["green", "red", "front", "back", "left", "right"]

COLORS = ("black and white", "brown", "blue", "gray", "white", "red", "orange", "yellow")
SHAPES = (
    "vase",
    "chalice",
    "freeform",
    "bottle",
    "canoe",
    "cup",
    "bowl",
    "trapezoidal prism",
    "cylinder",
    "round hole",
)
CONTAINER_COLORS: tuple[ContainerColor, ...] = ("green", "red")
CONTAINER_WORDS: tuple[ContainerWord, ...] = ("green", "red", "front", "back", "left", "right")


@dataclass(frozen=True)
class ObjectLabel:
    """Name, shape and color of an object.

    Its geometry is in `gym_deltaco.objects.objects`, `random_objects` or `foreign_objects`.

    Attributes:
        index: 0..31 for the paper's objects, in the order of its table (0..23 are scenario A's training
            objects); 32..10007 for random objects; 20500..20999 for foreign ones.
        name: Name of the object, such as "conic cup". No instruction uses that of a random or foreign object.
        shape: One of `SHAPES`; of a foreign object, its name, so that it shares it with no other.
        color: One of `COLORS`; of a foreign object, its name.
    """

    index: int
    name: str
    shape: str
    color: str


OBJECTS = tuple(
    ObjectLabel(index, name, shape, color)
    for index, (name, shape, color) in enumerate(
        [
            ("conic cup", "cup", "black and white"),
            ("fountain vase", "vase", "brown"),
            ("circular table", "chalice", "blue"),
            ("hex deep bowl", "bowl", "brown"),
            ("smushed dumbbell", "chalice", "black and white"),
            ("square prism bin", "trapezoidal prism", "brown"),
            ("narrow tray", "trapezoidal prism", "brown"),
            ("colunnade top", "chalice", "gray"),
            ("stalagcite chunk", "freeform", "white"),
            ("bongo drum bowl", "bowl", "red"),
            ("pacifier vase", "vase", "white"),
            ("beehive funnel", "vase", "brown"),
            ("crooked lid trash can", "cylinder", "gray"),
            ("toilet bowl", "bowl", "white"),
            ("pepsi bottle", "bottle", "red"),
            ("tongue chair", "freeform", "red"),
            ("modern canoe", "canoe", "orange"),
            ("pear ringed vase", "vase", "orange"),
            ("short handle cup", "cup", "blue"),
            ("bullet vase", "vase", "brown"),
            ("glass half gallon", "bottle", "gray"),
            ("flat bottom sack vase", "vase", "brown"),
            ("trapezoidal bin", "trapezoidal prism", "brown"),
            ("vintage canoe", "canoe", "brown"),
            ("bathtub", "bowl", "gray"),
            ("flowery half donut", "round hole", "gray"),
            ("t cup", "cup", "blue"),
            ("cookie circular lidless tin", "bowl", "brown"),
            ("box sofa", "trapezoidal prism", "brown"),
            ("two layered lampshade", "round hole", "yellow"),
            ("conic bin", "cup", "gray"),
            ("jar", "cylinder", "blue"),
        ]
    )
)

N_ROWS = len(OBJECTS) + len(COLORS) + len(SHAPES)
N_COLUMNS = len(CONTAINER_WORDS)
N_TASKS = N_ROWS * N_COLUMNS
_FIRST_COLOR_ROW = len(OBJECTS)
_FIRST_SHAPE_ROW = _FIRST_COLOR_ROW + len(COLORS)
_N_PAIRS = len(COLORS) * len(SHAPES)
_PAIR_TASKS = range(1000, 1000 + N_COLUMNS * _N_PAIRS)
_FOREIGN_TASKS = range(2000, 2000 + N_COLUMNS * 1000)
MESHES = range(500, 1000)  # of PyBullet's 1,000 random ones; the benchmark never uses the others
FIRST_FOREIGN_INDEX = 20_000  # index of the object that mesh 0 would be
FOREIGN_FILE = Path(__file__).parent / "objects" / "foreign_objects.json"


@dataclass(frozen=True)
class Task:
    """A task: put an object, given by name, color, shape, or both, or by a demonstration, into a container.

    Attributes:
        index: 0..299, `50 * column + row`; 1000..1479 for tasks by color and shape; or
            `2000 + 1000 * column + row` for foreign objects.
    """

    index: int

    @property
    def row(self) -> int:
        """Row of the task table: 0..31 names, 32..39 colors, 40..49 shapes, 50..129 both, 500..999 meshes."""
        if self.index in _FOREIGN_TASKS:
            return self.index % 1000
        if self.index in _PAIR_TASKS:
            return N_ROWS + (self.index - _PAIR_TASKS.start) % _N_PAIRS
        return self.index % N_ROWS

    @property
    def column(self) -> int:
        """Column of the task table, 0..5: an index into `CONTAINER_WORDS`."""
        if self.index in _FOREIGN_TASKS:
            return (self.index - _FOREIGN_TASKS.start) // 1000
        if self.index in _PAIR_TASKS:
            return (self.index - _PAIR_TASKS.start) // _N_PAIRS
        return self.index // N_ROWS

    @property
    def kind(self) -> TaskKind:
        """Property by which the instruction describes the object."""
        if self.row < _FIRST_COLOR_ROW:
            return "name"
        if self.row >= N_ROWS:
            return "foreign" if self.row in MESHES else "color_shape"
        return "color" if self.row < _FIRST_SHAPE_ROW else "shape"

    @property
    def container(self) -> ContainerWord:
        """Word by which the instruction describes the container."""
        return CONTAINER_WORDS[self.column]

    @property
    def is_position_task(self) -> bool:
        """Whether the container is described by its position (front, back, left, right), not its color."""
        return self.container not in CONTAINER_COLORS

    @cached_property
    def targets(self) -> tuple[int, ...]:
        """Indices of the paper's objects that the instruction describes."""
        return tuple(label.index for label in OBJECTS if self.describes(label))

    @property
    def target_object(self) -> int | None:
        """Index of the object that a demonstration has to move; None if the instruction describes it."""
        return FIRST_FOREIGN_INDEX + self.row if self.kind == "foreign" else None

    def describes(self, label: ObjectLabel) -> bool:
        """Returns whether the task asks for an object, by its instruction or its demonstration."""
        if self.target_object is not None:
            return label.index == self.target_object
        if self.kind == "name":
            return label.index == self.row
        if self.kind == "color":
            return label.color == self.color
        if self.kind == "shape":
            return label.shape == self.shape
        return (label.color, label.shape) == (self.color, self.shape)

    @property
    def color(self) -> str:
        """Color of a task by color, or by color and shape."""
        return COLORS[
            self.row - _FIRST_COLOR_ROW if self.kind == "color" else (self.row - N_ROWS) // len(SHAPES)
        ]

    @property
    def shape(self) -> str:
        """Shape of a task by shape, or by color and shape."""
        return SHAPES[
            self.row - _FIRST_SHAPE_ROW if self.kind == "shape" else (self.row - N_ROWS) % len(SHAPES)
        ]

    @property
    def object_phrase(self) -> str:
        """Object in the words of the instruction, such as "blue colored object"."""
        if self.kind == "foreign":
            return "thing"
        if self.kind == "name":
            label = OBJECTS[self.row]
            return f"{label.color} colored, {label.shape} shaped {label.name}"
        if self.kind == "color":
            return f"{self.color} colored object"
        if self.kind == "shape":
            return f"{self.shape} shaped object"
        return f"{self.color} colored, {self.shape} shaped object"

    @property
    def instruction(self) -> str:
        """Template sentence, such as "Put blue colored object in front bin."."""
        return f"Put {self.object_phrase} in {self.container} bin."


TASKS = tuple(Task(index) for index in range(N_TASKS))
COLOR_SHAPE_TASKS = tuple(Task(index) for index in _PAIR_TASKS)


@dataclass(frozen=True)
class Scenario:
    """A split of the rows of the task table; every row comes with all six containers.

    Attributes:
        name: "a" or "b" for the paper's scenarios; "a_validation" for choosing settings; "a_clean" for
            training without test objects.
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
    rows = set(rows)
    return tuple(task.index for task in TASKS if task.row in rows)


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
_YELLOW_ROW = _FIRST_COLOR_ROW + COLORS.index("yellow")
CLEAN = Scenario(
    "a_clean",
    train_rows=tuple(row for row in SCENARIOS["a"].train_rows if row != _YELLOW_ROW),
    test_rows=SCENARIOS["a"].test_rows,
)

# Colors and shapes of random objects, which no test object of scenario A has
_TEST_PAIRS = {(label.color, label.shape) for label in OBJECTS if label.index in SCENARIOS["a"].test_rows}
COLOR_SHAPE_PAIRS = tuple(
    (color, shape) for color in COLORS for shape in SHAPES if (color, shape) not in _TEST_PAIRS
)
_COLOR_SHAPE_TASKS = tuple(
    _PAIR_TASKS.start + _N_PAIRS * column + len(SHAPES) * COLORS.index(color) + SHAPES.index(shape)
    for column in range(N_COLUMNS)
    for color, shape in COLOR_SHAPE_PAIRS
)


def get_task(index: int) -> Task:
    """Returns the task of an index.

    Args:
        index: 0..299 for the paper's tasks, 1000..1479 for tasks by color and shape, and
            `2000 + 1000 * column + mesh` for foreign objects.

    Raises:
        ValueError: The index is not an integer, or out of range.
    """
    is_integer = isinstance(index, Integral) and not isinstance(index, bool)
    is_foreign = is_integer and index in _FOREIGN_TASKS and index % 1000 in MESHES
    if not is_integer or not (0 <= index < N_TASKS or index in _PAIR_TASKS or is_foreign):
        raise ValueError(
            f"`task_id` must be an integer from 0 to {N_TASKS - 1}, from {_PAIR_TASKS.start} to "
            f"{_PAIR_TASKS.stop - 1} for tasks by color and shape, or from {_FOREIGN_TASKS.start} on, ending "
            f"in {MESHES.start} to {MESHES.stop - 1}, for foreign objects. Got {index!r}."
        )
    return TASKS[int(index)] if index < N_TASKS else Task(int(index))


# Scenario A's training objects in three folds of eight, for choosing settings on novel objects. Each fold has
# three brown objects and five of other colors, two vases and six of other shapes.
FOLDS = ((0, 1, 2, 5, 9, 10, 20, 23), (3, 4, 6, 8, 11, 12, 14, 17), (7, 13, 15, 16, 18, 19, 21, 22))


def fold_pairs(fold: int) -> frozenset[tuple[str, str]]:
    """Returns the pairs of color and shape of a fold's objects, which no training object of it has."""
    return frozenset((OBJECTS[index].color, OBJECTS[index].shape) for index in FOLDS[fold])


def _fold_train_tasks(fold: int) -> tuple[int, ...]:
    """Returns the training tasks of a fold: those of `random_train` that do not need its objects."""
    held_out = fold_pairs(fold)
    kept = [
        task.index
        for task in map(get_task, (*SCENARIOS["a"].train_tasks, *_COLOR_SHAPE_TASKS))
        if task.row not in FOLDS[fold]
        and not (task.kind == "color_shape" and (task.color, task.shape) in held_out)
    ]
    return tuple(kept)


def _fold_validation_tasks(fold: int) -> tuple[int, ...]:
    """Returns the tasks that ask for a fold's objects, by name, color or shape."""
    return tuple(task.index for task in TASKS if set(task.targets) & set(FOLDS[fold]))


# Meshes that the expert manages: the first ones for the test, the next ones for choosing settings. Each is
# the target of one task, so that none is more likely than the two distractors beside it.
_MESHES_OF_EXPERT: tuple[int, ...] = tuple(json.loads(FOREIGN_FILE.read_text(encoding="utf-8")))
FOREIGN_MESHES, FOREIGN_VALIDATION_MESHES = _MESHES_OF_EXPERT[:96], _MESHES_OF_EXPERT[96:192]


def _foreign_tasks(meshes: tuple[int, ...]) -> tuple[int, ...]:
    """Returns one task for each mesh, the containers in turn."""
    return tuple(
        _FOREIGN_TASKS.start + 1000 * (number % N_COLUMNS) + mesh for number, mesh in enumerate(meshes)
    )


TASK_SETS = MappingProxyType(
    {
        "all": tuple(range(N_TASKS)),
        **{f"scenario_{name}_train": scenario.train_tasks for name, scenario in SCENARIOS.items()},
        **{f"scenario_{name}_test": scenario.test_tasks for name, scenario in SCENARIOS.items()},
        "scenario_a_selection_train": VALIDATION.train_tasks,
        "scenario_a_validation": VALIDATION.test_tasks,
        "scenario_a_clean_train": CLEAN.train_tasks,
        # For the objects "random:N": scenario A's training tasks, and tasks by color and shape
        "random_train": (*SCENARIOS["a"].train_tasks, *_COLOR_SHAPE_TASKS),
        # For the objects "fold_K:N", and for "scenario_a_train"
        **{f"scenario_a_fold_{fold}_train": _fold_train_tasks(fold) for fold in range(len(FOLDS))},
        **{f"scenario_a_fold_{fold}_validation": _fold_validation_tasks(fold) for fold in range(len(FOLDS))},
        # For the objects of the same names
        "foreign": _foreign_tasks(FOREIGN_MESHES),
        "foreign_validation": _foreign_tasks(FOREIGN_VALIDATION_MESHES),
    }
)


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
        f"Valid are the task sets {', '.join(TASK_SETS)}, and indices and ranges from 0 to {N_TASKS - 1}, "
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
