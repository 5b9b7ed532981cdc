"""Tests of which actions of predicted chunks are carried out."""

import math

import pytest
import torch
from small_policies import TASKS, batch_of

from lerobot_deltaco.policies.base.action_queues import ActionQueues

OPEN, CLOSED = 1.0, -1.0


def carry_out(queues, commands, n_steps):
    """Carries out chunks whose gripper commands at a step are `commands[step:]`, for each sample.

    Returns:
        Steps at which the carried-out actions were predicted, and those that they are for, (n_steps, batch).
    """
    predicted_at, meant_for = [], []
    for step in range(n_steps):
        if queues.need_chunks:
            steps = torch.arange(step, step + 4).expand(len(commands), 4)
            gripper = torch.stack([torch.tensor(each)[step : step + 4] for each in commands])
            queues.refill(torch.stack([torch.full(steps.shape, step), steps, gripper], dim=-1))
        action = queues.pop()
        predicted_at.append(action[:, 0])
        meant_for.append(action[:, 1])
    return torch.stack(predicted_at).T.tolist(), torch.stack(meant_for).T.tolist()


CLOSES_AT_2 = [OPEN] * 2 + [CLOSED] * 10
STAYS_OPEN = [OPEN] * 12


@pytest.mark.parametrize(
    ("n_action_steps", "commands", "expected"),
    [
        (None, STAYS_OPEN, [0, 0, 0, 0, 4, 4, 4, 4]),
        (3, STAYS_OPEN, [0, 0, 0, 3, 3, 3, 6, 6]),
        (1, STAYS_OPEN, [0, 1, 2, 3, 4, 5, 6, 7]),
        # The chunk that closes the gripper is carried out as a whole.
        (1, CLOSES_AT_2, [0, 1, 2, 2, 2, 2, 6, 7]),
        (2, CLOSES_AT_2, [0, 0, 2, 2, 2, 2, 6, 6]),
        (3, CLOSES_AT_2, [0, 0, 0, 0, 4, 4, 4, 7]),
    ],
)
def test_chunk_that_moves_the_gripper_is_carried_out_as_a_whole(n_action_steps, commands, expected):
    predicted_at, meant_for = carry_out(ActionQueues(n_action_steps, 2), [commands], 8)
    assert predicted_at == [expected]
    assert meant_for == [list(range(8))]


def test_samples_of_a_batch_do_not_affect_each_other():
    batch = [CLOSES_AT_2, STAYS_OPEN]
    together, _ = carry_out(ActionQueues(2, 2), batch, 8)
    assert together == [carry_out(ActionQueues(2, 2), [each], 8)[0][0] for each in batch]


def test_without_a_gripper_every_chunk_is_carried_out_alike():
    assert carry_out(ActionQueues(2, None), [CLOSES_AT_2], 6)[0] == [[0, 0, 2, 2, 4, 4]]


def test_clear_forgets_the_actions_and_the_gripper():
    queues = ActionQueues(1, 2)
    carry_out(queues, [[CLOSED] * 12], 3)
    queues.clear()
    assert queues.need_chunks
    assert carry_out(queues, [STAYS_OPEN], 3)[0] == [[0, 1, 2]]


@pytest.mark.usefixtures("fake_language")
def test_temporal_ensembling_averages_all_predictions_for_a_step(make, dataset):
    """As in ACT: the weights of predictions fall by exp(-coefficient), from the oldest to the newest."""
    options = {"chunk_size": 3, "n_action_steps": 1, "temporal_ensemble_coeff": 0.5}
    policy, before, _ = make(method="language_only", **options)
    policy.eval()
    batches = [before({**batch_of(dataset, [frame]), "task": TASKS[:1]}) for frame in (0, 7)]
    first, second = (policy.predict_action_chunk(batch) for batch in batches)
    for _ in range(2):  # after a reset, as at first
        policy.reset()
        actions = [policy.select_action(batch) for batch in batches]
        torch.testing.assert_close(actions[0], first[:, 0])
        weight = math.exp(-0.5)
        torch.testing.assert_close(actions[1], (first[:, 1] + weight * second[:, 0]) / (1 + weight))
    assert not torch.allclose(actions[1], second[:, 0])
