"""The scripted expert succeeds, quickly, in every task."""

from collections import defaultdict
from contextlib import closing
from multiprocessing import get_context

import numpy as np
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import CLOSED, OPEN, Stage, expert_episode
from gym_deltaco.scene_config import AMBIGUITIES, SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import TASKS

# One task of each row of the table, over all columns
SAMPLE = [50 * (row % 6) + row for row in range(len(TASKS) // 6)]


def success_steps(job):
    """Returns the number of steps until the success of each episode of a task; infinity without success."""
    ambiguity, task_id, n_episodes = job
    steps = []
    with closing(PickPlaceEnv(task_id, SceneConfig(ambiguity=ambiguity))) as env:
        for trial in range(n_episodes):
            episode = expert_episode(env, task_id, episode_seed(0, "evaluation", task_id, trial))
            steps.append(next((n for n, step in enumerate(episode, 1) if step.info["is_success"]), np.inf))
    return steps


def steps_of_tasks(ambiguity, task_ids, n_episodes):
    """Returns `success_steps` of tasks, (tasks, episodes)."""
    jobs = [(ambiguity, task_id, n_episodes) for task_id in task_ids]
    with get_context("spawn").Pool(2) as pool:
        return np.array(pool.map(success_steps, jobs, chunksize=1))


@pytest.mark.parametrize(("ambiguity", "task_ids"), [("container", SAMPLE), ("object", SAMPLE[::4])])
def test_expert_succeeds_in_a_sample_of_tasks(ambiguity, task_ids):
    steps = steps_of_tasks(ambiguity, task_ids, 1)
    assert np.isfinite(steps).mean() >= 0.95
    assert np.median(steps) <= 15
    assert (steps <= 22).mean() >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_expert_succeeds_in_every_task(ambiguity):
    steps = steps_of_tasks(ambiguity, range(len(TASKS)), 50)
    assert np.median(steps) <= 15
    assert (steps <= 22).mean() >= 0.95
    assert np.isfinite(steps).mean(axis=1).min() >= 0.85


def test_stages_come_in_order_and_command_the_gripper():
    seen = defaultdict(set)
    with closing(PickPlaceEnv()) as env:
        for step in expert_episode(env, task_id=4, seed=0, noise=0.0):
            seen[step.stage].add(float(step.action[3]))
    assert list(seen) == list(Stage)
    closed = {Stage.GRASP, Stage.LIFT, Stage.CARRY, Stage.LOWER}
    assert seen == {stage: {CLOSED if stage in closed else OPEN} for stage in Stage}


def test_noise_is_on_the_motion_and_not_on_the_gripper():
    with closing(PickPlaceEnv()) as env:
        steps = [step for seed in range(8) for step in expert_episode(env, 4, seed)]
    # While it rests, the expert corrects the noise of the previous step.
    spread = np.std([step.action for step in steps if step.stage is Stage.REST], axis=0)
    np.testing.assert_allclose(spread[:3], np.sqrt(2) * 0.1, rtol=0.25)
    assert spread[3] == 0
