"""Keyframes of an episode: where the gripper closes around an object, and where it opens again.

The gripper's commands over an episode are its course. Each episode is judged on its own, since a gripper may
rest open or closed, and open by different amounts. A grasp is a valley of the course between two openings; a
gripper that rests closed at either end is not a grasp.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

logger = logging.getLogger(__name__)

_GLITCH, _MAX_GLITCH = 30, 3  # frames at either side of a median: a 30th of the episode's, but no more
_OUTLIERS = 0.02  # fraction of an episode's frames at either end of the range that do not count
_MIN_RANGE = 0.2  # of an episode, as a fraction of the usual range: less is a tremble
_MIN_DEPTH = 0.15  # of a valley below the openings at its sides, as a fraction of the episode's range
_MIN_RELATIVE_DEPTH = 0.3  # the same, as a fraction of the deepest valley's depth
_NOISE = 4.0  # ranges of less than so many standard deviations are noise
_CLOSED = 0.2  # fraction of the way up from the valley to an opening below which the gripper counts as closed
_APPROACH = 30  # the state before a grasp is a 30th of the episode before the gripper begins to close
_N_REASONS = 3  # that a warning names
_GRIPPER_CORRELATION = 0.8  # of a state with the gripper's command, above which it is the gripper's
_MAX_LAG = 8  # of such a state behind the command: an eighth of an episode
_N_LAGS = 8  # that are tried, at most
# Commands that mean close, stay, open, as LeRobot's gamepads and keyboards give them; and inverted.
_THREE_STATES = ({0.0, 1.0, 2.0}, {-1.0, 0.0, 1.0}, {-2.0, -1.0, 0.0})


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


class Keyframes(NamedTuple):
    """The robot's states at the keyframes of episodes.

    Attributes:
        states: States in which the gripper has closed and is about to open, (episodes, 2, state), as in the
            dataset. Zeros where there are none.
        approach: States shortly before the gripper closes, (episodes, state).
        carried: Frames halfway between grasp and release, (episodes,); the first of an episode without them.
        has_grasp: Whether an episode has them, (episodes,) bool.
        missing: Why an episode has none; None if it has them.
    """

    states: Tensor
    approach: Tensor
    carried: Tensor
    has_grasp: Tensor
    missing: tuple[str | None, ...]

    def to(self, device: torch.device) -> Keyframes:
        """Returns the keyframes on a device."""
        return Keyframes(
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


def find_keyframes(
    states: Tensor,
    gripper: Tensor,
    spans: Sequence[tuple[int, int]],
    usual: float | None = None,
) -> Keyframes:
    """Finds the grasp and the release of episodes. If an object slips, the last grasp counts.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.
        usual: As for `find_grasps`.
    """
    grasps, frames = find_grasps(gripper, spans, usual), []
    for (first, last), grasp in zip(spans, grasps, strict=True):
        if isinstance(grasp, str):
            frames.append((first,) * 4)
            continue
        approach = max(grasp.closing - max(1, (last - first + 1) // _APPROACH), first)
        # The command to close takes effect one step later.
        closed = min(grasp.grasp + 1, grasp.release)
        frames.append((closed, grasp.release, approach, (closed + grasp.release) // 2))
    has_grasp = torch.tensor([isinstance(grasp, Grasp) for grasp in grasps], device=states.device)
    rows = torch.tensor(frames, device=states.device)
    at = states[rows[:, :3]].float()  # (episodes, 3, state)
    at = torch.where(has_grasp[:, None, None], at, 0.0)
    missing = tuple(grasp if isinstance(grasp, str) else None for grasp in grasps)
    return Keyframes(at[:, :2], at[:, 2], rows[:, 3], has_grasp, missing)


def warn_of_missing(keyframes: Keyframes, episodes: Sequence[int], consequence: str) -> None:
    """Warns of episodes without a grasp.

    Args:
        keyframes: Keyframes of the episodes.
        episodes: Index of each episode.
        consequence: What becomes of them, as the end of a sentence about them.
    """
    example: dict[str, int] = {}
    for reason, episode in zip(keyframes.missing, episodes, strict=True):
        if reason is not None:
            example.setdefault(reason, episode)
    if example:
        counts = Counter(reason for reason in keyframes.missing if reason is not None)
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
    gripper: Tensor, spans: Sequence[tuple[int, int]], usual: float | None = None
) -> list[Grasp | str]:
    """Finds the last grasp of each episode that is released.

    Args:
        gripper: Commands to the gripper in all frames, greater for more open, (frames,). Of commands that
            mean close, stay and open (0, 1, 2 or -1, 0, 1), the last one before "stay" holds.
        spans: First and last frame of each episode.
        usual: Range of the commands in a usual episode, of which a fifth is needed for a grasp; by default,
            the median of these episodes.

    Returns:
        The grasp of each episode, or the reason why there is none.
    """
    courses = _courses(gripper, spans)
    smooth = [_without_outliers(course) for course in courses]
    ranges = [float(np.ptp(course)) for course in smooth]
    if usual is None:
        usual = float(np.nanmedian(ranges)) if np.isfinite(ranges).any() else 0.0
    grasps: list[Grasp | str] = []
    for (first, _), raw, course, size in zip(spans, courses, smooth, ranges, strict=True):
        grasp = _last_valley(raw, course, size, usual)
        grasps.append(grasp if isinstance(grasp, str) else Grasp(*(first + frame for frame in grasp)))
    return grasps


def _courses(gripper: Tensor, spans: Sequence[tuple[int, int]]) -> list[NDArray[np.float64]]:
    """Returns the course of each episode; commands to stay are replaced by the last state."""
    commands = gripper.cpu().double().numpy()
    courses = [commands[first : last + 1] for first, last in spans]
    values = np.unique(np.concatenate(courses)) if courses else commands
    if set(values.tolist()) in _THREE_STATES:
        courses = [_held(course, *values) for course in courses]
    return courses


def _held(course: NDArray[np.float64], closed: float, stay: float, opened: float) -> NDArray[np.float64]:
    """Returns a course in which the last state holds while it should stay."""
    given = np.flatnonzero(course != stay)
    if not len(given):
        return course
    # Before the first command, the gripper is in the other state.
    before = closed if course[given[0]] == opened else opened
    last = np.searchsorted(given, np.arange(len(course)), side="right") - 1
    return np.where(last < 0, before, course[given[np.maximum(last, 0)]])


def _without_outliers(course: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a course without glitches of a few frames, and without the extremes of its range."""
    if len(np.unique(course)) > 2:  # binary commands have no glitches
        reach = min(max(1, len(course) // _GLITCH), _MAX_GLITCH)
        course = np.median(sliding_window_view(np.pad(course, reach, "edge"), 2 * reach + 1), axis=1)
    return np.clip(course, *np.quantile(course, [_OUTLIERS, 1 - _OUTLIERS]))


def _last_valley(
    raw: NDArray[np.float64], course: NDArray[np.float64], size: float, usual: float
) -> tuple[int, int, int, int] | str:
    """Returns the frames of a `Grasp` at the last valley between two openings, or why there is none.

    Args:
        raw: The course as recorded.
        course: The course without outliers.
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
    sides = np.minimum(np.maximum.accumulate(course), np.maximum.accumulate(course[::-1])[::-1])
    depth = max(_MIN_DEPTH * size, _MIN_RELATIVE_DEPTH * float((sides - course).max()), _NOISE * noise)
    # Backwards: from the last opening down into the valley, and up to the opening before it.
    after, bottom, level = course[-1], 0, None
    for frame in range(len(course) - 1, -1, -1):
        if level is None and course[frame] > after:
            after = course[frame]
        elif (level is None and after - course[frame] >= depth) or (
            level is not None and course[frame] < level
        ):
            level, bottom = course[frame], frame
        elif level is not None and course[frame] - level >= depth:
            break
    else:
        return _why_no_valley(course, depth)
    before = _opening(course[frame::-1], level + depth / 2)
    # The opening that ends the valley need not be the last one.
    rise = bottom + int(np.argmax(course[bottom:] - level >= depth))
    after = _opening(course[rise:], level + depth / 2)
    grasp = frame + int(np.argmax(course[frame:] <= level + _CLOSED * (before - level)))
    closing = np.flatnonzero(course[:grasp] > (level + before) / 2)[-1]
    is_closed = course[: rise + 1] <= level + _CLOSED * (after - level)
    release = int(np.flatnonzero(is_closed)[-1]) + 1
    opened = release + int(np.argmax(course[release:] >= after - _CLOSED * (after - level)))
    return int(closing), grasp, release, opened


def _why_no_valley(course: NDArray[np.float64], depth: float) -> str:
    """Returns why a course that moves has no valley between two openings."""
    opens, closes = (course.max() - end >= depth for end in (course[0], course[-1]))
    if opens and closes:
        return "the gripper opens and closes, but does not open again"
    return "the gripper opens, but does not close before" if opens else "the gripper does not open again"


def _opening(course: NDArray[np.float64], least: float) -> float:
    """Returns the greatest value before a course falls to a level for the first time."""
    ends = np.flatnonzero(course <= least)
    return float(course[: ends[0] if len(ends) else None].max())


def follows_gripper(states: Tensor, gripper: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Returns which dimensions of the robot's state tell how far the gripper is open, (state,) bool.

    These are the dimensions that follow the gripper's commands, within an eighth of an episode.

    Args:
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, as for `find_grasps`, (frames,).
        spans: First and last frame of each episode.
    """
    courses, follows = _courses(gripper, spans), torch.zeros(states.shape[1], dtype=torch.bool)
    longest = max(1, int(np.median([len(course) for course in courses])) // _MAX_LAG)
    for lag in np.unique(np.linspace(1, longest, min(longest, _N_LAGS)).astype(int)).tolist():
        frames = torch.cat([torch.arange(first, last + 1)[lag:] for first, last in spans]).to(states.device)
        held = torch.from_numpy(np.concatenate([course[:-lag] for course in courses])).to(states.device)
        after, command = states[frames].double(), held[:, None]
        after, command = after - after.mean(dim=0), command - command.mean()
        covariance = (after * command).mean(dim=0)
        scale = after.square().mean(dim=0).sqrt() * command.square().mean().sqrt()
        follows |= (covariance.abs() > _GRIPPER_CORRELATION * scale.clamp_min(1e-12)).cpu()
    return follows.to(states.device)
