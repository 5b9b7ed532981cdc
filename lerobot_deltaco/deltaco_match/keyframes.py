"""Keyframes of an episode: where the gripper closes around an object, and where it opens again.

The gripper's commands over an episode are its course. Each episode is judged on its own, since a gripper may
rest open or closed, and open by different amounts. A grasp is a valley of the course between two openings; a
gripper that rests closed at either end is not a grasp.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

logger = logging.getLogger(__name__)

_OUTLIERS = 0.02  # fraction of an episode's frames at either end of the range that do not count
_MIN_RANGE = 0.2  # of an episode, as a fraction of the usual range: less is a tremble
_MIN_DEPTH = 0.25  # of a valley below the openings at its sides, as a fraction of the episode's range
_CLOSED = 0.2  # fraction of the way up from the valley to an opening below which the gripper counts as closed
_APPROACH_FRAMES = 2  # before the gripper closes
_GRIPPER_CORRELATION = 0.8  # of a state with the gripper's command, above which it is the gripper's


class Keyframes(NamedTuple):
    """The robot's states at the keyframes of episodes.

    Attributes:
        states: States in which the gripper has closed and is about to open, (episodes, 2, state), as in the
            dataset. Zeros where there are none.
        approach: States shortly before the gripper closes, (episodes, state).
        found: Whether an episode has them, (episodes,) bool.
    """

    states: Tensor
    approach: Tensor
    found: Tensor

    @property
    def pick_states(self) -> Tensor:
        """The states in which the gripper has closed, (episodes, state); NaN where there are none."""
        return torch.where(self.found[:, None], self.states[:, 0], torch.nan)


def find_keyframes(states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]) -> Keyframes:
    """Finds the grasp and the release of episodes. If an object slips, the last grasp counts.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
    """
    found, frames = [], []
    for (first, _), keyframes in zip(spans, grasp_frames(gripper, spans), strict=True):
        found.append(keyframes is not None)
        grasp, release = (first, first) if keyframes is None else keyframes
        # The command to close takes effect one step later.
        frames.append((min(grasp + 1, release), release, max(grasp - _APPROACH_FRAMES, first)))
    if not all(found):
        logger.warning(
            "The gripper does not close and open again in %d of %d episodes; they are not trained on.",
            found.count(False),
            len(found),
        )
    is_found = torch.tensor(found, device=states.device)
    at = states[torch.tensor(frames, device=states.device)].float()  # (episodes, 3, state)
    at = torch.where(is_found[:, None, None], at, 0.0)
    return Keyframes(at[:, :2], at[:, 2], is_found)


def grasp_frames(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> list[tuple[int, int] | None]:
    """Finds the frames in which the gripper has closed around an object, and in which it opens again.

    Args:
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.

    Returns:
        Frame of the grasp and of the release of each episode; None where there is no grasp.
    """
    commands = gripper.cpu().double().numpy()
    courses = [commands[first : last + 1] for first, last in spans]
    ranges = [np.diff(np.quantile(course, [_OUTLIERS, 1 - _OUTLIERS])).item() for course in courses]
    usual = float(np.median(ranges))
    found = [
        _last_valley(course) if size > _MIN_RANGE * usual else None
        for course, size in zip(courses, ranges, strict=True)
    ]
    return [
        None if valley is None else (first + valley[0], first + valley[1])
        for (first, _), valley in zip(spans, found, strict=True)
    ]


def _last_valley(course: NDArray[np.float64]) -> tuple[int, int] | None:
    """Returns the first frame of the last valley between two openings, and the first frame after it."""
    low, high = np.quantile(course, [_OUTLIERS, 1 - _OUTLIERS])
    course, depth = np.clip(course, low, high), _MIN_DEPTH * (high - low)
    # Backwards: from the last opening down into the valley, and up to the opening before it.
    after, bottom, level = course[-1], 0, None
    for frame in range(len(course) - 1, -1, -1):
        if level is None and course[frame] > after:
            after = course[frame]
        elif (level is None and after - course[frame] >= depth > 0) or (
            level is not None and course[frame] < level
        ):
            level, bottom = course[frame], frame
        elif level is not None and course[frame] - level >= depth:
            break
    else:
        return None
    before = _opening(course[frame::-1], level + depth / 2)
    # The opening that ends the valley need not be the last one.
    rise = bottom + int(np.argmax(course[bottom:] - level >= depth))
    after = _opening(course[rise:], level + depth / 2)
    grasp = frame + int(np.argmax(course[frame:] <= level + _CLOSED * (before - level)))
    is_closed = course[: rise + 1] <= level + _CLOSED * (after - level)
    return grasp, int(np.flatnonzero(is_closed)[-1]) + 1


def _opening(course: NDArray[np.float64], least: float) -> float:
    """Returns the greatest value before a course falls to a level for the first time."""
    ends = np.flatnonzero(course <= least)
    return float(course[: ends[0] if len(ends) else None].max())


def warn_if_inverted(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> None:
    """Warns if more episodes have a grasp when low and high are swapped.

    Args:
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
    """
    n_found = sum(found is not None for found in grasp_frames(gripper, spans))
    n_inverted = sum(found is not None for found in grasp_frames(-gripper, spans))
    if n_inverted > n_found:
        logger.warning(
            "%d of %d episodes have a grasp, and %d would have one if the gripper's values meant the "
            "opposite. Then set --policy.gripper_closed to the other of low and high.",
            n_found,
            len(spans),
            n_inverted,
        )


def follows_gripper(states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Returns which dimensions of the robot's state tell how far the gripper is open, (state,) bool.

    These are the dimensions that follow the gripper's commands one step later.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, (frames,).
        spans: First and last frame of each episode.
    """
    frames = torch.cat([torch.arange(first, last) for first, last in spans]).to(states.device)
    after, command = states[frames + 1].double(), gripper[frames].double()[:, None]
    after, command = after - after.mean(dim=0), command - command.mean()
    covariance = (after * command).mean(dim=0)
    scale = after.square().mean(dim=0).sqrt() * command.square().mean().sqrt()
    return covariance.abs() > _GRIPPER_CORRELATION * scale.clamp_min(1e-12)
