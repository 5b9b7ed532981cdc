"""Pauses: stretches of an episode in which the robot stands still, as people let it when they hesitate.

A policy that sees only the present cannot tell how long a pause has lasted, so it would never end one.
Training leaves them out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lerobot_deltaco.data.demonstrations import RobotData

_STILL = 0.1  # of the usual highest speed (the 95th percentile), below which the robot stands still
_REACH = 0.1  # s, before and after a frame, over which its speed is measured
_KEPT = 0.1  # s, of each pause
_MIN_RANGE = 0.1  # of a dimension, as a fraction of the median of all; others only tremble


def paused_frames(data: RobotData, fps: float) -> NDArray[np.bool_]:
    """Returns which frames continue a pause of more than 0.1 s, (frames,); never an end of an episode.

    Args:
        data: States and actions of all frames.
        fps: Frames per second.
    """
    reach = max(1, round(_REACH * fps))
    still = _is_still(data.states, data.spans, reach) & _is_still(data.actions, data.spans, reach)
    paused, n_kept = np.zeros(len(still), dtype=bool), max(1, round(_KEPT * fps))
    for first, last in data.spans:
        run = 0
        for frame in range(first, last):
            run = run + 1 if still[frame] else 0
            paused[frame] = run > n_kept
    return paused


def _is_still(values: Tensor, spans: Sequence[tuple[int, int]], reach: int) -> NDArray[np.bool_]:
    """Returns in which frames values (frames, dimensions) hardly change, (frames,)."""
    array = values.double().cpu().numpy()
    ranges = np.quantile(array, 0.99, axis=0) - np.quantile(array, 0.01, axis=0)
    array = array / np.maximum(ranges, _MIN_RANGE * np.median(ranges)).clip(1e-9)
    speed = np.zeros(len(array))
    for first, last in spans:
        frames = np.arange(first, last + 1)
        before, after = array[np.maximum(frames - reach, first)], array[np.minimum(frames + reach, last)]
        speed[frames] = np.abs(after - before).max(axis=1)
    return speed <= _STILL * np.quantile(speed, 0.95)
