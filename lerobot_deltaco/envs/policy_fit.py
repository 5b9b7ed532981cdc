"""Whether a policy fits an environment: it must get there what it was trained on."""

from __future__ import annotations

from lerobot.configs import PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv


def check_policy_fits(policy: DeltacoConfig, env: DeltacoEnv) -> None:
    """Checks the images, the state and the action.

    Without this, a policy would act on images of another size than those that it was trained on: LeRobot and
    the policy scale them.

    Raises:
        ValueError: The policy was trained on something else than the environment gives.
    """
    cameras = list(policy.image_features)
    if cameras != [OBS_IMAGE]:
        raise ValueError(
            f"The policy was trained on images of {', '.join(cameras)}, but the benchmark's environment has "
            f"{OBS_IMAGE} alone. Evaluate it where it was trained for."
        )
    trained_on, given = _size(policy.image_features[OBS_IMAGE]), (env.image_size, env.image_size)
    if trained_on != given:
        raise ValueError(
            f"The policy was trained on images of {trained_on[0]} x {trained_on[1]} pixels, but those of the "
            f"environment have {given[0]} x {given[1]}. Set its `image_size` to {trained_on[0]}: "
            f"--env.image_size={trained_on[0]}, or --image-size of deltaco-evaluate."
        )
    state, action = policy.robot_state_feature, policy.action_feature
    for name, feature, key in ((OBS_STATE, state, "agent_pos"), (ACTION, action, ACTION)):
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
