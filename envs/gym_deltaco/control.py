"""Controls of the arm, as data: names of states and actions, cameras and rates."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from gym_deltaco import CONTROL_FPS, EPISODE_STEPS

_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
# As LeRobot's robots name them
_JOINT_POSITIONS = [f"{name}.pos" for name in (*_JOINTS, "gripper")]


class Control(NamedTuple):
    """Interface of the environment under one control of the arm.

    Attributes:
        fps: Control steps per second; nominal with control "position".
        episode_length: Default number of steps of an episode.
        state_names: Names of the numbers of `agent_pos`.
        action_names: Names of the numbers of an action.
        cameras: Names of the cameras in `pixels`; empty if `pixels` is the front camera's image itself.
    """

    fps: int
    episode_length: int
    state_names: list[str]
    action_names: list[str]
    cameras: tuple[str, ...]

    @property
    def camera_keys(self) -> tuple[str, ...]:
        """Names of the cameras' images in datasets, as LeRobot derives them from `pixels`."""
        return tuple(f"observation.images.{name}" for name in self.cameras) or ("observation.image",)


CONTROLS = {
    "position": Control(
        CONTROL_FPS,
        EPISODE_STEPS,
        [*_JOINTS, "end_effector_x", "end_effector_y", "end_effector_z", "gripper_open"],
        ["delta_x", "delta_y", "delta_z", "gripper"],
        (),
    ),
    "joints": Control(30, 240, _JOINT_POSITIONS, _JOINT_POSITIONS, ("front", "wrist")),
}


def control_of(cameras: Iterable[str]) -> str | None:
    """Returns the control whose cameras are in a dataset; None if those of neither are.

    Args:
        cameras: Names of the dataset's images, such as "observation.images.front".
    """
    names = set(cameras)
    return next((name for name, control in CONTROLS.items() if names.issuperset(control.camera_keys)), None)
