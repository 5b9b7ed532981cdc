"""Pauses: stretches of an episode in which the robot stands still, as people let it when they hesitate.

A policy that sees only the present cannot tell how long a pause has lasted, so it would never end one.
Training leaves them out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.demonstrations import RobotData

_STILL = 0.05  # of the usual highest speed (the 95th percentile), below which the robot stands still
_KEPT_SECONDS = 0.1  # of each pause


def paused_frames(data: RobotData, fps: float) -> NDArray[np.bool_]:
    """Returns which frames continue a pause of more than 0.1 s, (frames,); never an end of an episode.

    Args:
        data: States and actions of all frames.
        fps: Frames per second.
    """
    states, actions = (values.double().cpu().numpy() for values in (data.states, data.actions))
    scale = np.quantile(states, 0.99, axis=0) - np.quantile(states, 0.01, axis=0)
    speed = (np.abs(np.diff(states, axis=0)) / scale.clip(1e-9)).max(axis=1, initial=0.0)
    scale = np.quantile(actions, 0.99, axis=0) - np.quantile(actions, 0.01, axis=0)
    change = (np.abs(np.diff(actions, axis=0)) / scale.clip(1e-9)).max(axis=1, initial=0.0)
    still = (speed < _STILL * np.quantile(speed, 0.95)) & (change < _STILL)
    paused = np.zeros(len(states), dtype=bool)
    n_kept = max(1, round(_KEPT_SECONDS * fps))
    for first, last in data.spans:
        run = 0
        for frame in range(first, last):
            run = run + 1 if still[frame] else 0
            paused[frame] = run > n_kept
    return paused
