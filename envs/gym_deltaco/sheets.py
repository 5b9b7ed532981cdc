"""Contact sheets: images with captions, put together into larger ones."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gym_deltaco.atomic_files import atomic_write

GAP = 8  # px, between the things of a sheet
PAPER, INK, ACCENT = (250, 250, 248), (30, 30, 34), (196, 84, 0)
_LINE_SPACING = 1.3
_PALETTE_SIZE = 256

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
RGB = tuple[int, int, int]
Align = Literal["start", "middle", "end"]


def to_image(pixels: NDArray[np.uint8], size: int | None = None) -> Image.Image:
    """An image of an array (H, W, 3), smoothly shrunk to `size` px where that is given."""
    image = Image.fromarray(pixels)
    return image if size is None else image.resize((size, size), Image.Resampling.BOX)


def enlarged(pixels: NDArray[np.uint8], factor: int) -> Image.Image:
    """An image of an array (H, W, 3) in which every pixel is a visible square."""
    height, width, _ = pixels.shape
    return Image.fromarray(pixels).resize((width * factor, height * factor), Image.Resampling.NEAREST)


def caption(
    text: str, width: int, size: int = 15, color: RGB = INK, n_lines: int = 1, indent: int = 0
) -> Image.Image:
    """Text, wrapped at words.

    Args:
        text: The text, which may have line breaks.
        width: Width of the image, px.
        size: Size of the font, px.
        color: Color of the text.
        n_lines: Least number of lines to leave room for, so that captions in a row are equally high.
        indent: Space to the left of the text, px.

    Returns:
        An image, as high as its lines.
    """
    font = _font(size)
    lines = [line for paragraph in text.split("\n") for line in _wrapped(paragraph, width - indent, font)]
    line_height = round(size * _LINE_SPACING)
    image = Image.new("RGB", (width, line_height * max(len(lines), n_lines)), PAPER)
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        draw.text((indent, number * line_height), line, fill=color, font=font)
    return image


def across(images: Sequence[Image.Image], gap: int = GAP, align: Align = "start") -> Image.Image:
    """Images from left to right."""
    width = sum(image.width for image in images) + gap * (len(images) - 1)
    height = max(image.height for image in images)
    sheet, x = Image.new("RGB", (width, height), PAPER), 0
    for image in images:
        sheet.paste(image, (x, _start(height - image.height, align)))
        x += image.width + gap
    return sheet


def down(images: Sequence[Image.Image], gap: int = GAP, align: Align = "start") -> Image.Image:
    """Images from top to bottom."""
    width = max(image.width for image in images)
    height = sum(image.height for image in images) + gap * (len(images) - 1)
    sheet, y = Image.new("RGB", (width, height), PAPER), 0
    for image in images:
        sheet.paste(image, (_start(width - image.width, align), y))
        y += image.height + gap
    return sheet


def grid(images: Sequence[Image.Image], n_columns: int, gap: int = 2 * GAP) -> Image.Image:
    """Images in rows."""
    rows = [images[first : first + n_columns] for first in range(0, len(images), n_columns)]
    return down([across(row, gap) for row in rows], gap)


def framed(image: Image.Image, color: RGB = PAPER, thickness: int = 4) -> Image.Image:
    """An image in a frame, which makes it larger."""
    sheet = Image.new("RGB", (image.width + 2 * thickness, image.height + 2 * thickness), color)
    sheet.paste(image, (thickness, thickness))
    return sheet


def circled(image: Image.Image, center: NDArray[np.float64], radius: float) -> Image.Image:
    """A copy of an image with a white ring, edged in black, about a point (x, y)."""
    copy = image.copy()
    draw = ImageDraw.Draw(copy)
    x, y = center
    for color, inset, width in (((0, 0, 0), 0, 5), ((255, 255, 255), 1, 3)):
        reach = radius - inset
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=color, width=width)
    return copy


def save_png(image: Image.Image, path: Path) -> None:
    """Writes an image with all of its colors: by a palette, small objects would change theirs."""
    with atomic_write(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def save_gif(frames: Sequence[Image.Image], durations: Sequence[int], path: Path) -> None:
    """Writes an endless animation.

    Args:
        frames: Images of equal size.
        durations: Duration of each frame, ms.
        path: File to write.
    """
    # One palette for all frames, so that only what moves is stored again.
    palette = down(frames, gap=0).quantize(_PALETTE_SIZE, Image.Quantize.MEDIANCUT)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with atomic_write(path) as temporary:
        first.save(
            temporary, format="GIF", save_all=True, append_images=others, duration=list(durations), loop=0
        )


@cache
def _font(size: int) -> Font:
    return ImageFont.load_default(size)


def _wrapped(paragraph: str, width: int, font: Font) -> list[str]:
    lines = [""]
    for word in paragraph.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _start(free: int, align: Align) -> int:
    return {"start": 0, "middle": free // 2, "end": free}[align]
