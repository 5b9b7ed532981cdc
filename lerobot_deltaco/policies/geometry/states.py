"""The robot's states at the pick and place locations, and the height offset of a grasp.

An image location fixes a point only up to its depth along the camera's ray. At a grasp, the depth depends on
the object: a flat object looks like a tall one farther away. A demonstration resolves this, through the
robot's state when its gripper closed.

Grasp height offset: how far along the camera's ray the state at a grasp is from what the location predicts,
measured along the robot's direction of approach. It is in standard deviations over the training episodes, 0
on average, and larger farther along the approach: in the benchmark, lower.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.data.grasps import GraspStates
from lerobot_deltaco.policies.geometry.calibration import ImageProjection
from lerobot_deltaco.policies.geometry.regression import robust_regression

N_LOCATIONS = 2  # pick and place
_MAX_BY_POSITION = 3000  # episodes, below which locations depend on the hand's position alone
_N_LOCATION_FEATURES = 10
_N_HEIGHT_FEATURES = 3  # of the first of those: 1, x, y
_N_LEVEL_FEATURES = 6  # up to the squares
_EPISODES_PER_TASK = 3  # at least, of tasks by which heights are compared
_DEGREES = (0, 1, 1, 2, 2, 2, 3, 3, 3, 3)  # of these features
_HEIGHT_ROUNDS = 3  # of estimating heights, and the direction in which they move states
_LEAST_ERROR = 0.02  # of a normalized state, below which errors are all alike
_CHANCE = 2.0  # standard errors of a correlation that are taken for chance
_LEAST_UNEXPLAINED = 0.2  # of a dimension's residual by a height; less is taken for chance
# Spread of a normalized state around what locations predict, below which it does not count.
_MIN_SPREAD = 1e-3
_MAX_REST = 4.0  # in that spread; more is an accident


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


class StateRegressor(nn.Module):
    """Predicts the state of the robot at a location, by regression over the training episodes.

    Args:
        state_dim: Size of the robot's state.

    Attributes:
        to_image: Projects states to locations in the image.
        follows_place: How far each dimension of the state at a release follows from the location, 0..1,
            (state,). The rest, such as how the hand is turned, is the demonstration's.
    """

    location_to_state: Tensor
    height_to_state: Tensor
    state_scale: Tensor
    state_shift: Tensor
    rest_scale: Tensor
    follows_place: Tensor

    def __init__(self, state_dim: int) -> None:
        super().__init__()
        self.to_image = ImageProjection(state_dim)
        self.register_buffer("location_to_state", torch.zeros(N_LOCATIONS, _N_LOCATION_FEATURES, state_dim))
        self.register_buffer("height_to_state", torch.zeros(_N_HEIGHT_FEATURES, state_dim))
        # A state as the policy gets it is state_scale * state + state_shift.
        self.register_buffer("state_scale", torch.ones(state_dim))
        self.register_buffer("state_shift", torch.zeros(state_dim))
        self.register_buffer("rest_scale", torch.zeros(state_dim))
        self.register_buffer("follows_place", torch.ones(state_dim))

    def fit(
        self,
        grasps: GraspStates,
        first: Tensor,
        carried: Tensor,
        last: Tensor,
        scale: Tensor,
        shift: Tensor,
        is_arm: Tensor,
        tasks: Sequence[str] | None = None,
        position_dims: Sequence[int] | None = None,
    ) -> TrainingLocations:
        """Calibrates the camera and learns which state the robot has at a location.

        Args:
            grasps: Grasps of the training episodes.
            first: First images of the episodes, (episodes, 3, H, W) uint8.
            carried: Images halfway between grasp and release, (episodes, 3, H, W) uint8.
            last: Last images of the episodes, (episodes, 3, H, W) uint8.
            scale: The policy's input is `scale * state + shift`, (state,).
            shift: Shift of each dimension, (state,).
            is_arm: Dimensions of the state other than the gripper's opening, (state,) bool. At a grasp, the
                opening depends on the object's width, and says nothing about where the object is.
            tasks: Task of each episode; the object of a task is as high wherever it stands. None if unknown.
            position_dims: Dimensions that are the hand's position along x, y and z, of which z is up; None
                if they are not known. With few episodes, locations and heights depend on these alone:
                rotations that hardly vary would only add noise, and a novel one much of it.

        Returns:
            The locations and heights of the episodes.
        """
        has_grasp = grasps.has_grasp
        seen = position_dims if int(has_grasp.sum()) < _MAX_BY_POSITION else None
        is_related = is_arm
        if seen is not None:
            is_related = torch.zeros_like(is_arm)
            is_related[list(seen)] = True
        first, carried, last = (images[has_grasp] for images in (first, carried, last))
        self.to_image.fit(first, carried, last, grasps.states[has_grasp, 0], scale * is_related, seen)
        locations = self.to_image(grasps.states).clamp(-1, 1)
        self.state_scale.copy_(scale)
        self.state_shift.copy_(shift)
        states = (grasps.states * scale + shift)[has_grasp]  # (episodes, 2, state)
        last_moves = states[:, 0] - (grasps.approach * scale + shift)[has_grasp]
        features = _location_features(locations[has_grasp])
        degrees = torch.tensor(_DEGREES, device=states.device)
        for n in range(N_LOCATIONS):
            self.location_to_state[n].copy_(
                robust_regression(features[:, n], states[:, n], degrees, _LEAST_ERROR, is_arm.float())
            )
        self._fit_follows_place(features[:, 1], states[:, 1], position_dims)
        if self.to_image.has_camera:
            self._measure_heights(states[:, 0], int(self.to_image.position_dims[2]))
            return self.locate(grasps)
        self._fit_heights(features[:, 0], states[:, 0], last_moves, is_related)
        if tasks is not None:
            self._level(
                features[:, 0], states[:, 0], [t for t, has in zip(tasks, has_grasp, strict=True) if has]
            )
        return self.locate(grasps)

    def locate(self, grasps: GraspStates) -> TrainingLocations:
        """Returns the locations and heights of episodes, from the robot's states in them."""
        has_grasp = grasps.has_grasp
        locations = self.to_image(grasps.states).clamp(-1, 1)
        heights = self.heights(grasps.states[:, 0])
        return TrainingLocations(
            torch.where(has_grasp[:, None, None], locations, 0.0),
            torch.where(has_grasp, heights, 0.0),
            has_grasp,
        )

    def _fit_follows_place(
        self, features: Tensor, states: Tensor, position_dims: Sequence[int] | None
    ) -> None:
        """Learns which dimensions of the state at a release follow from the place.

        Args:
            features: Features of the locations of releases, (episodes, features).
            states: States there, normalized, (episodes, state).
            position_dims: See `fit`. With it, x and y follow from the place, and z as far as they tell it: a
                tall object is released higher.
        """
        if position_dims is None:
            predicted = features @ self.location_to_state[1]
            self.follows_place.copy_(_explained(states, predicted))
            return
        *across, up = position_dims
        self.follows_place.zero_()
        self.follows_place[across] = 1
        linear = torch.cat([torch.ones_like(states[:, :1]), states[:, across]], dim=1)
        degrees = torch.tensor([0, 1, 1], device=states.device)
        weights = robust_regression(linear, states[:, [up]], degrees, _LEAST_ERROR)
        self.follows_place[up] = _explained(states[:, [up]], linear @ weights)[0]

    def _measure_heights(self, states: Tensor, up: int) -> None:
        """Takes the height of the hand for the height of a grasp.

        Args:
            states: States at grasps, normalized, (episodes, state).
            up: Dimension that is the hand's height.
        """
        self.location_to_state[0, :, up] = 0
        self.location_to_state[0, 0, up] = states[:, up].mean()
        self.height_to_state.zero_()
        self.height_to_state[0, up] = -states[:, up].std()  # nearer to the table is farther
        self.rest_scale.zero_()
        self.rest_scale[up] = 1

    def _fit_heights(self, features: Tensor, states: Tensor, last_moves: Tensor, is_arm: Tensor) -> None:
        """Learns how an unknown height moves the state at a grasp, and what a location predicts without it.

        The height begins as what the location leaves open of the state along the approach. States move with
        it along the camera's ray, which may lean away from the approach.

        Args:
            features: Features of the locations of grasps, (episodes, features).
            states: States there, normalized, (episodes, state).
            last_moves: How they moved before, (episodes, state).
            is_arm: Dimensions other than the gripper's opening, (state,) bool.
        """
        rest = states - features @ self.location_to_state[0]  # (episodes, state)
        is_open = is_arm & (_spread(rest) > _MIN_SPREAD)
        self._weigh(rest, rest, is_open)
        linear, degrees = features[:, :_N_HEIGHT_FEATURES], torch.tensor(_DEGREES, device=states.device)
        approach = robust_regression(linear, last_moves * is_arm, degrees[:_N_HEIGHT_FEATURES], _LEAST_ERROR)
        self.height_to_state.copy_(approach)
        degrees = torch.cat([degrees, torch.tensor([0, 2, 2], device=states.device)])
        scale = self.rest_scale + 1e-6 * is_arm
        for _ in range(_HEIGHT_ROUNDS):
            heights = self._project(rest, features)
            std = heights.std()
            if not std > 0:
                self.height_to_state.zero_()
                return
            heights = (heights - heights.mean()) / std
            both = torch.cat([features, linear * heights[:, None]], dim=1)
            weights = robust_regression(both, states, degrees, _LEAST_ERROR, scale)
            self.location_to_state[0].copy_(weights[:_N_LOCATION_FEATURES])
            rest = states - features @ self.location_to_state[0]
            # With few episodes, a height seems to move dimensions that have nothing to do with it.
            clipped = rest.clamp(-_MAX_REST * _spread(rest), _MAX_REST * _spread(rest))
            correlation = (clipped * heights[:, None]).mean(dim=0) / clipped.square().mean(dim=0).sqrt()
            kept = (1 - (_CHANCE / correlation).square() / len(rest)).nan_to_num(0, 0, 0).clamp_min(0)
            self.height_to_state.copy_(weights[_N_LOCATION_FEATURES:] * is_arm * kept)
            unexplained = rest - heights[:, None] * (linear @ self.height_to_state)
            self._weigh(rest, unexplained, is_open)

    def _level(self, features: Tensor, states: Tensor, tasks: Sequence[str]) -> None:
        """Makes heights comparable between locations.

        What a location predicts too much along the ray, all heights there lack. It is what varies with the
        location among the heights of one task, whose object is as high everywhere.

        Args:
            features: Features of the locations of grasps, (episodes, features).
            states: States there, normalized, (episodes, state).
            tasks: Task of each.
        """
        known = {task: n for n, task in enumerate(dict.fromkeys(tasks))}
        task = torch.tensor([known[each] for each in tasks], device=features.device)
        if len(tasks) < _EPISODES_PER_TASK * len(known):
            return
        heights = self._project(states - features @ self.location_to_state[0], features)
        one_hot = F.one_hot(task).to(features)
        columns = features[:, 1:_N_LEVEL_FEATURES]
        both = torch.cat([one_hot, columns], dim=1)
        degrees = torch.tensor([0] * len(known) + [2] * columns.shape[1], device=features.device)
        slopes = robust_regression(both, heights[:, None], degrees, _LEAST_ERROR)[len(known) :, 0]
        # A line times a parabola is a cubic, which the features are.
        grid = _location_features(torch.cartesian_prod(*[torch.linspace(-1, 1, 6)] * 2).to(features))
        level = (grid[:, 1:_N_LEVEL_FEATURES] @ slopes)[:, None]
        moved = level * (grid[:, :_N_HEIGHT_FEATURES] @ self.height_to_state)
        self.location_to_state[0].add_(torch.linalg.pinv(grid.double()).to(grid) @ moved)
        heights = self._project(states - features @ self.location_to_state[0], features)
        # Heights have a mean of 0 and a standard deviation of 1.
        mean, std = heights.mean(), heights.std().clamp_min(1e-6)
        self.location_to_state[0, :_N_HEIGHT_FEATURES] += mean * self.height_to_state
        self.height_to_state.mul_(std)

    def _weigh(self, rest: Tensor, unexplained: Tensor, is_open: Tensor) -> None:
        """Weighs dimensions by how well a height explains what locations leave open of them.

        Args:
            rest: Residuals of states given locations, (episodes, state).
            unexplained: Those given heights, too, (episodes, state).
            is_open: Dimensions that count, (state,) bool.
        """
        spread = _spread(rest).clamp_min(1e-12)
        ratio = (_spread(unexplained) / spread).clamp(_LEAST_UNEXPLAINED, 1)
        # Relative to the best one, which must not be cut at less than `_MAX_REST`.
        ratio = ratio / torch.where(is_open, ratio, 1.0).min()
        self.rest_scale.copy_(torch.where(is_open, 1 / (spread * ratio), 0.0))

    def displacements(
        self, demonstrated: Tensor, locations: Tensor, heights: Tensor, is_same_place: Tensor
    ) -> Tensor:
        """Returns how far the states at a demonstrated grasp and release are from those at other locations.

        Args:
            demonstrated: The robot's states at the grasp and at the release, as in the dataset,
                (batch, 2, state).
            locations: Where to pick and place instead, (batch, 2, 2) in -1..1.
            heights: Height offset of each grasp, (batch,).
            is_same_place: Whether the place is the demonstrated one, wherever it stands now, (batch,) bool.

        Returns:
            As the policy gets states, (batch, 2, state).
        """
        moved = self(locations, heights)
        # Relative to what is expected of such a demonstration: how it grasped is kept, beside the middle or
        # with the hand turned. Where it released is chance, unless its place was found again.
        at = self.to_image(demonstrated).clamp(-1, 1)
        expected = self(at, self.heights(demonstrated[:, 0]))
        release = demonstrated[:, 1] * self.state_scale + self.state_shift
        by_chance = self.follows_place * (moved[:, 1] - release)
        if self.to_image.has_camera:  # as high above the place as it was
            same = (
                self.to_image.positions_at(locations[:, 1], demonstrated[:, 1]) - demonstrated[:, 1]
            ) * self.state_scale
        else:
            same = moved[:, 1] - expected[:, 1]
        place = torch.where(is_same_place[:, None], same, by_chance)
        return torch.stack([moved[:, 0] - expected[:, 0], place], dim=1)

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
        pick = states[:, 0] + further
        if self.to_image.has_camera:
            as_recorded = (pick - self.state_shift) / self.state_scale
            pick = self.to_image.positions_at(locations[:, 0], as_recorded)
            pick = pick * self.state_scale + self.state_shift
        return torch.cat([pick[:, None], states[:, 1:]], dim=1)


def _explained(values: Tensor, predicted: Tensor) -> Tensor:
    """Returns the fraction of the variance of values (n, dims) that is predicted, (dims,) in 0..1."""
    left = (values - predicted).square().mean(dim=0)
    return (1 - left / values.var(dim=0, correction=0).clamp_min(1e-12)).clamp_min(0)


def _spread(values: Tensor) -> Tensor:
    """Returns the standard deviations of values (n, dims) around 0, (dims,), without outliers."""
    return 1.4826 * values.abs().median(dim=0).values


def _location_features(locations: Tensor) -> Tensor:
    """Returns the powers of x and y up to the third: (..., 2) to (..., 10)."""
    x, y = locations.unbind(dim=-1)
    ones = torch.ones_like(x)
    return torch.stack([ones, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], dim=-1)
