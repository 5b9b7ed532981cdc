"""Names the failure of an episode: where between the first image and the success it ended.

Not found: the policy localized another object or container, since its location is nearer to that one. Thrown
off: the target lies outside of the tray, since closing fingers or a fast motion threw it. Missed: the target
was never held. Lost: it was held, and slipped out of the closed gripper. Not put down: it was still held at
the end. Put down beside: the gripper opened, and the target does not lie in its container.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import target_positions
from gym_deltaco.sim.workspace import TRAY_CENTER, TRAY_HALF_EXTENTS

NO_FAILURE = "none"
FAILURES = ("not found", "thrown off", "missed", "lost", "not put down", "put down beside")
_MM = 1000  # per m


class EpisodeMonitor:
    """Follows the target through an episode of an environment.

    Args:
        env: The environment after its reset.
    """

    def __init__(self, env: PickPlaceEnv) -> None:
        self._env, scene = env, env.scene
        self._target, self._container = scene.layout.target_object, scene.layout.target_container
        self._true_positions = target_positions(scene)
        self._objects = np.array([scene.object_pose(n).position[:2] for n in range(len(scene.bodies))])
        self._containers = np.array([item.quadrant.container_center for item in scene.layout.containers])
        self._is_held, self._opening = False, 1.0
        self._end = "missed"

    def step(self) -> None:
        """Notes what the gripper holds after a step."""
        was_held, last_opening = self._is_held, self._opening
        self._is_held = self._env.scene.is_grasped(self._target)
        self._opening = self._env.scene.arm.opening
        if self._is_held:
            self._end = "not put down"
        elif was_held:
            # A gripper from which an object has slipped closes further.
            self._end = "put down beside" if self._opening > last_opening else "lost"

    def failure(self, localized: NDArray[np.float64] | None) -> str:
        """Returns the name of the failure of an episode that did not succeed.

        Args:
            localized: Where the policy picks and places, (2, 3), m; None if it does not localize.
        """
        if localized is not None:
            picks, places = self._objects - localized[0, :2], self._containers - localized[1, :2]
            nearest = [int(np.linalg.norm(offsets, axis=1).argmin()) for offsets in (picks, places)]
            if nearest != [self._target, self._container]:
                return "not found"
        position = self._env.scene.object_pose(self._target).position[:2]
        is_off = (np.abs(position - TRAY_CENTER) > TRAY_HALF_EXTENTS).any()
        return "thrown off" if is_off and not self._is_held else self._end

    def errors(self, localized: NDArray[np.float64] | None) -> tuple[float, float]:
        """Returns how far the localized pick and place are from the true ones, mm; NaN if not localized.

        The error of the pick is that of the end effector's position. That of the place is horizontal, from
        the middle of the target container.
        """
        if localized is None:
            return np.nan, np.nan
        pick, place = _MM * (localized - self._true_positions)
        return float(np.linalg.norm(pick)), float(np.linalg.norm(place[:2]))
