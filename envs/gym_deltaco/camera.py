"""Cameras, described without the simulator that renders what they see."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks at a point; the image is square.

    Attributes:
        target: The point in the center of the image, (x, y, z), m.
        distance: Distance from the target, m.
        yaw: Angle about the vertical axis, degrees; 0 looks along +y.
        pitch: Angle above the horizon, degrees; negative looks down.
        fov: Vertical field of view, degrees.
        near: Distance of the near plane, m.
        far: Distance of the far plane, m.
    """

    target: tuple[float, float, float]
    distance: float
    yaw: float
    pitch: float
    fov: float = 60.0
    near: float = 0.1
    far: float = 2.0
