"""Conditioning by goals (ours): what a `GoalLocator` finds, as inputs of the policy's network."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.correspondence import GOALS, Description, GoalLocator, peak_places
from lerobot_deltaco.policy.training_goals import TrainingGoals

_N_PLACE_FEATURES = 10
_RIDGE = 1e-3


class FoundGoals(NamedTuple):
    """Goals of the scenes of a batch, and why.

    Attributes:
        places: (batch, 2, 2): grasp and release, x and y in -1..1.
        logits: Maps of both over the scene, (batch, 2, h, w).
        attention: Where the demonstrated object was and where it was put in the demonstration,
            (batch, 2, h, w); None without a demonstration.
    """

    places: Tensor
    logits: Tensor
    attention: Tensor | None


class GoalConditioning(nn.Module):
    """A locator of goals, and where the robot's state would be at them.

    Args:
        locator: Finds goals in the first images of episodes.
        state_dim: Size of the robot's state.
    """

    place_to_state: Tensor

    def __init__(self, locator: GoalLocator, state_dim: int) -> None:
        super().__init__()
        self.locator = locator
        self.register_buffer("place_to_state", torch.zeros(len(GOALS), _N_PLACE_FEATURES, state_dim))

    def fit(self, goals: TrainingGoals, states: Tensor) -> None:
        """Learns, by regression, which state the robot has when it is at a goal.

        Args:
            goals: Goals of the training episodes.
            states: The states there, normalized as the policy's input is, (episodes, 2, state).
        """
        for goal in range(len(GOALS)):
            features = _place_features(goals.places[goals.found, goal])
            ridge = _RIDGE * len(features) * torch.eye(_N_PLACE_FEATURES, device=features.device)
            solution = torch.linalg.solve(
                features.T @ features + ridge, features.T @ states[goals.found, goal]
            )
            self.place_to_state[goal].copy_(solution)

    def offsets(self, places: Tensor, state: Tensor) -> Tensor:
        """How far the robot's state is from where it would be at its goals.

        Args:
            places: (batch, 2, 2).
            state: Present state, normalized, (batch, state).

        Returns:
            (batch, 2 * state).
        """
        states = torch.einsum("bgf,gfs->bgs", _place_features(places), self.place_to_state)
        return (states - state[:, None]).flatten(1)

    @torch.no_grad()
    def find(self, scenes: Tensor, demonstrations: Tensor | None, condition: Tensor | None) -> FoundGoals:
        """Finds the goals of tasks in scenes.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            demonstrations: First and last images of one or more demonstrations of each task,
                (batch, demonstrations, 2, 3, H, W); None if the locator takes none.
            condition: Embeddings of the instructions, or one-hot tasks; None if the locator takes none.
        """
        description = None
        if demonstrations is not None:
            n_each = demonstrations.shape[1]
            each = self.locator.describe(demonstrations.flatten(0, 1))
            moved = F.normalize(each.moved, dim=1).unflatten(0, (-1, n_each)).mean(dim=1)
            target = each.target
            if target is not None:
                target = target.unflatten(0, (-1, n_each)).mean(dim=1)
            description = Description(moved, target, each.attention[::n_each])
        logits = self.locator(scenes, scenes, description, condition)
        attention = None if description is None else description.attention
        return FoundGoals(peak_places(logits), logits, attention)


def _place_features(places: Tensor) -> Tensor:
    """Powers of x and y up to the third: (..., 2) to (..., 10)."""
    x, y = places.unbind(dim=-1)
    ones = torch.ones_like(x)
    return torch.stack([ones, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], dim=-1)
