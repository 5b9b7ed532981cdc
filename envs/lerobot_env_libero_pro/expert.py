"""The scripted expert for tasks in which an object is picked and placed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lerobot_env_libero_pro.grasps import FAR, find_grasp, turn
from lerobot_env_libero_pro.scene import CONTROL_FPS, Scene

NEAR = 0.015  # m from where a stage ends, within which it may end early
APPROACH = 0.08  # m above the grasp, at least, where the hand has turned before it descends
PASSING = 0.05  # m above all objects on the way there
CROSSING = 0.06  # m between the object's lowest point and the highest one where it goes, on the way
RELEASE = 0.01  # m between them when the gripper opens
# In a hollow place, tall objects go below the rim, so that they do not stay hanging on a finger. Fingertips
# stop above it: below, they would rake the place.
HOLLOW = "contain_region"
FINGERTIP = 0.012  # m below the point between the fingertips
# Far out, the hand tilts: where the elbow becomes straight, the controller loses the way back.
TILT_LENGTH = 0.2  # m per rad
MAX_TILT = 0.4  # rad
CLOSING_STEPS = 9
RIM_CLOSING_STEPS = 14  # where the outer finger may push the object first
OPENING_STEPS = 10  # until the fingers are off the object
RISING_STEPS = 8
SLOW = 0.0015  # m per action, below which the hand does not drift along a rim while the fingers close
STALLED = 0.0005  # m per action, below which the hand touches something that holds it back
TIMEOUT = 3 * CONTROL_FPS  # actions after which a stage ends anyway


def pick_and_place(scene: Scene, target: str, place: str) -> Iterator[np.ndarray]:
    """Yields the actions, (7,) float32, that put an object where it is to go. The caller carries each out.

    The hand approaches from above, turns to the object's narrow side, descends, closes, lifts, crosses high
    enough, lowers the object, releases it above what is below it, and rises. From the grasp on, it is the
    object's origin that is steered, since the goals of LIBERO test that point. It gives up if it lifts
    nothing.

    Args:
        scene: The scene, which the caller steps.
        target: Name of the object.
        place: Name of the object or of the region where it is to go.
    """
    grasp = find_grasp(scene, target, _hand_axis(scene))
    origin = scene.position(target)[2]
    bottom = scene.vertices(target)[:, 2].min() - origin
    release = _release_height(scene, place, grasp.point[2] - origin - bottom)
    crossing = max(_rim(scene, place), origin + bottom) + CROSSING
    tallest = max(scene.vertices(name)[:, 2].max() for name in scene.task.objects)
    above = np.array([*grasp.point[:2], max(grasp.point[2] + APPROACH, tallest + PASSING)])

    def hand_to(point: np.ndarray, tolerance: float, speed: float = np.inf) -> Iterator[np.ndarray]:
        """Moves the open hand until it is that near, m, and that slow, m per action."""
        before = np.full(3, np.inf)
        for _ in range(TIMEOUT):
            hand = scene.hand_position()
            offset, moved = np.linalg.norm(point - hand), np.linalg.norm(hand - before)
            is_turned = abs(turn(grasp.axis, _hand_axis(scene))) < 0.05
            is_there = offset < tolerance and moved <= speed
            if is_turned and (is_there or (offset < NEAR and moved < STALLED)):
                return
            before = hand
            yield _action(scene, point - hand, grasp.axis, -1)

    def object_to(height: float, tolerance: float, level: bool, slow: float = 1) -> Iterator[np.ndarray]:
        """Moves until the object's lowest point is that high, and, if level, its origin over the place."""
        for _ in range(TIMEOUT):
            origin = scene.position(target)
            offset = np.array([*(scene.position(place)[:2] - origin[:2]), height - bottom - origin[2]])
            if not level:
                offset[:2] = 0
            if np.linalg.norm(offset[:2]) < tolerance and abs(offset[2]) < 0.02:
                return
            yield _action(scene, offset, grasp.axis, 1, slow)

    yield from hand_to(above, 0.006)
    yield from hand_to(grasp.point, 0.004, SLOW if grasp.is_at_rim else np.inf)
    for _ in range(RIM_CLOSING_STEPS if grasp.is_at_rim else CLOSING_STEPS):
        # Around an object, the fingers center the hand; at a rim, it would drift.
        offset = grasp.point - scene.hand_position() if grasp.is_at_rim else np.zeros(3)
        yield _action(scene, offset, grasp.axis, 1)
    yield from object_to(crossing, 1, level=False)
    if target not in scene.lifted():
        return
    yield from object_to(crossing, 0.015, level=True)
    yield from object_to(release, 0.01, level=True, slow=0.6)
    for _ in range(OPENING_STEPS):
        yield _action(scene, np.zeros(3), grasp.axis, -1)
    for _ in range(RISING_STEPS):
        yield _action(scene, np.array([0, 0, 0.08]), grasp.axis, -1)


def grasp_and_release(scene: Scene, target: str, place: str) -> np.ndarray:
    """Returns the robot's states, (2, 8) float32, in which the hand would grasp and release an object.

    Arguments are those of `pick_and_place`. The fingers are as they are now.
    """
    grasp = find_grasp(scene, target, _hand_axis(scene))
    origin = scene.position(target)
    bottom = scene.vertices(target)[:, 2].min() - origin[2]
    height = _release_height(scene, place, grasp.point[2] - origin[2] - bottom)
    released = np.array([*scene.position(place)[:2], height - bottom])
    angle = turn(grasp.axis, _hand_axis(scene))
    hands = (grasp.point, grasp.point + released - origin)
    return np.stack([scene.robot_state_at(hand, angle) for hand in hands])


def _hand_axis(scene: Scene) -> np.ndarray:
    """Returns the horizontal direction in which the fingers close, (2,)."""
    return scene.hand_rotation()[:2, 0]


def _rim(scene: Scene, place: str) -> float:
    """Returns the height, m, above which an object can cross where it is to go."""
    owner = scene.owner(place)
    return float(scene.position(place)[2] if owner is None else scene.vertices(owner)[:, 2].max())


def _release_height(scene: Scene, place: str, held_at: float) -> float:
    """Returns the height, m, of an object's lowest point when the gripper opens.

    Args:
        scene: The scene.
        place: Name of the object or of the region where it is to go.
        held_at: Height of the point between the fingertips above the object's lowest point, m.
    """
    rim, owner = _rim(scene, place), scene.owner(place)
    if owner is None or not place.endswith(HOLLOW):
        return rim + RELEASE
    floor = scene.vertices(owner)[:, 2].min()
    return float(np.clip(rim + RELEASE + FINGERTIP - held_at, floor + 2 * RELEASE, rim + RELEASE))


def _action(
    scene: Scene, offset: np.ndarray, axis: np.ndarray, gripper: float, slow: float = 1
) -> np.ndarray:
    """Returns an action that moves the hand by an offset, (3,) m, keeps it upright and turns it."""
    rotation = scene.hand_rotation()
    outwards = (scene.hand_position() - scene.base_position())[:2]
    distance = np.linalg.norm(outwards)
    tilt = np.clip((distance - FAR) / TILT_LENGTH, 0, MAX_TILT)
    pointing = np.array([*(np.sin(tilt) * outwards / distance), -np.cos(tilt)])
    action = np.zeros(7, np.float32)
    action[:3] = np.clip(offset / 0.05, -slow, slow)
    turning = np.cross(rotation[:, 2], pointing) + [0, 0, turn(axis, rotation[:2, 0])]
    action[3:6] = np.clip(turning / 0.5, -1, 1)
    action[6] = gripper
    return action
