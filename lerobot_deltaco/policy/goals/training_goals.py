"""The goals of training episodes: where in the image each of them grasped and released something."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_deltaco.policy.goals.calibration import StateToImage
from lerobot_deltaco.policy.goals.keyframes import find_keyframes, warn_if_inverted

logger = logging.getLogger(__name__)


class TrainingGoals(NamedTuple):
    """Goals of episodes, in the order of their demonstrations.

    Attributes:
        places: Grasp and release in the first camera's image, x and y in -1..1, (episodes, 2, 2).
        states: The robot's states there, (episodes, 2, state), as in the dataset.
        approach: The robot's states shortly before the grasps, (episodes, state).
        found: Whether the gripper closed and opened in an episode, (episodes,) bool; else the rest is 0.
    """

    places: Tensor
    states: Tensor
    approach: Tensor
    found: Tensor


def find_training_goals(
    to_image: StateToImage,
    first: Tensor,
    last: Tensor,
    states: Tensor,
    gripper: Tensor,
    spans: Sequence[tuple[int, int]],
) -> TrainingGoals:
    """Finds the goals of episodes without a calibrated camera.

    Args:
        to_image: Map from states to places, which is fitted to the episodes.
        first: First images of the episodes, (episodes, 3, H, W) uint8.
        last: Last images of the episodes, (episodes, 3, H, W) uint8.
        states: Robot states of all frames, (frames, state).
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        spans: First and last frame of each episode.

    Raises:
        ValueError: There are too few episodes in which the gripper closes and opens.
    """
    keyframes = find_keyframes(states, gripper, spans)
    found = keyframes.found
    if not found.all():
        logger.warning(
            "The gripper does not close and open again in %d of %d episodes; they are not trained on.",
            int((~found).sum()),
            len(found),
        )
    warn_if_inverted(gripper, spans)
    to_image.fit(first[found], last[found], keyframes.states[found, 0])
    places = to_image(keyframes.states).clamp(-1, 1)
    places = torch.where(found[:, None, None], places, 0.0)
    return TrainingGoals(places, keyframes.states, keyframes.approach, found)
