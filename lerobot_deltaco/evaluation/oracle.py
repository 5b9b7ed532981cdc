"""Oracles: the benchmark says where to pick and place, or moves the arm there, in place of the policy.

They tell apart the two parts of a policy that first finds where to pick and place, and then acts. Positions
are those of the end effector at the grasp and at the release, (2, 3), m.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gym_deltaco.env import N_JOINTS, PickPlaceEnv
from gym_deltaco.expert import Expert, JointExpert, target_positions
from gym_deltaco.robot.kinematics import forward, inverse
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import Oracle

_POSITION = slice(N_JOINTS, N_JOINTS + 3)  # in the state, with position control


def check_oracle(policy: Any, oracle: Oracle) -> None:
    """Checks that an oracle can replace a part of a policy.

    Raises:
        UserError: It cannot.
    """
    needed = {"location": "set_pick_and_place", "controller": "localized_states"}
    if oracle != "none" and not hasattr(policy, needed[oracle]):
        raise UserError(
            f"`oracle` is {oracle!r}, but a policy of the type {policy.config.type!r} does not find where to "
            "pick and place before it acts: there is nothing to replace. Use it with deltaco_match."
        )


def state_at(position: NDArray[np.float64], control: str) -> NDArray[np.float64]:
    """Returns the robot's state with the open gripper at a position of the end effector, (3,), m."""
    joints, opening = inverse(position), 1.0
    return np.array([*joints, opening] if control == "joints" else [*joints, *position, opening])


def give_locations(policy: Any, envs: Sequence[PickPlaceEnv]) -> None:
    """Gives a policy the robot's states at the true pick and place of each environment's scene."""
    states = [
        [state_at(position, env.scene_config.control) for position in target_positions(env.scene)]
        for env in envs
    ]
    device = next(policy.parameters()).device
    policy.set_pick_and_place(torch.tensor(np.array(states), dtype=torch.float32, device=device))


def localized_positions(policy: Any, control: str) -> NDArray[np.float64] | None:
    """Returns where a policy picks and places in its running episodes, (batch, 2, 3), m; None if unknown."""
    states = getattr(policy, "localized_states", None)
    if states is None:
        return None
    states = states.cpu().double().numpy()
    if control == "position":
        return states[..., _POSITION]
    joints = states[..., :N_JOINTS]
    return np.array([[forward(angles)[0] for angles in episode] for episode in joints])


def make_controllers(policy: Any, envs: Sequence[PickPlaceEnv]) -> list[Expert]:
    """Returns controllers without noise, which grasp and release where a policy has localized."""
    control = envs[0].scene_config.control
    positions = localized_positions(policy, control)
    assert positions is not None
    kind = JointExpert if control == "joints" else Expert
    return [
        kind(env, np.random.default_rng(0), noise=0.0, goals=goals)
        for env, goals in zip(envs, positions, strict=True)
    ]
