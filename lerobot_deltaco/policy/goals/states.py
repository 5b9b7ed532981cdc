"""The robot's states at goals, from places in the image and the depth of the grasp.

A place in an image leaves one number open: how far along the camera's ray it is. At a grasp, that depends on
the object, and a flat object of an unknown kind looks like a tall one that is farther away. A demonstration
says it: the robot's state when its gripper closed.

Depth: how far the state at a grasp is along the way on which the robot approaches, from what the place
predicts; in standard deviations over the training episodes, 0 on average. In the benchmark, greater is lower.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_deltaco.policy.goals.calibration import StateToImage
from lerobot_deltaco.policy.goals.training_goals import TrainingGoals

_N_PLACE_FEATURES = 10
_N_DEPTH_FEATURES = 3  # of the first of those: 1, x, y
_RIDGE = 1e-5
# Spread of a normalized state around what places predict, below which it does not count.
_MIN_SPREAD = 1e-3
_MAX_REST = 4.0  # beyond which, in that spread, it is an accident


class GoalStates(nn.Module):
    """Which state the robot has when it is at a goal.

    Args:
        state_dim: Size of the robot's state.
        n_goals: Number of goals; the first is the grasp.
        has_depth: Whether the state at the grasp depends on a depth as well.

    Attributes:
        to_image: Map from states to places in the image; None without depths.
    """

    place_to_state: Tensor
    depth_to_state: Tensor
    state_scale: Tensor
    state_shift: Tensor
    rest_scale: Tensor

    def __init__(self, state_dim: int, n_goals: int, has_depth: bool) -> None:
        super().__init__()
        self.has_depth = has_depth
        self.register_buffer("place_to_state", torch.zeros(n_goals, _N_PLACE_FEATURES, state_dim))
        self.to_image = StateToImage(state_dim) if has_depth else None
        if has_depth:
            self.register_buffer("depth_to_state", torch.zeros(_N_DEPTH_FEATURES, state_dim))
            # A state as the policy gets it is state_scale * state + state_shift.
            self.register_buffer("state_scale", torch.ones(state_dim))
            self.register_buffer("state_shift", torch.zeros(state_dim))
            self.register_buffer("rest_scale", torch.zeros(state_dim))

    def fit(self, goals: TrainingGoals, scale: Tensor, shift: Tensor, is_arm: Tensor) -> None:
        """Learns, by regression, which state the robot has when it is at a goal.

        Args:
            goals: Goals of the training episodes, which were found by `to_image` if there is one.
            scale: The policy's input is `scale * state + shift`, (state,).
            shift: Shift of each dimension, (state,).
            is_arm: Dimensions of the state that do not tell how far the gripper is open, (state,) bool. At a
                grasp, that depends on the object's width, and says nothing about the depth.
        """
        states = goals.states * scale + shift  # (episodes, goals, state)
        for goal in range(len(self.place_to_state)):
            features = _place_features(goals.places[goals.found, goal])
            self.place_to_state[goal].copy_(_ridge_regression(features, states[goals.found, goal]))
        if self.has_depth:
            self.state_scale.copy_(scale)
            self.state_shift.copy_(shift)
            last_moves = (states[:, 0] - (goals.approach * scale + shift))[goals.found]
            self._fit_depth(goals.places[goals.found, 0], states[goals.found, 0], last_moves, is_arm)

    def _fit_depth(self, places: Tensor, states: Tensor, last_moves: Tensor, is_arm: Tensor) -> None:
        features = _place_features(places)
        rest = states - features @ self.place_to_state[0]  # (episodes, state)
        spread = 1.4826 * rest.abs().median(dim=0).values
        # A joint that only vibrates counts no more than one that reaches.
        self.rest_scale.copy_(torch.where(is_arm & (spread > _MIN_SPREAD), 1 / spread.clamp_min(1e-12), 0.0))
        self.depth_to_state.copy_(_ridge_regression(features[:, :_N_DEPTH_FEATURES], last_moves * is_arm))
        self.depth_to_state.mul_(self._project(rest, features).std())

    def depths(self, states: Tensor) -> Tensor:
        """Depths of grasps.

        Args:
            states: The robot's states at the grasps, as in the dataset, (grasps, state); NaN if a grasp is
                not known.

        Returns:
            (grasps,); NaN if it is not known.
        """
        features = _place_features(self.grasp_places(states))
        rest = states * self.state_scale + self.state_shift - features @ self.place_to_state[0]
        return self._project(rest, features)

    def grasp_places(self, states: Tensor) -> Tensor:
        """Places of grasps in the image, (grasps, 2), by the robot's states there, as `depths` takes them."""
        assert self.to_image is not None
        return self.to_image(states).clamp(-1, 1)

    def _project(self, rest: Tensor, features: Tensor) -> Tensor:
        """Depths from what places do not tell of states, (grasps, state), and features of the places."""
        direction = (features[:, :_N_DEPTH_FEATURES] @ self.depth_to_state) * self.rest_scale
        return (self._scaled(rest) * direction).sum(dim=1) / direction.square().sum(dim=1).clamp_min(1e-12)

    def _scaled(self, rest: Tensor) -> Tensor:
        return (rest * self.rest_scale).clamp(-_MAX_REST, _MAX_REST)

    def forward(self, places: Tensor, depths: Tensor | None) -> Tensor:
        """States at goals, as the policy gets them.

        Args:
            places: Places of the goals, x and y in -1..1, (batch, goals, 2).
            depths: Depth of each grasp, (batch,); None without depths.

        Returns:
            (batch, goals, state).
        """
        features = _place_features(places)
        states = torch.einsum("bgf,gfs->bgs", features, self.place_to_state)
        if not self.has_depth:
            return states
        assert depths is not None
        further = (features[:, 0, :_N_DEPTH_FEATURES] * depths[:, None]) @ self.depth_to_state
        return torch.cat([states[:, :1] + further[:, None], states[:, 1:]], dim=1)


def _ridge_regression(features: Tensor, targets: Tensor) -> Tensor:
    """Weights that predict targets (n, targets) from features (n, features): (features, targets)."""
    ridge = _RIDGE * len(features) * torch.eye(features.shape[1], device=features.device)
    return torch.linalg.solve(features.T @ features + ridge, features.T @ targets)


def _place_features(places: Tensor) -> Tensor:
    """Powers of x and y up to the third: (..., 2) to (..., 10)."""
    x, y = places.unbind(dim=-1)
    ones = torch.ones_like(x)
    return torch.stack([ones, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], dim=-1)
