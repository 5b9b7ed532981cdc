"""Static bodies of a scene: the table, the shallow tray on it, and the two containers."""

from __future__ import annotations

import functools

import numpy as np

from gym_deltaco.containers import ContainerColor
from gym_deltaco.objects.solids import Color, Loft, Mesh, Row
from gym_deltaco.sim.simulation import Box
from gym_deltaco.sim.workspace import (
    CONTAINER_FLOOR_THICKNESS,
    CONTAINER_HALF_EXTENTS,
    CONTAINER_WALL_HEIGHT,
    CONTAINER_WALL_THICKNESS,
    TABLE_TOP,
    TRAY_CENTER,
    TRAY_FLOOR,
    TRAY_HALF_EXTENTS,
    TRAY_WALL_HEIGHT,
    TRAY_WALL_THICKNESS,
)

_TABLE_COLOR: Color = (0.67, 0.62, 0.56)
_TRAY_FLOOR_COLOR: Color = (0.60, 0.54, 0.47)
_TRAY_WALL_COLOR: Color = (0.47, 0.42, 0.36)
_CONTAINER_COLORS: dict[ContainerColor, tuple[Color, Color]] = {  # walls, floor
    "green": ((0.10, 0.62, 0.20), (0.10, 0.48, 0.16)),
    "red": ((0.82, 0.13, 0.10), (0.62, 0.08, 0.07)),
}
_SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def _open_box(
    half_extents: tuple[float, float], floor: tuple[float, float], wall_top: float, thickness: float
) -> tuple[Box, ...]:
    """Returns the boxes of a floor, given its bottom and top, and of four walls inside the half extents."""
    half_x, half_y = half_extents
    bottom, top = floor
    middle, half_height = (wall_top + bottom) / 2, (wall_top - bottom) / 2
    half = thickness / 2
    return (
        Box((0, 0, (top + bottom) / 2), (half_x, half_y, (top - bottom) / 2)),
        *(Box((side * (half_x - half), 0, middle), (half, half_y, half_height)) for side in (1, -1)),
        *(Box((0, side * (half_y - half), middle), (half_x, half, half_height)) for side in (1, -1)),
    )


# The table is in the world's frame. The origin of the tray is the center of the top of its floor, that of a
# container the center of its underside.
TABLE_BOXES = (Box((*TRAY_CENTER, TABLE_TOP - 0.02), (0.7, 0.65, 0.02)),)
TRAY_BOXES = _open_box(
    TRAY_HALF_EXTENTS, (TABLE_TOP - TRAY_FLOOR, 0.0), TRAY_WALL_HEIGHT, TRAY_WALL_THICKNESS
)
CONTAINER_BOXES = _open_box(
    CONTAINER_HALF_EXTENTS, (0.0, CONTAINER_FLOOR_THICKNESS), CONTAINER_WALL_HEIGHT, CONTAINER_WALL_THICKNESS
)


@functools.cache
def table_mesh() -> Mesh:
    """Returns the table's top around the tray, in the world's frame. The tray would hide the rest."""
    (x, y, _), (half_x, half_y, _) = TABLE_BOXES[0]
    hole_x, hole_y = TRAY_HALF_EXTENTS
    rows: list[Row] = [((half_x, half_y), TABLE_TOP, _TABLE_COLOR), ((hole_x, hole_y), TABLE_TOP)]
    return _without_undersides(Loft(_SQUARE, rows, offset=(x, y, 0.0), closed=True).mesh())


@functools.cache
def tray_mesh() -> Mesh:
    """Returns the tray; its origin is the center of the top of its floor."""
    return _open_box_mesh(TRAY_BOXES, _TRAY_WALL_COLOR, _TRAY_FLOOR_COLOR)


@functools.cache
def container_mesh(color: ContainerColor) -> Mesh:
    """Returns a container; its origin is the center of its underside."""
    return _open_box_mesh(CONTAINER_BOXES, *_CONTAINER_COLORS[color])


def _open_box_mesh(boxes: tuple[Box, ...], wall_color: Color, floor_color: Color) -> Mesh:
    """Returns the surface of an `_open_box`: up the outside, over the rim, down the inside, and the floor."""
    floor, wall = boxes[0], boxes[1]
    outer = np.array(floor.half_extents[:2])
    inner = outer - 2 * wall.half_extents[0]
    bottom, top = (wall.center[2] + side * wall.half_extents[2] for side in (-1, 1))
    floor_top = floor.center[2] + floor.half_extents[2]
    rows: list[Row] = [
        ((outer[0], outer[1]), bottom, wall_color),
        ((outer[0], outer[1]), top),
        ((inner[0], inner[1]), top),
        ((inner[0], inner[1]), floor_top),
        (0.0, floor_top, floor_color),
    ]
    return _without_undersides(Loft(_SQUARE, rows).mesh())


def _without_undersides(mesh: Mesh) -> Mesh:
    """Removes the faces that look down."""
    edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]  # (F, 2, 3)
    seen = np.cross(edges[:, 0], edges[:, 1])[:, 2] >= 0
    return Mesh(mesh.vertices, mesh.normals, mesh.faces[seen], mesh.colors[seen])
