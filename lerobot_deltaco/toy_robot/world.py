"""The toy robot's table: an arm, two boxes, four objects, and the cameras that see them.

An object is held while the gripper is closed around it; nothing else is simulated. Lengths are in meters: x
points away from the arm's base, y to the left, z upwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

MOTORS = tuple(
    f"{joint}.pos"
    for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
)
CAMERAS = ("front", "wrist")
HEIGHT, WIDTH, FPS = 120, 160, 30
# What people said, and the object and the box that they meant.
TASKS = {
    "Put the red cube in the white box.": ("red cube", "white"),
    "put the red cube into the black box": ("red cube", "black"),
    "Place the yellow ball in the white box": ("yellow ball", "white"),
    "Move the yellow ball over to the black box.": ("yellow ball", "black"),
    "pick up the green cup and drop it into the white box": ("green cup", "white"),
    "The green cup goes in the black box.": ("green cup", "black"),
    "Grab the blue cone, then put it in the white box": ("blue cone", "white"),
    "blue cone to the black box": ("blue cone", "black"),
}
NEW_TASKS = {
    "Put the orange bar in the white box.": ("orange bar", "white"),
    "put the orange bar into the black box": ("orange bar", "black"),
}
HOME = np.array([0.0, -60.0, 60.0, 60.0, 0.0, 2.0])  # degrees; the gripper from 0, closed, to 100

_SHOULDER, _UPPER_ARM, _FOREARM, _HAND = 0.12, 0.14, 0.16, 0.12
_MAX_GAP, REACH = 0.08, 0.02  # between the open fingers; of the fingers around an object's center
_FOLLOWING = 0.5  # of the way to the commanded position, at each step
_BOX, _WALL = 0.045, 0.04  # half of a box's side, and its height
_BOXES = {"white": (0.16, -0.19), "black": (0.16, 0.19)}
_COLORS = {"white": (235, 235, 230), "black": (50, 50, 55), "table": (196, 164, 128), "arm": (245, 245, 245)}
_COLORS |= {"finger": (70, 70, 75), "red": (205, 40, 40), "yellow": (235, 200, 40), "green": (50, 150, 70)}
_COLORS |= {"blue": (50, 90, 200), "orange": (240, 130, 30)}
# Of each shape: number of corners, their direction, and radii at heights from the table.
_SHAPES: dict[str, tuple[int, float, list[tuple[float, float]]]] = {
    "cube": (4, np.pi / 4, [(0, 0.022), (0.032, 0.022)]),
    "ball": (10, 0, [(0, 0.004), (0.005, 0.012), (0.016, 0.017), (0.027, 0.012), (0.032, 0.001)]),
    "cup": (12, 0, [(0, 0.013), (0.042, 0.019)]),
    "cone": (12, 0, [(0, 0.021), (0.045, 0.001)]),
    "bar": (4, np.pi / 4, [(0, 0.014), (0.06, 0.014)]),
}

Vector = NDArray[Any]
Face = tuple[Vector, tuple[int, ...]]  # corners, (n, 3), and color


class Camera(NamedTuple):
    """A pinhole camera."""

    position: Vector
    axes: Vector  # right, down and forward, (3, 3)
    focal_length: float  # as a fraction of the image's width

    @classmethod
    def looking(cls, position: Vector, target: Vector, up: Vector, focal_length: float) -> Camera:
        """Returns a camera that looks at a point."""
        forward = _unit(target - position)
        right = _unit(np.cross(forward, up))
        return cls(position, np.stack([right, np.cross(forward, right), forward]), focal_length)

    def project(self, points: Vector) -> tuple[Vector, Vector]:
        """Returns pixels (n, 2) of points (n, 3), in twice the image's size, and their depths (n,)."""
        seen = (points - self.position) @ self.axes.T
        depth = seen[:, 2].clip(0.01)
        pixels = 2 * WIDTH * self.focal_length * seen[:, :2] / depth[:, None]
        return pixels + [WIDTH, HEIGHT], seen[:, 2]


class Pose(NamedTuple):
    """Where the arm is: shoulder, elbow, wrist and tip; and the direction from finger to finger."""

    points: Vector  # (4, 3)
    across: Vector
    upward: Vector  # perpendicular to the hand


def pose_of(joints: Vector) -> Pose:
    """Returns where the arm is at joint positions, (6,) in degrees."""
    pan, lift, elbow, flex, roll = np.radians(joints[:5])
    out, left, up = np.array([np.cos(pan), np.sin(pan), 0]), np.array([-np.sin(pan), np.cos(pan), 0]), _UP
    points, angle = [_SHOULDER * up], np.pi / 2
    for length, turn in ((_UPPER_ARM, lift), (_FOREARM, np.pi / 2 + elbow), (_HAND, flex)):
        angle -= turn
        points.append(points[-1] + length * (np.cos(angle) * out + np.sin(angle) * up))
    upward = -np.sin(angle) * out + np.cos(angle) * up
    return Pose(np.stack(points), np.cos(roll) * left + np.sin(roll) * upward, upward)


def joints_at(x: float, y: float, z: float, gripper: float, roll: float = 0.0) -> Vector:
    """Returns the joint positions, (6,), at which the tip is at a point, with the hand pointing down."""
    reach, height = np.hypot(x, y), z + _HAND - _SHOULDER
    distance = min(np.hypot(reach, height), 0.999 * (_UPPER_ARM + _FOREARM))
    at_shoulder = np.arccos(
        (_UPPER_ARM**2 + distance**2 - _FOREARM**2) / (2 * _UPPER_ARM * distance)
    ) + np.arctan2(height, reach)
    inner = np.arccos((_UPPER_ARM**2 + _FOREARM**2 - distance**2) / (2 * _UPPER_ARM * _FOREARM))
    lift, elbow = np.pi / 2 - at_shoulder, np.pi / 2 - inner
    flex = np.pi - lift - (np.pi / 2 + elbow)
    return np.array([*np.degrees([np.arctan2(y, x), lift, elbow, flex]), roll, gripper])


class ToyWorld:
    """A table with two boxes, four objects and the arm.

    Args:
        seed: Seed of the places.
        has_new_object: Whether an object that is in no training episode replaces one of the others.

    Attributes:
        joints: Joint positions, (6,).
        objects: Center of each object's base, (3,), by name.
        boxes: Center of each box, (2,), by color.
    """

    def __init__(self, seed: int, has_new_object: bool = False) -> None:
        rng = np.random.default_rng(seed)
        self.joints, self.held = HOME.copy(), ""
        self.boxes = {name: place + rng.uniform(-0.015, 0.015, 2) for name, place in _BOXES.items()}
        names = sorted({name for name, _ in TASKS.values()})
        if has_new_object:
            names[rng.integers(len(names))] = NEW_TASKS[next(iter(NEW_TASKS))][0]
        self.objects: dict[str, Vector] = {}
        while len(self.objects) < len(names):
            place = np.array([*rng.uniform((0.14, -0.11), (0.26, 0.11)), 0.0])
            if all(np.hypot(*(place - other)[:2]) > 0.06 for other in self.objects.values()):
                self.objects[names[len(self.objects)]] = place

    def step(self, action: Vector) -> None:
        """Moves the arm towards commanded joint positions, (6,), for a frame."""
        self.joints = self.joints + _FOLLOWING * (action - self.joints)
        tip = pose_of(self.joints).points[-1]
        if self.held:
            width = self._opening_around(self.held)
            if action[-1] > 1.15 * width:
                inside = any(np.abs(tip[:2] - box).max() < _BOX for box in self.boxes.values())
                self.objects[self.held] = np.array([*tip[:2], 0.003 if inside else 0.0])
                self.held = ""
            else:
                self.joints[-1] = max(self.joints[-1], width)
                self.objects[self.held] = tip - [0, 0, REACH]
        else:
            for name, place in self.objects.items():
                is_near = np.hypot(*(tip - place)[:2]) < 0.015 and abs(tip[2] - place[2] - REACH) < 0.015
                if is_near and action[-1] < self.joints[-1] <= self._opening_around(name):
                    self.held = name

    def _opening_around(self, name: str) -> float:
        return 100 * 2 * max(radius for _, radius in _SHAPES[name.split()[1]][2]) / _MAX_GAP

    def in_boxes(self) -> dict[str, str]:
        """Returns the color of the box that each object in a box is in."""
        return {
            name: color
            for name, place in self.objects.items()
            for color, box in self.boxes.items()
            if name != self.held and np.abs(place[:2] - box).max() < _BOX
        }

    def images(self) -> dict[str, NDArray[np.uint8]]:
        """Returns the images of both cameras, (HEIGHT, WIDTH, 3)."""
        points, across, upward = pose_of(self.joints)
        wrist, tip = points[2:]
        cameras = {
            "front": Camera.looking(np.array([0.5, 0, 0.5]), np.array([0.12, 0, 0.02]), _UP, 1.08),
            "wrist": Camera.looking(wrist + 0.07 * upward, tip + 0.02 * upward, upward, 0.6),
        }
        faces = [*self._things(), *self._arm(points, across)]
        return {name: _drawn(camera, faces) for name, camera in cameras.items()}

    def _things(self) -> Iterator[Face]:
        for color, (x, y) in self.boxes.items():
            corners = np.array([[x, y, 0]]) + _BOX * np.array(_SQUARE)
            yield corners, _COLORS[color]
            for n in range(4):
                wall = corners[[n, (n + 1) % 4]]
                yield np.concatenate([wall, wall[::-1] + _WALL * _UP]), _COLORS[color]
        for name, place in self.objects.items():
            color, shape = name.split()
            n_corners, first, rings = _SHAPES[shape]
            angles = first + 2 * np.pi * np.arange(n_corners) / n_corners
            circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
            levels = [place + radius * circle + height * _UP for height, radius in rings]
            for low, high in zip(levels, levels[1:], strict=False):
                for n in range(n_corners):
                    m = (n + 1) % n_corners
                    yield np.stack([low[n], low[m], high[m], high[n]]), _COLORS[color]
            yield levels[-1], _COLORS[color]

    def _arm(self, points: Vector, across: Vector) -> Iterator[Face]:
        yield from _beam(np.zeros(3), points[0], 0.035)
        for start, end, width in zip(points, points[1:], (0.02, 0.017, 0.014), strict=False):
            yield from _beam(start, end if width > 0.014 else start + 0.5 * (end - start), width)
        wrist, tip = points[2:]
        for side in (-1, 1):
            aside = side * across * (self.joints[-1] / 100 * _MAX_GAP / 2 + 0.005)
            yield from _beam(wrist + 0.45 * (tip - wrist) + aside, tip + aside, 0.005, "finger")


_UP = np.array([0.0, 0.0, 1.0])
_SQUARE = ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))
_LIGHT = np.array([0.4, 0.3, 0.85])


def _unit(vector: Vector) -> Vector:
    return vector / np.linalg.norm(vector)


def _beam(start: Vector, end: Vector, width: float, color: str = "arm") -> Iterator[Face]:
    """Yields the faces of a beam with a square profile."""
    along = _unit(end - start)
    aside = _unit(np.cross(along, _UP if abs(along[2]) < 0.9 else np.array([1.0, 0.0, 0.0])))
    other = np.cross(along, aside)
    profile = [width * (x * aside + y * other) for x, y, _ in _SQUARE]
    for n in range(4):
        a, b = profile[n], profile[(n + 1) % 4]
        yield np.stack([start + a, start + b, end + b, end + a]), _COLORS[color]
    yield np.stack([end + corner for corner in profile]), _COLORS[color]


def _table() -> Iterator[Face]:
    """Yields boards of wood, by which a moving camera can be told from one that stands still."""
    rng = np.random.default_rng(0)
    for y in np.arange(-0.5, 0.5, 0.05):
        for x in np.arange(-0.1, 0.42, 0.26) + rng.uniform(-0.05, 0.05):
            board = np.array([[x, y, 0], [x + 0.26, y, 0], [x + 0.26, y + 0.05, 0], [x, y + 0.05, 0]])
            shade = rng.uniform(0.88, 1.0)
            yield board, tuple(int(shade * value) for value in _COLORS["table"])


_TABLE = list(_table())


def _drawn(camera: Camera, faces: list[Face]) -> NDArray[np.uint8]:
    """Draws faces on the table, the farthest first."""
    image = Image.new("RGB", (2 * WIDTH, 2 * HEIGHT), (120, 125, 130))
    draw = ImageDraw.Draw(image)
    first = np.stack([corners[:3] for corners, _ in faces])
    normals = np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 1])
    shades = 0.65 + 0.35 * np.abs(normals @ _LIGHT) / np.linalg.norm(normals, axis=1).clip(1e-9)
    centers = np.stack([corners.mean(axis=0) for corners, _ in faces])
    order = np.argsort(-np.linalg.norm(centers - camera.position, axis=1))
    shaded = [(faces[n][0], tuple(int(shades[n] * value) for value in faces[n][1])) for n in order]
    in_turn = [*_TABLE, *shaded]
    pixels, depths = camera.project(np.concatenate([corners for corners, _ in in_turn]))
    points, is_before, start = [tuple(pixel) for pixel in pixels.tolist()], depths > 0.01, 0
    for corners, color in in_turn:
        end = start + len(corners)
        if is_before[start:end].all():
            draw.polygon(points[start:end], color)
        start = end
    return np.array(image.reduce(2))
