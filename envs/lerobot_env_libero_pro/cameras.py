"""The pictures, drawn without robosuite: without shadows and reflections, in a fraction of the time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

# LeRobot's names of the images, and LIBERO's of the cameras.
CAMERAS = {"image": "agentview", "image2": "robot0_eye_in_hand"}
# Pixels drawn per pixel and axis, which replace the multisampling that takes longer in software.
SUPERSAMPLING = 2
VISIBLE_GROUP = 1  # of MuJoCo's geoms; group 0 is what collides
HIDDEN_GROUP = 5
MAX_GEOMS = 1000  # in a picture
RESTING = 1e-5  # m by which a geom may move, and the entries of its rotation change, to count as resting
BACKGROUND_PICTURES = 20  # after which what has come to rest joins the background


@dataclass
class Background:
    """What rests in the pictures of a camera that rests.

    Attributes:
        geoms: Which geoms it shows, (geoms,) bool.
        poses: Poses of all geoms, (geoms, 12).
        color: Colors, (height, width, 3) uint8, from the lower left corner.
        depth: Depths, (height, width), 0 being far away.
        age: Number of pictures that it was used for.
    """

    geoms: np.ndarray
    poses: np.ndarray
    color: np.ndarray
    depth: np.ndarray
    age: int = 0


class Cameras:
    """Draws pictures of a scene.

    **Pictures are mirrored**, left and right exchanged, as in LeRobot's datasets of LIBERO: LeRobot turns by
    180 degrees what robosuite gives upside down.

    In software, a picture takes as long as its 300,000 triangles. So nothing is drawn that a camera does not
    see, and where a camera rests, what rests before it is drawn once and kept, with its depths.

    Args:
        model: Model of MuJoCo.
        size: Width and height of the pictures, pixels.

    Raises:
        RuntimeError: MuJoCo finds no way to draw.
    """

    def __init__(self, model: Any, size: int) -> None:
        import mujoco

        self.size = size
        self._mujoco, self._model = mujoco, model
        side = SUPERSAMPLING * size
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, side)
        model.vis.global_.offheight = max(model.vis.global_.offheight, side)
        try:
            self._window = mujoco.GLContext(side, side)
            self._window.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:
            raise RuntimeError(
                "MuJoCo cannot draw. Without a GPU, on Debian and Ubuntu: `apt-get install libegl1 "
                "libgl1-mesa-dri` for MUJOCO_GL=egl, or `apt-get install libosmesa6` for MUJOCO_GL=osmesa."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._frame = mujoco.MjrRect(0, 0, side, side)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[VISIBLE_GROUP] = 1
        self._options.sitegroup[:] = 0
        corners = np.array(list(itertools.product((-1, 1), repeat=3)))
        center, half = model.geom_aabb[:, None, :3], model.geom_aabb[:, None, 3:]
        self._corners = center + corners * half  # (geoms, 8, 3)
        self.restart()

    def restart(self) -> None:
        """Forgets earlier pictures, so that later ones do not depend on them."""
        self._views: dict[str, np.ndarray] = {}
        self._poses: dict[str, np.ndarray] = {}
        self._backgrounds: dict[str, Background] = {}

    def draw(self, data: Any, name: str) -> np.ndarray:
        """Returns a picture: (size, size, 3), uint8.

        Args:
            data: Data of MuJoCo.
            name: Name of the image, of `CAMERAS`.
        """
        camera = data.camera(CAMERAS[name])
        view = np.concatenate([camera.xpos, camera.xmat])
        poses = np.concatenate([data.geom_xpos, data.geom_xmat], axis=1)
        is_seen = self._is_seen(data, camera)
        if np.array_equal(view, self._views.get(name, ())):
            background = self._background(data, name, poses, is_seen)
            color, depth = self._render(data, name, is_seen & ~background.geoms)
            color = np.where((depth > background.depth)[..., None], color, background.color)
        else:
            color, _ = self._render(data, name, is_seen)
        self._views[name], self._poses[name] = view, poses
        shape = (self.size, SUPERSAMPLING, self.size, SUPERSAMPLING, 3)
        picture = color.reshape(shape).mean((1, 3), dtype=np.float32).round().astype(np.uint8)
        return np.ascontiguousarray(picture[::-1, ::-1])

    def _background(self, data: Any, name: str, poses: np.ndarray, is_seen: np.ndarray) -> Background:
        """Returns the background of a picture, drawn anew if a part of it has moved, or if it is old."""
        kept = self._backgrounds.get(name)
        if kept is None or kept.age >= BACKGROUND_PICTURES or _moves(poses, kept.poses)[kept.geoms].any():
            geoms = is_seen & ~_moves(poses, self._poses[name])
            kept = self._backgrounds[name] = Background(geoms, poses, *self._render(data, name, geoms))
        kept.age += 1
        return kept

    def _render(self, data: Any, name: str, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Draws some geoms: colors, (height, width, 3), and depths, (height, width), as in `Background`."""
        mujoco, model = self._mujoco, self._model
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = model.camera(CAMERAS[name]).id
        groups = model.geom_group.copy()
        model.geom_group[~geoms] = HIDDEN_GROUP
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._options, None, camera, everything, self._scene)
        model.geom_group[:] = groups
        side = SUPERSAMPLING * self.size
        color, depth = np.empty((side, side, 3), np.uint8), np.empty((side, side), np.float32)
        self._window.make_current()
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(color, depth, self._frame, self._context)
        return color, depth

    def _is_seen(self, data: Any, camera: Any) -> np.ndarray:
        """Tells which geoms' bounding boxes are not outside a camera's view: (geoms,), bool."""
        rotations = data.geom_xmat.reshape(-1, 3, 3)
        corners = data.geom_xpos[:, None] + self._corners @ rotations.transpose(0, 2, 1)
        # The camera looks along its negative third axis.
        x, y, z = np.moveaxis((corners - camera.xpos) @ camera.xmat.reshape(3, 3), -1, 0)  # (geoms, 8) each
        slope = np.tan(np.radians(self._model.cam_fovy[camera.id]) / 2)
        outside = [z > 0, *(sign * axis > -z * slope for axis in (x, y) for sign in (1, -1))]
        is_plane = self._model.geom_rbound == 0
        return is_plane | ~np.any([side.all(axis=1) for side in outside], axis=0)

    def pixels(self, data: Any, name: str, points: np.ndarray) -> np.ndarray:
        """Returns where points are in a picture: (n, 2), column and row, pixels from the upper left corner.

        Args:
            data: Data of MuJoCo.
            name: Name of the image, of `CAMERAS`.
            points: Points of the world, (n, 3), m.
        """
        camera = data.camera(CAMERAS[name])
        # The camera looks along its negative third axis.
        x, y, z = ((np.asarray(points) - camera.xpos) @ camera.xmat.reshape(3, 3)).T
        focal = 0.5 * self.size / np.tan(np.radians(self._model.cam_fovy[camera.id]) / 2)
        return np.stack([self.size / 2 + focal * x / z, self.size / 2 + focal * y / z], -1)

    def close(self) -> None:
        """Frees the renderer."""
        self._context.free()
        self._window.free()


def _moves(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Tells which geoms' poses differ: (geoms,), bool."""
    return np.abs(poses - others).max(axis=1) > RESTING
