"""Pictures of where the policy looked."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.policies.deltaco_match.crop_encoder import CROP_RESOLUTION, cut_crops
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.deltaco_match.localization import DemonstrationBatch, PickPlace
from lerobot_deltaco.policies.deltaco_match.prompts import prompted_crop

# No object and no container of the benchmark has these colors. They differ in lightness, so that they can be
# told apart without color vision.
PICK_COLOR, PLACE_COLOR = (225, 0, 170), (90, 240, 255)
MIN_SIDE = 320  # px, below which a scene is enlarged
_OPACITY = 0.65  # of a map at its maximum

Color = tuple[int, int, int]


def draw_localization(
    scene: NDArray[np.uint8],
    demonstration_ends: NDArray[np.uint8] | None,
    localization: PickPlace,
    recorded: Tensor | None = None,
) -> Image.Image:
    """Draws where a policy looked: the demonstration, and to its right the scene.

    A magenta ring marks the pick location, a cyan square the place location.

    Args:
        scene: First image of the episode, (H, W, 3).
        demonstration_ends: First and last image of the demonstration, (2, h, w, 3); None without one.
        localization: The policy's locations in a batch of one episode.
        recorded: Pick and place locations in the dataset, (2, 2) in -1..1, which get white crosses.

    Returns:
        The picture. Scenes of less than 320 px are enlarged.
    """
    picture = Image.fromarray(scene)
    scale = MIN_SIDE / min(picture.size)
    if scale > 1:
        size = (round(picture.width * scale), round(picture.height * scale))
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    logits = localization.maps[0].float().cpu()
    picture = _overlay(picture, logits.flatten(1).softmax(dim=1).view_as(logits), (PICK_COLOR, PLACE_COLOR))
    if recorded is not None:
        for location in recorded.tolist():
            _draw_cross(picture, location)
    pick, place = localization.locations[0].tolist()
    draw_mark(picture, pick, PICK_COLOR, "pick")
    draw_mark(picture, place, PLACE_COLOR, "place")
    if demonstration_ends is None:
        return picture
    gap = max(4, picture.height // 80)
    height = (picture.height - gap) // 2
    width = round(height * demonstration_ends.shape[2] / demonstration_ends.shape[1])
    image = Image.new("RGB", (width + gap + picture.width, picture.height), "white")
    image.paste(picture, (width + gap, 0))
    for n, (end, color) in enumerate(zip(demonstration_ends, (PICK_COLOR, PLACE_COLOR), strict=True)):
        panel = Image.fromarray(end).resize((width, height), Image.Resampling.BICUBIC)
        if localization.attention is not None and localization.by_demonstration[n]:
            panel = _overlay(panel, localization.attention[0, n : n + 1].float().cpu(), (color,))
        image.paste(panel, (0, n * (height + gap)))
    return image


def draw_crop(image: Tensor, location: Tensor, size: Tensor) -> Image.Image:
    """Draws a crop as a policy compares it, but in the proportions of the image.

    Args:
        image: (1, 3, H, W), uint8 or in 0..1.
        location: Center of the crop, (1, 1, 2) in -1..1.
        size: Its side as a fraction of the image's, (1, 1).
    """
    crop = cut_crops(image, location, size, CROP_RESOLUTION)[0, 0]
    width = round(CROP_RESOLUTION * image.shape[-1] / image.shape[-2])
    picture = Image.fromarray(as_uint8(crop).permute(1, 2, 0).cpu().numpy())
    return picture.resize((width, CROP_RESOLUTION), Image.Resampling.BICUBIC)


@torch.no_grad()
def compared_crops(
    matching: FeatureMatching,
    localization: PickPlace,
    image: Tensor,
    shown: Demonstration | ObjectPrompt | None = None,
) -> list[Image.Image]:
    """Draws the crops that were compared.

    The first is of the demonstration or photo, if there is one; the last is of what was chosen in the scene.

    Args:
        matching: Feature matching, fitted.
        localization: What was found, in a batch of one episode.
        image: First image of the episode, (3, H, W) in 0..1.
        shown: Its first demonstration, or an object prompt; None for none.
    """
    crops = []
    if isinstance(shown, ObjectPrompt):
        crops.append(draw_crop(*prompted_crop(matching, shown, image)))
        if shown.image is None:  # which shows what is chosen
            return crops
    elif shown is not None:
        assert localization.demonstrated is not None
        first = shown.frames[0] if shown.first_image is None else shown.first_image
        crops.append(_crop(matching, first[None], localization.demonstrated[:1]))
    return [*crops, _crop(matching, image[None], localization.proposal[:1])]


@torch.no_grad()
def demonstrated_crop(matching: FeatureMatching, given: DemonstrationBatch) -> Image.Image:
    """Draws the crop of what a demonstration grasped, the first of a batch."""
    ends, full_resolution, picks, _ = (part[0] for part in given)
    center, _ = matching.demonstrated(ends, full_resolution, picks, picks)
    return _crop(matching, full_resolution, center)


def _crop(matching: FeatureMatching, image: Tensor, center: Tensor) -> Image.Image:
    """Draws the crop of an image (1, 3, H, W) at a center (1, 2) in -1..1."""
    location = center[:, None]
    return draw_crop(image, location, matching.crop_sizes(location))


def write_picture(
    folder: Path, image: Tensor, shown: Demonstration | ObjectPrompt | None, localization: PickPlace
) -> Path:
    """Writes a picture of a localization, named by the present time, and returns its file.

    See `compared_crops` for the arguments.
    """
    scene = np.ascontiguousarray(as_uint8(image).permute(1, 2, 0).cpu().numpy())
    ends = demonstration_ends(shown) if isinstance(shown, Demonstration) else None
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S_%f}.png"
    draw_localization(scene, ends, localization).save(path)
    return path


def _overlay(picture: Image.Image, maps: Tensor, colors: tuple[Color, ...]) -> Image.Image:
    """Lays maps (maps, h, w) of weights over a picture, each in its color."""
    for weights, color in zip(maps, colors, strict=True):
        # The square root shows less likely locations, too.
        relative = (weights / weights.max().clamp_min(1e-12)).sqrt().numpy()
        opacity = Image.fromarray(np.round(255 * _OPACITY * relative).astype(np.uint8))
        opacity = opacity.resize(picture.size, Image.Resampling.BILINEAR)
        picture = Image.composite(Image.new("RGB", picture.size, color), picture, opacity)
    return picture


def _pixel(picture: Image.Image, location: Sequence[float]) -> tuple[float, float]:
    return (location[0] + 1) / 2 * picture.width, (location[1] + 1) / 2 * picture.height


def draw_mark(picture: Image.Image, location: Sequence[float], color: Color, name: str) -> None:
    """Draws a ring for a pick, or a square for a place, with its name."""
    draw, (x, y) = ImageDraw.Draw(picture), _pixel(picture, location)
    radius, line = min(picture.size) / 18, max(2, min(picture.size) // 130)
    outline = draw.ellipse if name == "pick" else draw.rectangle
    for reach, width, ink in ((radius + line, 3 * line, (0, 0, 0)), (radius, line, color)):
        outline((x - reach, y - reach, x + reach, y + reach), outline=ink, width=width)
    font = ImageFont.load_default(size=max(14, min(picture.size) // 22))
    is_low = y > picture.height / 2
    position = (x, y - radius - 2 * line) if is_low else (x, y + radius + 2 * line)
    anchor = "mb" if is_low else "mt"
    draw.text(position, name, "white", font, anchor, stroke_width=2, stroke_fill="black")


def _draw_cross(picture: Image.Image, location: Sequence[float]) -> None:
    draw, (x, y) = ImageDraw.Draw(picture), _pixel(picture, location)
    reach, line = min(picture.size) / 30, max(2, min(picture.size) // 130)
    for width, ink in ((3 * line, "black"), (line, "white")):
        draw.line((x - reach, y - reach, x + reach, y + reach), ink, width)
        draw.line((x - reach, y + reach, x + reach, y - reach), ink, width)


def demonstration_ends(demonstration: Demonstration) -> NDArray[np.uint8]:
    """Returns the first and the last image of a demonstration, (2, H, W, 3)."""
    return demonstration.frames[[0, -1]].permute(0, 2, 3, 1).cpu().numpy()
