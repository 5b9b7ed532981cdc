"""Demonstrations: frames of episodes in memory, and the draw of one for each sample."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.policy.dataset_folders import check_dataset_folder

logger = logging.getLogger(__name__)

# Frames of an episode that are kept, if a demonstration has random ones: from the first to the last, evenly.
N_KEPT_FRAMES = 16


# Index of the object that an episode moves, in datasets of the benchmark.
TARGET_OBJECT = "benchmark.target_object"


class Demonstrated(NamedTuple):
    """The episode that demonstrates a task.

    Attributes:
        episode: Index of the episode in its dataset.
        target_object: Index of the object that it moves; None if its dataset does not say.
    """

    episode: int
    target_object: int | None


class DemonstrationSet(torch.nn.Module):
    """Episodes that demonstrate tasks.

    Its tensors move with the policy, but are not among its weights.

    Args:
        frames: (episodes, kept frames, 3, H, W) uint8; the first and the last frame of each are among them.
        tasks: Instruction of each episode.
        episodes: Index of each episode in its dataset.
        target_objects: Index of the object that each episode moves; None if the dataset does not say.

    Attributes:
        features: Features of each by a frozen image encoder, (episodes, variants, features) float16; None
            unless they were asked for (`policy/frozen_features.py`).
        grasp_states: The robot's state at each grasp, as in the dataset, (episodes, state) float32; NaN where
            there is none. None unless the policy needs them.
    """

    frames: Tensor
    episodes: Tensor
    _order: Tensor
    _start: Tensor
    _place: Tensor
    _ascending: Tensor
    _row_of_place: Tensor
    features: Tensor | None
    grasp_states: Tensor | None

    def __init__(
        self,
        frames: Tensor,
        tasks: Sequence[str],
        episodes: Sequence[int],
        target_objects: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.target_objects = None if target_objects is None else list(target_objects)
        self.tasks = list(tasks)
        self.rows: dict[str, list[int]] = defaultdict(list)
        for row, task in enumerate(self.tasks):
            self.rows[task].append(row)
        self.register_buffer("frames", frames, persistent=False)
        self.register_buffer("episodes", torch.as_tensor(episodes), persistent=False)
        self.register_buffer("features", None, persistent=False)
        self.register_buffer("grasp_states", None, persistent=False)
        # By row: where the rows of its task begin in `order`, how many they are, and which of them it is.
        order = [row for rows in self.rows.values() for row in rows]
        place = {row: (n, len(rows)) for rows in self.rows.values() for n, row in enumerate(rows)}
        starts, start = {}, 0
        for task, rows in self.rows.items():
            starts[task] = start
            start += len(rows)
        self.register_buffer("_order", torch.tensor(order), persistent=False)
        self.register_buffer("_start", torch.tensor([starts[task] for task in self.tasks]), persistent=False)
        self.register_buffer(
            "_place", torch.tensor([place[row] for row in range(len(self.tasks))]), persistent=False
        )
        # Sorted, since a table by index could be far larger than the set.
        ascending, row_of_place = self.episodes.sort()
        self.register_buffer("_ascending", ascending, persistent=False)
        self.register_buffer("_row_of_place", row_of_place, persistent=False)
        single = [task for task, rows in self.rows.items() if len(rows) == 1]
        if single:
            logger.info(
                "%d tasks have a single episode, such as %r. In training, it demonstrates itself.",
                len(single),
                single[0],
            )

    def sample_other_episodes(
        self,
        episodes: Tensor,
        generator: torch.Generator,
        check: bool = True,
        tasks: Sequence[str] | None = None,
    ) -> Tensor:
        """Draws for each sample another episode of its task.

        Args:
            episodes: The samples' own, (batch,), as indices of the dataset.
            generator: Source of the draws, on the CPU.
            check: Whether to check that all of them are in the set, which waits for a GPU.
            tasks: Task of each sample. If it is given, episodes may be missing from the set, such as those
                that `--dataset.eval_split` holds back; then any episode of their task is drawn.

        Returns:
            Rows, (batch,). A task's only episode demonstrates itself.

        Raises:
            ValueError: An episode is not in the set, or no episode of its task.
        """
        draws = torch.rand(len(episodes), generator=generator).to(self.frames.device)
        rows = self.episode_rows(episodes)
        held_back = rows < 0
        if tasks is not None and held_back.any():
            rows = torch.where(held_back, self._any_rows(tasks, held_back), rows)
        elif check:
            self.check_episodes(episodes, rows)
        own, count = self._place[rows].unbind(dim=1)
        place = (draws * (count - 1)).long()  # one of the count - 1 others
        place = torch.where(count > 1, place + (place >= own), own)
        if tasks is not None:
            place = torch.where(held_back, (draws * count).long(), place)
        return self._order[self._start[rows] + place]

    def sample_shared_episodes(
        self,
        episodes: Tensor,
        column: Tensor,
        n_tasks: int,
        n_each: int,
        generator: torch.Generator,
        check: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Draws a few episodes of each task, and for each sample one of them that is not its own.

        Args:
            episodes: The samples' own, (batch,), as indices of the dataset.
            column: The samples' tasks, (batch,), numbered from 0.
            n_tasks: Number of tasks.
            n_each: Number of episodes drawn of each task, at least 2.
            generator: Source of the draws, on the CPU.
            check: Whether to check that all episodes are in the set, which waits for a GPU.

        Returns:
            Rows, (tasks * n_each,), and the place of each sample's among them, (batch,). An episode is drawn
            twice only for a task that has fewer.

        Raises:
            ValueError: An episode is not in the set.
        """
        n_samples, device = len(episodes), self.frames.device
        longest = max(map(len, self.rows.values()))
        priorities = torch.rand(n_tasks, longest, generator=generator).to(device)
        start = torch.randint(n_each, (n_samples,), generator=generator).to(device)
        rows = self.episode_rows(episodes)
        if check:
            self.check_episodes(episodes, rows)
        first = torch.full((n_tasks,), n_samples, device=device).scatter_reduce(
            0, column, torch.arange(n_samples, device=device), "amin"
        )
        count = self._place[rows[first], 1]  # (tasks,)
        late = torch.arange(longest, device=device) >= count[:, None]
        order = priorities.masked_fill(late, 2).argsort(dim=1)  # (tasks, longest)
        turn = torch.arange(n_each, device=device) % count[:, None]  # (tasks, n_each)
        place = order.gather(1, turn)
        drawn = self._order[self._start[rows[first], None] + place]  # (tasks, n_each)
        n_distinct = count.clamp(max=n_each)[column]  # (batch,)
        start = start % n_distinct
        own = drawn[column, start] == rows
        which = column * n_each + torch.where(own, (start + 1) % n_distinct, start)
        return drawn.flatten(), which

    def describe(self, rows: Tensor) -> tuple[Demonstrated, ...]:
        """The episodes of rows, (batch,)."""
        objects = self.target_objects
        return tuple(
            Demonstrated(int(self.episodes[row]), None if objects is None else objects[row])
            for row in rows.tolist()
        )

    def episode_rows(self, episodes: Tensor) -> Tensor:
        """Rows of episodes, (batch,); -1 of those that are not in the set."""
        place = torch.searchsorted(self._ascending, episodes).clamp(max=len(self._ascending) - 1)
        return torch.where(self._ascending[place] == episodes, self._row_of_place[place], -1)

    def check_episodes(self, episodes: Tensor, rows: Tensor) -> None:
        """Checks that episodes (batch,) were found in these rows (batch,).

        Raises:
            ValueError: One was not.
        """
        if (rows < 0).any():
            raise ValueError(
                f"Episode {int(episodes[rows < 0][0])} is trained on, but is not among those that "
                "demonstrations are drawn from. Name all of them in `demo_episodes`."
            )

    def _any_rows(self, tasks: Sequence[str], wanted: Tensor) -> Tensor:
        """A row of each sample's task, (batch,); -1 where none is wanted."""
        rows = [-1] * len(tasks)
        for sample in wanted.nonzero().flatten().tolist():
            if tasks[sample] not in self.rows:
                raise ValueError(
                    f"The task {tasks[sample]!r} has no episode among those that demonstrations are drawn "
                    "from. Hold back fewer of its episodes, or name some in `demo_episodes`."
                )
            rows[sample] = self.rows[tasks[sample]][0]
        return torch.tensor(rows, device=wanted.device)

    def sample_frames(
        self, rows: Tensor, n_frames: int, generator: torch.Generator, spread: bool = False
    ) -> Tensor:
        """Frames of demonstrations in the order of time: the first, random ones between, and the last.

        Args:
            rows: Rows of the demonstrations, (batch,).
            n_frames: Number of frames per demonstration, at least 2.
            generator: Source of the draws, on the CPU.
            spread: Whether one frame is drawn from each of as many equal parts of the time between the ends,
                so that none is drawn twice if there are enough; else, all frames are drawn independently.

        Returns:
            (batch, n_frames, 3, H, W) in 0..1.
        """
        last = self.frames.shape[1] - 1
        draws = torch.rand(len(rows), n_frames - 2, generator=generator)
        if spread and n_frames > 2:
            draws = (torch.arange(n_frames - 2) + draws) / (n_frames - 2)
        between = 1 + (draws * max(last - 1, 1)).long().clamp(max=max(last - 2, 0))
        ends = torch.tensor([[0, last]]).expand(len(rows), 2)
        columns = torch.cat([ends, between], dim=1).sort(dim=1).values.to(self.frames.device)
        return self.frames[rows[:, None], columns].float() / 255


def load_demonstrations(
    repo_id: str,
    root: str | Path | None,
    episodes: Sequence[int] | None,
    camera: str,
    image_size: int,
    n_demo_frames: int,
    may_enlarge: bool = True,
) -> DemonstrationSet:
    """Reads demonstrations from a LeRobotDataset.

    Args:
        repo_id: Repository id of the dataset.
        root: Folder of the dataset; None for LeRobot's cache.
        episodes: Episodes to read; None for all.
        camera: Key of the images, such as "observation.image".
        image_size: Height and width to which images are scaled, px.
        n_demo_frames: Number of frames per demonstration; for more than 2, `N_KEPT_FRAMES` are kept.
        may_enlarge: Whether images may be smaller than that.

    Raises:
        FileNotFoundError: There is no network, and no dataset in the folder.
        ValueError: The dataset has no such camera or episode, or smaller images.
    """
    check_dataset_folder("--policy.demo_root", root)
    dataset = LeRobotDataset(repo_id, root=root, return_uint8=True)
    if camera not in dataset.meta.camera_keys:
        raise ValueError(
            f"The demonstrations in {repo_id} have no camera {camera!r}, only {dataset.meta.camera_keys}."
        )
    side = shorter_side(dataset.meta.features[camera]["shape"])
    if side < image_size and not may_enlarge:
        raise ValueError(
            f"The demonstrations in {repo_id} have images of {side} pixels, but the policy finds goals in "
            f"images of {image_size} (`goal_image_size`). Name a dataset with images of that size."
        )
    total = dataset.meta.total_episodes
    episodes = list(range(total)) if episodes is None else list(episodes)
    if not episodes or not all(0 <= episode < total for episode in episodes):
        raise ValueError(f"{repo_id} has the episodes 0 to {total - 1}. Got {episodes[:5]}.")
    frames, tasks, target_objects = [], [], []
    for episode in tqdm(episodes, desc="Reading demonstrations", unit="episode", leave=False):
        row = dataset.meta.episodes[episode]
        indices = kept_frame_indices(
            row["dataset_from_index"], row["dataset_to_index"] - 1, n_demo_frames
        ).tolist()
        items = [dataset[index] for index in indices]
        if TARGET_OBJECT in items[0]:
            target_objects.append(int(items[0][TARGET_OBJECT]))
        images = torch.stack([item[camera] for item in items])  # (kept, 3, h, w)
        frames.append(resize_images(images, image_size))
        tasks.append(row["tasks"][0])
    return DemonstrationSet(torch.stack(frames), tasks, episodes, target_objects or None)


class RobotData(NamedTuple):
    """States and actions of episodes.

    Attributes:
        states: Robot states of frames, (frames, state).
        actions: Actions in these frames, (frames, action).
        spans: First and last frame of each episode.
    """

    states: Tensor
    actions: Tensor
    spans: list[tuple[int, int]]


def check_robot_features(
    repo_id: str, features: Mapping[str, Mapping[str, Any]], expected: Mapping[str, Sequence[int]]
) -> None:
    """Checks that a dataset is of a robot such as the policy's.

    Args:
        repo_id: Repository id of the dataset.
        features: Its features, as in LeRobot's info.json.
        expected: Shape of each feature that is needed, by name.

    Raises:
        ValueError: It lacks one, or has another shape.
    """
    for name, shape in expected.items():
        found = tuple(features[name]["shape"]) if name in features else None
        if found != tuple(shape):
            got = "have none" if found is None else f"have the shape {found}"
            raise ValueError(
                f"The demonstrations in {repo_id} are of another robot: the policy knows {name!r} of the "
                f"shape {tuple(shape)}, and they {got}. Name a dataset of the policy's robot."
            )


def load_robot_data(repo_id: str, root: str | Path | None, episodes: Sequence[int]) -> RobotData:
    """Reads the states and actions of episodes from a LeRobotDataset.

    Args:
        repo_id: Id of the dataset.
        root: Folder of the dataset, None for LeRobot's cache.
        episodes: Indices of the episodes to read.
    """
    dataset = LeRobotDataset(repo_id, root=root)
    columns = dataset.hf_dataset.select_columns([OBS_STATE, ACTION]).with_format("numpy")[:]
    states, actions = (
        torch.from_numpy(np.stack(columns[name]).astype(np.float32)) for name in (OBS_STATE, ACTION)
    )
    starts, ends = (dataset.meta.episodes[f"dataset_{side}_index"][:] for side in ("from", "to"))
    return RobotData(states, actions, [(starts[episode], ends[episode] - 1) for episode in episodes])


def shorter_side(shape: Sequence[int]) -> int:
    """Shorter side of a dataset's images, px, whose shape is (H, W, 3) or (3, H, W)."""
    return sorted(shape)[1]


def kept_frame_indices(first: int, last: int, n_demo_frames: int) -> Tensor:
    """Indices of the frames of an episode that are kept for demonstrations, (kept,) int64.

    Args:
        first: Index of the first frame.
        last: Index of the last frame.
        n_demo_frames: Number of frames per demonstration; for more than 2, `N_KEPT_FRAMES` are kept.
    """
    n_kept = 2 if n_demo_frames == 2 else max(N_KEPT_FRAMES, n_demo_frames)
    # In double precision, which holds every index of a large dataset.
    return torch.linspace(first, last, n_kept, dtype=torch.float64).round().long()


def to_uint8(images: Tensor) -> Tensor:
    """Images, uint8 or 0..1, as uint8."""
    if images.dtype == torch.uint8:
        return images
    return (images * 255).round().clamp(0, 255).to(torch.uint8)


def resize_images(images: Tensor, size: int) -> Tensor:
    """Images (..., 3, H, W), uint8 or 0..1, as uint8 (..., 3, size, size)."""
    images = to_uint8(images)
    if images.shape[-2:] == (size, size):
        return images
    flat = images.flatten(0, -4).float()
    flat = F.interpolate(flat, (size, size), mode="bilinear", antialias=True).round().clamp(0, 255)
    return flat.to(torch.uint8).view(*images.shape[:-2], size, size)
