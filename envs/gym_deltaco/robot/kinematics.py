"""Kinematics of the WidowX 250 (6 degrees of freedom), with the gripper pointing straight down.

The joints are the published ones: waist (z), shoulder (y), elbow (y), forearm roll (x), wrist angle (y) and
wrist rotate (x). The frames from the elbow to the wrist angle are rolled by pi. While the gripper points down
and its fingers move along the world's x axis, the forearm does not roll, and the wrist compensates the waist.
The other three joints form a triangle in a vertical plane, so that the inverse has a closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

BASE_POSITION = np.array([0.6, 0.0, -0.4])  # m, in the world
# Origins of the joints in their parents' frames, m
WAIST_ORIGIN = (0.0, 0.0, 0.0716)
SHOULDER_ORIGIN = (0.0, 0.0, 0.03865)
ELBOW_ORIGIN = (0.04975, 0.0, 0.25)
FOREARM_ROLL_ORIGIN = (0.175, 0.0, 0.0)
WRIST_ANGLE_ORIGIN = (0.075, 0.0, 0.0)
WRIST_ROTATE_ORIGIN = (0.065, 0.0, 0.0)
END_EFFECTOR_OFFSET = (0.043, 0.0, 0.0)  # from the wrist-rotate joint
_ORIGINS = [
    np.array(origin)
    for origin in (
        WAIST_ORIGIN,
        SHOULDER_ORIGIN,
        ELBOW_ORIGIN,
        FOREARM_ROLL_ORIGIN,
        WRIST_ANGLE_ORIGIN,
        WRIST_ROTATE_ORIGIN,
    )
]
_END_EFFECTOR_OFFSET = np.array(END_EFFECTOR_OFFSET)
_IDENTITY = np.eye(3)
_FLIP = np.diag([1.0, -1.0, -1.0])  # rolls a frame by pi about x
_AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}  # the plane of a rotation about each axis
REST_JOINTS = np.array([1.57, -0.6, -0.6, 0.0, -1.57, 0.0])  # rad

SHOULDER = BASE_POSITION + WAIST_ORIGIN + SHOULDER_ORIGIN  # m, in the world
_UPPER_ARM = float(np.hypot(ELBOW_ORIGIN[0], ELBOW_ORIGIN[2]))
_UPPER_ARM_ELEVATION = float(np.arctan2(ELBOW_ORIGIN[2], ELBOW_ORIGIN[0]))  # at shoulder angle 0
_FOREARM = FOREARM_ROLL_ORIGIN[0] + WRIST_ANGLE_ORIGIN[0]
_HAND = WRIST_ROTATE_ORIGIN[0] + END_EFFECTOR_OFFSET[0]
REACH = _UPPER_ARM + _FOREARM + _HAND  # m, from the shoulder to the end effector of the stretched arm
# m, largest distance of the wrist from the shoulder, short of the singularity
_MAX_REACH = 0.999 * (_UPPER_ARM + _FOREARM)
# m, smallest distance of the end effector from the waist's axis, where the waist's angle is undefined
_MIN_RADIUS = 0.03


def forward(joints: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Computes the pose of the end effector.

    Args:
        joints: Joint angles, (6,), rad.

    Returns:
        Position in the world, (3,), m, and rotation, (3, 3). The gripper points along the rotation's first
        column, and the fingers move along the second one.
    """
    waist, shoulder, elbow, roll, wrist, rotate = np.asarray(joints, dtype=np.float64)
    position, rotation = BASE_POSITION, _IDENTITY
    rotations = (
        _rotation("z", waist),
        _rotation("y", shoulder),
        _FLIP @ _rotation("y", elbow),
        _rotation("x", roll),
        _rotation("y", wrist),
        _FLIP @ _rotation("x", rotate),
    )
    for origin, joint_rotation in zip(_ORIGINS, rotations, strict=True):
        position = position + rotation @ origin
        rotation = rotation @ joint_rotation
    return position + rotation @ _END_EFFECTOR_OFFSET, rotation


def inverse(position: ArrayLike, near: ArrayLike = REST_JOINTS) -> NDArray[np.float64]:
    """Computes joint angles for a position, with the gripper pointing down and the fingers along x.

    A position out of reach is replaced by the nearest one towards the shoulder. Within 3 cm of the waist's
    axis, it is moved away from the axis.

    Args:
        position: Position of the end effector in the world, (3,), m.
        near: Current joint angles, (6,), rad. Of equivalent angles, waist and wrist rotate take the nearest.

    Returns:
        Joint angles, (6,), rad.
    """
    x, y, z = np.asarray(position, dtype=np.float64) - SHOULDER
    near = np.asarray(near, dtype=np.float64)
    radius, height = max(float(np.hypot(x, y)), _MIN_RADIUS), z + _HAND
    reach = float(np.hypot(radius, height))
    if reach > _MAX_REACH:
        radius, height, reach = (value * _MAX_REACH / reach for value in (radius, height, reach))

    waist = np.arctan2(y, x) if x or y else near[0]
    waist += 2 * np.pi * np.round((near[0] - waist) / (2 * np.pi))
    # Law of cosines in the triangle of shoulder, elbow (above the other two) and wrist
    opening = np.arccos((_UPPER_ARM**2 + reach**2 - _FOREARM**2) / (2 * _UPPER_ARM * reach))
    upper_arm_elevation = np.arctan2(height, radius) + opening
    forearm_pitch = -np.arctan2(
        height - _UPPER_ARM * np.sin(upper_arm_elevation), radius - _UPPER_ARM * np.cos(upper_arm_elevation)
    )
    shoulder = _UPPER_ARM_ELEVATION - upper_arm_elevation
    elbow = shoulder - forearm_pitch
    wrist = forearm_pitch - np.pi / 2
    return np.array([waist, shoulder, elbow, 0.0, wrist, waist - np.pi / 2])


def _rotation(axis: str, angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    first, second = _AXES[axis]
    matrix = _IDENTITY.copy()
    matrix[first, first] = matrix[second, second] = c
    matrix[first, second], matrix[second, first] = -s, s
    return matrix
