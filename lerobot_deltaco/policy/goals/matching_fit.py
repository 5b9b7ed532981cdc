"""Fits matching by pretrained features to episodes: pairs of episodes of a task show the same object."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.policy.goals.correspondence import goal_loss
from lerobot_deltaco.policy.goals.pretrained_matching import ImageMaps, PretrainedMatching
from lerobot_deltaco.policy.memory import keep_freed_memory

# Tried on validation tasks (docs/experiment-log.md).
_STEPS = 2000
_MAX_EPISODES = 10_000  # drawn for the fit
_PAIRS_PER_STEP = 32
_LEARNING_RATE = 2e-3
_WARMUP_SHARE = 0.1
_WEIGHT_DECAY = 0.2
_WORD_DROPOUT = 0.3
_WORD_STD = 0.1  # of the words' descriptors before the fit
_IMAGES_AT_A_TIME = 32
_N_FOR_STATISTICS = 256  # images whose maps give the channels' means and spreads


def fit_matching(
    matching: PretrainedMatching,
    images: Tensor,
    places: Tensor,
    tasks: Sequence[str],
    present: Tensor | None,
    seed: int,
    steps: int = _STEPS,
) -> None:
    """Fits the compared features and the words.

    What one episode of a task grasps is to be found in the scene of another, and by some of the words of its
    task: a share of them is left out in each step, so that none is needed.

    Args:
        matching: What is fitted; its encoder has its weights already.
        images: First images of episodes, (episodes, 3, H, W) uint8.
        places: Places of their grasps, x and y in -1..1, (episodes, 2); NaN where there is none.
        tasks: Task of each episode.
        present: Which of the known words each task has, (episodes, words); None without words.
        seed: Seed of the initial weights and of the draws.
        steps: Number of training steps.

    Raises:
        ValueError: No task has two episodes with a grasp.
    """
    generator = torch.Generator().manual_seed(seed)
    device = images.device
    if device.type == "cpu":
        keep_freed_memory()  # halves the time of encoding the images
    grasps = (~places.isnan().any(dim=1)).nonzero().flatten().cpu()
    drawn = grasps[torch.randperm(len(grasps), generator=generator)[:_MAX_EPISODES]].sort().values
    tasks = [tasks[row] for row in drawn.tolist()]
    images, places = images[drawn.to(device)], places[drawn.to(device)]
    present = None if present is None else present[drawn.to(device)]
    pairs = _Pairs(tasks)
    with torch.enable_grad(), torch.autocast(device.type, enabled=False):
        maps = _encoded(matching, images)
        some = torch.arange(0, len(images), math.ceil(len(images) / _N_FOR_STATISTICS), device=device)
        matching.normalize_by(maps.rows(some))
        _initialize(matching, generator)
        learned = matching.learned
        for weights in learned:
            weights.requires_grad_(True)
        optimizer = torch.optim.AdamW(learned, lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, _LEARNING_RATE, steps, pct_start=_WARMUP_SHARE
        )
        for _ in tqdm(range(steps), desc="Fitting the matching", unit="step", leave=False):
            scenes, demonstrations = (rows.to(device) for rows in pairs.draw(_PAIRS_PER_STEP, generator))
            here, there = places[scenes][:, None], matching.normalized(maps.rows(scenes))
            descriptors = matching.describe(
                matching.normalized(maps.rows(demonstrations)), places[demonstrations]
            )
            loss = goal_loss(matching.find(there, descriptors)[:, None], here).mean()
            if present is not None:
                kept = torch.rand(_PAIRS_PER_STEP, present.shape[1], generator=generator) >= _WORD_DROPOUT
                words = present[scenes] * kept.to(present)
                loss = loss + goal_loss(matching.find_named(there, words)[:, None], here).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        for weights in learned:
            weights.requires_grad_(False)
            weights.grad = None
        if present is not None:
            matching.words[:-1][~present.any(dim=0)] = 0  # words of no episode say nothing
    matching.fitted.fill_(True)


class _Pairs:
    """Draws pairs of different episodes of a task.

    Args:
        tasks: Task of each episode; all have a grasp.

    Raises:
        ValueError: No task has two episodes with a grasp.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        rows: dict[str, list[int]] = {}
        for row, task in enumerate(tasks):
            rows.setdefault(task, []).append(row)
        self._rows = [torch.tensor(found) for found in rows.values() if len(found) > 1]
        if not self._rows:
            raise ValueError(
                "Matching by pretrained features needs tasks with at least two episodes in which the gripper "
                f"closes on something. The {len(tasks)} such episodes are of {len(rows)} different "
                "tasks. Add episodes, or train without `pretrained_matching`."
            )

    def draw(self, n_pairs: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Rows of the scenes and of the demonstrations, (n_pairs,) each, of tasks that are equally likely."""
        scenes, demonstrations = [], []
        for task in torch.randint(len(self._rows), (n_pairs,), generator=generator).tolist():
            rows = self._rows[task]
            first = int(torch.randint(len(rows), (), generator=generator))
            further = int(torch.randint(1, len(rows), (), generator=generator))
            scenes.append(rows[first])
            demonstrations.append(rows[(first + further) % len(rows)])
        return torch.stack(scenes), torch.stack(demonstrations)


def _encoded(matching: PretrainedMatching, images: Tensor) -> ImageMaps:
    """Maps of images (n, 3, H, W) uint8, not normalized, in float16."""
    found: ImageMaps | None = None
    with tqdm(total=len(images), desc="Encoding scenes", unit="image", leave=False) as bar:
        for first in range(0, len(images), _IMAGES_AT_A_TIME):
            some = images[first : first + _IMAGES_AT_A_TIME]
            maps = matching.encode(some.float() / 255)
            if found is None:
                # At once, since there is no room for two copies of many large maps.
                found = ImageMaps(
                    *(kind.new_empty(len(images), *kind.shape[1:], dtype=torch.half) for kind in maps)
                )
            for all_maps, kind in zip(found, maps, strict=True):
                all_maps[first : first + len(some)] = kind
            bar.update(len(some))
    assert found is not None
    return found


@torch.no_grad()
def _initialize(matching: PretrainedMatching, generator: torch.Generator) -> None:
    """Draws initial weights as PyTorch's layers do, but from a generator."""
    networks = [matching.demo] if matching.named is None else [matching.demo, matching.named]
    for network in networks:
        for layer in network.modules():
            if isinstance(layer, torch.nn.Conv2d):
                bound = layer.weight[0].numel() ** -0.5
                for weights in layer.parameters():
                    weights.copy_(bound * (2 * torch.rand(weights.shape, generator=generator) - 1))
    if matching.named is not None:
        matching.words.copy_(_WORD_STD * torch.randn(matching.words.shape, generator=generator))
        matching.words[-1] = 0
