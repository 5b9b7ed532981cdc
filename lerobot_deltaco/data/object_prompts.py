"""Object prompts: a point or a box in a picture that shows an object, in place of a demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lerobot_deltaco.errors import UserError


@dataclass(frozen=True)
class ObjectPrompt:
    """An object in a picture.

    Attributes:
        box: Left, top, right and bottom edge of the object, as fractions of the picture's width and height.
            The edges of a point coincide.
        image: The picture, (3, H, W) uint8: for a point, by the camera of demonstrations; for a box, by any
            camera. None for the first image of the episode.
    """

    box: tuple[float, float, float, float]
    image: Tensor | None = None

    @property
    def is_point(self) -> bool:
        """Whether the prompt is a point, which tells no size."""
        left, top, right, bottom = self.box
        return left == right and top == bottom

    @property
    def location(self) -> tuple[float, float]:
        """Middle of the box: x and y in -1..1."""
        left, top, right, bottom = self.box
        return left + right - 1, top + bottom - 1


def read_prompt(
    point: Sequence[float] | None, photo: str | Path | None, camera_size: tuple[int, int]
) -> ObjectPrompt:
    """Returns the prompt that options name.

    Args:
        point: [x, y], or [left, top, right, bottom] of a box, px; None for the whole photo.
        photo: Image file; None for the first image of the episode.
        camera_size: Width and height of the camera's images, px.

    Raises:
        UserError: The photo cannot be read, or these are not numbers of a point or box in the picture.
    """
    image = None if photo is None else _read_photo(Path(photo))
    width, height = camera_size if image is None else (image.shape[2], image.shape[1])
    numbers = [0, 0, width, height] if point is None else list(point)
    if len(numbers) not in (2, 4):
        raise UserError(
            "`demo_point` must be a point [x, y] or a box [left, top, right, bottom], px. Got "
            f"{len(numbers)} numbers."
        )
    left, top, right, bottom = numbers if len(numbers) == 4 else (*numbers, *numbers)
    if not (0 <= left <= right <= width and 0 <= top <= bottom <= height):
        raise UserError(
            f"`demo_point` must lie in the picture, which has {width} x {height} px, and a box is [left, "
            f"top, right, bottom]. Got {numbers}."
        )
    return ObjectPrompt((left / width, top / height, right / width, bottom / height), image)


def _read_photo(path: Path) -> Tensor:
    """Returns the content of an image file, (3, H, W) uint8."""
    try:
        with Image.open(path) as photo:
            pixels = np.array(photo.convert("RGB"))
    except OSError as error:
        raise UserError(
            f"The photo {path} cannot be read ({error}). Name an image file, such as a PNG or JPEG."
        ) from error
    return torch.from_numpy(pixels).permute(2, 0, 1)
