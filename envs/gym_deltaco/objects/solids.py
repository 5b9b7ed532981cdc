"""Parametric solids: an outline, scaled and stacked along a profile, becomes a colored triangle mesh.

A vase is a circle stacked along its silhouette, a bin a square, a canoe a pointed oval. A `Loft` describes
such a solid; `Loft.mesh` makes its triangles, and `Loft.points` the corners of a collision part. Lengths have
any unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

Color = tuple[float, float, float]
Radius = float | tuple[float, float]
Center = float | tuple[float, float, float]
Paint = Color | Sequence[Color]
Row = tuple[Radius, Center] | tuple[Radius, Center, Paint]

# Triangles of a smaller area, relative to the squared diagonal of the bounding box, are dropped
_MIN_AREA = 1e-9


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with one color per face. Shading is smooth across faces that share a vertex.

    Attributes:
        vertices: Positions, (V, 3).
        normals: Unit normals of the vertices, (V, 3).
        faces: Indices of vertices, counterclockwise seen from outside, (F, 3).
        colors: RGB in [0, 1], (F, 3).
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    colors: np.ndarray

    def __post_init__(self) -> None:
        """Makes the arrays read-only, since meshes are shared."""
        for array in (self.vertices, self.normals, self.faces, self.colors):
            array.setflags(write=False)

    @property
    def triangles(self) -> np.ndarray:
        """Corners of the faces, (F, 3, 3): face, corner, xyz."""
        return self.vertices[self.faces]

    def moved(self, offset: Sequence[float] | np.ndarray, scale: float = 1.0) -> Mesh:
        """Returns the mesh shifted by `offset` (x, y, z), then scaled."""
        return Mesh((self.vertices + np.asarray(offset)) * scale, self.normals, self.faces, self.colors)


@dataclass(frozen=True, eq=False)
class Loft:
    """An outline in the xy plane, stacked along z.

    Attributes:
        outline: Unit outline, counterclockwise and star-shaped about the axis, (n, 2); or (n, 3), with
            heights of its points.
        profile: Rings from the bottom along the outside to the top, and on along the inside of a hollow
            solid: (radius, center) or (radius, center, paint). The radius scales the outline, equally or as
            (x, y). The center is a height on the axis or a point (x, y, z). The paint is the color of the
            surface between the previous ring and this one, or several colors that alternate around it; it
            stays until another ring changes it. Caps close both ends.
        closed: Whether the last ring is joined to the first one, as in a torus, instead of capping both.
        tilt: Rotation about the y axis, degrees; applied first.
        turn: Rotation about the z axis, degrees; applied second.
        offset: Translation (x, y, z); applied last.
        crease: Angle between faces above which their edge is not smoothed, degrees.
    """

    outline: np.ndarray
    profile: Sequence[Row]
    closed: bool = False
    tilt: float = 0.0
    turn: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crease: float = 40.0

    def points(self) -> np.ndarray:
        """Returns the points of all rings, (rows * n, 3), which are the corners of a collision part."""
        return np.concatenate([self._ring(row) for row in self.profile])

    def mesh(self) -> Mesh:
        """Returns the surface.

        Raises:
            ValueError: The first ring has no paint.
        """
        if len(self.profile[0]) < 3:
            raise ValueError(f"The first ring of a profile needs a paint. Got {self.profile[0]!r}.")
        if self.closed:
            rows = [*self.profile, self.profile[0]]
        else:
            rows = [(0.0, self.profile[0][1]), *self.profile, (0.0, self.profile[-1][1])]
        rings = [self._ring(row) for row in rows]
        sides = len(self.outline)
        paint: Paint = self.profile[0][-1]
        triangles, colors = [], []
        for (lower, upper), row in zip(pairwise(rings), rows[1:], strict=True):
            paint = row[2] if len(row) == 3 else paint
            # (sides, 3) each: the corners of the quads, then (2 * sides, 3 corners, xyz)
            lower_next, upper_next = np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0)
            triangles.append(np.stack([lower, lower_next, upper_next], axis=1))
            triangles.append(np.stack([lower, upper_next, upper], axis=1))
            colors += [np.resize(np.asarray(paint, float), (sides, 3))] * 2
        return shaded(np.concatenate(triangles), np.concatenate(colors), self.crease)

    def _ring(self, row: Row) -> np.ndarray:
        """Returns the points of one ring, (n, 3)."""
        radius, center = row[:2]
        ring = np.zeros((len(self.outline), 3))
        if np.any(radius):
            ring[:, : self.outline.shape[1]] = self.outline
        ring[:, :2] *= radius
        ring += center if np.ndim(center) else (0.0, 0.0, center)
        return ring @ (_rotation(self.turn, axis=2) @ _rotation(self.tilt, axis=1)).T + self.offset


def shaded(triangles: np.ndarray, colors: np.ndarray, crease: float) -> Mesh:
    """Makes a mesh of triangles, and smooths the edges between faces that meet at a small angle.

    Args:
        triangles: (F, 3, 3): face, corner, xyz. Degenerate triangles are dropped.
        colors: RGB in [0, 1], (F, 3).
        crease: Largest angle between faces whose edge is smoothed, degrees.
    """
    flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(flat, axis=1)
    kept = area > _MIN_AREA * np.square(np.ptp(triangles, axis=(0, 1))).sum()
    triangles, colors, flat = triangles[kept], colors[kept], flat[kept] / area[kept, None]
    sides = np.roll(triangles, -1, axis=1) - triangles
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-np.einsum("fci,fci->fc", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0))

    corners = triangles.reshape(-1, 3)
    point = np.unique(corners.round(6), axis=0, return_inverse=True)[1].ravel()
    face = np.repeat(np.arange(len(triangles)), 3)
    is_smooth = (flat @ flat.T > np.cos(np.radians(crease)))[face][:, face]
    blend = (point[:, None] == point) & is_smooth  # (3F, 3F): corners whose faces share a normal
    normals = blend @ (flat[face] * angle.reshape(-1, 1))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    _, first, faces = np.unique(
        np.column_stack([point, normals.round(6)]), axis=0, return_index=True, return_inverse=True
    )
    return Mesh(corners[first], normals[first], faces.reshape(-1, 3), colors)


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """Joins several meshes into one."""
    meshes = list(meshes)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.colors for mesh in meshes]),
    )


def polygon(sides: int, radii: Sequence[float] = (1.0,)) -> np.ndarray:
    """Returns a regular polygon with a corner on the x axis, or a star with alternating radii, (sides, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle)]) * np.resize(radii, (sides, 1))


def rounded_square(corner: float) -> np.ndarray:
    """Returns a square of half side 1 whose corners are rounded with three points each, (12, 2).

    Args:
        corner: Radius of the corners, 0..1.
    """
    angle = np.radians([0.0, 45.0, 90.0])
    arc = 1.0 - corner + corner * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.concatenate([arc @ _rotation(turn, axis=2)[:2, :2].T for turn in (0.0, 90.0, 180.0, 270.0)])


def pointed_oval(sides: int, lift: float = 0.0) -> np.ndarray:
    """Returns the outline of a boat along y, (sides, 3).

    Args:
        sides: Number of corners, a multiple of 4; two of them are the tips.
        lift: Height of the tips above the center.
    """
    along = np.linspace(-1.0, 1.0, sides // 2 + 1)[:-1]
    starboard = np.column_stack([1.0 - np.abs(along) ** 2.6, along, lift * np.abs(along) ** 4])
    return np.concatenate([starboard, starboard * (-1.0, -1.0, 1.0)])


def _rotation(degrees: float, axis: int) -> np.ndarray:
    """Returns a counterclockwise rotation about a coordinate axis, (3, 3)."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[first, second], [first, second]] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return matrix


# Outlines of several objects
CIRCLE, OCTAGON = polygon(12), polygon(8)
ROUNDED = rounded_square(0.5)
SQUARE = np.array([(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)])
HALVED_SQUARE = np.array([(1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1)], float)
