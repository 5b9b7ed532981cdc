"""Loads the policy of a checkpoint, ready to act."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline

from lerobot_deltaco.common.run_folder import RunError
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy


class LoadedPolicy(NamedTuple):
    """A policy in evaluation mode, with its processors."""

    policy: DeltacoPolicy
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline


def load_policy(folder: Path, overrides: Sequence[str] = ()) -> LoadedPolicy:
    """Loads a policy and its processors, in evaluation mode.

    Args:
        folder: Folder with the policy's configuration and weights.
        overrides: Options of the policy, as on LeRobot's command line but without `policy.`:
            "--device=cpu", "--demo_root=DIR".

    Raises:
        RunError: The folder holds another type of policy.
    """
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=list(overrides))
    if not isinstance(config, DeltacoConfig):
        raise RunError(f"{folder} holds a policy of type {config.type!r}. Expected 'deltaco'.")
    policy = DeltacoPolicy.from_pretrained(folder, config=config)
    policy.to(config.device)
    policy.eval()
    preprocessor, postprocessor = make_pre_post_processors(
        config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": str(config.device)}},
    )
    return LoadedPolicy(policy, preprocessor, postprocessor)
