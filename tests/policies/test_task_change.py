"""A new task in mid-episode, as LeRobot's rollout sets it while the arm runs."""

import numpy as np
import pytest
import torch
from lerobot.rollout.inference.sync import SyncInferenceEngine
from small_policies import TABLE_LENGTH, TABLE_TASKS, demos_of, small_policy


@pytest.mark.usefixtures("short_fit")
@pytest.mark.parametrize("chunk_size", [1, 4])
def test_a_new_task_is_found_in_the_current_image(table, chunk_size):
    policy, before, after = small_policy(table, "deltaco_match", chunk_size=chunk_size, **demos_of(table))
    policy.eval()
    names = table.meta.features["action"]["names"]

    def engine(task):
        return SyncInferenceEngine(policy, before, after, table.meta.features, names, task, "cpu", "robot")

    def seen(row):
        """An observation as a robot gives it."""
        image, state = (table[row][f"observation.{name}"].numpy() for name in ("image", "state"))
        image = np.round(255 * image.transpose(1, 2, 0)).astype(np.uint8)
        return {"observation.image": image, "observation.state": state}

    running = engine(TABLE_TASKS[0])
    running.reset()
    running.get_action(seen(0))
    at_first = policy.localization
    running.get_action(seen(TABLE_LENGTH))
    assert policy.localization is at_first  # in the same episode, the scene is not looked at again
    running._task = TABLE_TASKS[1]  # as `set_task` does
    actions = [running.get_action(seen(TABLE_LENGTH)) for _ in range(2)]
    locations = policy.localization.locations
    assert policy.localization is not at_first
    fresh = engine(TABLE_TASKS[1])
    fresh.reset()
    # Nothing of the old task is left, not even the rest of its chunk.
    for action in actions:
        assert torch.equal(action, fresh.get_action(seen(TABLE_LENGTH)))
    assert torch.equal(locations, policy.localization.locations)
