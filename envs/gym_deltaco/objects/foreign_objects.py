"""Foreign objects: random meshes that come with PyBullet, which nobody designed for this benchmark.

`pybullet_data/random_urdfs` holds 1,000 random meshes of a few convex parts, each of one color. Here, a mesh
lies on the tray with its longest side across the fingers' motion and its shortest side upright, scaled to the
gripper. Only meshes 500 to 999 are used, and of these only those that the scripted expert manages:
`foreign_objects.json` lists them, and `python -m gym_deltaco.objects.foreign_objects` makes that file.
"""

from __future__ import annotations

import json
import re
import sys
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np

from gym_deltaco.atomic_files import write_text
from gym_deltaco.objects.objects import ObjectModel
from gym_deltaco.objects.solids import Mesh
from gym_deltaco.sim.simulation import check_simulator
from gym_deltaco.tasks import FIRST_FOREIGN_INDEX, FOREIGN_FILE, MESHES, ObjectLabel

_WIDTH, _LENGTH = 0.044, 0.085  # m, largest size along the fingers' motion and across it
_MAX_YAW = 0.2  # rad
_PALM_DISTANCE = 0.035  # m, largest distance of an object's top above its grasp height


def is_foreign(index: int) -> bool:
    """Returns whether the index of an object is that of a mesh."""
    return index - FIRST_FOREIGN_INDEX in MESHES


@cache
def foreign_label(index: int) -> ObjectLabel:
    """Returns the label of a mesh, whose name stands for a shape and a color that no other object has."""
    name = f"thing {index - FIRST_FOREIGN_INDEX}"
    return ObjectLabel(int(index), name, name, name)


@cache
def foreign_model(index: int) -> ObjectModel:
    """Returns the model of a mesh; it is read on first use.

    Raises:
        ImportError: PyBullet, with which the meshes come, is not installed.
    """
    number = index - FIRST_FOREIGN_INDEX
    folder = _folder() / f"{number:03d}"
    vertices, faces, parts = _read_obj((folder / f"{number:03d}.obj").read_text())
    sizes = np.ptp(vertices, axis=0)
    short, middle, long = np.argsort(sizes, kind="stable")
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = vertices[:, [middle, long, short]] * min(_WIDTH / sizes[middle], _LENGTH / sizes[long])
    if (middle, long, short) not in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        vertices *= (-1, 1, 1)  # so that it is rotated, not reflected
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    kept = areas[:, 0] > 0
    corners, normals = corners[kept], normals[kept] / areas[kept]
    rgba = re.search(r'rgba="([^"]+)"', (folder / f"{number:03d}.urdf").read_text())
    assert rgba is not None
    mesh = Mesh(
        corners.reshape(-1, 3),
        np.repeat(normals, 3, axis=0),
        np.arange(3 * len(corners)).reshape(-1, 3),
        np.tile([float(level) for level in rgba[1].split()[:3]], (len(corners), 1)),
    )
    height = float(np.ptp(vertices[:, 2]))
    return ObjectModel(
        label=foreign_label(index),
        mesh=mesh,
        parts=tuple(vertices[part] for part in parts),
        grasp_height=max(height / 2, height - _PALM_DISTANCE),
        yaw_range=(-_MAX_YAW, _MAX_YAW),
    )


def _folder() -> Path:
    check_simulator()
    import pybullet_data

    return Path(pybullet_data.getDataPath()) / "random_urdfs"


def _read_obj(text: str) -> tuple[np.ndarray, np.ndarray, list[slice]]:
    """Returns vertices (V, 3), faces (F, 3), and the vertices of each convex part."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    starts: list[int] = []
    for key, *values in filter(None, map(str.split, text.splitlines())):
        if key == "o":
            starts.append(len(vertices))
        elif key == "v":
            vertices.append([float(value) for value in values])
        elif key == "f":
            faces.append([int(value) - 1 for value in values])
    ends = [*starts[1:], len(vertices)]
    return np.array(vertices), np.array(faces), [slice(*ends) for ends in zip(starts, ends, strict=True)]


def main() -> None:
    """Lists the meshes that the expert manages, and writes `foreign_objects.json`.

    The expert has to succeed in three of three scenes, whose other two objects are any meshes.
    """
    from gym_deltaco.env import PickPlaceEnv
    from gym_deltaco.expert import expert_episode
    from gym_deltaco.scene_config import SceneConfig
    from gym_deltaco.seeding import episode_seed

    managed = []
    with closing(PickPlaceEnv(2000 + MESHES[0], SceneConfig(objects="foreign_unchecked"))) as env:
        for mesh in MESHES:
            # In the green, the front, and the left container
            tasks = (2000 + mesh, 4000 + mesh, 6000 + mesh)
            episodes = (expert_episode(env, task, episode_seed(0, "train", task, 0)) for task in tasks)
            if all(any(step.info["is_success"] for step in episode) for episode in episodes):
                managed.append(mesh)
    write_text(FOREIGN_FILE, json.dumps(managed) + "\n")
    sys.stdout.write(f"The expert manages {len(managed)} of {len(MESHES)} meshes.\n")


if __name__ == "__main__":
    main()
