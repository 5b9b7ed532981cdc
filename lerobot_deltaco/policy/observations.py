"""What a batch of observations has for the policy: the images of its cameras, and its instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor


def stacked_images(batch: Mapping[str, Any], cameras: Sequence[str], size: int) -> Tensor:
    """Images of all cameras.

    Args:
        batch: Batch from the preprocessor, with images (batch, 3, H, W) of each camera.
        cameras: Names of the cameras.
        size: Height and width to which images are scaled, if they differ, px.

    Returns:
        (batch, cameras, 3, size, size), in the order of the names.
    """
    images = []
    for name in cameras:
        image = batch[name]  # (batch, 3, H, W)
        if image.shape[-2:] != (size, size):
            image = F.interpolate(image, (size, size), mode="bilinear", antialias=True)
        images.append(image)
    return torch.stack(images, dim=1)


def instructions_of(batch: Mapping[str, Any]) -> tuple[str, ...]:
    """The instruction of each sample.

    Args:
        batch: Batch from the preprocessor.

    Raises:
        ValueError: There is none.
    """
    tasks = batch.get("task")
    if isinstance(tasks, (list, tuple)) and tasks and all(isinstance(task, str) for task in tasks):
        return tuple(tasks)
    raise ValueError(
        "`task` must be a list with an instruction for each sample of the batch. Got "
        f"{'none' if tasks is None else repr(tasks)}. LeRobot takes it from the environment's "
        '`task_description`, or from --task; in Python, set observation["task"] before the preprocessor.'
    )
