"""Meshes of the WidowX 250: low-poly sketches of its links, matte black, each in the frame of its link."""

from __future__ import annotations

import numpy as np

from gym_deltaco.objects.solids import Color, Loft, Mesh, Row, merged, polygon

_BLACK: Color = (0.13, 0.13, 0.14)
_DARK: Color = (0.20, 0.20, 0.22)
_GRAY: Color = (0.33, 0.33, 0.35)
# A square with its corners cut off
_BEAM = np.array([(1, -0.6), (1, 0.6), (0.6, 1), (-0.6, 1), (-1, 0.6), (-1, -0.6), (-0.6, -1), (0.6, -1)])
_ROUND = polygon(8)


def _beam(
    half_y: float, half_z: float, start: float, end: float, color: Color, outline: np.ndarray = _BEAM
) -> Mesh:
    """Returns a bar along x, from `start` to `end` (m)."""
    rows: list[Row] = [((half_z, half_y), start, color), ((half_z, half_y), end)]
    return Loft(outline, rows, tilt=90).mesh()


def _column(half_x: float, half_y: float, bottom: float, top: float, color: Color, x: float = 0.0) -> Mesh:
    """Returns a bar along z, from `bottom` to `top` (m)."""
    return Loft(_BEAM, [((half_x, half_y), (x, 0, bottom), color), ((half_x, half_y), (x, 0, top))]).mesh()


def _axle(radius: float, half_length: float, color: Color) -> Mesh:
    """Returns the cylinder of a motor, along y, about its joint."""
    return Loft(_ROUND, [(radius, -half_length, color), (radius, half_length)], tilt=90, turn=90).mesh()


def _finger(side: int) -> Mesh:
    """Returns a finger with its pad at y = 0, which narrows towards its tip at x = 0.05 m."""
    thick, thin = 0.0045, 0.003
    return Loft(
        np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]),
        [
            ((0.010, thick), (0, side * thick, -0.012), _DARK),
            ((0.010, thick), (0, side * thick, 0.018)),
            ((0.007, thin), (0, side * thin, 0.05), _GRAY),
        ],
        tilt=90,
    ).mesh()


BASE_MESH = merged(
    [_column(0.07, 0.055, 0.0, 0.035, _BLACK), Loft(_ROUND, [(0.045, 0.035, _DARK), (0.04, 0.0716)]).mesh()]
)
LINK_MESHES = {
    "waist": merged([_column(0.035, 0.035, 0.0, 0.03, _BLACK), _column(0.03, 0.04, 0.025, 0.055, _DARK)]),
    "shoulder": merged(
        [
            _axle(0.027, 0.045, _BLACK),
            _column(0.02, 0.022, 0.0, 0.265, _DARK),
            _beam(0.022, 0.018, 0.0, 0.05, _DARK).moved((0, 0, 0.25)),
        ]
    ),
    "elbow": merged([_axle(0.025, 0.04, _BLACK), _beam(0.02, 0.018, 0.0, 0.175, _DARK)]),
    "forearm_roll": _beam(0.023, 0.02, 0.0, 0.06, _BLACK),
    "wrist_angle": merged([_axle(0.02, 0.03, _DARK), _beam(0.018, 0.016, 0.0, 0.06, _BLACK)]),
    "wrist_rotate": merged([_beam(0.022, 0.022, 0.0, 0.03, _DARK), _beam(0.05, 0.012, 0.022, 0.036, _BLACK)]),
    "left_finger": _finger(1),
    "right_finger": _finger(-1),
}
