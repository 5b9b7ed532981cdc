"""What the policy has found at the start of an episode, for people: words, boxes and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace
from lerobot_deltaco.policies.deltaco_match.words import understand, words_of
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion, is_moved

# No object and no container of the benchmark has these colors. They differ in lightness, so that they can be
# told apart without color vision.
PICK_COLOR, PLACE_COLOR = (225, 0, 170), (90, 240, 255)
MIN_SIDE = 320  # px, below which a scene is enlarged
_OPACITY = 0.65  # of a map at its maximum

Color = tuple[int, int, int]


def describe_findings(
    matching: FeatureMatching,
    localization: PickPlace,
    camera: str,
    size: tuple[int, ...],
    instruction: str,
    shown: Demonstration | ObjectPrompt | None,
) -> list[str]:
    """Returns lines about what was found.

    Args:
        matching: Feature matching, fitted.
        localization: What was found, in a batch of one episode.
        camera: Name of the camera.
        size: Height and width of its images, px.
        instruction: Instruction of the episode; empty for none.
        shown: Its first demonstration, or an object prompt; None for none.
    """
    motion = localization.camera_motion
    locations = _in_picture(localization.locations[0], motion)
    pick, place = (_describe_pixel(location, size) for location in locations)
    sources = ["the demonstration"] if isinstance(shown, Demonstration) else []
    if isinstance(shown, ObjectPrompt):
        sources.append("the point" if shown.image is None else "the photo")
    words = _quoted(dict(matching.understood(instruction))) if instruction else ""
    sources += [f"the words {words}"] if words else []
    is_shown = not instruction or bool(localization.is_same_place[0])
    place_source = "the demonstration" if is_shown else "the sentence"
    lines = [
        f"Found in the first image by {camera}, {size[1]} x {size[0]} px:",
        f"  object: at {pick}, {localization.confidence[0].item():.0%} sure, by "
        f"{' and '.join(sources) or 'what stands out'}",
        f"  place: at {place}, {localization.place_confidence[0].item():.0%} sure, by {place_source}",
    ]
    if isinstance(shown, Demonstration):
        assert localization.demonstrated_grasp is not None
        name = "demonstration" if shown.episode is None else f"demonstration: episode {shown.episode}"
        does = (
            "without a grasp: the change between its first and last image counts"
            if shown.pick_state is None
            else f"which grasped at {_describe_pixel(localization.demonstrated_grasp[0], size)}"
        )
        lines.append(f"  {name}, {does}")
    moved = "not compared with the training's"
    if motion is not None:
        moved = motion.describe(size[1], size[0])
        moved = f"moved by {moved}" if is_moved(motion) else f"as in training ({moved} off)"
    return [*lines, f"  camera: {moved}"]


def _in_picture(locations: Tensor, motion: CameraMotion | None) -> Tensor:
    """Returns locations (..., 2) in the pictures of the camera as it stands now."""
    if not is_moved(motion):
        return locations
    return motion.to_picture(locations)


def _describe_pixel(location: Tensor, size: tuple[int, ...]) -> str:
    x, y = ((location.cpu() + 1) / 2 * torch.tensor([size[1], size[0]])).round().int().tolist()
    return f"({x}, {y}) px"


def predicted_boxes(matching: FeatureMatching, localization: PickPlace, camera: str) -> dict[str, Any]:
    """Returns pick and place as LeRobot draws predictions on the live picture of a camera.

    Each has a box as large as a typical object there: `bbox` is [left, top, right, bottom], as fractions of
    the picture's sides.
    """
    locations = _in_picture(localization.locations, localization.camera_motion)
    half = matching.object_sizes(locations)[..., None] / 2  # (batch, 2, 1)
    centers = (locations + 1) / 2
    boxes = torch.cat([centers - half, centers + half], dim=-1).clamp(0, 1).tolist()
    sure = torch.stack([localization.confidence, localization.place_confidence], dim=1).tolist()
    detections = [
        {
            "detections": [
                {"label": f"{name} {p:.0%}", "bbox": box}
                for name, p, box in zip(("pick", "place"), probabilities, own, strict=True)
            ]
        }
        for probabilities, own in zip(sure, boxes, strict=True)
    ]
    return {"boxes": {camera: detections}}


def describe_words(matching: FeatureMatching, sentence: str) -> str:
    """Returns which words of an instruction are read as the object's, misread and not known."""
    if not sentence:
        return ""
    about = _quoted(dict(matching.understood(sentence)))
    read = dict(zip(words_of(sentence), understand(sentence, matching.vocabulary), strict=True))
    unknown = _quoted(word for word, meaning in read.items() if meaning is None)
    others = [f"“{word}” as “{meaning}”" for word, meaning in read.items() if meaning not in (None, word)]
    text = f"Words for the object: {about}." if about else "No word for the object."
    text += f" Read {', '.join(others)}." if others else ""
    return text + (f" Unknown words: {unknown}." if unknown else "")


def _quoted(words: Iterable[str]) -> str:
    return ", ".join(f"“{word}”" for word in words)


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


def write_picture(
    folder: Path, image: Tensor, shown: Demonstration | ObjectPrompt | None, localization: PickPlace
) -> Path:
    """Writes a picture of a localization, named by the present time, and returns its file.

    Args:
        folder: Folder of the picture.
        image: First image of the episode, (3, H, W) in 0..1.
        shown: Its first demonstration, or an object prompt; None for none.
        localization: What was found, in a batch of one episode.
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
