"""Names, shapes and colors of all objects; no geometry.

The index of an object tells its origin: 0 to 31 are the paper's, in the order of its table; 32 to 10,007 are
random objects; 20,500 to 20,999 are meshes of PyBullet, the out-of-distribution objects.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

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


@dataclass(frozen=True)
class ObjectLabel:
    """Name, shape and color of an object.

    Attributes:
        index: Index of the object.
        name: Name of the object, such as "conic cup". Instructions name only the paper's objects.
        shape: One of `SHAPES`; of an out-of-distribution object, its name, so that no other object shares it.
        color: One of `COLORS`; of an out-of-distribution object, its name.
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

SCENARIO_A_TRAIN = OBJECTS[:24]  # that scenario A trains on by name
SCENARIO_A_TEST = OBJECTS[24:]

# Random objects

FIRST_RANDOM_INDEX = len(OBJECTS)
RANDOM_SEED = 2210_04476  # seed of all random objects
# Random objects have every color and shape, except for the pairs of scenario A's test objects.
_TEST_PAIRS = {(label.color, label.shape) for label in SCENARIO_A_TEST}
COLOR_SHAPE_PAIRS = tuple(
    (color, shape) for color in COLORS for shape in SHAPES if (color, shape) not in _TEST_PAIRS
)


@cache
def random_label(index: int) -> ObjectLabel:
    """Returns the label of a random object.

    Successive indices run through `COLOR_SHAPE_PAIRS` again and again, each time in a new order.

    Args:
        index: At least `FIRST_RANDOM_INDEX`.
    """
    cycle, position = divmod(int(index) - FIRST_RANDOM_INDEX, len(COLOR_SHAPE_PAIRS))
    order = np.random.default_rng((RANDOM_SEED, cycle)).permutation(len(COLOR_SHAPE_PAIRS))
    color, shape = COLOR_SHAPE_PAIRS[order[position]]
    return ObjectLabel(int(index), f"object {index}", shape, color)


# Out-of-distribution objects

MESHES = range(500, 1000)  # of PyBullet's 1,000 random ones; the benchmark never uses the others
FIRST_MESH_INDEX = 20_000  # index of the object that mesh 0 would be
EXPERT_MESHES_FILE = Path(__file__).with_name("out_of_distribution.json")
# Meshes that the scripted expert can pick and place: `scripts/select_meshes.py`
EXPERT_MESHES: tuple[int, ...] = tuple(json.loads(EXPERT_MESHES_FILE.read_text(encoding="utf-8")))


def is_mesh(index: int) -> bool:
    """Returns whether an object is one of PyBullet's meshes."""
    return index - FIRST_MESH_INDEX in MESHES


@cache
def mesh_label(mesh: int) -> ObjectLabel:
    """Returns the label of a mesh. Its name stands for a shape and a color that no other object has."""
    name = f"thing {mesh}"
    return ObjectLabel(FIRST_MESH_INDEX + mesh, name, name, name)


def find_label(index: int) -> ObjectLabel:
    """Returns the label of an object."""
    if is_mesh(index):
        return mesh_label(int(index) - FIRST_MESH_INDEX)
    return OBJECTS[index] if index < FIRST_RANDOM_INDEX else random_label(index)
