"""Grasps of episodes: where the gripper closes around an object, and where it opens again.

A grasp is a closed interval of the gripper trajectory between two openings, in which the arm travels. Each
episode is judged on its own, since a gripper may rest open or closed, and open by different amounts. A
gripper that rests closed at either end of an episode is no grasp; nor is a blip, in which it closes and opens
again while the arm stands still.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from lerobot_deltaco.data.gripper_states import find_gripper_states
from lerobot_deltaco.data.gripper_trajectories import gripper_trajectories

logger = logging.getLogger(__name__)

_GLITCH, _MAX_GLITCH = 30, 3  # frames at either side of a median: a 30th of the episode's, but no more
_OUTLIERS = 0.02  # fraction of an episode's frames at either end of the range that do not count
_MIN_RANGE = 0.2  # of an episode, as a fraction of the usual range: less is a tremble
_MIN_DEPTH = 0.15  # of a valley below the openings at its sides, as a fraction of the episode's range
_MIN_RELATIVE_DEPTH = 0.3  # the same, as a fraction of the deepest valley's depth
_NOISE = 4.0  # ranges of less than so many standard deviations are noise
_CLOSED = 0.2  # fraction of the way up from the valley to an opening below which the gripper counts as closed
_APPROACH = 0.15  # distance from the grasp at which the arm approaches it, of the farthest before it
_N_REASONS = 3  # that a warning names
# Travels of the arm, as fractions of the range of that dimension of the state which moves farthest.
_AT_REST = 0.03  # less is no travel
_MIN_CARRY = 0.1  # usual with a closed gripper
_TREMBLE = 5.0  # usual changes between two frames, beyond which a dimension of the state moves
_MIN_APPROACH = 0.05  # usual with an open gripper, on the way to an object and away from it
_MIN_RELATIVE_TRAVEL = 0.3  # of a grasp that counts, as a fraction of the farthest travel in the episode
_AT_HOME = 0.15  # distance from the first state of the episode within which the arm has returned to it
_RANGE_QUANTILE = 0.01  # of a dimension's values at either end that do not count for its range
_MIN_STATE_RANGE = 0.25  # of a dimension, as a fraction of the median of all


class Grasp(NamedTuple):
    """Frames of a grasp.

    Attributes:
        closing: The last one before it in which the gripper is more than half open.
        grasp: The first one in which it has closed.
        release: The first one in which it is no longer closed.
        opened: The first one in which it has opened again.
    """

    closing: int
    grasp: int
    release: int
    opened: int


class _ClosedInterval(NamedTuple):
    """A grasp, or a blip of the gripper: the frames from which it was open before, and until which after."""

    grasp: Grasp
    open_since: int
    open_until: int


class GraspStates(NamedTuple):
    """The robot's states at the grasps of episodes.

    Attributes:
        states: States in which the gripper has closed and is about to open, (episodes, 2, state), as in the
            dataset. Zeros where there are none.
        approach: States on the way to where the gripper closes, (episodes, state).
        carried: Frames halfway between grasp and release, (episodes,); the first of an episode without them.
        has_grasp: Whether an episode has them, (episodes,) bool.
        missing: Why an episode has none; None if it has them.
    """

    states: Tensor
    approach: Tensor
    carried: Tensor
    has_grasp: Tensor
    missing: tuple[str | None, ...]

    def to(self, device: torch.device) -> GraspStates:
        """Returns the grasps on a device."""
        return GraspStates(
            self.states.to(device),
            self.approach.to(device),
            self.carried.to(device),
            self.has_grasp.to(device),
            self.missing,
        )

    @property
    def pick_states(self) -> Tensor:
        """The states in which the gripper has closed, (episodes, state); NaN where there are none."""
        return torch.where(self.has_grasp[:, None], self.states[:, 0], torch.nan)


def find_grasp_states(
    states: Tensor,
    gripper: Tensor,
    spans: Sequence[tuple[int, int]],
    usual: float | None = None,
) -> GraspStates:
    """Finds the states of the robot at the grasp and the release of episodes; see `find_grasps`.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
        usual: As for `find_grasps`.
    """
    grasps, frames = find_grasps(gripper, spans, usual, states), []
    # A dimension that trembles counts little.
    tremble = states.float().diff(dim=0).abs().median(dim=0).values
    scale = (states.float().std(dim=0) + _TREMBLE * tremble).clamp_min(1e-6)
    for (first, _), grasp in zip(spans, grasps, strict=True):
        if isinstance(grasp, str):
            frames.append((first,) * 4)
            continue
        approach = _last_far(states[first : grasp.closing + 1] / scale) + first
        # The command to close takes effect one step later.
        closed = min(grasp.grasp + 1, grasp.release)
        frames.append((closed, grasp.release, approach, (closed + grasp.release) // 2))
    has_grasp = torch.tensor([isinstance(grasp, Grasp) for grasp in grasps], device=states.device)
    rows = torch.tensor(frames, device=states.device)
    at = states[rows[:, :3]].float()  # (episodes, 3, state)
    at = torch.where(has_grasp[:, None, None], at, 0.0)
    missing = tuple(grasp if isinstance(grasp, str) else None for grasp in grasps)
    return GraspStates(at[:, :2], at[:, 2], rows[:, 3], has_grasp, missing)


def _last_far(states: Tensor) -> int:
    """Returns the last frame of an approach (frames, state) in which the arm is still on its way."""
    distance = (states - states[-1]).norm(dim=1)
    return int((distance >= _APPROACH * distance.max()).nonzero()[-1])


def warn_of_missing(grasps: GraspStates, episodes: Sequence[int], consequence: str) -> None:
    """Warns of episodes without a grasp.

    Args:
        grasps: Grasps of the episodes.
        episodes: Index of each episode.
        consequence: What becomes of them, as the end of a sentence about them.
    """
    example: dict[str, int] = {}
    for reason, episode in zip(grasps.missing, episodes, strict=True):
        if reason is not None:
            example.setdefault(reason, episode)
    if example:
        counts = Counter(reason for reason in grasps.missing if reason is not None)
        logger.warning(
            "%d of %d episodes have no grasp, and %s: %s.",
            counts.total(),
            len(episodes),
            consequence,
            "; ".join(
                f"in {count}, such as episode {example[reason]}, {reason}"
                for reason, count in counts.most_common(_N_REASONS)
            ),
        )


def find_grasps(
    gripper: Tensor,
    spans: Sequence[tuple[int, int]],
    usual: float | None = None,
    states: Tensor | None = None,
) -> list[Grasp | str]:
    """Finds the grasp of each episode that carried the object to its goal.

    Of several grasps that the arm travels with, the last one counts, since an object may slip.

    Args:
        gripper: Commands to the gripper in all frames, as for `gripper_trajectories`, (frames,).
        spans: First and last frame of each episode.
        usual: Range of the commands in a usual episode, of which a fifth is needed for a grasp; by default,
            the median of these episodes.
        states: Robot states of all frames, (frames, state), which tell whether the arm travels with a grasp;
            without them, the last grasp that is released counts.

    Returns:
        The grasp of each episode, or the reason why there is none.
    """
    trajectories = gripper_trajectories(gripper, spans)
    smooth = [_without_outliers(trajectory) for trajectory in trajectories]
    ranges = [float(np.ptp(trajectory)) for trajectory in smooth]
    if usual is None:
        usual = float(np.nanmedian(ranges)) if np.isfinite(ranges).any() else 0.0
    arm = None if states is None else _arm_positions(states, gripper, spans)
    grasps: list[Grasp | str] = []
    for (first, last), raw, trajectory, size in zip(spans, trajectories, smooth, ranges, strict=True):
        intervals = _closed_intervals(raw, trajectory, size, usual)
        if isinstance(intervals, str):
            grasps.append(intervals)
            continue
        grasp = intervals[-1].grasp if arm is None else _carrying(intervals, arm[first : last + 1])
        grasps.append(grasp if isinstance(grasp, str) else Grasp(*(first + frame for frame in grasp)))
    return grasps


def _arm_positions(
    states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]
) -> NDArray[np.float64] | None:
    """Returns the states without the gripper's opening, (frames, dims) in units of each dimension's range.

    None if no dimension moves.
    """
    is_arm = ~find_gripper_states(states, gripper, spans).is_gripper.cpu()
    values = states.cpu().double()[:, is_arm].numpy()
    ends = [_RANGE_QUANTILE, 1 - _RANGE_QUANTILE]
    ranges = np.diff(np.quantile(values, ends, axis=0), axis=0)[0] if values.size else np.zeros(1)
    if not ranges.any():
        return None
    return values / np.maximum(ranges, _MIN_STATE_RANGE * np.median(ranges[ranges > 0]))


def _carrying(intervals: Sequence[_ClosedInterval], arm: NDArray[np.float64]) -> Grasp | str:
    """Returns the grasp of an episode that carried the object to its goal, or why there is none.

    Args:
        intervals: In the order of time, with frames of the episode.
        arm: Positions of the arm in the episode, from `_arm_positions`.
    """

    def travel(first: int, last: int) -> float:
        return float(np.abs(arm[first : last + 1] - arm[first]).max())

    distances = np.array([travel(grasp.grasp, grasp.release) for grasp, *_ in intervals])
    if distances.max() < _AT_REST:
        return "the arm stands still while the gripper is closed"
    (moving,) = np.nonzero(distances >= min(_MIN_CARRY, distances.max()))
    grasps, distances = [intervals[n].grasp for n in moving], distances[moving]
    # An arm comes to an object and leaves it with an open gripper. One that opens at rest releases nothing.
    opens = [(one.opened, max(one.opened, two.closing)) for one, two in pairwise(grasps)]
    opens = [
        (intervals[0].open_since, grasps[0].closing),
        *opens,
        (grasps[-1].opened, intervals[-1].open_until),
    ]
    comes = [
        first == 0 or last == len(arm) - 1 or travel(first, last) >= _MIN_APPROACH for first, last in opens
    ]
    is_grasp = np.array(comes[:-1]) & np.array(comes[1:])
    # A gripper that closes after the release and opens at home has put nothing down there.
    is_away = np.array([np.abs(arm[grasp.release] - arm[0]).max() >= _AT_HOME for grasp in grasps])
    for counts in (is_grasp & is_away, is_away, is_grasp, distances > 0):
        counts = counts & (distances >= _MIN_RELATIVE_TRAVEL * distances.max())
        if counts.any():
            break
    return grasps[np.flatnonzero(counts)[-1]]


def _without_outliers(trajectory: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a trajectory without glitches of a few frames, and without the extremes of its range."""
    if len(np.unique(trajectory)) > 2:  # binary commands have no glitches
        reach = min(max(1, len(trajectory) // _GLITCH), _MAX_GLITCH)
        trajectory = np.median(sliding_window_view(np.pad(trajectory, reach, "edge"), 2 * reach + 1), axis=1)
    return np.clip(trajectory, *np.quantile(trajectory, [_OUTLIERS, 1 - _OUTLIERS]))


def _closed_intervals(
    raw: NDArray[np.float64], trajectory: NDArray[np.float64], size: float, usual: float
) -> list[_ClosedInterval] | str:
    """Returns the closed intervals of an episode between openings, in order, or why there are none.

    Args:
        raw: The gripper trajectory as recorded.
        trajectory: The trajectory without outliers.
        size: Its range.
        usual: Range of the usual episode.
    """
    if not np.isfinite(raw).all():
        return f"the gripper's command is not finite in frame {int(np.argmin(np.isfinite(raw)))}"
    if size == 0:
        return "the gripper does not move"
    is_binary = len(np.unique(raw)) <= 2
    noise = 0.0 if is_binary else 1.48 * float(np.median(np.abs(np.diff(raw)))) / np.sqrt(2)
    if size <= max(_MIN_RANGE * usual, _NOISE * noise):
        return "the gripper only trembles"
    ends = np.maximum.accumulate(trajectory), np.maximum.accumulate(trajectory[::-1])[::-1]
    depth_below = float((np.minimum(*ends) - trajectory).max())
    depth = max(_MIN_DEPTH * size, _MIN_RELATIVE_DEPTH * depth_below, _NOISE * noise)
    # Backwards: from an opening down into a valley, and up to the opening before it.
    intervals: list[_ClosedInterval] = []
    after, bottom, level = trajectory[-1], 0, None
    for frame in range(len(trajectory) - 1, -1, -1):
        if level is None:
            after = max(after, trajectory[frame])
            if after - trajectory[frame] >= depth:
                level, bottom = trajectory[frame], frame
        elif trajectory[frame] < level:
            level, bottom = trajectory[frame], frame
        elif trajectory[frame] - level >= depth:
            intervals.append(_interval_at(trajectory, frame, bottom, depth))
            after, level = trajectory[frame], None
    return intervals[::-1] or _why_not_closed(trajectory, depth)


def _interval_at(trajectory: NDArray[np.float64], frame: int, bottom: int, depth: float) -> _ClosedInterval:
    """Returns the closed interval around the lowest point of a valley.

    Args:
        trajectory: The gripper trajectory of an episode.
        frame: The last frame before the valley in which the gripper is open.
        bottom: The frame in which it is closed farthest.
        depth: How far it is open at least, above that.
    """
    level = trajectory[bottom]
    before = _opening(trajectory[frame::-1], level + depth / 2)
    # The opening that ends the valley need not be the last one.
    rise = bottom + int(np.argmax(trajectory[bottom:] - level >= depth))
    after = _opening(trajectory[rise:], level + depth / 2)
    grasp = frame + int(np.argmax(trajectory[frame:] <= level + _CLOSED * (before - level)))
    closing = np.flatnonzero(trajectory[:grasp] > (level + before) / 2)[-1]
    is_closed = trajectory[: rise + 1] <= level + _CLOSED * (after - level)
    release = int(np.flatnonzero(is_closed)[-1]) + 1
    opened = release + int(np.argmax(trajectory[release:] >= after - _CLOSED * (after - level)))
    was_closed = np.flatnonzero(trajectory[:closing] <= (level + before) / 2)
    closes = np.flatnonzero(trajectory[opened:] <= (level + after) / 2)
    return _ClosedInterval(
        Grasp(int(closing), grasp, release, opened),
        int(was_closed[-1]) + 1 if len(was_closed) else 0,
        opened + int(closes[0]) - 1 if len(closes) else len(trajectory) - 1,
    )


def _why_not_closed(trajectory: NDArray[np.float64], depth: float) -> str:
    """Returns why a trajectory that moves has no valley between two openings."""
    opens, closes = (trajectory.max() - end >= depth for end in (trajectory[0], trajectory[-1]))
    if opens and closes:
        return "the gripper opens and closes, but does not open again"
    return "the gripper opens, but does not close before" if opens else "the gripper does not open again"


def _opening(trajectory: NDArray[np.float64], least: float) -> float:
    """Returns the greatest value before a trajectory falls to a level for the first time."""
    ends = np.flatnonzero(trajectory <= least)
    return float(trajectory[: ends[0] if len(ends) else None].max())
