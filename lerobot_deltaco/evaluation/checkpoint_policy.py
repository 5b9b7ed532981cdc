"""Loads the policy of a checkpoint, of this project's type or another one of LeRobot's, ready to act."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_deltaco.common.run_folder import RunError
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import check_policy_fits
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.processor_files import check_processor_files

_RENAMING_STEP = "rename_observations_processor"


class LoadedPolicy(NamedTuple):
    """A policy in evaluation mode, with its processors."""

    policy: PreTrainedPolicy
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline


def load_policy(
    folder: Path, overrides: Sequence[str] = (), rename_map: Mapping[str, str] | None = None
) -> LoadedPolicy:
    """Loads a policy and its processors, in evaluation mode.

    Args:
        folder: Folder with the policy's configuration and weights.
        overrides: Options of the policy, as on LeRobot's command line but without `policy.`:
            "--device=cpu", "--demo_root=DIR".
        rename_map: Names under which the policy knows the environment's observations, by the environment's
            names; None takes those with which it was trained.

    Raises:
        RunError: Packages of this type of policy are not installed.
        ProcessorFileError: The checkpoint's processors would run code of their own when they are loaded.
        ValueError: It is a policy of another type, and not one for the benchmark's environment; or the
            overrides do not fit it.
    """
    try:
        config = PreTrainedConfig.from_pretrained(folder, cli_overrides=list(overrides))
    except ParsingError as error:
        raise ValueError(f"{folder}: {error.__cause__ or error}") from error
    if isinstance(config, DeltacoConfig):
        policy: PreTrainedPolicy = DeltacoPolicy.from_pretrained(folder, config=config)
    else:
        policy = _load_other(folder, config, rename_map)
    policy.to(config.device)
    policy.eval()
    replaced: dict[str, Any] = {"device_processor": {"device": str(config.device)}}
    if rename_map is not None:
        replaced[_RENAMING_STEP] = {"rename_map": dict(rename_map)}
    preprocessor, postprocessor = make_pre_post_processors(
        config, pretrained_path=str(folder), preprocessor_overrides=replaced
    )
    return LoadedPolicy(policy, preprocessor, postprocessor)


def trained_rename_map(folder: Path) -> dict[str, str]:
    """The names that the environment's observations had in a policy's training, which its processor keeps."""
    path = folder / f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json"
    if not path.is_file():
        return {}
    for step in json.loads(path.read_text(encoding="utf-8")).get("steps", []):
        if step.get("registry_name") == _RENAMING_STEP:
            return dict(step.get("config", {}).get("rename_map") or {})
    return {}


def _load_other(
    folder: Path, config: PreTrainedConfig, rename_map: Mapping[str, str] | None
) -> PreTrainedPolicy:
    """A policy of another type, which was trained on the benchmark."""
    kind = config.type
    try:
        get_policy_class(kind)
        # The steps of its processors are registered there, if it has some of its own.
        importlib.import_module(type(config).__module__.replace("configuration_", "processor_"))
    except ImportError as error:
        raise RunError(
            f"{folder} holds a policy of the type {kind!r}, whose packages are not installed: {error}. "
            f"Install LeRobot's extra for it, such as `pip install 'lerobot[{kind}]'`."
        ) from error
    check_processor_files(folder)
    names = trained_rename_map(folder) if rename_map is None else dict(rename_map)
    sizes = [feature.shape[-1] for feature in config.image_features.values()]
    env = DeltacoEnv(image_size=sizes[0]) if sizes else DeltacoEnv()
    check_policy_fits(config, env, names)
    started_from, config.pretrained_path = config.pretrained_path, folder
    backbone = getattr(config, "pretrained_backbone_weights", None)
    if backbone is not None:
        # Those of the checkpoint take their place, so that they need not be downloaded.
        config.pretrained_backbone_weights = None
    try:
        policy = make_policy(config, env_cfg=env, rename_map=names)
    except ImportError as error:
        raise RunError(
            f"{folder} holds a policy of the type {kind!r}, whose packages are not installed: {error}"
        ) from error
    finally:
        # As the training had them, for the record.
        config.pretrained_path = started_from
        if backbone is not None:
            config.pretrained_backbone_weights = backbone
    return policy
