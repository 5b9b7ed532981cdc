"""The scripted expert succeeds, quickly, in every task."""

from collections import defaultdict
from multiprocessing import get_context

import numpy as np
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import CLOSED, OPEN, Stage, expert_episode
from gym_deltaco.layout import AMBIGUITIES
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import N_TASKS
from lerobot_deltaco.common.cores import available_cores

ALL_TASKS_SEEDS = 50
# One task of every row of the table, over all columns.
SAMPLE = [50 * (row % 6) + row for row in range(N_TASKS // 6)]
SAMPLE_SEEDS = 2


def success_steps(job):
    """(task, number of the step at which each episode had succeeded, or infinity)."""
    ambiguity, task_id, n_seeds = job
    env = PickPlaceEnv(task_id, ambiguity=ambiguity)
    steps = []
    for trial in range(n_seeds):
        episode = expert_episode(env, task_id, episode_seed(0, "evaluation", task_id, trial))
        steps.append(next((n for n, step in enumerate(episode, start=1) if step.info["is_success"]), np.inf))
    env.close()
    return task_id, steps


def measure(ambiguity, task_ids, n_seeds):
    """{task: steps}, over all cores."""
    jobs = [(ambiguity, task_id, n_seeds) for task_id in task_ids]
    with get_context("spawn").Pool(min(available_cores(), len(jobs))) as pool:
        return dict(pool.imap_unordered(success_steps, jobs))


def check_thresholds(results, per_task, share_by_step_22):
    steps = np.concatenate(list(results.values()))
    assert np.isfinite(steps).mean() >= 0.95
    assert np.median(steps) <= 15
    assert (steps <= 22).mean() >= share_by_step_22
    rates = {task_id: np.isfinite(task_steps).mean() for task_id, task_steps in results.items()}
    assert {task_id: rate for task_id, rate in rates.items() if rate < per_task} == {}


@pytest.mark.parametrize(("ambiguity", "tasks"), [("container", SAMPLE), ("object", SAMPLE[::4])])
def test_the_expert_succeeds_in_a_sample_of_tasks(ambiguity, tasks):
    # 95 % are released by step 22, as the slow test holds; so few episodes show it less closely.
    check_thresholds(measure(ambiguity, tasks, SAMPLE_SEEDS), per_task=1 / SAMPLE_SEEDS, share_by_step_22=0.9)


@pytest.mark.slow
@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_the_expert_succeeds_in_every_task(ambiguity):
    check_thresholds(
        measure(ambiguity, range(N_TASKS), ALL_TASKS_SEEDS), per_task=0.85, share_by_step_22=0.95
    )


def test_the_stages_come_in_order_and_command_the_gripper():
    env = PickPlaceEnv()
    seen = defaultdict(set)
    for step in expert_episode(env, task_id=4, seed=0, noise=0.0):
        seen[step.stage].add(float(step.action[3]))
    env.close()
    assert list(seen) == list(Stage)
    closed = {Stage.GRASP, Stage.LIFT, Stage.CARRY, Stage.LOWER}
    assert seen == {stage: {CLOSED if stage in closed else OPEN} for stage in Stage}


def test_the_noise_is_on_the_motions_and_not_on_the_gripper():
    env = PickPlaceEnv()
    resting = [
        step.action for seed in range(8) for step in expert_episode(env, 4, seed) if step.stage is Stage.REST
    ]
    env.close()
    # While it rests, the expert's own motion corrects the noise of the step before.
    spread = np.std(resting, axis=0)
    np.testing.assert_allclose(spread[:3], np.sqrt(2) * 0.1, rtol=0.25)
    assert spread[3] == 0


def test_an_episode_is_a_function_of_its_seed():
    env = PickPlaceEnv()
    first, second = ([step.action for step in expert_episode(env, 7, seed=3)] for _ in range(2))
    other = [step.action for step in expert_episode(env, 7, seed=4)]
    env.close()
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)
