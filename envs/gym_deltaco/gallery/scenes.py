"""Scenes of tasks, and what several figures need of the environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.layout import Ambiguity
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sheets import (
    GAP,
    across,
    caption,
    down,
    enlarged,
    framed,
    grid,
    save_png,
    to_image,
)
from gym_deltaco.simulation import camera_matrices
from gym_deltaco.workspace import CAMERA

POLICY_SIZE = 48  # px, height and width of the policy's image
PEOPLE_SIZE = 256  # px, height and width of images for people
_SCENE_ZOOM = 4


class Figure(NamedTuple):
    """An image of the page."""

    file: str
    title: str
    text: str


def draw_scenes(out: Path, seed: int, task_ids: Sequence[int], tick: Callable[[], object]) -> Figure:
    """A scene of each task."""
    cells = []
    with closing(make_env("container")) as env:
        for task_id in task_ids:
            observation, _ = env.reset(seed=scene_seed(seed, task_id), options={"task_id": task_id})
            small = enlarged(observation["pixels"], _SCENE_ZOOM)
            images = across([view_of(env), small], gap=4, align="end")
            instruction = caption(f"{task_id}: {env.task_description}", images.width, n_lines=2)
            cells.append(down([images, instruction], gap=4))
            tick()
    save_png(framed(grid(cells, n_columns=3), thickness=GAP), out / "scenes.png")
    text = (
        f"{len(task_ids)} of the 300 tasks: the start of an episode, with the task's number and instruction. "
        f"Left: for people. Right: the {POLICY_SIZE} x {POLICY_SIZE} pixels that a policy gets, enlarged."
    )
    return Figure("scenes.png", "Scenes", text)


def make_env(ambiguity: Ambiguity) -> PickPlaceEnv:
    """An environment whose images have the policy's size."""
    return PickPlaceEnv(ambiguity=ambiguity, image_size=POLICY_SIZE)


def view_of(env: PickPlaceEnv) -> Image.Image:
    """Image of the present scene, for people."""
    return to_image(env.scene.render(PEOPLE_SIZE))


def scene_seed(seed: int, task_id: int, number: int = 0) -> int:
    """Seed of a training scene: the figures show no scene of an evaluation."""
    return episode_seed(seed, "train", task_id, number)


def pixel_of(point: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Where the benchmark's camera sees a point of the world, (3,), m: (x, y) in an image of `size` px."""
    view, projection = (np.reshape(matrix, (4, 4)).T for matrix in camera_matrices(CAMERA))
    x, y, _, w = projection @ view @ [*point, 1.0]
    return np.array([1 + x / w, 1 - y / w]) * size / 2
