"""Which demonstrations the samples of a batch get, in training and in evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.goals.conditioning import Demonstrations, GoalConditioning


def choose_training_demonstrations(
    demonstrations: DemonstrationSet,
    episodes: Tensor,
    column: Tensor,
    n_tasks: int,
    demos_per_task: int,
    generator: torch.Generator,
    check: bool,
) -> tuple[Tensor, Tensor | None]:
    """Draws for each sample a demonstration of its task: an episode other than the sample's own.

    Args:
        demonstrations: Demonstrations to draw from.
        episodes: The samples' own episodes, (batch,), as indices of the dataset.
        column: The samples' tasks, (batch,), numbered from 0.
        n_tasks: Number of tasks.
        demos_per_task: Number of demonstrations that the samples of a task share; 0 draws one per sample.
        generator: Source of the draws, on the CPU.
        check: Whether to check that all episodes are among the demonstrations, which waits for a GPU.

    Returns:
        Rows of the drawn demonstrations, and the place of each sample's demonstration among them, (batch,);
        None if each sample has its own, in order.

    Raises:
        ValueError: An episode is not among the demonstrations.
    """
    if not demos_per_task:
        return demonstrations.sample_other_episodes(episodes, generator, check), None
    return demonstrations.sample_shared_episodes(episodes, column, n_tasks, demos_per_task, generator, check)


def choose_eval_demonstrations(
    candidates: Sequence[DemonstrationSet | None],
    tasks: Sequence[str],
    trials: Sequence[int],
    demonstrated_as: Mapping[str, str],
) -> tuple[DemonstrationSet, Tensor]:
    """Chooses a demonstration for each sample by its instruction; the demonstrations of a task take turns.

    Args:
        candidates: Sets of demonstrations, in the order in which they are searched.
        tasks: Instruction of each sample.
        trials: Number of each sample's episode among those of its task, from 0.
        demonstrated_as: Task strings by instruction: those whose demonstrations replace its own.

    Returns:
        The first set that has demonstrations of all tasks, and the row of each sample's, (batch,).

    Raises:
        ValueError: A task has no demonstration.
    """
    sets = [candidate for candidate in candidates if candidate is not None]
    names = [demonstrated_as.get(task, task) for task in tasks]
    for demonstrations in sets:
        if all(name in demonstrations.rows for name in names):
            rows = [
                demonstrations.rows[name][trial % len(demonstrations.rows[name])]
                for name, trial in zip(names, trials, strict=True)
            ]
            return demonstrations, torch.tensor(rows, device=demonstrations.frames.device)
    known = sorted({name for demonstrations in sets for name in demonstrations.rows})
    missing = next((name for name in names if name not in known), None)
    if missing is None:
        raise ValueError(
            f"The demonstrations of the {len(set(names))} tasks of this batch are in two sets: those of "
            "--policy.demo_repo_id and those of the training. Name a dataset that has them all."
        )
    example = f", such as {known[0]!r}" if known else ""
    raise ValueError(
        f"There is no demonstration of the task {missing!r}. There are demonstrations of {len(known)} tasks"
        f"{example}. Name a dataset that has the task with --policy.demo_repo_id and --policy.demo_root. If "
        "its wording differs, choose the episode with --policy.demo_episode."
    )


def choose_episode(
    demonstrations: DemonstrationSet, episode: int, n_samples: int
) -> tuple[DemonstrationSet, Tensor]:
    """Chooses one episode as the demonstration of all samples.

    Returns:
        The set, and the row of the episode for each sample, (samples,).

    Raises:
        ValueError: The episode is not in the set.
    """
    found = (demonstrations.episodes == episode).nonzero().flatten()
    if not len(found):
        raise ValueError(
            f"`demo_episode` is {episode}, which is not among the demonstrations: the episodes "
            f"{demonstrations.episodes.tolist()[:10]} ..."
        )
    return demonstrations, found[:1].expand(n_samples)


def goal_demonstrations(
    chosen: Sequence[tuple[DemonstrationSet, Tensor]], goals: GoalConditioning, device: torch.device
) -> Demonstrations:
    """Chosen demonstrations as goals are found by them.

    Args:
        chosen: One or more demonstrations of each sample's task: each time a set, and rows of it, (batch,).
        goals: Networks that find goals, which know the depths of states at grasps.
        device: Device of the result.
    """
    ends, depths, grasps = [], [], []
    for demonstrations, rows in chosen:
        ends.append(demonstrations.frames[rows][:, [0, -1]].float() / 255)  # (batch, 2, 3, H, W)
        states = demonstrations.grasp_states
        if states is None or goals.depth is None:
            depths.append(torch.full((len(rows),), torch.nan, device=rows.device))
            grasps.append(torch.full((len(rows), 2), torch.nan, device=rows.device))
        else:
            depths.append(goals.states.depths(states[rows]))
            grasps.append(goals.states.grasp_places(states[rows]))
    return Demonstrations(
        torch.stack(ends, dim=1).to(device),
        torch.stack(depths, dim=1).to(device),
        grasps=torch.stack(grasps, dim=1).to(device),
    )
