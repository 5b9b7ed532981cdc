"""Where and how to grasp an object, from the shape that is seen: across its narrow side, or at its rim."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from lerobot_env_libero_pro.scene import Scene

OPENING = 0.077  # m between the open fingers
CLEARANCE = 0.006  # m between them that the object must leave, in all
REACH = 0.030  # m from an object's top down to the point between the fingertips at most: the palm is at 0.032
LOWEST = 0.012  # m of that point above what the object stands on
HIGHEST = 0.016  # m of that point below the object's top
PAD = 0.009  # m above and below the point that the fingertips touch
# Half extents along the axis and across it, m, of the open fingers and of the palm, and the palm's height.
FINGERS = ((0.036, 0.068), 0.016)
PALM = ((0.0, 0.105), 0.035)
PALM_HEIGHT = 0.032
# m from the rim to the point between the fingertips. From further in, the outer finger pushes the object.
INWARDS = (0.005, 0.02)
FAR = 0.72  # m from the robot's axis, where the arm begins to be straight
FAR_COST = 20  # rad/m: so much rather turns the hand than the arm reaches beyond
ANGLES = np.radians(np.arange(0, 180, 5))


@dataclass(frozen=True)
class Grasp:
    """A grasp from above.

    Attributes:
        point: Where the point between the fingertips is to be, (3,), m.
        axis: Horizontal direction in which the fingers close, (2,), a unit vector. Its sign has no meaning.
        is_at_rim: Whether only one side of a hollow object is between the fingers.
    """

    point: np.ndarray
    axis: np.ndarray
    is_at_rim: bool = False


def find_grasp(scene: Scene, name: str, hand_axis: np.ndarray) -> Grasp:
    """Returns the grasp at which the hand hits nothing else, turns least and does not reach far.

    Args:
        scene: The scene.
        name: Name of the object.
        hand_axis: Horizontal direction in which the fingers close now, (2,).
    """
    solids = scene.solids(name)
    others = [scene.vertices(other)[::10] for other in scene.task.objects if other != name]
    around = np.concatenate([*others, *scene.fixture_points(), np.zeros((0, 3))])
    base = scene.base_position()

    def touched(height: float) -> tuple[np.ndarray, float]:
        return _slab(solids, height - PAD, height + PAD), height

    candidates = across(*touched(_even_height(solids))) or at_rim(*touched(_rim_height(solids)))
    return min(candidates, key=lambda grasp: _cost(grasp, around, hand_axis, base))


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
    for inwards, angle in itertools.product(INWARDS, np.radians(np.arange(0, 360, 10))):
        axis = np.array([np.cos(angle), np.sin(angle)])
        point = center + axis * (((slab - center) @ axis).max() - inwards)
        grasps.append(Grasp(np.array([*point, height]), axis, is_at_rim=True))
    return grasps


def turn(axis: np.ndarray, hand_axis: np.ndarray) -> float:
    """Returns the angle by which the hand turns to close its fingers along an axis: -pi/2 to pi/2."""
    angle = np.arctan2(axis[1], axis[0]) - np.arctan2(hand_axis[1], hand_axis[0])
    return float((angle + np.pi / 2) % np.pi - np.pi / 2)


def _slab(solids: list[np.ndarray], low: float, high: float) -> np.ndarray:
    """Returns the corners, (n, 2), of the parts of an object that are between two heights."""
    parts = [part[:, :2] for part in solids if part[:, 2].min() < high and part[:, 2].max() > low]
    return np.concatenate([*parts, np.zeros((0, 2))])


def _rim_height(solids: list[np.ndarray]) -> float:
    """Returns the height of a grasp at the rim: high, where the palm is above what the object stands in."""
    heights = np.concatenate(solids)[:, 2]
    return float(max(heights.max() - HIGHEST, heights.min() + LOWEST))


def _even_height(solids: list[np.ndarray]) -> float:
    """Returns the lowest height in reach at which both pads meet an even wall: at an edge, objects stick."""
    heights = np.concatenate(solids)[:, 2]
    bottom, top = heights.min(), heights.max()
    lowest = max((bottom + top) / 2, top - REACH, bottom + LOWEST)

    def unevenness(height: float) -> float:
        halves = [_slab(solids, height - PAD, height), _slab(solids, height, height + PAD)]
        if any(not len(half) for half in halves):
            return np.inf
        lower, upper = (np.concatenate([half.min(0), half.max(0)]) for half in halves)
        return float(np.abs(lower - upper).max().round(3))

    return min(np.arange(lowest, max(lowest, top - HIGHEST) + 1e-6, 0.003), key=unevenness)


def _cost(grasp: Grasp, around: np.ndarray, hand_axis: np.ndarray, base: np.ndarray) -> float:
    """Returns the hand's turn, rad; more where it would come down on something else, or at a far rim."""
    relative = around - grasp.point
    along = np.abs(relative[:, :2] @ grasp.axis)
    beside = np.abs(relative[:, :2] @ [-grasp.axis[1], grasp.axis[0]])
    cost = abs(turn(grasp.axis, hand_axis))
    if grasp.is_at_rim:  # otherwise, all grasps are at the same place
        cost += FAR_COST * max(0, np.linalg.norm((grasp.point - base)[:2]) - FAR)
    for ((inner, outer), half_width), height in ((FINGERS, -PAD), (PALM, PALM_HEIGHT)):
        is_hit = (along >= inner) & (along < outer) & (beside < half_width) & (relative[:, 2] > height)
        cost += 10 * bool(is_hit.any())
    return cost
