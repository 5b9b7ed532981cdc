"""What happens to observations and actions on their way to the policy and back."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.lerobot_internals import make_processor_steps_thread_safe, shorten_logs

make_processor_steps_thread_safe()
shorten_logs()


def make_deltaco_pre_post_processors(
    config: DeltacoConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's usual pipelines, with the configuration's normalization.

    Images stay in 0..1; the state has mean 0 and standard deviation 1; actions are in -1..1: those of the
    benchmark as they are, any other dataset's by their least and greatest values.

    Args:
        config: The configuration.
        dataset_stats: Statistics of the training dataset.

    Returns:
        The pipelines before and behind the policy.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
