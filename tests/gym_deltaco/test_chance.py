"""Success rates of policies that ignore the task."""

import pytest

from gym_deltaco.chance import RULES, chance_levels
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import TASK_SETS


def test_chance_levels_of_the_test_tasks():
    levels = chance_levels(TASK_SETS["scenario_a_test"], n_trials=10)
    assert list(levels) == list(RULES)
    assert list(levels.values()) == pytest.approx([1 / 3, 0.418, 0.559, 0.594], abs=0.03)


def test_adversarial_distractors_give_the_target_away():
    uniform, adversarial = (
        chance_levels(range(24, 32), SceneConfig(adversarial_probability=p), n_trials=30) for p in (0, 1)
    )
    rule = "most shared colors and shapes"
    assert uniform["random object"] == adversarial["random object"] == pytest.approx(1 / 3)
    assert uniform[rule] + 0.2 < adversarial[rule]


def test_nothing_gives_an_unseen_target_or_a_twin_away():
    levels = chance_levels(
        TASK_SETS["out_of_distribution"][:8], SceneConfig(objects="out_of_distribution"), n_trials=2
    )
    assert list(levels.values()) == pytest.approx([1 / 3] * 4)
    levels = chance_levels([24, 74], SceneConfig(ambiguity="object"), n_trials=5)
    assert levels["most shared colors and shapes"] == 0.5
