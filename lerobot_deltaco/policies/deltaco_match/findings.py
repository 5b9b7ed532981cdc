"""What the policy has found at the start of an episode, in words, and as boxes for the live picture."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace
from lerobot_deltaco.policies.deltaco_match.words import understand, words_of


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
    pick, place = (_pixel(location, size) for location in localization.locations[0])
    sources = ["the demonstration"] if isinstance(shown, Demonstration) else []
    if isinstance(shown, ObjectPrompt):
        sources.append("the point" if shown.image is None else "the photo")
    words = _quoted(dict(matching.understood(instruction))) if instruction else ""
    sources += [f"the words {words}"] if words else []
    place_source = "the sentence" if instruction else "the demonstration"
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
            else f"which grasped at {_pixel(localization.demonstrated_grasp[0], size)}"
        )
        lines.append(f"  {name}, {does}")
    motion, moved = localization.camera_motion, "not compared with the training's"
    if motion is not None:
        moved = motion.describe(size[1], size[0])
        moved = f"moved by {moved}" if motion.is_significant else f"as in training ({moved} off)"
    return [*lines, f"  camera: {moved}"]


def _pixel(location: Tensor, size: tuple[int, ...]) -> str:
    x, y = ((location.cpu() + 1) / 2 * torch.tensor([size[1], size[0]])).round().int().tolist()
    return f"({x}, {y}) px"


def predicted_boxes(matching: FeatureMatching, localization: PickPlace, camera: str) -> dict[str, Any]:
    """Returns pick and place as LeRobot draws predictions on the live picture of a camera.

    Each has a box as large as a typical object there: `bbox` is [left, top, right, bottom], as fractions of
    the picture's sides.
    """
    locations = localization.locations
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
