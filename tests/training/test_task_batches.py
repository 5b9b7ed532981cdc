"""Batches of tasks: what is in them, and that their order is a function of the seed."""

from collections import Counter

import numpy as np
import pytest

from lerobot_deltaco.training.task_batches import TaskBatchSampler

# 7 tasks of 10, 20, ... 70 frames.
TASKS = np.repeat(np.arange(7), np.arange(10, 80, 10))


def batches(sampler):
    return np.array(list(sampler)).reshape(-1, sampler.batch_size)


def test_a_batch_has_as_many_samples_of_each_of_its_tasks():
    for tasks_per_batch in (1, 3, 4, 7):
        sampler = TaskBatchSampler(TASKS, 5 * tasks_per_batch, tasks_per_batch)
        drawn = batches(sampler)
        assert drawn.size == len(sampler)
        for batch in drawn:
            assert list(Counter(TASKS[batch].tolist()).values()) == [5] * tasks_per_batch


def test_tasks_are_in_as_many_batches_and_their_frames_drawn_as_often():
    drawn = batches(TaskBatchSampler(TASKS, 20, 4)).ravel()
    per_task = Counter(TASKS[drawn].tolist())
    assert set(per_task) == set(range(7))
    assert max(per_task.values()) - min(per_task.values()) <= 5  # the samples of one visit
    per_frame = np.bincount(drawn, minlength=len(TASKS))
    for task in range(7):
        assert np.ptp(per_frame[task == TASKS]) <= 1


def test_upsampled_tasks_get_their_fraction_of_each_batch():
    for batch in batches(TaskBatchSampler(TASKS, 24, 4, upsampled=[0, 1], upsampled_fraction=0.5)):
        assert np.isin(TASKS[batch], [0, 1]).mean() == 0.5
        assert len(set(TASKS[batch])) == 4


def test_the_order_is_a_function_of_seed_and_epoch():
    first, again = TaskBatchSampler(TASKS, 12, 3, seed=5), TaskBatchSampler(TASKS, 12, 3, seed=5)
    np.testing.assert_array_equal(batches(first), batches(again))
    assert not np.array_equal(first.order(0), first.order(1))
    assert not np.array_equal(first.order(0), TaskBatchSampler(TASKS, 12, 3, seed=6).order(0))
    # The second iteration is the second epoch.
    np.testing.assert_array_equal(batches(again).ravel(), first.order(1))


def test_a_resumed_epoch_continues():
    sampler = TaskBatchSampler(TASKS, 12, 3)
    whole = batches(sampler).ravel()
    sampler.load_state_dict({"epoch": 0, "start_index": 36})
    np.testing.assert_array_equal(np.array(list(sampler)), whole[36:])
    np.testing.assert_array_equal(batches(sampler).ravel(), sampler.order(1))


def test_unused_frames_are_not_drawn():
    use = np.arange(len(TASKS)) % 2 == 0
    drawn = batches(TaskBatchSampler(TASKS, 12, 3, use=use)).ravel()
    assert use[drawn].all()
    assert set(TASKS[drawn]) == set(range(7))


def test_numbers_that_do_not_fit_are_refused():
    for message, arguments in {
        "10 samples cannot hold 4 tasks.*such as 8": (10, 4),
        "8 different tasks, but the dataset has only 7": (16, 8),
        "2 different upsampled tasks, but the dataset has only 1": (8, 4, [0], 0.5),
        "`upsampled_fraction` must leave at least one .* Got 0.1 of 4 tasks": (8, 4, [0, 1], 0.1),
    }.items():
        with pytest.raises(ValueError, match=message):
            TaskBatchSampler(TASKS, *arguments)
