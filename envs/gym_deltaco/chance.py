"""Chance levels: success rates of policies that ignore the task, computed from layouts alone.

Distractors are drawn around the target, from objects of its color or shape. A policy can therefore guess the
target from the scene, without an instruction or a demonstration. `python -m gym_deltaco.chance` prints the
chance levels of a set of tasks.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

import numpy as np

from gym_deltaco.layout import sample_layout
from gym_deltaco.objects.labels import SCENARIO_A_TEST, ObjectLabel
from gym_deltaco.objects.object_sets import select_objects
from gym_deltaco.scene_config import DEFAULT_SCENE, SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task, select_tasks

_TEST_OBJECTS = {label.index for label in (*SCENARIO_A_TEST, *select_objects("out_of_distribution"))}


def _n_shared(label: ObjectLabel, labels: Sequence[ObjectLabel]) -> int:
    """Returns how many colors and shapes an object shares with the other two of a scene, 0..4."""
    # It shares both with itself.
    return sum((label.color == other.color) + (label.shape == other.shape) for other in labels) - 2


# A rule scores each object of a scene, given all three, and picks the one with the highest score.
RULES: dict[str, Callable[[ObjectLabel, Sequence[ObjectLabel]], tuple[int, ...]]] = {
    "random object": lambda label, labels: (),
    "most shared colors and shapes": lambda label, labels: (_n_shared(label, labels),),
    "one of the test objects": lambda label, labels: (label.index in _TEST_OBJECTS,),
    "test object, then most shared": lambda label, labels: (
        label.index in _TEST_OBJECTS,
        _n_shared(label, labels),
    ),
}


def chance_levels(
    task_ids: Sequence[int], scene: SceneConfig = DEFAULT_SCENE, n_trials: int = 100, first_trial: int = 1000
) -> dict[str, float]:
    """Computes how often policies that pick an object by a rule pick the right one.

    Half of these picks succeed with a container chosen at random.

    Args:
        task_ids: Indices of the tasks.
        scene: Settings of the scenes.
        n_trials: Number of scenes of each task, at least 1.
        first_trial: Number of the first trial; the scenes equal those of an evaluation with this seed.

    Returns:
        Expected rate by name of the rule, 0..1. Objects with the same score are equally likely.
    """
    rates: dict[str, list[float]] = {name: [] for name in RULES}
    for task_id in task_ids:
        for trial in range(first_trial, first_trial + n_trials):
            rng = np.random.default_rng(episode_seed(0, "evaluation", task_id, 0, trial))
            layout = sample_layout(get_task(task_id), scene, rng)
            labels = [item.label for item in layout.objects]
            for name, rule in RULES.items():
                scores = [rule(label, labels) for label in labels]
                best = [number for number, score in enumerate(scores) if score == max(scores)]
                rates[name].append((layout.target_object in best) / len(best))
    return {name: float(np.mean(of_rule)) for name, of_rule in rates.items()}


def main() -> None:
    """Prints the chance levels of a set of tasks: right grasps, and success with a random container."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("tasks", nargs="?", default="scenario_a_test", help="selection of tasks")
    parser.add_argument("--trials", type=int, default=100, help="number of scenes of each task")
    parser.add_argument("--adversarial-probability", type=float, default=0.6, help="as in the scenes")
    options = parser.parse_args()
    scene = SceneConfig(adversarial_probability=options.adversarial_probability).for_tasks(options.tasks)
    sys.stdout.write(f"{'':<31} grasps success\n")
    for name, rate in chance_levels(select_tasks(options.tasks), scene, options.trials).items():
        sys.stdout.write(f"{name:<31} {rate:6.1%} {rate / 2:7.1%}\n")


if __name__ == "__main__":
    main()
