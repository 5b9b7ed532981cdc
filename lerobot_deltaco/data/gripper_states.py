"""Which dimensions of a robot's state tell how far the gripper is open, by their names or by their motion.

At a grasp, the opening depends on the width of the object and says nothing about its location.

Names decide where there are any. Without names, a dimension is the gripper's if it changes when the gripper's
command does, and not otherwise. The level of a dimension is not compared with that of the command: an arm is
low whenever the gripper closes.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_deltaco.data.gripper_trajectories import gripper_trajectories

logger = logging.getLogger(__name__)

_GRIPPER_WORDS = ("gripper", "finger", "jaw")
_AXES = {"x", "y", "z", "rx", "ry", "rz", "qx", "qy", "qz", "qw", "roll", "pitch", "yaw"}
_NOT_POSITIONS = {
    "rot",
    "rotation",
    "axis",
    "angle",
    "euler",
    "quat",
    "quaternion",
    "vel",
    "velocity",
    "force",
}
_ARM_WORDS = (
    "joint",
    "shoulder",
    "elbow",
    "wrist",
    "waist",
    "arm",
    "base",
    "eef",
    "end_effector",
    "tcp",
    "pose",
)
_MIN_CORRELATION = 0.75  # between the changes of a gripper's state and those of its command
_UNRELATED_CORRELATION = 0.3  # below which a dimension does not follow the command
_MAX_LAG = 1 / 8  # of a state behind the command, as a fraction of an episode
_N_LAGS = 8  # lags that are compared, at most


class GripperStates(NamedTuple):
    """The dimensions of the state that tell how far the gripper is open.

    Attributes:
        is_gripper: Whether a dimension is one of them, (state,) bool.
        reason: How they were found, as a clause about them.
        doubts: What speaks against the decision, each a sentence; usually none.
    """

    is_gripper: Tensor
    reason: str
    doubts: tuple[str, ...]

    def warn(self) -> None:
        """Logs the doubts."""
        for doubt in self.doubts:
            logger.warning("%s See the gripper's state in `deltaco check`.", doubt)


def find_gripper_states(
    states: Tensor,
    gripper: Tensor,
    spans: Sequence[tuple[int, int]],
    names: Sequence[str] | None = None,
) -> GripperStates:
    """Finds the dimensions of the robot's state that tell how far the gripper is open.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, as for `find_grasps`, (frames,).
        spans: First and last frame of each episode.
        names: Name of each dimension of the state; None or empty if the dataset has none.
    """
    follows = _follows_command(states, gripper, spans)
    labels = list(names or map(str, range(len(follows))))
    named = np.array([_names_gripper(label) for label in labels])
    arm = np.array([_names_arm(label) for label in labels])
    doubts = []
    if named.any():
        chosen, reason = named, "by name"
        doubts += [
            f"`{labels[n]}` is named like the gripper, but does not follow its commands."
            for n in np.flatnonzero(named & (follows < _UNRELATED_CORRELATION))
        ]
    else:
        chosen = (follows > _MIN_CORRELATION) & ~arm
        reason = "since they change when the gripper's command does, and not otherwise"
        doubts += [
            f"`{labels[n]}` follows the gripper's commands, but is named like a part of the arm."
            for n in np.flatnonzero((follows > _MIN_CORRELATION) & arm)
        ]
    if not chosen.any():
        reason = "since none is named like the gripper or changes only with its command"
    return GripperStates(torch.from_numpy(chosen).to(states.device), reason, tuple(doubts))


def find_positions(names: Sequence[str]) -> list[int] | None:
    """Returns which dimensions are the hand's position along x, y and z, by names such as `x` and `ee.x`.

    None if no three dimensions, or more than these, are named so.

    Args:
        names: Name of each dimension of the state; empty if the dataset has none.
    """
    axes = [
        "" if _NOT_POSITIONS & (own := _tokens(name)) else "".join(own & {"x", "y", "z"}) for name in names
    ]
    if sorted(filter(None, axes)) != ["x", "y", "z"]:
        return None
    return [axes.index(axis) for axis in "xyz"]


def _names_gripper(name: str) -> bool:
    return any(word in name.lower() for word in _GRIPPER_WORDS) and not _tokens(name) & _AXES


def _names_arm(name: str) -> bool:
    return bool(_tokens(name) & _AXES) or any(word in name.lower() for word in _ARM_WORDS)


def _tokens(name: str) -> set[str]:
    return set(re.split(r"[^a-z0-9]+", name.lower()))


def _follows_command(
    states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]
) -> NDArray[np.float64]:
    """Returns the correlation of each dimension's changes with those of the command, (state,) in 0..1."""
    commands = gripper_trajectories(gripper, spans)
    values = states.cpu().double().numpy()
    longest = max(1, int(_MAX_LAG * np.median([len(command) for command in commands])))
    lags = np.unique(np.linspace(1, longest, min(longest, _N_LAGS)).astype(int))
    # A gripper takes time to close, so changes are taken over as long as the longest lag.
    given = [_changes(command, longest) for command in commands]
    moved = [_changes(values[first : last + 1], longest) for first, last in spans]
    best = np.zeros(values.shape[1])
    for lag in lags:
        command = np.concatenate([change[: max(0, len(change) - lag)] for change in given])
        state = np.concatenate([change[lag:] for change in moved])
        size = np.sqrt((state**2).sum(axis=0) * (command**2).sum())
        best = np.maximum(best, np.abs(command @ state) / np.maximum(size, 1e-12))
    return best


def _changes(values: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Returns how much values (frames, ...) change over some frames, as if they rested before and after."""
    padded = np.pad(values, [(frames, frames)] + [(0, 0)] * (values.ndim - 1), "edge")
    return padded[frames:] - padded[:-frames]
