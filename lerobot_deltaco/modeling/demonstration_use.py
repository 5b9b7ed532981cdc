"""Which demonstrations an evaluation uses, as the configuration says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.demonstration_choice import choose_episode, choose_eval_demonstrations
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.language.paraphrases import Paraphrases


def choose_demonstrations(
    config: DeltacoConfig,
    candidates: Sequence[DemonstrationSet | None],
    tasks: Sequence[str],
    trials: Sequence[int],
    replaced: Mapping[str, str],
    paraphrases: Paraphrases | None,
) -> tuple[DemonstrationSet, Tensor]:
    """Chooses a demonstration for each sample: the configuration's episode or task, or its instruction's.

    Args:
        config: Configuration of the policy.
        candidates: Sets of demonstrations, in the order in which they are searched; that of the dataset
            `demo_repo_id` first.
        tasks: Instruction of each sample, or the task string that demonstrates it.
        trials: Number of each sample's episode among those of its task, from 0.
        replaced: For instructions that get another task's demonstrations, its task string.
        paraphrases: Sentences that stand for task strings; None for none.

    Returns:
        A set, and the row of each sample's demonstration in it, (batch,).

    Raises:
        ValueError: A task has no demonstration, or the episode is not there.
    """
    named = candidates[0]
    if config.demo_episode is not None and named is not None:
        return choose_episode(named, config.demo_episode, len(tasks))
    task_strings = dict(replaced)
    if config.demo_task is not None:
        task_strings |= dict.fromkeys(tasks, config.demo_task)
    if paraphrases is not None:
        known = {name for candidate in candidates if candidate is not None for name in candidate.rows}
        task_strings = paraphrases.tasks_of(tasks, known) | task_strings
    return choose_eval_demonstrations(candidates, tasks, trials, task_strings)
