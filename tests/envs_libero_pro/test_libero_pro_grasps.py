"""Grasps of the scripted expert, on objects made of boxes. Without the simulator."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("lerobot_env_libero_pro", reason="envs/lerobot_env_libero_pro is not on the path")
from lerobot_env_libero_pro.grasps import FAR, FINGERS, HIGHEST, OPENING, find_grasp

RADIUS, HEIGHT = 0.054, 0.05  # m
HAND_AXIS = np.array([0.0, 1.0])


def box(center, half_extents):
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    return np.array(center) + corners * half_extents


def bowl():
    """Parts of the wall of a round bowl around the origin."""
    angles = np.radians(np.arange(0, 360, 10))
    centers = np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), 0 * angles + HEIGHT / 2], 1)
    return [box(center, [0.002, 0.002, HEIGHT / 2]) for center in centers]


def wall(y):
    """Points of a wall along x, higher than a bowl."""
    x, z = np.meshgrid(np.arange(-0.2, 0.2, 0.01), np.arange(0, 2 * HEIGHT, 0.01))
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], 1)


class FakeScene:
    """A scene with one object, around the origin, and fixtures."""

    task = SimpleNamespace(objects=("object_1",))

    def __init__(self, solids, fixtures=(), base=(-0.6, 0, 0)):
        self.solids = lambda name: solids
        self.fixture_points = lambda: list(fixtures)
        self.base_position = lambda: np.array(base)


def test_a_narrow_object_is_grasped_across_its_narrow_side():
    grasp = find_grasp(FakeScene([box([0, 0, 0.05], [0.02, 0.06, 0.05])]), "object_1", HAND_AXIS)
    assert not grasp.is_at_rim
    assert abs(grasp.axis[0]) > 0.99
    assert np.allclose(grasp.point[:2], 0, atol=1e-3)


def test_a_bowl_is_grasped_high_at_its_rim_without_a_turn():
    grasp = find_grasp(FakeScene(bowl()), "object_1", HAND_AXIS)
    assert grasp.is_at_rim
    assert abs(grasp.axis[1]) > 0.99
    assert np.linalg.norm(grasp.point[:2]) == pytest.approx(RADIUS, abs=0.01)
    assert grasp.point[2] == pytest.approx(HEIGHT - HIGHEST)


def test_both_fingers_come_down_beside_the_walls_around_a_bowl():
    walls = [wall(0.085), wall(-0.085)]
    grasp = find_grasp(FakeScene(bowl(), walls), "object_1", HAND_AXIS)
    relative = np.concatenate(walls) - grasp.point
    along, beside = relative[:, :2] @ grasp.axis, relative[:, :2] @ [-grasp.axis[1], grasp.axis[0]]
    (inner, outer), half_width = FINGERS
    is_hit = (np.abs(along) >= inner) & (np.abs(along) < outer) & (np.abs(beside) < half_width)
    assert not is_hit.any()
    # The rim is between the open fingers.
    assert abs(np.linalg.norm(grasp.point[:2]) - RADIUS) < OPENING / 2


@pytest.mark.parametrize("side", [-1, 1])
def test_of_both_sides_of_a_bowl_far_out_the_near_one_is_grasped(side):
    scene = FakeScene(bowl(), base=(side * (FAR + 0.05), 0, 0))
    grasp = find_grasp(scene, "object_1", np.array([1.0, 0.0]))
    assert side * grasp.point[0] > 0.02
