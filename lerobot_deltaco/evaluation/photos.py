"""Photos of objects of the benchmark, in place of demonstrations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sim.simulation import camera_matrices
from gym_deltaco.sim.workspace import CAMERA
from lerobot_deltaco.data.object_prompts import ObjectPrompt


def image_locations(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Projects points of the world, (n, 3), m, into the benchmark's camera: (n, 2) in -1..1."""
    view, projection = (np.reshape(matrix, (4, 4)).T for matrix in camera_matrices(CAMERA))
    x, y, _, w = projection @ view @ np.column_stack([points, np.ones(len(points))]).T
    return np.column_stack([x, -y]) / w[:, None]


def take_photo(env: PickPlaceEnv, task_id: int, number: int, camera: str) -> ObjectPrompt:
    """Takes a photo of a task's object in a scene for validation, and points at the object's center.

    Args:
        env: The environment, which is reset.
        task_id: Index of the task.
        number: Number of the scene.
        camera: Camera of the photo, if the control has several.
    """
    seed = episode_seed(0, "validation", task_id, number)
    observation, _ = env.reset(seed=seed, options={"task_id": task_id})
    pixels = observation["pixels"]
    image = pixels[camera] if isinstance(pixels, Mapping) else pixels
    center = env.scene.object_pose(env.scene.layout.target_object).position
    x, y = ((image_locations(np.array(center)[None])[0] + 1) / 2).clip(0, 1).tolist()
    return ObjectPrompt((x, y, x, y), torch.from_numpy(np.array(image)).permute(2, 0, 1))
