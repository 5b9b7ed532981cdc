"""The statistics of evaluations: the paper's success rate, intervals, breakdowns and what behavior followed.

Rates are shares, 0..1. Nothing here reads or writes a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gym_deltaco.object_sets import find_label
from gym_deltaco.tasks import COLOR_SHAPE_TASKS, CONTAINER_COLORS, TASKS, Task, get_task
from gym_deltaco.workspace import Quadrant, container_matches
from lerobot_deltaco.evaluation.record import Counterfactual, EpisodeResult

N_BEST_SETS = 10  # the paper's


class PaperRate(NamedTuple):
    """The success rate of an experiment as the paper reports it.

    Attributes:
        rate: Mean over the best evaluation sets of the mean over seeds.
        sd: Mean over the best evaluation sets of the standard deviation over seeds; None of a single seed.
        best: Indices of the best evaluation sets, ascending: 10, or fewer if there are fewer.
    """

    rate: float
    sd: float | None
    best: tuple[int, ...]


def paper_rate(rates: ArrayLike) -> PaperRate:
    """The paper's success rate: of the 10 evaluation sets with the highest mean over seeds.

    They are chosen by the very episodes that are then averaged, which flatters. With fewer than ten sets, all
    count. Of sets with the same mean, the earlier ones count. The standard deviation is the population's
    (NumPy's default, `ddof=0`): the paper does not say which one it is, and with three seeds the sample's
    would be 22 % greater.

    Args:
        rates: (sets, seeds), 0..1, at least one of each; sets in the order of their steps.

    Returns:
        Rate, SD and the rows of `rates` that they are of.
    """
    rates = np.asarray(rates, dtype=np.float64)
    means = rates.mean(axis=1)
    # Rounded, so that means that are the same but for the order of their sum remain a tie.
    best = np.sort(np.argsort(-means.round(12), kind="stable")[:N_BEST_SETS])
    sd = float(rates[best].std(axis=1).mean()) if rates.shape[1] > 1 else None
    return PaperRate(float(means[best].mean()), sd, tuple(best.tolist()))


@dataclass(frozen=True)
class Proportion:
    """A count of episodes out of others.

    Args:
        count: In how many of them it was so.
        total: Number of episodes; with 0, rate and interval are None.
    """

    count: int
    total: int

    @property
    def rate(self) -> float | None:
        """Their share, 0..1."""
        return self.count / self.total if self.total else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % Wilson interval of the share."""
        return wilson_interval(self.count, self.total) if self.total else None


def wilson_interval(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's interval of a share (Wilson 1927): it stays within 0..1, and is not empty at 0 and 1.

    Args:
        count: In how many episodes it was so.
        total: Number of episodes, at least 1.
        confidence: That the interval covers the true share, 0..1.

    Returns:
        Its ends.
    """
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    share = count / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z / (1 + z**2 / total) * sqrt(share * (1 - share) / total + z**2 / (4 * total**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


OUTCOMES = MappingProxyType[str, Callable[[EpisodeResult], bool]](
    {
        "success": lambda episode: episode.success,
        "grasped_anything": lambda episode: episode.grasped_object >= 0,
        "right_object": lambda episode: episode.right_object,
        "right_container": lambda episode: episode.right_container,
        "right_object_and_container": lambda episode: episode.right_object and episode.right_container,
    }
)
KINDS = ("name", "color", "shape")  # of the paper's tasks
ALL_KINDS = (*KINDS, "color_shape")
WORDS = ("color_word", "position_word")


class BreakdownRow(NamedTuple):
    """What happened in the episodes of a group of tasks.

    Attributes:
        kind: Kind of words for their object: name, color, shape, color_shape (ours), or "all".
        word: Kind of word for their container: color_word (green, red), position_word (front, back, left,
            right), or "all".
        outcomes: For each of `OUTCOMES`, in how many episodes it came about.
    """

    kind: str
    word: str
    outcomes: dict[str, Proportion]


def breakdown(episodes: Sequence[EpisodeResult]) -> list[BreakdownRow]:
    """Outcomes of all episodes, by kind of task, by kind of container word, and by both.

    There are always rows of the paper's kinds of task; of others, where there are episodes.
    """
    rows = []
    found = {get_task(episode.task_id).kind for episode in episodes}
    for kind in ("all", *(kind for kind in ALL_KINDS if kind in KINDS or kind in found)):
        for word in ("all", *WORDS):
            group = [
                episode
                for episode in episodes
                if kind in ("all", get_task(episode.task_id).kind) and word in ("all", _word_kind(episode))
            ]
            outcomes = {
                name: Proportion(sum(map(came_about, group)), len(group))
                for name, came_about in OUTCOMES.items()
            }
            rows.append(BreakdownRow(kind, word, outcomes))
    return rows


def by_object(episodes: Sequence[EpisodeResult]) -> dict[int, dict[str, Proportion]]:
    """For each object that was a target, by its index: in how many episodes each of `OUTCOMES` came about."""
    groups: dict[int, list[EpisodeResult]] = {}
    for episode in episodes:
        groups.setdefault(episode.objects[episode.target_object], []).append(episode)
    return {
        index: {
            name: Proportion(sum(map(came_about, group)), len(group)) for name, came_about in OUTCOMES.items()
        }
        for index, group in sorted(groups.items())
    }


def _word_kind(episode: EpisodeResult) -> str:
    return WORDS[get_task(episode.task_id).is_position_task]


Aspect = Literal["object", "container"]
Cue = Literal["scene", "demonstration", "instruction"]
CUES: tuple[Cue, ...] = ("scene", "demonstration", "instruction")


class Followed(NamedTuple):
    """How often behavior was what a cue asks for.

    Attributes:
        aspect: "object": the one that the gripper held last. "container": the only one in which something
            lies at the end.
        among: "all": the episodes in whose scene the cue leaves a choice that it can be seen to follow.
            "conflicts": those in which, besides, demonstration and instruction ask for different ones.
        cue: The task of the scene, of the demonstration or of the instruction; of conflicts also "neither".
        proportion: In how many of those episodes.
    """

    aspect: Aspect
    among: Literal["all", "conflicts"]
    cue: str
    proportion: Proportion


def followed(episodes: Sequence[EpisodeResult], counterfactual: Counterfactual) -> list[Followed]:
    """What behavior followed when demonstration and instruction are of different tasks.

    A task asks for those objects of the scene that it describes, whatever the scene is for, and for those
    containers that its word describes. Two tasks may agree in one of the two; and what a task asks for may
    not be in the scene, or, with a position word, be both containers. Therefore a cue counts only in scenes
    in which it asks for some objects (containers), but not for all, and conflicts are counted apart: those in
    which demonstration and instruction ask for different ones, and either can be followed.

    Args:
        episodes: Episodes of an evaluation set.
        counterfactual: Cue that was another task's; the other cue belongs to the scene's task, in any words.

    Returns:
        Counts by aspect, among which episodes, and cue.
    """
    aspects: tuple[Aspect, ...] = ("object", "container")
    rows = []
    for aspect in aspects:
        asked = [_asked_for(episode, counterfactual, aspect) for episode in episodes]
        chosen = [
            _chosen_object(item) if aspect == "object" else _chosen_container(item) for item in episodes
        ]
        for cue in CUES:
            follows = [
                choice in wanted[cue] for wanted, choice in zip(asked, chosen, strict=True) if wanted[cue]
            ]
            rows.append(Followed(aspect, "all", cue, Proportion(sum(follows), len(follows))))
        conflicts = [
            {cue: choice in wanted[cue] for cue in CUES[1:]}
            for wanted, choice in zip(asked, chosen, strict=True)
            if wanted["demonstration"]
            and wanted["instruction"]
            and wanted["demonstration"].isdisjoint(wanted["instruction"])
        ]
        for cue in CUES[1:]:
            count = sum(conflict[cue] for conflict in conflicts)
            rows.append(Followed(aspect, "conflicts", cue, Proportion(count, len(conflicts))))
        neither = sum(not any(conflict.values()) for conflict in conflicts)
        rows.append(Followed(aspect, "conflicts", "neither", Proportion(neither, len(conflicts))))
    return rows


def unknown_sentences(episodes: Sequence[EpisodeResult], counterfactual: Counterfactual) -> int:
    """In how many episodes the cue that is another task's is a sentence of none of the benchmark's tasks.

    Nobody knows then what it asks for: as a cue it is not counted.
    """
    tasks = (_cue_tasks(episode, counterfactual) for episode in episodes)
    changed: Cue = "demonstration" if counterfactual == "demo" else "instruction"
    return sum(counterfactual != "none" and cues[changed] is None for cues in tasks)


_TASK_OF_SENTENCE = MappingProxyType({task.instruction: task for task in (*TASKS, *COLOR_SHAPE_TASKS)})


def _cue_tasks(episode: EpisodeResult, counterfactual: Counterfactual) -> dict[Cue, Task | None]:
    scene_task = get_task(episode.task_id)
    demonstration = None
    if episode.demonstration is not None:
        own = None if counterfactual == "demo" else scene_task
        demonstration = _TASK_OF_SENTENCE.get(episode.demonstration, own)
    # A paraphrase is still the scene's task, unless the instruction is what was changed.
    own = None if counterfactual == "instruction" else scene_task
    instruction = _TASK_OF_SENTENCE.get(episode.instruction, own)
    return {"scene": scene_task, "demonstration": demonstration, "instruction": instruction}


def _asked_for(
    episode: EpisodeResult, counterfactual: Counterfactual, aspect: Aspect
) -> dict[Cue, frozenset[int]]:
    """Numbers of the objects (containers) for which each cue asks; none where that leaves no choice."""
    asked = {}
    for cue, task in _cue_tasks(episode, counterfactual).items():
        if task is None:
            numbers = []
        elif aspect == "container" and task.index == episode.task_id:
            numbers = [episode.target_container]
        elif aspect == "container":
            numbers = [
                number
                for number, color in enumerate(CONTAINER_COLORS)
                if container_matches(task.container, color, Quadrant(*episode.container_quadrants[number]))
            ]
        elif task.index == episode.task_id and cue != "instruction":
            # In ambiguity scheme (ii), the instruction describes the target's twin as well.
            numbers = [episode.target_object]
        else:
            numbers = [n for n, index in enumerate(episode.objects) if task.describes(find_label(index))]
        n_options = len(episode.objects) if aspect == "object" else len(episode.container_quadrants)
        asked[cue] = frozenset(numbers) if len(numbers) < n_options else frozenset()
    return asked


def _chosen_object(episode: EpisodeResult) -> int | None:
    return episode.grasped_object if episode.grasped_object >= 0 else None


def _chosen_container(episode: EpisodeResult) -> int | None:
    filled = {container for container in episode.object_containers if container >= 0}
    return filled.pop() if len(filled) == 1 else None
