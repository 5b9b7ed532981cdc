"""The episodes of an evaluation set, and the batches in which they are run."""

import pytest

from gym_deltaco.tasks import get_task
from lerobot_deltaco.evaluation.episodes import Episode, draw_episodes, split_into_batches
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.simulators import Simulators

TASKS = (4, 14, 55, 64, 214)
SELECTION = ",".join(map(str, TASKS))


@pytest.mark.parametrize("counterfactual", ["none", "demo", "instruction"])
def test_each_trial_of_each_task_is_drawn_once(counterfactual):
    plan = EvaluationPlan(SELECTION, trials=3, counterfactual=counterfactual)
    episodes = draw_episodes(plan, set_number=1)
    assert [(each.trial, each.task_id) for each in episodes] == [
        (n, task) for n in range(3) for task in TASKS
    ]
    assert len({each.seed for each in episodes}) == len(episodes)
    for each in episodes:
        own = get_task(each.task_id).instruction
        assert (each.instruction != own, each.demonstrated != own) == (
            counterfactual == "instruction",
            counterfactual == "demo",
        )


def test_counterfactual_demonstrations_are_of_tasks_that_have_some():
    known = {get_task(4).instruction, get_task(14).instruction}
    plan = EvaluationPlan(SELECTION, trials=2, counterfactual="demo")
    assert {each.demonstrated for each in draw_episodes(plan, 0, known)} == known


@pytest.mark.parametrize(
    ("n_episodes", "n_batches"), [(1, 1), (3, 3), (4, 4), (6, 3), (20, 4), (40, 5), (204, 26)]
)
def test_batches_hold_all_episodes_in_their_order(n_episodes, n_batches):
    episodes = [Episode(0, number, number, "do it", "do it") for number in range(n_episodes)]
    batches = split_into_batches(episodes)
    assert [each for batch in batches for each in batch] == episodes
    assert len(batches) == n_batches
    assert max(map(len, batches)) <= 8


def test_simulators_run_any_tasks_in_any_number():
    simulators = Simulators({"image_size": 16})
    try:
        for task_ids in ([4, 14], [55], [64, 4, 14], [14, 4]):
            env = simulators.vector_env(task_ids)
            assert env.num_envs == len(task_ids)
            observations, infos = env.reset(seed=list(range(len(task_ids))))
            assert observations["pixels"].shape == (len(task_ids), 16, 16, 3)
            assert infos["task_id"].tolist() == task_ids
            assert env.call("task_description") == tuple(get_task(task).instruction for task in task_ids)
        assert len({id(each) for size in (1, 2, 3) for each in simulators.vector_env([4] * size).envs}) == 3
    finally:
        simulators.close()
