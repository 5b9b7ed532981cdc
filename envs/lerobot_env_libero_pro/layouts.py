"""Permuted layouts: the objects of a scene at random places, kept apart, for training or for evaluation."""

from __future__ import annotations

import numpy as np

from lerobot_env_libero_pro.scene import Scene
from lerobot_env_libero_pro.suites import base_suite

LAYOUTS = ("standard", "permuted")
# Layouts of one kind never occur in the other, whatever the seeds.
STREAMS = {"training": 0, "evaluation": 1}
# Where objects can be, m, of the suites whose tasks do not ask for a place by what stands beside it.
AREAS = {
    "libero_object": ((-0.25, 0.20), (-0.32, 0.06)),  # beside the basket, the palm would hit it
    "libero_goal": ((-0.24, 0.16), (-0.05, 0.28)),  # beside the drawers
}
# Circles that stay free, of fixtures: x, y and radius, m.
FIXTURES = {"libero_object": (), "libero_goal": ((-0.28, 0.20, 0.17),)}  # the stove
RECEPTACLE = "basket_1"
RECEPTACLE_AREA = ((-0.02, 0.02), (0.24, 0.28))
REACH = 0.80  # m from the robot's axis
GAP = 0.06  # m between two objects' outer circles, so that the hand fits between them


def permuted_poses(scene: Scene, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Returns new poses of all movable objects: positions and quaternions, (7,), by name.

    Objects keep their height and direction. A basket moves by 2 cm only.

    Args:
        scene: A scene after a reset.
        rng: Source of the places: `layout_rng`.

    Raises:
        ValueError: Tasks of the suite name places by what stands beside them.
    """
    base = base_suite(scene.task.suite)
    if base not in AREAS:
        raise ValueError(f"{scene.task.suite} has no permuted layouts. Suites that have: {', '.join(AREAS)}.")
    poses = {name: scene.pose(name) for name in scene.task.objects}
    names = [name for name in poses if name != RECEPTACLE]
    radii = np.array([_radius(scene, name) for name in names])
    apart = radii[:, None] + radii + GAP
    np.fill_diagonal(apart, 0)
    while True:
        places = rng.uniform(*np.transpose(AREAS[base]), (len(names), 2))
        is_apart = np.linalg.norm(places[:, None] - places, axis=2) >= apart
        is_near = np.linalg.norm(places - scene.base_position()[:2], axis=1) < REACH
        is_free = [
            np.linalg.norm(places - center, axis=1) >= radii + radius for *center, radius in FIXTURES[base]
        ]
        if is_apart.all() and is_near.all() and np.all(is_free):
            break
    if RECEPTACLE in poses:
        poses[RECEPTACLE][:2] = rng.uniform(*np.transpose(RECEPTACLE_AREA))
    for name, place in zip(names, places, strict=True):
        poses[name][:2] = place
    return poses


def layout_rng(stream: str, *seeds: int) -> np.random.Generator:
    """Returns the source of a layout's places.

    Args:
        stream: `training` or `evaluation`.
        *seeds: Non-negative integers that tell layouts of a stream apart.
    """
    return np.random.default_rng([STREAMS[stream], *seeds])


def _radius(scene: Scene, name: str) -> float:
    return float(np.linalg.norm((scene.vertices(name) - scene.position(name))[:, :2], axis=1).max())
