"""What the policy has found at the start of an episode, for people: lines of the log, boxes and pictures."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.policies.base.image_coordinates import grid_of_centers
from lerobot_deltaco.policies.deltaco_match.pictures import demonstration_ends, draw_crop, draw_localization
from lerobot_deltaco.policies.deltaco_match.prompts import prompted_crop
from lerobot_deltaco.policies.deltaco_match.words import understand, words_of

if TYPE_CHECKING:
    from lerobot_deltaco.policies.deltaco_match.localization import FeatureMatching
    from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy, PickPlace

logger = logging.getLogger(__name__)


def report_findings(
    policy: DeltacoMatchPolicy, image: Tensor, instruction: str, shown: Demonstration | ObjectPrompt | None
) -> None:
    """Logs what a policy has found in its running episode, and draws it if `picture_folder` says where.

    Args:
        policy: The policy, in a batch of one episode.
        image: First image of the episode, (3, H, W) in 0..1.
        instruction: Its instruction; empty for none.
        shown: Its first demonstration, or an object prompt; None for none.
    """
    if logger.isEnabledFor(logging.INFO):
        logger.info("%s", "\n".join(describe_findings(policy, image.shape[-2:], instruction, shown)))
    if policy.config.picture_folder is not None:
        assert policy.localization is not None
        scene = (255 * image).round().byte().permute(1, 2, 0).cpu().numpy()
        path = _draw(Path(policy.config.picture_folder), scene, shown, policy.localization)
        logger.info("Where the policy looked: %s.", path)


def describe_findings(
    policy: DeltacoMatchPolicy,
    size: tuple[int, ...],
    instruction: str,
    shown: Demonstration | ObjectPrompt | None,
) -> list[str]:
    """Returns lines about what a policy has found in its running episode. See `report_findings`."""
    localization, episode = policy.localization, policy._episode
    assert localization is not None
    pick, place = (_pixel(location, size) for location in localization.locations[0])
    sure, place_sure = localization.confidence[0].item(), place_confidence(policy, localization)[0].item()
    sources = ["the demonstration"] if isinstance(shown, Demonstration) else []
    if isinstance(shown, ObjectPrompt):
        sources.append("the point" if shown.image is None else "the photo")
    words = _quoted(dict(policy.matching.understood(instruction))) if instruction else ""
    sources += [f"the words {words}"] if words else []
    place_source = "the sentence" if instruction else "the demonstration"
    motion, residual = localization.camera_motion, policy.state_regressor.to_image.residual.item()
    camera = "not compared with the training's"
    if motion is not None:
        moved = motion.describe(size[1], size[0])
        camera = f"moved by {moved}" if motion.is_significant else f"as in training ({moved} off)"
    acting = "the policy network acts"
    if bool(episode.replayed.all()):
        is_own = isinstance(shown, Demonstration) and shown.states is not None
        acting = f"replays {'the demonstration' if is_own else 'a training episode'}"
    return [
        f"Found in the first image by {policy.config.cameras[0]}, {size[1]} x {size[0]} px:",
        f"  object: at {pick}, {sure:.0%} sure, by {' and '.join(sources) or 'what stands out'}",
        f"  place: at {place}, {place_sure:.0%} sure, by {place_source}",
        *([_describe_demonstration(policy, shown, size)] if isinstance(shown, Demonstration) else []),
        f"  acting: {acting}",
        f"  camera: {camera}",
        *([f"  states to image: off by {residual:.1%} of its side in training"] if residual >= 0 else []),
    ]


def _describe_demonstration(policy: DeltacoMatchPolicy, shown: Demonstration, size: tuple[int, ...]) -> str:
    name = "demonstration" if shown.episode is None else f"demonstration: episode {shown.episode}"
    if shown.pick_state is not None:
        state = shown.pick_state.to(policy.step.device)[None]
        (location,) = policy.state_regressor.pick_locations(state)
        return f"  {name}, which grasped at {_pixel(location, size)}"
    return f"  {name}, without a grasp: the change between its first and last image counts"


def _pixel(location: Tensor, size: tuple[int, ...]) -> str:
    x, y = ((location.cpu() + 1) / 2 * torch.tensor([size[1], size[0]])).round().int().tolist()
    return f"({x}, {y}) px"


def place_confidence(policy: DeltacoMatchPolicy, localization: PickPlace) -> Tensor:
    """Returns the probability of the place map within an object's radius of the place location, (batch,)."""
    logits = localization.maps[:, 1].float()
    grid = grid_of_centers(logits.shape[1], logits.shape[2], logits.device)
    is_near = torch.cdist(localization.locations[:, 1:], grid)[:, 0] < policy.matching.grasp_radius
    return (logits.flatten(1).softmax(dim=1) * is_near).sum(dim=1)


def predicted_boxes(policy: DeltacoMatchPolicy, localization: PickPlace) -> dict[str, Any]:
    """Returns pick and place as LeRobot draws predictions on the live picture.

    Each has a box as large as a typical object there: `bbox` is [left, top, right, bottom], as fractions of
    the picture's sides.
    """
    locations = localization.locations
    half = policy.matching.object_sizes(locations)[..., None] / 2  # (batch, 2, 1)
    centers = (locations + 1) / 2
    boxes = torch.cat([centers - half, centers + half], dim=-1).clamp(0, 1).tolist()
    sure = torch.stack([localization.confidence, place_confidence(policy, localization)], dim=1).tolist()
    detections = [
        {
            "detections": [
                {"label": f"{name} {p:.0%}", "bbox": box}
                for name, p, box in zip(("pick", "place"), probabilities, own, strict=True)
            ]
        }
        for probabilities, own in zip(sure, boxes, strict=True)
    ]
    return {"boxes": {policy.config.cameras[0]: detections}}


@torch.no_grad()
def compared_crops(
    policy: DeltacoMatchPolicy, image: Tensor, shown: Demonstration | ObjectPrompt | None = None
) -> list[Image.Image]:
    """Returns the crops that were compared in a policy's running episode, as pictures.

    The first is of the demonstration or photo, if there is one; the last is of what was chosen in the scene.
    See `report_findings` for the arguments.
    """
    matching, localization = policy.matching, policy.localization
    assert localization is not None
    scene, crops = image[None], []
    if isinstance(shown, ObjectPrompt):
        crops.append(draw_crop(*prompted_crop(matching, shown, image)))
        if shown.image is None:  # which shows what is chosen
            return crops
    elif shown is not None:
        assert localization.demonstrated is not None
        first = shown.frames[0] if shown.first_image is None else shown.first_image
        crops.append(_crop(matching, first[None], localization.demonstrated[:1]))
    return [*crops, _crop(matching, scene, localization.proposal[:1])]


@torch.no_grad()
def demonstrated_crop(policy: DeltacoMatchPolicy, shown: Demonstration) -> Image.Image:
    """Returns the crop of what a demonstration grasped, as a picture.

    Args:
        policy: A policy whose feature matching is fitted.
        shown: The demonstration.
    """
    given = policy._batch_demonstrations([[shown]], policy.step.device)
    assert given is not None
    ends, full_resolution = given.ends[0], given.first_images[0]
    grasps = policy.state_regressor.pick_locations(given.pick_states[0])
    center, _ = policy.matching.demonstrated(ends, full_resolution, grasps, grasps)
    return _crop(policy.matching, full_resolution, center)


def _crop(matching: FeatureMatching, image: Tensor, center: Tensor) -> Image.Image:
    """Draws the crop of an image (1, 3, H, W) at a center (1, 2) in -1..1."""
    location = center[:, None]
    return draw_crop(image, location, matching.crop_sizes(location))


def _draw(
    folder: Path, scene: Any, shown: Demonstration | ObjectPrompt | None, localization: PickPlace
) -> Path:
    """Writes a picture of a localization, under the present time, and returns its file."""
    ends = demonstration_ends(shown) if isinstance(shown, Demonstration) else None
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S_%f}.png"
    draw_localization(np.ascontiguousarray(scene), ends, localization).save(path)
    return path


def describe_words(policy: DeltacoMatchPolicy, sentence: str) -> str:
    """Returns which words of an instruction a policy reads as the object's, misreads and does not know."""
    if not sentence:
        return ""
    about = _quoted(dict(policy.matching.understood(sentence)))
    read = dict(zip(words_of(sentence), understand(sentence, policy.config.known_words), strict=True))
    unknown = _quoted(word for word, meaning in read.items() if meaning is None)
    others = [f"“{word}” as “{meaning}”" for word, meaning in read.items() if meaning not in (None, word)]
    text = f"Words for the object: {about}." if about else "No word for the object."
    text += f" Read {', '.join(others)}." if others else ""
    return text + (f" Unknown words: {unknown}." if unknown else "")


def _quoted(words: Iterable[str]) -> str:
    return ", ".join(f"“{word}”" for word in words)
