"""Where and how to grasp an object, from the shape that is seen: across its narrow side, or at its rim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_env_libero_pro.scene import Scene

OPENING = 0.077  # m between the open fingers
CLEARANCE = 0.007  # m between them that the object must leave, in all
REACH = 0.035  # m from an object's top down to the point between the fingertips, at most: above are the knuckles
LOWEST = 0.012  # m of that point above what the object stands on
SLAB = 0.012  # m above and below the point, which the fingertips touch
FINGERS = ((0.036, 0.066), 0.014)  # m: where the open fingers are along their axis, and half their width across it
ANGLES = np.radians(np.arange(0, 180, 5))


@dataclass(frozen=True)
class Grasp:
    """A grasp from above.

    Attributes:
        point: Where the point between the fingertips is to be, (3,), m.
        axis: Horizontal direction in which the fingers close, (2,), a unit vector. Its sign has no meaning.
    """

    point: np.ndarray
    axis: np.ndarray


def find_grasp(scene: Scene, name: str, hand_axis: np.ndarray) -> Grasp:
    """Returns the grasp that leaves most room for the fingers and turns the hand least.

    Args:
        scene: The scene.
        name: Name of the object.
        hand_axis: Horizontal direction in which the fingers close now, (2,).
    """
    vertices = scene.vertices(name)
    bottom, top = vertices[:, 2].min(), vertices[:, 2].max()
    height = max((bottom + top) / 2, top - REACH, bottom + LOWEST)
    slab = vertices[np.abs(vertices[:, 2] - height) < SLAB][:, :2]
    obstacles = [scene.vertices(other)[::10] for other in scene.task.objects if other != name]
    around = np.concatenate(obstacles) if obstacles else np.zeros((0, 3))
    around = around[around[:, 2] > height - SLAB][:, :2]
    candidates = across(slab, height) or at_rim(slab, height)
    return min(candidates, key=lambda grasp: _cost(grasp, around, hand_axis))


def across(slab: np.ndarray, height: float) -> list[Grasp]:
    """Returns grasps with the object's whole width between the fingers; none if it is too wide everywhere.

    Args:
        slab: What the fingertips could touch, (n, 2), m.
        height: Height of the grasps, m.
    """
    grasps = []
    for angle in ANGLES:
        axis, side = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        along, beside = slab @ axis, slab @ side
        if np.ptp(along) <= OPENING - CLEARANCE:
            point = axis * (along.min() + along.max()) / 2 + side * (beside.min() + beside.max()) / 2
            grasps.append((np.ptp(along), Grasp(np.array([*point, height]), axis)))
    # Where one side is clearly narrower, jaws that are not parallel to it would turn the object.
    narrowest = min((width for width, _ in grasps), default=0)
    return [grasp for width, grasp in grasps if width < narrowest + 0.004]


def at_rim(slab: np.ndarray, height: float) -> list[Grasp]:
    """Returns grasps with one finger in a hollow object and one outside. Arguments as in `across`."""
    center = (slab.min(0) + slab.max(0)) / 2
    grasps = []
    for angle in np.radians(np.arange(0, 360, 10)):
        axis = np.array([np.cos(angle), np.sin(angle)])
        point = center + axis * (((slab - center) @ axis).max() - 0.005)
        grasps.append(Grasp(np.array([*point, height]), axis))
    return grasps


def turn(axis: np.ndarray, hand_axis: np.ndarray) -> float:
    """Returns the angle, rad, by which the hand turns to close its fingers along an axis, at most a quarter turn."""
    angle = np.arctan2(axis[1], axis[0]) - np.arctan2(hand_axis[1], hand_axis[0])
    return float((angle + np.pi / 2) % np.pi - np.pi / 2)


def _cost(grasp: Grasp, around: np.ndarray, hand_axis: np.ndarray) -> float:
    """Returns the hand's turn, rad, and 10 where a finger would come down on another object."""
    relative = around - grasp.point[:2]
    along = np.abs(relative @ grasp.axis)
    beside = np.abs(relative @ [-grasp.axis[1], grasp.axis[0]])
    (inner, outer), half_width = FINGERS
    is_blocked = np.any((along > inner) & (along < outer) & (beside < half_width))
    return abs(turn(grasp.axis, hand_axis)) + 10 * bool(is_blocked)
