"""Whether low or high values close a gripper: objects move while it is closed, and rest while it is open.

The gripper trajectory alone often does not tell. One that is low, high, low, high, low may rest closed and
grasp in the middle, or rest open and grasp twice. So the images decide.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_deltaco.data.demonstrations import RobotData
from lerobot_deltaco.data.grasps import Grasp, find_grasps

logger = logging.getLogger(__name__)

_N_EPISODES = 16  # whose images are compared
_MIN_CHANGE, _MIN_DIFFERENCE = 0.3, 0.2  # as fractions of an episode's change
_MIN_CONTRAST = 8  # gray levels of 255; smaller changes are noise


def is_inverted(gripper: Tensor, data: RobotData) -> bool | None:
    """Returns whether greater commands close a gripper, rather than open it; None if it cannot be told.

    Args:
        gripper: Commands to the gripper in all frames, (frames,).
        data: The episodes, and their images.
    """
    readings = [find_grasps(commands, data.spans, states=data.states) for commands in (gripper, -gripper)]
    n_grasps, n_inverted = (sum(isinstance(grasp, Grasp) for grasp in reading) for reading in readings)
    if 2 * n_inverted < len(data.spans):
        return False if n_grasps > n_inverted else None
    if data.images is None:
        return None
    as_is, inverted = (_change_while_closed(data.images, data.spans, reading) for reading in readings)
    if max(as_is, inverted) < _MIN_CHANGE or abs(as_is - inverted) < _MIN_DIFFERENCE:
        return None
    return inverted > as_is


def _change_while_closed(
    images: Callable[[list[int]], Tensor], spans: Sequence[tuple[int, int]], grasps: Sequence[Grasp | str]
) -> float:
    """Returns how much of the change from first to last image happens between grasp and release.

    Returns:
        Median over some of the episodes, as a fraction; 0 if there are no grasps.
    """
    episodes = [(span, grasp) for span, grasp in zip(spans, grasps, strict=True) if isinstance(grasp, Grasp)]
    if not episodes:
        return 0.0
    shown = []
    for n in np.unique(np.linspace(0, len(episodes) - 1, min(_N_EPISODES, len(episodes))).astype(int)):
        (first, last), grasp = episodes[n]
        # The arm has begun to leave the object.
        after = min(grasp.opened + max(1, (last - first + 1) // 30), last)
        shown.append(images([first, grasp.closing, after, last]))
    start, *between, end = torch.stack(shown, dim=1).float()  # (episodes, 3, H, W) each
    change = _distance(start, end)
    # The arm itself changes the images of all episodes.
    change = change - change.mean(dim=0) if len(change) > 1 else change
    weight = torch.where(change >= _MIN_CONTRAST, change, 0.0)
    is_changed = [(_distance(image, end) < _distance(image, start)).float() for image in between]
    gained = ((is_changed[1] - is_changed[0]) * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp_min(1)
    return float(gained.median())


def _distance(images: Tensor, others: Tensor) -> Tensor:
    """Returns the mean difference of colors in images (n, 3, H, W), (n, H, W)."""
    return (images - others).abs().mean(dim=1)


def warn_if_inverted(gripper: Tensor, data: RobotData, closed: str) -> None:
    """Warns if the gripper closes where its commands are said to open it, or if that is open.

    Args:
        gripper: Commands to the gripper in all frames, said to be greater for more open, (frames,).
        data: The episodes, and their images.
        closed: The option `gripper_closed`, low or high.
    """
    other = "high" if closed == "low" else "low"
    inverted = is_inverted(gripper, data)
    if inverted:
        logger.warning(
            "In the images, objects move while the gripper's values are %s, so these close it. Set "
            "--policy.gripper_closed=%s.",
            other,
            other,
        )
    elif inverted is None and not any(
        isinstance(grasp, Grasp) for grasp in find_grasps(gripper, data.spans, states=data.states)
    ):
        logger.warning(
            "No episode has a grasp if %s values of the gripper mean closed (--policy.gripper_closed), and "
            "the images do not show whether they do. Look at a recording: if %s values mean closed, set "
            "--policy.gripper_closed=%s; otherwise, the gripper never closes and opens again.",
            closed,
            other,
            other,
        )
