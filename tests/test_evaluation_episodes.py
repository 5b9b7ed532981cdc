"""The episodes of an evaluation set, and the batches in which they are run."""

from collections import Counter

import pytest

from gym_deltaco.tasks import get_task
from lerobot_deltaco.evaluation.episodes import Episode, batched, draw_episodes
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


@pytest.mark.parametrize("counterfactual", ["none", "demo", "instruction"])
@pytest.mark.parametrize("size", [1, 3, 8])
def test_batches_hold_all_episodes_in_their_order(counterfactual, size):
    plan = EvaluationPlan(SELECTION, trials=4, counterfactual=counterfactual)
    episodes = draw_episodes(plan, set_number=0)
    batches = batched(episodes, size)
    assert [each for batch in batches for each in batch.episodes] == episodes
    seen = Counter()
    for batch in batches:
        assert 1 <= len(batch.episodes) <= size
        for each in batch.episodes:
            assert batch.demonstrated_as[each.instruction] == each.demonstrated
        own = Counter(each.instruction for each in batch.episodes)
        assert Counter(batch.earlier) == Counter({text: seen[text] for text in own if seen[text]})
        seen += own
    if counterfactual == "none":
        assert len(batches) == -(-len(episodes) // size)


def test_an_instruction_has_one_demonstration_in_a_batch():
    first, second = Episode(0, 0, 0, "put it away", "a"), Episode(1, 0, 1, "put it away", "b")
    assert [len(batch.episodes) for batch in batched([first, first, second, second])] == [2, 2]


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
