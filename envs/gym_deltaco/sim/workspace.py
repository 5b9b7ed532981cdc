"""Positions and sizes of the table, the tray, its four quadrants, the containers and the camera.

The numbers are from the paper's appendix and the authors' published settings. A quadrant is a pair (i, j): i
is 0 on the right of the image and 1 on the left; j is 0 at the back, near the robot, and 1 in front.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.containers import ContainerColor, ContainerWord
from gym_deltaco.sim.camera import Camera, HandCamera

TABLE_TOP = -0.375  # m
TRAY_FLOOR = -0.37  # m
TRAY_CENTER = (0.6, 0.25)  # m
TRAY_HALF_EXTENTS = (0.2, 0.165)  # m
TRAY_WALL_HEIGHT = 0.012  # m above its floor
TRAY_WALL_THICKNESS = 0.006  # m

CONTAINER_HALF_EXTENTS = (0.075, 0.0525)  # m
CONTAINER_FLOOR_THICKNESS = 0.003  # m
CONTAINER_FLOOR = TRAY_FLOOR + CONTAINER_FLOOR_THICKNESS  # m
CONTAINER_WALL_HEIGHT = 0.022  # m above the tray's floor
CONTAINER_WALL_THICKNESS = 0.004  # m

DROP_HEIGHT = -0.30  # m, height of an object's center when it is dropped into the tray
CAMERA = Camera(target=(0.6, 0.2, -0.28), distance=0.37, yaw=180, pitch=-40)
WRIST_CAMERA = HandCamera(eye=(-0.04, 0.0, 0.07), target=(0.07, 0.0, 0.005), up=(-1, 0, 0), fov=70)


class Region(NamedTuple):
    """A rectangle of the tray."""

    low: NDArray[np.float64]  # (2,), m
    high: NDArray[np.float64]  # (2,), m


class Quadrant(NamedTuple):
    """A quarter of the tray."""

    i: int  # 0 right, 1 left
    j: int  # 0 back, 1 front

    @property
    def container_center(self) -> NDArray[np.float64]:
        """Center of a container in the quadrant, (2,), m."""
        return np.array([0.515 + 0.16 * self.i, 0.18 + 0.14 * self.j])

    @property
    def object_region(self) -> Region:
        """Region of the centers of objects, inset by 38 mm on the two sides that face the tray's center."""
        low = np.array([0.44 + 0.15 * self.i, 0.14 + 0.12 * self.j])
        high = np.array([0.59 + 0.15 * self.i, 0.26 + 0.12 * self.j])
        inset = 0.038
        low += inset * np.array([self.i == 1, self.j == 1])
        high -= inset * np.array([self.i == 0, self.j == 0])
        return Region(low, high)

    def satisfies(self, word: ContainerWord) -> bool:
        """Returns whether a word describes the position of the quadrant; False for a color."""
        return word in (("right", "left")[self.i], ("back", "front")[self.j])


def container_matches(word: ContainerWord, color: ContainerColor, quadrant: Quadrant) -> bool:
    """Returns whether a word of an instruction, a color or a position, describes a container."""
    return word == color or quadrant.satisfies(word)


QUADRANTS = tuple(Quadrant(i, j) for i in (0, 1) for j in (0, 1))
