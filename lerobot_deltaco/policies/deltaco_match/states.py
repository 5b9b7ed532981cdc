"""The robot's states at the pick and place locations, and the height offset of a grasp.

A location in an image leaves one number open: how far along the camera's ray it is. At a grasp, that depends
on the object, and an unknown flat object looks like a tall one farther away. A demonstration resolves this,
through the robot's state when its gripper closed.

Grasp height offset: how far the state at a grasp is along the robot's direction of approach, beyond what the
location predicts; in standard deviations over the training episodes, 0 on average. In the benchmark, larger
is lower.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_deltaco.data.grasps import Keyframes
from lerobot_deltaco.policies.deltaco_match.calibration import StateToImage

N_LOCATIONS = 2  # pick and place
_N_LOCATION_FEATURES = 10
_N_HEIGHT_FEATURES = 3  # of the first of those: 1, x, y
_RIDGE = 1e-5
# Spread of a normalized state around what locations predict, below which it does not count.
_MIN_SPREAD = 1e-3
_MAX_REST = 4.0  # beyond which, in that spread, it is an accident


class TrainingLocations(NamedTuple):
    """Pick and place locations of training episodes.

    Attributes:
        locations: Pick and place in the first camera's image, (episodes, 2, 2) in -1..1.
        heights: Grasp height offsets, (episodes,).
        has_grasp: Whether the gripper closed and opened in an episode, (episodes,) bool; else the rest is 0.
    """

    locations: Tensor
    heights: Tensor
    has_grasp: Tensor


class RobotStates(nn.Module):
    """The state of the robot at a location, by regression over the training episodes.

    Args:
        state_dim: Size of the robot's state.

    Attributes:
        to_image: Map from states to locations in the image.
    """

    location_to_state: Tensor
    height_to_state: Tensor
    state_scale: Tensor
    state_shift: Tensor
    rest_scale: Tensor

    def __init__(self, state_dim: int) -> None:
        super().__init__()
        self.to_image = StateToImage(state_dim)
        self.register_buffer("location_to_state", torch.zeros(N_LOCATIONS, _N_LOCATION_FEATURES, state_dim))
        self.register_buffer("height_to_state", torch.zeros(_N_HEIGHT_FEATURES, state_dim))
        # A state as the policy gets it is state_scale * state + state_shift.
        self.register_buffer("state_scale", torch.ones(state_dim))
        self.register_buffer("state_shift", torch.zeros(state_dim))
        self.register_buffer("rest_scale", torch.zeros(state_dim))

    def fit(
        self,
        keyframes: Keyframes,
        first: Tensor,
        carried: Tensor,
        last: Tensor,
        scale: Tensor,
        shift: Tensor,
        is_arm: Tensor,
    ) -> TrainingLocations:
        """Calibrates the camera and learns which state the robot has at a location.

        Args:
            keyframes: Keyframes of the training episodes.
            first: First images of the episodes, (episodes, 3, H, W) uint8.
            carried: Images halfway between grasp and release, (episodes, 3, H, W) uint8.
            last: Last images of the episodes, (episodes, 3, H, W) uint8.
            scale: The policy's input is `scale * state + shift`, (state,).
            shift: Shift of each dimension, (state,).
            is_arm: Dimensions of the state other than the gripper's opening, (state,) bool. At a grasp, the
                opening depends on the object's width, and says nothing about where the object is.

        Returns:
            The locations and heights of the episodes.
        """
        has_grasp = keyframes.has_grasp
        first, carried, last = (images[has_grasp] for images in (first, carried, last))
        self.to_image.fit(first, carried, last, keyframes.states[has_grasp, 0], scale * is_arm)
        locations = self.to_image(keyframes.states).clamp(-1, 1)
        self.state_scale.copy_(scale)
        self.state_shift.copy_(shift)
        states = keyframes.states * scale + shift  # (episodes, 2, state)
        for n in range(N_LOCATIONS):
            features = _location_features(locations[has_grasp, n])
            self.location_to_state[n].copy_(_ridge_regression(features, states[has_grasp, n]))
        last_moves = (states[:, 0] - (keyframes.approach * scale + shift))[has_grasp]
        self._fit_heights(locations[has_grasp, 0], states[has_grasp, 0], last_moves, is_arm)
        return self.locate(keyframes)

    def locate(self, keyframes: Keyframes) -> TrainingLocations:
        """Returns the locations and heights of episodes, from the robot's states in them."""
        has_grasp = keyframes.has_grasp
        locations = self.to_image(keyframes.states).clamp(-1, 1)
        heights = self.heights(keyframes.states[:, 0])
        return TrainingLocations(
            torch.where(has_grasp[:, None, None], locations, 0.0),
            torch.where(has_grasp, heights, 0.0),
            has_grasp,
        )

    def _fit_heights(self, locations: Tensor, states: Tensor, last_moves: Tensor, is_arm: Tensor) -> None:
        features = _location_features(locations)
        rest = states - features @ self.location_to_state[0]  # (episodes, state)
        spread = 1.4826 * rest.abs().median(dim=0).values
        # A joint that only vibrates counts no more than one that reaches.
        self.rest_scale.copy_(torch.where(is_arm & (spread > _MIN_SPREAD), 1 / spread.clamp_min(1e-12), 0.0))
        self.height_to_state.copy_(_ridge_regression(features[:, :_N_HEIGHT_FEATURES], last_moves * is_arm))
        self.height_to_state.mul_(self._project(rest, features).std())

    def heights(self, pick_states: Tensor) -> Tensor:
        """Returns the height offsets of grasps, (grasps,); NaN for a grasp that is not known.

        Args:
            pick_states: The robot's states at the grasps, as in the dataset, (grasps, state); NaN if a grasp
                is not known.
        """
        features = _location_features(self.pick_locations(pick_states))
        rest = pick_states * self.state_scale + self.state_shift - features @ self.location_to_state[0]
        return self._project(rest, features)

    def pick_locations(self, pick_states: Tensor) -> Tensor:
        """Returns the locations of grasps, (grasps, 2), from the robot's states there."""
        return self.to_image(pick_states).clamp(-1, 1)

    def _project(self, rest: Tensor, features: Tensor) -> Tensor:
        """Returns heights from the residuals of states given locations, (grasps, state)."""
        direction = (features[:, :_N_HEIGHT_FEATURES] @ self.height_to_state) * self.rest_scale
        rest = (rest * self.rest_scale).clamp(-_MAX_REST, _MAX_REST)
        return (rest * direction).sum(dim=1) / direction.square().sum(dim=1).clamp_min(1e-12)

    def forward(self, locations: Tensor, heights: Tensor) -> Tensor:
        """Returns the states at the pick and place locations, as the policy gets them.

        Args:
            locations: Pick and place, (batch, 2, 2) in -1..1.
            heights: Height offset of each grasp, (batch,).

        Returns:
            (batch, 2, state).
        """
        features = _location_features(locations)
        states = torch.einsum("bgf,gfs->bgs", features, self.location_to_state)
        further = (features[:, 0, :_N_HEIGHT_FEATURES] * heights[:, None]) @ self.height_to_state
        return torch.cat([states[:, :1] + further[:, None], states[:, 1:]], dim=1)


def _ridge_regression(features: Tensor, targets: Tensor) -> Tensor:
    """Returns weights (features, targets) that predict targets (n, targets) from features (n, features)."""
    ridge = _RIDGE * len(features) * torch.eye(features.shape[1], device=features.device)
    return torch.linalg.solve(features.T @ features + ridge, features.T @ targets)


def _location_features(locations: Tensor) -> Tensor:
    """Returns the powers of x and y up to the third: (..., 2) to (..., 10)."""
    x, y = locations.unbind(dim=-1)
    ones = torch.ones_like(x)
    return torch.stack([ones, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], dim=-1)
