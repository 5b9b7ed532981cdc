"""Geometry of any object, by its index."""

from __future__ import annotations

from gym_deltaco.objects.labels import FIRST_RANDOM_INDEX, is_mesh
from gym_deltaco.objects.objects import ObjectModel, object_model
from gym_deltaco.objects.out_of_distribution import mesh_model
from gym_deltaco.objects.random_objects import random_model


def find_model(index: int) -> ObjectModel:
    """Returns the geometry of an object.

    Args:
        index: Index of the object, as in `gym_deltaco.objects.labels`.

    Raises:
        ImportError: The object is one of PyBullet's meshes, and PyBullet is not installed.
    """
    if is_mesh(index):
        return mesh_model(index)
    return object_model(index) if index < FIRST_RANDOM_INDEX else random_model(index)
