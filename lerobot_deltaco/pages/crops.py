"""Pictures of the crops that a policy compares."""

from __future__ import annotations

import torch
from PIL import Image
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.deltaco_match.localization import DemonstrationBatch, PickPlace
from lerobot_deltaco.policies.deltaco_match.prompts import prompted_crop
from lerobot_deltaco.policies.scene.crops import CROP_RESOLUTION, cut_crops


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
    ends, full_resolution, picks = (part[0] for part in given[:3])
    center, _ = matching.demonstrated(ends, full_resolution, picks, picks)
    return _crop(matching, full_resolution, center)


def _crop(matching: FeatureMatching, image: Tensor, center: Tensor) -> Image.Image:
    """Draws the crop of an image (1, 3, H, W) at a center (1, 2) in -1..1."""
    location = center[:, None]
    return draw_crop(image, location, matching.object_sizes(location))
