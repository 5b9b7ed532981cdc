"""The pictures, drawn without robosuite: the same, but for edges, at a third of the time."""

from __future__ import annotations

from typing import Any

import numpy as np

# LeRobot's names of the images, and LIBERO's of the cameras.
CAMERAS = {"image": "agentview", "image2": "robot0_eye_in_hand"}
SUPERSAMPLING = (
    2  # pixels drawn per pixel and axis, which replace the multisampling that takes longer in software
)
VISIBLE_GROUP = 1  # of MuJoCo's geoms; group 0 is what collides
HIDDEN_GROUP = 5


class Cameras:
    """Draws pictures of a scene.

    **Pictures are mirrored**, left and right exchanged, as in LeRobot's datasets of LIBERO: LeRobot turns by
    180 degrees what robosuite gives upside down.

    Args:
        model: Model of MuJoCo.
        size: Width and height of the pictures, pixels.

    Raises:
        RuntimeError: MuJoCo finds no way to draw.
    """

    def __init__(self, model: Any, size: int) -> None:
        import mujoco

        self.size = size
        self._model = model
        model.vis.quality.offsamples = 0
        side = SUPERSAMPLING * size
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, side)
        model.vis.global_.offheight = max(model.vis.global_.offheight, side)
        try:
            self._renderer = mujoco.Renderer(model, side, side)
        except Exception as error:
            raise RuntimeError(
                "MuJoCo cannot draw. Without a GPU, on Debian and Ubuntu: `apt-get install libegl1 "
                "libgl1-mesa-dri` for MUJOCO_GL=egl, or `apt-get install libosmesa6` for MUJOCO_GL=osmesa."
            ) from error
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = False
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[VISIBLE_GROUP] = 1
        self._options.sitegroup[:] = 0

    def draw(self, data: Any, name: str) -> np.ndarray:
        """Returns a picture: (size, size, 3), uint8.

        Args:
            data: Data of MuJoCo.
            name: Name of the image, of `CAMERAS`.
        """
        # MuJoCo sends all meshes to the renderer, also those behind the camera: 300,000 triangles.
        groups = self._model.geom_group.copy()
        self._model.geom_group[self._outside(data, name)] = HIDDEN_GROUP
        self._renderer.update_scene(data, camera=CAMERAS[name], scene_option=self._options)
        self._model.geom_group[:] = groups
        drawn = self._renderer.render()
        shape = (self.size, SUPERSAMPLING, self.size, SUPERSAMPLING, 3)
        upright = drawn.reshape(shape).mean((1, 3)).round().astype(np.uint8)
        return np.ascontiguousarray(upright[:, ::-1])

    def _outside(self, data: Any, name: str) -> np.ndarray:
        """Tells which geoms' bounding spheres are outside a camera's view: (number of geoms,), bool."""
        camera = data.camera(CAMERAS[name])
        # The camera looks along its negative third axis.
        points = (data.geom_xpos - camera.xpos) @ camera.xmat.reshape(3, 3)
        half = np.radians(self._model.cam_fovy[camera.id]) / 2
        # Signed distances from the four sides of the view, and from the plane of the camera.
        sides = [
            sign * points[:, i] * np.cos(half) + points[:, 2] * np.sin(half)
            for i in (0, 1)
            for sign in (1, -1)
        ]
        radius = self._model.geom_rbound
        return (np.max([*sides, points[:, 2]], axis=0) > radius) & (radius > 0)

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
        self._renderer.close()
