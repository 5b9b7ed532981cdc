"""Whether a policy fits an environment: it must get there what it was trained on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from types import MappingProxyType

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_deltaco.envs.configuration_env import DeltacoEnv

NO_RENAMING: Mapping[str, str] = MappingProxyType({})


def check_policy_fits(
    policy: PreTrainedConfig, env: DeltacoEnv, rename_map: Mapping[str, str] = NO_RENAMING
) -> None:
    """Checks the images, the state and the action.

    Without this, a policy would act on images of another size than those that it was trained on: LeRobot and
    the policy scale them.

    Args:
        policy: Configuration of a policy of any type.
        env: Configuration of the environment.
        rename_map: Names under which the policy knows the environment's observations, by the environment's
            names, as LeRobot's `--rename_map` takes them.

    Raises:
        ValueError: The policy was trained on something else than the environment gives.
    """
    unknown = sorted(set(rename_map) - {OBS_IMAGE, OBS_STATE})
    if unknown:
        raise ValueError(
            f"`rename_map` renames {unknown[0]}, which the environment does not give. It gives "
            f"{OBS_IMAGE} and {OBS_STATE}."
        )
    cameras = list(policy.image_features)
    camera = rename_map.get(OBS_IMAGE, OBS_IMAGE)
    # Vision-language-action models (which have this option) leave out cameras that are not there, and keep
    # the image size of what they were fine-tuned from, whatever that of the dataset was.
    can_lack_cameras = hasattr(policy, "empty_cameras")
    if camera not in cameras or (len(cameras) > 1 and not can_lack_cameras):
        called = "" if camera == OBS_IMAGE else f", which `rename_map` calls {camera}"
        example = json.dumps({OBS_IMAGE: cameras[0]}) if cameras else ""
        advice = f", or, if it is the same camera, rename it: --rename_map='{example}'" if example else ""
        raise ValueError(
            f"The policy was trained on images of {', '.join(cameras) or 'no camera'}, but the benchmark's "
            f"environment has {OBS_IMAGE} alone{called}. Evaluate it where it was trained for{advice}."
        )
    trained_on, given = _size(policy.image_features[camera]), (env.image_size, env.image_size)
    if trained_on != given and not can_lack_cameras:
        raise ValueError(
            f"The policy was trained on images of {trained_on[0]} x {trained_on[1]} pixels, but those of the "
            f"environment have {given[0]} x {given[1]}. Set its `image_size` to {trained_on[0]}: "
            f"--env.image_size={trained_on[0]}, or --image-size of deltaco-evaluate."
        )
    for name, feature in (policy.input_features or {}).items():
        if feature.type is FeatureType.ENV:
            raise ValueError(
                f"The policy was trained on `{name}`, which the benchmark's environment does not give. "
                "Evaluate it where it was trained for."
            )
    # Models that pad the state take any that is short enough.
    state = None if hasattr(policy, "max_state_dim") else policy.robot_state_feature
    for name, feature, key in ((OBS_STATE, state, "agent_pos"), (ACTION, policy.action_feature, ACTION)):
        if feature is not None and tuple(feature.shape) != tuple(env.features[key].shape):
            raise ValueError(
                f"The policy was trained on `{name}` of the shape {tuple(feature.shape)}, but that of the "
                f"benchmark's environment is {tuple(env.features[key].shape)}. Evaluate it where it was "
                "trained for."
            )


def _size(image: PolicyFeature) -> tuple[int, int]:
    """Height and width of (3, height, width)."""
    _, height, width = image.shape
    return height, width
