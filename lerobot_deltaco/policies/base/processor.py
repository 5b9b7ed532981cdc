"""LeRobot's pipelines around the policy."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig


def make_task_conditioned_pre_post_processors(
    config: TaskConditionedConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Returns LeRobot's usual pipelines, with the configuration's normalization.

    Images stay in 0..1; the state has mean 0 and standard deviation 1; actions are scaled to -1..1 by minimum
    and maximum.

    Args:
        config: The configuration.
        dataset_stats: Statistics of the training dataset.

    Returns:
        The pipelines before and after the policy.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
