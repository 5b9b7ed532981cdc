"""Finds prompted objects: what a person points at, or a photo shows, in place of a demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.deltaco_match.feature_matching import Candidates, FeatureMatching
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion
from lerobot_deltaco.policies.scene.proposals import nearest_proposals

_MIN_CROP = 8  # px


def prompts_of(
    instructions: Sequence[str], demonstrations: Sequence[Sequence[Demonstration | ObjectPrompt]]
) -> list[ObjectPrompt]:
    """Returns the prompt of each sample; empty if the samples have none.

    Raises:
        UserError: Some samples have prompts and others demonstrations, or a prompt has no instruction.
    """
    prompts = [each for given in demonstrations for each in given if isinstance(each, ObjectPrompt)]
    if not prompts:
        return []
    if any(len(given) != 1 for given in demonstrations) or len(prompts) != len(demonstrations):
        raise UserError("Each sample of a batch must have one object prompt, or none of them any.")
    if not all(instructions):
        raise UserError(
            "A point, box or photo shows an object, but not where to put it. Give an instruction, too, such "
            "as with --task."
        )
    return prompts


def registered_prompt(prompt: ObjectPrompt, motion: CameraMotion) -> ObjectPrompt:
    """Returns a prompt whose point in the first image is where the training's camera would see it.

    Args:
        prompt: A prompt; one with a picture of its own stays as it is.
        motion: How far the camera has moved.
    """
    if prompt.image is not None:
        return prompt
    location = torch.tensor(prompt.location)
    right, down = ((motion.from_picture(location) - location) / 2).tolist()
    left, top, right_edge, bottom = prompt.box
    return replace(prompt, box=(left + right, top + down, right_edge + right, bottom + down))


@torch.no_grad()
def describe_prompts(matching: FeatureMatching, prompts: Sequence[ObjectPrompt], scenes: Tensor) -> Tensor:
    """Returns descriptors of prompted objects, (batch, descriptor).

    Args:
        matching: Feature matching, fitted.
        prompts: A prompt for each sample.
        scenes: First images of the episodes at full resolution, (batch, 3, H, W) in 0..1.
    """
    with torch.autocast(scenes.device.type, enabled=False):
        crops = [
            prompted_crop(matching, prompt, scene) for prompt, scene in zip(prompts, scenes, strict=True)
        ]
        return torch.cat([matching.compare(matching.features(*crop)).descriptors[:, 0] for crop in crops])


def prompted_crop(
    matching: FeatureMatching, prompt: ObjectPrompt, scene: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns an image (1, 3, H, W), and the center (1, 1, 2) and the side (1, 1) of a prompt's crop of it.

    That is around the proposal at a point, or the point itself if there is none.

    Args:
        matching: Feature matching, fitted.
        prompt: The prompt.
        scene: First image of the episode, (3, H, W) in 0..1, at full resolution.
    """
    image = scene if prompt.image is None else prompt.image.to(scene.device).float() / 255
    if prompt.image is not None and not prompt.is_point:
        height, width = scene.shape[-2:]
        side = float(matching.object_sizes(torch.zeros(2, device=image.device)))
        extent = max(_MIN_CROP, round(side * height)), max(_MIN_CROP, round(side * width))
        crop = cut_box(image, prompt.box, extent)[None]
        return crop, crop.new_zeros(1, 1, 2), crop.new_ones(1, 1)
    point = image.new_tensor([prompt.location])  # (1, 2)
    proposed = matching.background(image[None])
    nearest, is_near = nearest_proposals(proposed, point, matching.grasp_radius)
    location = torch.where(is_near[:, None], proposed[0, nearest], point)[:, None]
    return image[None], location, matching.object_sizes(location)


def cut_box(image: Tensor, box: Sequence[float], size: tuple[int, int]) -> Tensor:
    """Cuts a box out of an image, extended to a size's ratio of height to width, and scales it to that size.

    Args:
        image: (3, H, W) in 0..1.
        box: Left, top, right and bottom edge, as fractions of the image's width and height.
        size: Height and width of the result, px. Beyond the image's edge, its last pixels are repeated.
    """
    height, width = image.shape[-2:]
    left, top, right, bottom = (
        fraction * side for fraction, side in zip(box, (width, height, width, height), strict=True)
    )
    scale = max((bottom - top) / size[0], (right - left) / size[1], 1 / min(size))
    half_height, half_width = scale * size[0] / 2, scale * size[1] / 2
    x, y = (left + right) / 2, (top + bottom) / 2
    first_row, first_column = round(y - half_height), round(x - half_width)
    end_row, end_column = (
        max(round(y + half_height), first_row + 1),
        max(round(x + half_width), first_column + 1),
    )
    beyond = (max(0, -first_column), max(0, end_column - width), max(0, -first_row), max(0, end_row - height))
    padded = F.pad(image[None], beyond, mode="replicate")
    rows = slice(first_row + beyond[2], end_row + beyond[2])
    columns = slice(first_column + beyond[0], end_column + beyond[0])
    return F.interpolate(padded[..., rows, columns], size, mode="bilinear", antialias=True)[0]


def choose_prompted(candidates: Candidates, prompts: Sequence[ObjectPrompt]) -> Candidates:
    """Chooses what was pointed at in the scenes themselves: no other candidate is likely any more.

    Args:
        candidates: The candidates.
        prompts: A prompt for each sample; those with a picture of their own change nothing.
    """
    points = candidates.locations.new_tensor([prompt.location for prompt in prompts])
    nearest, is_near = nearest_proposals(candidates.locations, points, candidates.radius)
    locations, heights = candidates.locations.clone(), candidates.heights.clone()
    log_probabilities = candidates.log_probabilities.clone()
    for n, prompt in enumerate(prompts):
        if prompt.image is not None:
            continue
        if not is_near[n]:
            locations[n, nearest[n]], heights[n, nearest[n]] = points[n], 0
        log_probabilities[n] = -torch.inf
        log_probabilities[n, nearest[n]] = 0
    return candidates._replace(locations=locations, log_probabilities=log_probabilities, heights=heights)
