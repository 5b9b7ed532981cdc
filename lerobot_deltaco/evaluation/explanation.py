"""Draws what a policy with `demo_encoder=correspondence` sees: where it looks, and which goals it finds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from gym_deltaco.sheets import GAP, across, caption, down, to_image
from lerobot_deltaco.policy.goals.conditioning import FoundGoals

# Colors that no object and no container of the benchmark has.
GRASP_COLOR, RELEASE_COLOR = (255, 0, 200), (0, 220, 255)
_COLORS = (GRASP_COLOR, RELEASE_COLOR)
_NAMES = ("grasp", "release")
_OPACITY = 0.75  # of an overlay where its map is greatest
_DIMMED = 0.75  # brightness of what lies under an overlay
_CAPTION_SIZE = 13  # px
_CAPTION_LINES = 2
_TITLE_SIZE = 15  # px
_MOTION = 1.0  # mean change of a pixel's value, 0..255, from one image to the next if something moves
_MOMENT_SIZE = 130  # px, about, of an image of the episode


def draw_explanation(
    scene: NDArray[np.uint8],
    demonstration: NDArray[np.uint8] | None,
    goals: FoundGoals | None,
    sample: int = 0,
    panel_size: int = 224,
) -> NDArray[np.uint8]:
    """Draws a demonstration and a scene side by side, with the policy's view of both laid over them.

    Args:
        scene: First image of an episode, (H, W, 3).
        demonstration: First and last image of the demonstration, (2, H, W, 3); None if the policy takes none.
        goals: Goals that the policy found; None if it finds none, which leaves the images as they are.
            Attention is drawn for those that were found by the demonstration.
        sample: Number of the scene within the batch that `goals` are of.
        panel_size: Height and width at which each image is drawn, in pixels.

    Returns:
        One image, (height, width, 3) RGB.
    """
    attention = None if goals is None or goals.attention is None else goals.attention[sample]
    panels = []
    if demonstration is not None:
        plain = ("Demonstration, first image", "Demonstration, last image")
        explained = ("Demonstration: what was moved", "Demonstration: where it was put")
        for number, image in enumerate(demonstration):
            panel = to_image(image).resize((panel_size, panel_size), Image.Resampling.BICUBIC)
            is_explained = goals is not None and goals.from_demonstration[number]
            if attention is not None and is_explained:
                panel = _overlaid(panel, attention[number : number + 1], _COLORS[number : number + 1])
            panels.append(_captioned(panel, explained[number] if is_explained else plain[number]))
    panel = to_image(scene).resize((panel_size, panel_size), Image.Resampling.BICUBIC)
    if goals is not None:
        weights = goals.logits[sample].float().flatten(1).softmax(dim=1).view_as(goals.logits[sample])
        panel = _overlaid(panel, weights, _COLORS)
        for place, color, name in zip(goals.places[sample].tolist(), _COLORS, _NAMES, strict=True):
            _mark(panel, place, color, name)
    panels.append(_captioned(panel, "Scene" if goals is None else "Scene: where it will grasp and release"))
    return np.asarray(across(panels))


def draw_episode(
    title: str,
    images: Sequence[NDArray[np.uint8]],
    observed: NDArray[np.uint8],
    demonstration: NDArray[np.uint8] | None,
    goals: FoundGoals,
) -> NDArray[np.uint8]:
    """Draws where a policy looked, and below it what it did then: images of the episode with both goals.

    Args:
        title: Instruction and what happened.
        images: The scene before the first step and after each, (H, W, 3), as the policy's camera sees it.
        observed: First image that the policy received, (H, W, 3).
        demonstration: First and last image of the demonstration, (2, H, W, 3); None if the policy takes none.
        goals: Goals that the policy found, of this episode alone.

    Returns:
        One image, (height, width, 3) RGB.
    """
    top = to_image(draw_explanation(observed, demonstration, goals))
    n_columns = max(2, round(top.width / _MOMENT_SIZE))
    size = (top.width - GAP * (n_columns - 1)) // n_columns
    moments = []
    for step in np.linspace(0, _last_motion(images), n_columns).round().astype(int).tolist():
        panel = to_image(images[step]).resize((size, size), Image.Resampling.LANCZOS)
        for place, color in zip(goals.places[0].tolist(), _COLORS, strict=True):
            _mark(panel, place, color)
        panels = [panel, caption(f"step {step}", size, _CAPTION_SIZE)]
        moments.append(down(panels, gap=4))
    return np.asarray(down([caption(title, top.width, _TITLE_SIZE), top, across(moments)]))


def _last_motion(images: Sequence[NDArray[np.uint8]]) -> int:
    """Number of the last image that differs from the one before it in more than noise."""
    for step in range(len(images) - 1, 0, -1):
        change = np.abs(images[step].astype(np.float32) - images[step - 1].astype(np.float32))
        if change.mean() > _MOTION:
            return step
    return len(images) - 1


def _overlaid(
    panel: Image.Image, maps: torch.Tensor, colors: tuple[tuple[int, int, int], ...]
) -> Image.Image:
    """A panel, dimmed, with maps (maps, h, w) of weights >= 0 laid over it, each in its color."""
    pixels = _DIMMED * np.asarray(panel, np.float32)
    for weights, color in zip(maps.float().cpu().numpy(), colors, strict=True):
        # The square root shows what is less likely, too.
        relative = np.sqrt(weights / max(float(weights.max()), 1e-12))
        heat = Image.fromarray(np.round(255 * relative).astype(np.uint8))
        heat = heat.resize(panel.size, Image.Resampling.BILINEAR)
        opacity = _OPACITY * np.asarray(heat, np.float32)[..., None] / 255
        pixels = (1 - opacity) * pixels + opacity * np.array(color, np.float32)
    return Image.fromarray(np.round(pixels).astype(np.uint8))


def _mark(panel: Image.Image, place: list[float], color: tuple[int, int, int], name: str = "") -> None:
    """Draws a ring and perhaps a name at a place, x and y in -1..1."""
    draw = ImageDraw.Draw(panel)
    x, y = ((coordinate + 1) / 2 * side for coordinate, side in zip(place, panel.size, strict=True))
    radius = panel.width / 20
    for outline, reach, width in (((0, 0, 0), radius + 1, 4), (color, radius, 2)):
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=outline, width=width)
    if not name:
        return
    above = y > panel.height / 2
    anchor, text_y = ("mb", y - radius - 2) if above else ("mt", y + radius + 2)
    x = min(max(x, 24), panel.width - 24)
    draw.text((x, text_y), name, fill=(255, 255, 255), anchor=anchor, stroke_width=2, stroke_fill=(0, 0, 0))


def _captioned(panel: Image.Image, text: str) -> Image.Image:
    label = caption(text, panel.width, _CAPTION_SIZE, n_lines=_CAPTION_LINES)
    return down([panel, label], gap=4)
