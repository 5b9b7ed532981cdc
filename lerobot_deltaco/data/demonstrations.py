"""Demonstrations: a few frames of an episode that shows a task, and banks of them.

A demonstration is a value. Training draws the demonstrations of a batch from a bank of the training episodes;
evaluation passes them to the policy's `set_tasks`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.data.reading import shortened
from lerobot_deltaco.errors import UserError

# Frames of an episode that are kept, evenly spaced, if a demonstration has more than its two ends.
N_KEPT_FRAMES = 16
_IMAGES_AT_A_TIME = 256  # with a progress bar


@dataclass(frozen=True)
class Demonstration:
    """An episode that shows a task.

    Attributes:
        task: Task string of the episode.
        frames: Frames in the order of time, the first and the last of the episode among them,
            (frames, 3, H, W) uint8.
        pick_state: The robot's state when its gripper closed around the object, as in the dataset, (state,);
            None if it is not known.
        first_image: The first frame at the camera's own resolution, (3, H', W') uint8; None if that is the
            resolution of `frames`.
        features: Features of the frames from a frozen image encoder, (features,); None without one.
        episode: Index of the episode in its dataset; None if it is not from a dataset.
        target_object: Index of the object that it moves; None if it is not known.
        states: The robot's state at each step of the episode, as in the dataset, (steps, state); None if they
            are not known.
        actions: The action at each step, as in the dataset, (steps, action); None if they are not known.
    """

    task: str
    frames: Tensor
    pick_state: Tensor | None = None
    first_image: Tensor | None = None
    features: Tensor | None = None
    episode: int | None = None
    target_object: int | None = None
    states: Tensor | None = None
    actions: Tensor | None = None


class DemonstrationBank(torch.nn.Module):
    """Episodes that demonstrate tasks, as tensors.

    The tensors move with the policy, but are not among its weights.

    Args:
        frames: (episodes, kept frames, 3, H, W) uint8; the first and the last frame of each are among them.
        tasks: Task string of each episode.
        episodes: Index of each episode in its dataset.
        target_objects: Index of the object that each episode moves; None if the dataset does not say.
        first_images: First frames at the camera's own resolution, (episodes, 3, H', W') uint8; None if that
            is the resolution of `frames`.
        pick_states: The robot's state when its gripper closed, as in the dataset, (episodes, state) float32;
            NaN where it did not. None unless the policy needs them.
        trajectories: States and actions of the episodes; None unless the policy needs them.

    Attributes:
        features: Features of each by a frozen image encoder, (episodes, variants, features) float16; None
            unless the policy needs them.
    """

    frames: Tensor
    episodes: Tensor
    first_images: Tensor | None
    pick_states: Tensor | None
    features: Tensor | None
    states: Tensor | None
    actions: Tensor | None
    _members: Tensor
    _count: Tensor
    _group: Tensor
    _place: Tensor
    _ascending: Tensor
    _row_of_place: Tensor

    def __init__(
        self,
        frames: Tensor,
        tasks: Sequence[str],
        episodes: Sequence[int],
        target_objects: Sequence[int] | None = None,
        first_images: Tensor | None = None,
        pick_states: Tensor | None = None,
        trajectories: RobotData | None = None,
    ) -> None:
        super().__init__()
        self.spans = None if trajectories is None else trajectories.spans
        self.tasks = list(tasks)
        self.target_objects = None if target_objects is None else list(target_objects)
        self.rows: dict[str, list[int]] = {}
        for row, task in enumerate(self.tasks):
            self.rows.setdefault(task, []).append(row)
        members = [torch.tensor(rows) for rows in self.rows.values()]
        group = {task: n for n, task in enumerate(self.rows)}
        place = torch.empty(len(self.tasks), dtype=torch.int64)  # of each row among those of its task
        for rows in members:
            place[rows] = torch.arange(len(rows))
        # Sorted, since a table by episode could be far larger than the bank.
        ascending, row_of_place = torch.as_tensor(episodes).sort()
        for name, tensor in (
            ("frames", frames),
            ("episodes", torch.as_tensor(episodes)),
            ("first_images", first_images),
            ("pick_states", pick_states),
            ("features", None),
            ("states", None if trajectories is None else trajectories.states),
            ("actions", None if trajectories is None else trajectories.actions),
            ("_members", torch.nn.utils.rnn.pad_sequence(members, batch_first=True)),
            ("_count", torch.tensor([len(rows) for rows in members])),
            ("_group", torch.tensor([group[task] for task in self.tasks])),
            ("_place", place),
            ("_ascending", ascending),
            ("_row_of_place", row_of_place),
        ):
            self.register_buffer(name, tensor, persistent=False)

    def __len__(self) -> int:
        return len(self.tasks)

    def __getitem__(self, row: int) -> Demonstration:
        """Returns the demonstration of a row."""
        pick_state = None if self.pick_states is None else self.pick_states[row]
        if pick_state is not None and bool(pick_state.isnan().any()):
            pick_state = None
        return Demonstration(
            self.tasks[row],
            self.frames[row],
            pick_state,
            None if self.first_images is None else self.first_images[row],
            None if self.features is None else self.features[row, 0].float(),
            int(self.episodes[row]),
            None if self.target_objects is None else self.target_objects[row],
            *self.trajectory(row),
        )

    def trajectory(self, row: int) -> tuple[Tensor | None, Tensor | None]:
        """Returns the states (steps, state) and actions (steps, action) of a row, None if not known."""
        if self.spans is None:
            return None, None
        first, last = self.spans[row]
        assert self.states is not None
        assert self.actions is not None
        return self.states[first : last + 1], self.actions[first : last + 1]

    def of_task(self, task: str, target_object: int | None = None) -> list[Demonstration]:
        """Returns the demonstrations of a task.

        Args:
            task: Task string.
            target_object: Index of the object that they move, where the task string does not say which.

        Raises:
            ValueError: There are none; the message names tasks that have some.
        """
        rows = self.rows.get(task, [])
        if target_object is not None:
            moved = self.target_objects
            rows = [row for row in rows if moved is not None and moved[row] == target_object]
        if not rows:
            raise UserError(
                f"There is no demonstration of the task {task!r}"
                f"{'' if target_object is None else f' with object {target_object}'}. There are some of "
                f"{len(self.rows)} tasks, such as {next(iter(self.rows))!r}. Name a dataset that has the "
                "task (`demo_repo_id`, `demo_root`). If its wording differs, choose an episode "
                "(`demo_episode`)."
            )
        return [self[row] for row in rows]

    def of_episode(self, episode: int) -> Demonstration:
        """Returns the demonstration of an episode of the dataset.

        Raises:
            ValueError: The episode is not in the bank.
        """
        found = (self.episodes == episode).nonzero().flatten().tolist()
        if not found:
            raise UserError(
                f"`demo_episode` is {episode}, which is not among the demonstrations. They are the episodes "
                f"{shortened(self.episodes.tolist())}."
            )
        return self[found[0]]

    def episode_rows(self, episodes: Tensor) -> Tensor:
        """Returns the rows of episodes, (batch,); -1 for those that are not in the bank."""
        place = torch.searchsorted(self._ascending, episodes).clamp(max=len(self._ascending) - 1)
        return torch.where(self._ascending[place] == episodes, self._row_of_place[place], -1)

    def draw_other_episodes(
        self, episodes: Tensor, tasks: Sequence[str], generator: torch.Generator
    ) -> Tensor:
        """Draws for each sample another episode of its task.

        Args:
            episodes: The samples' own episodes, (batch,), as indices of the dataset. For one that is not in
                the bank, such as a held-out one, any episode of its task is drawn.
            tasks: Task string of each sample.
            generator: Source of the draws, on the CPU.

        Returns:
            Rows, (batch,). The only episode of a task demonstrates itself.

        Raises:
            ValueError: No episode of a task is in the bank.
        """
        draws = torch.rand(len(episodes), generator=generator).to(self.frames.device)
        rows = self.episode_rows(episodes)
        held_back = rows < 0
        if held_back.any():
            rows = torch.where(held_back, self._first_rows(tasks, held_back), rows)
        group, own = self._group[rows], self._place[rows]
        count = self._count[group]
        place = (draws * (count - 1)).long()  # one of the count - 1 others
        place = torch.where(count > 1, place + (place >= own), own)
        place = torch.where(held_back, (draws * count).long(), place)
        return self._members[group, place]

    def _first_rows(self, tasks: Sequence[str], wanted: Tensor) -> Tensor:
        """Returns a row of each sample's task, (batch,); -1 where none is wanted."""
        rows = [-1] * len(tasks)
        for sample in wanted.nonzero().flatten().tolist():
            if tasks[sample] not in self.rows:
                raise UserError(
                    f"The task {tasks[sample]!r} has no episode among those that demonstrations are drawn "
                    "from. Hold back fewer of its episodes."
                )
            rows[sample] = self.rows[tasks[sample]][0]
        return torch.tensor(rows, device=wanted.device)


def sample_frames(frames: Tensor, n_frames: int, generator: torch.Generator) -> Tensor:
    """Draws frames of demonstrations in the order of time: the first, random ones, and the last.

    One frame is drawn from each of as many equal parts of the time between the ends, as in the authors' code.

    Args:
        frames: Kept frames of demonstrations, (batch, kept, 3, H, W) uint8.
        n_frames: Number of frames to draw, at least 2.
        generator: Source of the draws, on the CPU.

    Returns:
        (batch, n_frames, 3, H, W) in 0..1.
    """
    last, n_between = frames.shape[1] - 1, n_frames - 2
    draws = torch.rand(len(frames), n_between, generator=generator)
    if n_between:
        draws = (torch.arange(n_between) + draws) / n_between
    between = 1 + (draws * max(last - 1, 1)).long().clamp(max=max(last - 2, 0))
    ends = torch.tensor([[0, last]]).expand(len(frames), 2)
    columns = torch.cat([ends, between], dim=1).sort(dim=1).values.to(frames.device)
    return frames[torch.arange(len(frames), device=frames.device)[:, None], columns].float() / 255


class RobotData(NamedTuple):
    """States and actions of episodes.

    Attributes:
        states: Robot states of frames, (frames, state).
        actions: Actions in these frames, (frames, action).
        spans: First and last frame of each episode.
        images: Returns the images of some frames by the camera of demonstrations, (n, 3, H, W) uint8; None
            if there are only states and actions.
        state_names: Name of each dimension of the state; empty if the dataset has none.
    """

    states: Tensor
    actions: Tensor
    spans: list[tuple[int, int]]
    images: Callable[[list[int]], Tensor] | None = None
    state_names: Sequence[str] = ()

    def images_at(self, frames: Sequence[int]) -> Tensor:
        """Returns the images of some frames, (n, 3, H, W) uint8."""
        assert self.images is not None
        found = []
        with tqdm(total=len(frames), desc="Reading images", unit="image", leave=False) as progress:
            for n in range(0, len(frames), _IMAGES_AT_A_TIME):
                some = list(frames[n : n + _IMAGES_AT_A_TIME])
                found.append(self.images(some))
                progress.update(len(some))
        return torch.cat(found)

    def to(self, device: torch.device) -> RobotData:
        """Returns the states and actions on a device."""
        return self._replace(states=self.states.to(device), actions=self.actions.to(device))


def kept_frames(first: int, last: int, n_frames: int) -> Tensor:
    """Returns the indices of the frames of an episode that are kept for demonstrations, (kept,) int64.

    Args:
        first: Index of the first frame.
        last: Index of the last frame.
        n_frames: Number of frames per demonstration; for more than 2, `N_KEPT_FRAMES` are kept.
    """
    n_kept = 2 if n_frames == 2 else max(N_KEPT_FRAMES, n_frames)
    # In double precision, which holds every index of a large dataset.
    return torch.linspace(first, last, n_kept, dtype=torch.float64).round().long()
