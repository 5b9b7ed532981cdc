"""The 300 tasks as data: which object goes into which container, and on which a scenario trains and tests.

Rows of the task table are what is asked for: 32 objects by name (rows 0..31), 8 colors (32..39) and 10
shapes (40..49). Columns are the container: green, red, front, back, left, right. The index of a task is
`50 * column + row` (paper, appendix A). Nothing here depends on a simulator.

Beyond the paper's table, 80 rows ask for an object by its color and its shape together, since random objects
have no names: rows 50..129, `50 + 10 * color + shape`. Their tasks are `1000 + 80 * column + row - 50`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from types import MappingProxyType
from typing import Literal

TaskKind = Literal["name", "color", "shape", "color_shape"]
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
    """Name, shape and color of an object. Its geometry is in `gym_deltaco.objects` or `random_objects`.

    Attributes:
        index: 0..31 for the paper's objects, in the order of its table, where 0..23 are scenario A's training
            objects; 32..10007 for random ones.
        name: Name of the object, such as "conic cup"; a random one's is in no instruction.
        shape: One of `SHAPES`.
        color: One of `COLORS`.
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


@dataclass(frozen=True)
class Task:
    """A task: an object, asked for by name, color, shape, or color and shape, and a container.

    Attributes:
        index: 0..299, `50 * column + row`; or 1000..1479, by color and shape.
    """

    index: int

    @property
    def row(self) -> int:
        """0..49: 32 names, 8 colors, 10 shapes; 50..129: pairs of a color and a shape."""
        if self.index in _PAIR_TASKS:
            return N_ROWS + (self.index - _PAIR_TASKS.start) % _N_PAIRS
        return self.index % N_ROWS

    @property
    def column(self) -> int:
        """0..5, an index into `CONTAINER_WORDS`."""
        if self.index in _PAIR_TASKS:
            return (self.index - _PAIR_TASKS.start) // _N_PAIRS
        return self.index // N_ROWS

    @property
    def kind(self) -> TaskKind:
        """Word by which the instruction names the object."""
        if self.row < _FIRST_COLOR_ROW:
            return "name"
        if self.row >= N_ROWS:
            return "color_shape"
        return "color" if self.row < _FIRST_SHAPE_ROW else "shape"

    @property
    def container(self) -> ContainerWord:
        """The word that singles out the container."""
        return CONTAINER_WORDS[self.column]

    @property
    def is_position_task(self) -> bool:
        """Whether the container is asked for by its place (front, back, left, right), not by its color."""
        return self.container not in CONTAINER_COLORS

    @cached_property
    def targets(self) -> tuple[int, ...]:
        """Indices of those of the paper's 32 objects that the instruction describes."""
        return tuple(label.index for label in OBJECTS if self.describes(label))

    def describes(self, label: ObjectLabel) -> bool:
        """Whether an object is what the instruction asks for."""
        if self.kind == "name":
            return label.index == self.row
        if self.kind == "color":
            return label.color == self._color
        if self.kind == "shape":
            return label.shape == self._shape
        return (label.color, label.shape) == (self._color, self._shape)

    @property
    def _color(self) -> str:
        """The color that a task by color, or by color and shape, asks for."""
        return COLORS[
            self.row - _FIRST_COLOR_ROW if self.kind == "color" else (self.row - N_ROWS) // len(SHAPES)
        ]

    @property
    def _shape(self) -> str:
        """The shape that a task by shape, or by color and shape, asks for."""
        return SHAPES[
            self.row - _FIRST_SHAPE_ROW if self.kind == "shape" else (self.row - N_ROWS) % len(SHAPES)
        ]

    @property
    def object_phrase(self) -> str:
        """The object as the instruction calls it, such as "blue colored object"."""
        if self.kind == "name":
            label = OBJECTS[self.row]
            return f"{label.color} colored, {label.shape} shaped {label.name}"
        if self.kind == "color":
            return f"{self._color} colored object"
        if self.kind == "shape":
            return f"{self._shape} shaped object"
        return f"{self._color} colored, {self._shape} shaped object"

    @property
    def instruction(self) -> str:
        """The sentence, such as "Put blue colored object in front bin."."""
        return f"Put {self.object_phrase} in {self.container} bin."


TASKS = tuple(Task(index) for index in range(N_TASKS))
COLOR_SHAPE_TASKS = tuple(Task(index) for index in _PAIR_TASKS)


@dataclass(frozen=True)
class Scenario:
    """A split of the rows of the task table; every row comes with all six containers.

    Attributes:
        name: "a" or "b" for the paper's, "a_validation" for the one that settings are chosen on,
            "a_clean" for the one whose training shows no test object.
        train_rows: Rows whose tasks are trained on.
        test_rows: Rows whose tasks are held out of training.
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
        # Novel objects, colors and shapes.
        "a": Scenario(
            "a", train_rows=(*range(24), *range(36, 45)), test_rows=(*range(24, 36), *range(45, 50))
        ),
        # All objects are known by name; colors and shapes are novel.
        "b": Scenario(
            "b", train_rows=(*range(32), *range(36, 45)), test_rows=(*range(32, 36), *range(45, 50))
        ),
    }
)

# Held out of scenario A's training rows to choose settings on; see `VALIDATION`.
_VALIDATION_ROWS = (6, 10, 12, 16, 36, 38, 40, 44)

VALIDATION = Scenario(
    "a_validation",
    train_rows=tuple(row for row in SCENARIOS["a"].train_rows if row not in _VALIDATION_ROWS),
    test_rows=_VALIDATION_ROWS,
)
"""Scenario A's training tasks, split once more: settings are chosen on 48 of them, never on the test tasks.

Held out are four names (narrow tray, pacifier vase, crooked lid trash can, modern canoe), two colors (white,
orange) and two shapes (vase, canoe); the other 150 tasks are trained on meanwhile, and the final model is
trained on all 198. The rows were chosen from the table alone, before any result, by a rule that makes these
tasks resemble the test tasks:

1. A held-out object is never a target: no remaining row asks for its name, color or shape. It still stands in
   training scenes as a distractor, as the test objects do.
2. Each held-out color and shape has two objects or more, of which at least one is held out by name as well,
   and at least one remains a target under its own name.
3. The four objects have four different colors and four different shapes, and one of the shapes (cylinder) is
   in no remaining instruction, as "round hole" is in none of scenario A's.
4. Two of the objects are low and oblong (the tray and the canoe), two upright.

Scenario A itself breaks the first point: its test object 29 is the target of the six yellow training tasks.
"""

# Scenario A without its yellow tasks, which ask for a test object. With the objects "scenario_a_train" of
# `gym_deltaco.object_sets`, its training shows no test object at all.
_YELLOW_ROW = _FIRST_COLOR_ROW + COLORS.index("yellow")
CLEAN = Scenario(
    "a_clean",
    train_rows=tuple(row for row in SCENARIOS["a"].train_rows if row != _YELLOW_ROW),
    test_rows=SCENARIOS["a"].test_rows,
)

# What random objects may be: they share shape and color with no test object of scenario A.
_TEST_PAIRS = {(label.color, label.shape) for label in OBJECTS if label.index in SCENARIOS["a"].test_rows}
COLOR_SHAPE_PAIRS = tuple(
    (color, shape) for color in COLORS for shape in SHAPES if (color, shape) not in _TEST_PAIRS
)
_COLOR_SHAPE_TASKS = tuple(
    _PAIR_TASKS.start + _N_PAIRS * column + len(SHAPES) * COLORS.index(color) + SHAPES.index(shape)
    for column in range(N_COLUMNS)
    for color, shape in COLOR_SHAPE_PAIRS
)

TASK_SETS = MappingProxyType(
    {
        "all": tuple(range(N_TASKS)),
        **{f"scenario_{name}_train": scenario.train_tasks for name, scenario in SCENARIOS.items()},
        **{f"scenario_{name}_test": scenario.test_tasks for name, scenario in SCENARIOS.items()},
        "scenario_a_selection_train": VALIDATION.train_tasks,
        "scenario_a_validation": VALIDATION.test_tasks,
        "scenario_a_clean_train": CLEAN.train_tasks,
        "scenario_a_clean_test": CLEAN.test_tasks,
        # With the objects "random:N": scenario A's training tasks, and those by color and shape.
        "random_train": (*SCENARIOS["a"].train_tasks, *_COLOR_SHAPE_TASKS),
    }
)


def is_task(index: int) -> bool:
    """Returns whether a task of an index exists."""
    return 0 <= index < N_TASKS or index in _PAIR_TASKS


def get_task(index: int) -> Task:
    """Returns the task of an index.

    Args:
        index: 0..299 for the paper's tasks, 1000..1479 for tasks by color and shape.

    Raises:
        ValueError: The index is not an integer, or out of range.
    """
    if isinstance(index, bool) or not isinstance(index, Integral) or not is_task(int(index)):
        raise ValueError(
            f"`task_id` must be an integer from 0 to {N_TASKS - 1}, or from {_PAIR_TASKS.start} to "
            f"{_PAIR_TASKS.stop - 1} for tasks by color and shape. Got {index!r}."
        )
    return TASKS[int(index)] if index < N_TASKS else Task(int(index))


def select_tasks(selection: str) -> tuple[int, ...]:
    """The tasks that a selection names, in the order given, each once.

    Args:
        selection: Names of task sets, indices and ranges (both ends included), separated by commas:
            "scenario_a_test", "4", "4,50-73", "scenario_b_test,0-9".

    Returns:
        Indices of tasks, at least one.

    Raises:
        ValueError: Something in the selection is not a task set, an index or a range; an index is out of
            range; or nothing is selected.
    """
    selected: list[int] = []
    for term in filter(None, (part.strip() for part in selection.split(","))):
        span = re.fullmatch(r"(\d+)(?:\s*-\s*(\d+))?", term)
        if term in TASK_SETS:
            selected.extend(TASK_SETS[term])
        elif span is None:
            raise ValueError(
                f"Unknown task selection {term!r}. Valid are the task sets {', '.join(TASK_SETS)}, and "
                f"indices and ranges of 0 to {N_TASKS - 1}, separated by commas, such as '4,50-73'."
            )
        else:
            first, last = int(span[1]), int(span[2] or span[1])
            if last < first:
                raise ValueError(f"The range {term!r} is empty: its end lies before its start.")
            get_task(first), get_task(last)
            selected.extend(get_task(index).index for index in range(first, last + 1))
    if not selected:
        raise ValueError(
            f"The task selection {selection!r} is empty. Name a task set ({', '.join(TASK_SETS)}) or indices "
            "such as '4,50-73'."
        )
    return tuple(dict.fromkeys(selected))
