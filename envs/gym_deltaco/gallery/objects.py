"""Sheets of the objects: by name, by shape, by color, and random ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gym_deltaco.camera import Camera
from gym_deltaco.fixtures import TABLE_BOXES, TRAY_BOXES, table_mesh, tray_mesh
from gym_deltaco.gallery.scenes import POLICY_SIZE, Figure, pixel_of
from gym_deltaco.objects import ObjectModel
from gym_deltaco.random_objects import random_model
from gym_deltaco.sheets import (
    ACCENT,
    GAP,
    INK,
    PAPER,
    across,
    caption,
    down,
    enlarged,
    framed,
    grid,
    save_png,
    to_image,
)
from gym_deltaco.simulation import Simulation
from gym_deltaco.tasks import OBJECTS, SCENARIOS, SHAPES, ObjectLabel
from gym_deltaco.workspace import CAMERA, TRAY_CENTER, TRAY_FLOOR

TEST_OBJECTS = frozenset(SCENARIOS["a"].test_rows) & frozenset(range(len(OBJECTS)))

_CLOSE_UP = Camera(
    target=(*TRAY_CENTER, TRAY_FLOOR + 0.033), distance=0.21, yaw=CAMERA.yaw, pitch=-35, fov=30, near=0.02
)
_CLOSE_UP_SIZE = 136  # px
_CROP_SIZE = 14  # px of the policy's image, around an object
_CROP_ZOOM = 6
_N_COLUMNS = 6  # objects in a row
_OBJECT_YAW = 0.25  # rad, or as much as the object may be turned in a scene
_INDENT = 4  # px, of a name in its frame

_VIEWS_TEXT = (
    f"The large image of an object is a close-up, the small one its part of the policy's {POLICY_SIZE} x "
    f"{POLICY_SIZE} pixels, enlarged."
)
_OBJECTS_TEXT = f"{_VIEWS_TEXT} Orange frames mark the 8 objects that scenario A does not train on by name."


def draw_objects(out: Path, what: str, names: Sequence[str], cells: Sequence[Image.Image]) -> Figure:
    """The 32 objects in groups by shape or color, as in the paper's figures 6 and 5.

    Args:
        out: Folder to write to.
        what: "shape" or "color".
        names: Names of the groups.
        cells: An image for each object.
    """
    groups = []
    for name in names:
        members = [cells[label.index] for label in OBJECTS if getattr(label, what) == name]
        heading = caption(f"{name} ({len(members)})", width=cells[0].width, size=20)
        group = down([heading, grid(members, _N_COLUMNS, gap=GAP)], gap=4)
        groups.append((min(len(members), _N_COLUMNS), group))
    file = f"objects_by_{what}.png"
    shelves = [across(shelf, gap=GAP) for shelf in _shelves(groups)]
    save_png(framed(down(shelves, gap=2 * GAP), thickness=GAP), out / file)
    return Figure(file, f"Objects by {what}", f"All 32 objects, by {what}. {_OBJECTS_TEXT}")


def draw_objects_by_name(out: Path, cells: Sequence[Image.Image]) -> Figure:
    """The 32 objects in the order of their numbers, as in the paper's figure 4.

    Args:
        out: Folder to write to.
        cells: An image for each object.
    """
    file = "objects_by_name.png"
    save_png(framed(grid(cells, _N_COLUMNS, gap=GAP), thickness=GAP), out / file)
    return Figure(file, "Objects by name", f"All 32 objects, by number. {_OBJECTS_TEXT}")


def draw_random_objects(
    out: Path, labels: Sequence[ObjectLabel], simulation: Simulation, tick: Callable[[], object]
) -> Figure:
    """Random objects, by shape."""
    groups = []
    for shape in SHAPES:
        cells = []
        for label in labels:
            if label.shape == shape:
                close_up, crop = object_views(simulation, random_model(label.index))
                width = close_up.width + crop.width + 4
                name = caption(f"{label.index}  {label.color}", width, size=14)
                cells.append(down([across([close_up, crop], gap=4, align="end"), name], gap=2))
                tick()
        if cells:
            heading = caption(f"{shape} ({len(cells)})", width=cells[0].width, size=20)
            group = down([heading, grid(cells, _N_COLUMNS, gap=GAP)], gap=4)
            groups.append((min(len(cells), _N_COLUMNS), group))
    shelves = [across(shelf, gap=GAP) for shelf in _shelves(groups)]
    save_png(framed(down(shelves, gap=2 * GAP), thickness=GAP), out / "random_objects.png")
    text = (
        f"{len(labels)} random objects, by shape, each with its number and its color in instructions. None "
        f"has both the shape and the color of a test object of scenario A. {_VIEWS_TEXT}"
    )
    return Figure("random_objects.png", "Random objects", text)


def object_cell(simulation: Simulation, model: ObjectModel) -> Image.Image:
    """A close-up of an object, its part of the policy's image, and its name."""
    close_up, crop = object_views(simulation, model)
    label = model.label
    width = close_up.width + crop.width + 4
    is_test = label.index in TEST_OBJECTS
    name = f"{label.index}  {label.name}"
    text = caption(name, width, size=14, color=ACCENT if is_test else INK, indent=_INDENT)
    cell = down([across([close_up, crop], gap=4, align="end"), text], gap=2)
    return framed(cell, ACCENT if is_test else PAPER, thickness=3)


def object_views(simulation: Simulation, model: ObjectModel | None) -> tuple[Image.Image, Image.Image]:
    """A close-up of an object alone on the tray (None: of nothing), and its part of the policy's image."""
    simulation.reset()
    middle = np.array([*TRAY_CENTER, TRAY_FLOOR])
    if model is not None:
        middle[2] += model.height / 2
        yaw = min(_OBJECT_YAW, model.yaw_range[1])
        simulation.add_free_body(model.mesh, model.parts, middle, yaw, mass=1.0)
    simulation.add_static_body(tray_mesh(), TRAY_BOXES, (*TRAY_CENTER, TRAY_FLOOR))
    simulation.add_static_body(table_mesh(), TABLE_BOXES)
    close_up = to_image(simulation.render(_CLOSE_UP, 3 * _CLOSE_UP_SIZE), _CLOSE_UP_SIZE)
    seen = simulation.render(CAMERA, POLICY_SIZE)
    x, y = np.rint(pixel_of(middle, POLICY_SIZE) - _CROP_SIZE / 2).astype(int)
    return close_up, enlarged(seen[y : y + _CROP_SIZE, x : x + _CROP_SIZE], _CROP_ZOOM)


def _shelves(groups: Iterable[tuple[int, Image.Image]]) -> list[list[Image.Image]]:
    """Groups, given with their widths in columns, each on the first shelf that has room for it."""
    shelves: list[list[Image.Image]] = []
    free: list[int] = []
    for width, image in groups:
        number = next((number for number, columns in enumerate(free) if columns >= width), len(free))
        if number == len(free):
            shelves.append([])
            free.append(_N_COLUMNS)
        shelves[number].append(image)
        free[number] -= width
    return shelves
