"""Cameras, independent of the simulator."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a square image.

    Attributes:
        target: Point in the center of the image, (x, y, z), m.
        distance: Distance from the target, m.
        yaw: Angle about the vertical axis, degrees; at 0, the camera looks along +y.
        pitch: Angle above the horizon, degrees; negative when the camera looks down.
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


@dataclass(frozen=True)
class HandCamera:
    """A pinhole camera with a square image, fixed to the hand.

    Points are in the frame of the end effector, whose x axis is the direction of the gripper, and y that of
    the fingers' motion.

    Attributes:
        eye: Position of the camera, (x, y, z), m.
        target: Point in the center of the image, (x, y, z), m.
        up: Direction that is up in the image, (x, y, z).
        fov: Vertical field of view, degrees.
        near: Distance of the near plane, m.
        far: Distance of the far plane, m.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float
    near: float = 0.01
    far: float = 2.0
