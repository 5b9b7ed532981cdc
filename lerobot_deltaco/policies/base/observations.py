"""Checks of the observations that a policy acts on: numbers that a sensor or a unit cannot have produced."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_deltaco.errors import UserError

logger = logging.getLogger(__name__)

_MAX_IMAGE = 1.1  # resampling overshoots 1 a little
_MIN_CONTRAST = 0.02  # between the darkest and the brightest number of an image, in 0..1
_FAR_STATE = 10.0  # in standard deviations over the training data


class ObservationError(UserError, FloatingPointError):
    """Raised for an observation that no sensor gives; the message names the feature."""


class ObservationChecks:
    """Checks observations. Each warning is given once.

    Args:
        cameras: Names of the cameras.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self._cameras = cameras
        self._warned: set[str] = set()

    def __call__(self, batch: Mapping[str, Any], states: Tensor | None) -> None:
        """Checks the images and the states of a batch.

        Args:
            batch: As in `select_action`.
            states: Normalized states without the noise of joints that hardly move, (batch, state); None
                without states, or if they are not normalized.

        Raises:
            ObservationError: A number is not finite, or an image is not in 0..1.
        """
        for name in (OBS_STATE, *self._cameras):
            values = batch.get(name)
            if isinstance(values, Tensor) and values.numel():
                # NaN and infinity are among the ends.
                low, high = (float(end) for end in values.aminmax())
                if not -torch.inf < low <= high < torch.inf:
                    raise ObservationError(
                        f"In the observation, `{name}` has numbers that are not finite. Check the sensors, "
                        "and the normalization statistics of the checkpoint."
                    )
                if name != OBS_STATE:
                    self._check_image(name, low, high)
        if states is not None and states.numel():
            far, dimension = states.abs().amax(dim=0).max(dim=0)
            if far > _FAR_STATE:
                self._warn(
                    OBS_STATE,
                    f"`{OBS_STATE}` is not like that of the training: its dimension {int(dimension)} is "
                    f"{float(far):.0f} standard deviations from the mean. Are the units the same, such as "
                    "radians or degrees?",
                )

    def _check_image(self, name: str, low: float, high: float) -> None:
        if low < 1 - _MAX_IMAGE or high > _MAX_IMAGE:
            raise ObservationError(
                f"The image `{name}` must have numbers from 0 to 1. Got {low:.3g} to {high:.3g}. Divide "
                "images of 0 to 255 by 255."
            )
        if high - low < _MIN_CONTRAST:
            self._warn(name, f"The image `{name}` is of a single color. Is the camera on, and uncovered?")

    def _warn(self, name: str, message: str) -> None:
        if name not in self._warned:
            self._warned.add(name)
            logger.warning("%s", message)
