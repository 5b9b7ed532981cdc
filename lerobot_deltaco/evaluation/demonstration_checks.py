"""Checks that a policy takes the demonstrations that an evaluation gives it."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot.policies import PreTrainedPolicy

from gym_deltaco.tasks import get_task
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy


def check_enough_demonstrations(policy: DeltacoPolicy, task_ids: Sequence[int]) -> None:
    """Checks that the tasks have as many demonstrations as the policy combines.

    Raises:
        ValueError: A task has fewer.
    """
    n_wanted, known = policy.config.n_demonstrations, policy.eval_demonstrations
    if n_wanted == 1 or known is None or not policy.config.uses_demo:
        return
    for task_id in task_ids:
        instruction = get_task(task_id).instruction
        n_known = len(known.rows.get(instruction, ()))
        if 0 < n_known < n_wanted:
            raise ValueError(
                f"`n_demonstrations` is {n_wanted}, but there is a smaller number of demonstrations of the "
                f"task {instruction!r}: {n_known}. Collect more with `deltaco-collect --episodes-per-task "
                f"{n_wanted}` and name them with --policy.demo_repo_id and --policy.demo_root, or set "
                f"--n-demonstrations to at most {n_known}."
            )


def check_combines(policy: PreTrainedPolicy) -> None:
    """Checks that a policy combines the demonstrations of a task.

    Raises:
        ValueError: It does not.
    """
    if isinstance(policy, DeltacoPolicy) and policy.config.uses_demo and policy.config.locates_goals:
        return
    raise ValueError(
        "--n-demonstrations is for policies with `demo_encoder=correspondence` that take demonstrations. "
        f"This one (`{policy_kind(policy)}`) does not combine any: leave it out."
    )


def policy_kind(policy: PreTrainedPolicy) -> str:
    """What a policy is, for messages: its method, or its type if it is another of LeRobot's."""
    return f"method={policy.config.method}" if isinstance(policy, DeltacoPolicy) else policy.config.type
