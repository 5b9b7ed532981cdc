"""Keyframes of an episode: where the gripper closes around an object, and where it opens again."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

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
    """Finds the last closing of the gripper that is followed by an opening, and that opening.

    A gripper counts as closed where its command is below the middle of the commands' range. If an object
    slips and is grasped again, the last grasp counts.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
    """
    closed = _is_closed(gripper)
    found, frames = [], []
    for span in spans:
        opening = closing = _last_opening(closed, span)
        found.append(opening is not None)
        if opening is None or closing is None:
            frames.append((span[0], span[0], span[0]))
            continue
        while closing > span[0] and closed[closing - 1]:
            closing -= 1
        # One step later, the command to close has been carried out.
        frames.append((min(closing + 1, opening), opening, max(closing - _APPROACH_FRAMES, span[0])))
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


def release_frames(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> list[int | None]:
    """Returns the frame of each episode in which the gripper opens for the last time; None without any."""
    closed = _is_closed(gripper)
    return [_last_opening(closed, span) for span in spans]


def warn_if_inverted(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> None:
    """Warns if most episodes begin with a closed gripper: then grasps may be taken for releases.

    Args:
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
    """
    closed = _is_closed(gripper)
    n_closed = sum(closed[first] for first, _ in spans)
    if n_closed > len(spans) / 2:
        logger.warning(
            "The gripper is closed at the beginning of %d of %d episodes. If these values mean that it is "
            "open, grasps and releases are mistaken for each other: set --policy.gripper_closed to the other "
            "of low and high.",
            n_closed,
            len(spans),
        )


def follows_gripper(states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Returns which dimensions of the robot's state tell how far the gripper is open, (state,) bool.

    They are those that follow the gripper's commands, a step later.

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


def _is_closed(gripper: Tensor) -> list[bool]:
    return (gripper < (gripper.min() + gripper.max()) / 2).tolist()


def _last_opening(closed: Sequence[bool], span: tuple[int, int]) -> int | None:
    first, last = span
    for frame in range(last, first, -1):
        if closed[frame - 1] and not closed[frame]:
            return frame
    return None
