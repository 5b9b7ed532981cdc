"""Out-of-distribution objects: random meshes that come with PyBullet, not designed for this benchmark.

`pybullet_data/random_urdfs` holds 1,000 random meshes of a few convex parts, each of one color. A mesh lies
on the tray with its longest side across the motion of the fingers and its shortest side upright, scaled to
the gripper. `out_of_distribution.json` lists the meshes that the scripted expert can pick and place;
`scripts/select_meshes.py` writes it.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np

from gym_deltaco.objects.labels import FIRST_MESH_INDEX, mesh_label
from gym_deltaco.objects.objects import ObjectModel
from gym_deltaco.objects.solids import Mesh
from gym_deltaco.sim.simulation import check_simulator

_WIDTH, _LENGTH = 0.044, 0.085  # m, largest size along the fingers' motion and across it
_MAX_YAW = 0.2  # rad
_PALM_DISTANCE = 0.035  # m, largest distance of an object's top above its grasp height


@cache
def mesh_model(index: int) -> ObjectModel:
    """Returns the model of a mesh; it is read on first use.

    Args:
        index: Index of the object, 20,000 + the number of the mesh.

    Raises:
        ImportError: PyBullet is not installed.
    """
    number = index - FIRST_MESH_INDEX
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
        label=mesh_label(number),
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
