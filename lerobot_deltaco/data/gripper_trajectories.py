"""Gripper trajectories: the commands to the gripper over each episode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

# Commands that mean close, stay, open, as LeRobot's gamepads and keyboards give them; and inverted.
_THREE_STATES = ({0.0, 1.0, 2.0}, {-1.0, 0.0, 1.0}, {-2.0, -1.0, 0.0})


def gripper_trajectories(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> list[NDArray[np.float64]]:
    """Returns the gripper trajectory of each episode: its commands, greater for more open, (frames,).

    Args:
        gripper: Commands to the gripper in all frames, greater for more open, (frames,). Of commands that
            mean close, stay and open (0, 1, 2 or -1, 0, 1), the last one before "stay" holds.
        spans: First and last frame of each episode.
    """
    commands = gripper.cpu().double().numpy()
    trajectories = [commands[first : last + 1] for first, last in spans]
    values = np.unique(np.concatenate(trajectories)) if trajectories else commands
    if set(values.tolist()) in _THREE_STATES:
        trajectories = [_held(trajectory, *values) for trajectory in trajectories]
    return trajectories


def _held(trajectory: NDArray[np.float64], closed: float, stay: float, opened: float) -> NDArray[np.float64]:
    """Returns a trajectory in which the last state holds while it should stay."""
    given = np.flatnonzero(trajectory != stay)
    if not len(given):
        return trajectory
    # Before the first command, the gripper is in the other state.
    before = closed if trajectory[given[0]] == opened else opened
    last = np.searchsorted(given, np.arange(len(trajectory)), side="right") - 1
    return np.where(last < 0, before, trajectory[given[np.maximum(last, 0)]])
