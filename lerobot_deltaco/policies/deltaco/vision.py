"""Frozen image encoders for demonstrations, whose weights are neither trained nor saved.

Each gets a demonstration's grid of frames as one image, and returns features: a vector that describes it.
They are computed once: the paper draws the crop and the frames between the ends anew for each sample; here, a
fixed number of such variants of each demonstration is drawn beforehand.
"""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.base.image_encoder import (
    HEAD_CHANNELS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    EfficientNetLite0,
    PretrainedWeightsError,
)

_BATCH_SIZE = 64
_CLIP = "openai/clip-vit-base-patch32"
_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_R3M_URL = "https://pytorch.s3.amazonaws.com/models/rl/r3m/r3m_18.pt"
_R3M_PREFIX = "module.convnet."

Values = tuple[float, ...]  # of each color channel
# From images (batch, 3, height, width) in 0..1 to features (batch, features) in float32.
VisionEncoder = Callable[[Tensor], Tensor]


class VisionEncoderSpec(NamedTuple):
    """A frozen image encoder."""

    feature_dim: int
    load: Callable[[], nn.Module]
    features: Callable[[Any], Tensor]  # from the network's output, (batch, feature_dim)
    image_size: int | None  # px; None for images at their own size
    mean: Values
    std: Values


def _clip() -> nn.Module:
    from transformers import CLIPVisionModelWithProjection

    return CLIPVisionModelWithProjection.from_pretrained(_CLIP)


def _r3m() -> nn.Module:
    import torchvision

    content = torch.hub.load_state_dict_from_url(_R3M_URL, map_location="cpu", weights_only=True)
    network = torchvision.models.resnet18(weights=None)
    network.fc = nn.Identity()
    network.load_state_dict(
        {
            name.removeprefix(_R3M_PREFIX): value
            for name, value in content["r3m"].items()
            if name.startswith(_R3M_PREFIX) and not name.startswith(f"{_R3M_PREFIX}fc.")
        }
    )
    return network


VISION_ENCODERS = MappingProxyType(
    {
        # The authors' two. They give R3M images in 0..1, which it divides by 255, at their own size.
        "clip-vit-base-patch32": VisionEncoderSpec(
            512, _clip, lambda output: output.image_embeds, 224, _CLIP_MEAN, _CLIP_STD
        ),
        "r3m-resnet18": VisionEncoderSpec(512, _r3m, lambda output: output, 224, IMAGENET_MEAN, IMAGENET_STD),
        "r3m-resnet18-authors": VisionEncoderSpec(
            512,
            _r3m,
            lambda output: output,
            None,
            tuple(255 * value for value in IMAGENET_MEAN),
            tuple(255 * value for value in IMAGENET_STD),
        ),
        # It comes as a Python package. Its input is (x - 127) / 128 for x in 0..255.
        "efficientnet-lite0": VisionEncoderSpec(
            HEAD_CHANNELS,
            EfficientNetLite0,
            lambda output: output[-1].mean(dim=(2, 3)),
            224,
            (127 / 255,) * 3,
            (128 / 255,) * 3,
        ),
    }
)


@torch.random.fork_rng(devices=[])  # initial weights of a policy do not depend on draws of its encoder's
def load_vision_encoder(name: str, image_size: int | None = None) -> VisionEncoder:
    """Loads a frozen image encoder, which crops images to their middle square and scales it.

    Args:
        name: One of `VISION_ENCODERS`.
        image_size: Height and width to which images are scaled, px; by default, those of the encoder.

    Raises:
        PretrainedWeightsError: A package is missing, or the weights can be neither found nor downloaded.
    """
    spec = VISION_ENCODERS[name]
    size = image_size or spec.image_size
    try:
        network = spec.load().eval().requires_grad_(False)
    except (ImportError, OSError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise PretrainedWeightsError(
            f"The image encoder {name} cannot be loaded: {reason}. Without a network, "
            "choose efficientnet-lite0, or fill the caches of Hugging Face and torch.hub elsewhere. CLIP "
            'needs `pip install "lerobot_policy_deltaco[language]"`.'
        ) from error

    @torch.no_grad()
    def encode(images: Tensor) -> Tensor:
        device = images.device
        network.to(device)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (spec.mean, spec.std))
        with torch.autocast(device.type, enabled=False):
            batches = ((_square(part, size) - mean) / std for part in images.float().split(_BATCH_SIZE))
            return torch.cat([spec.features(network(batch)).float() for batch in batches])

    return encode


def _square(images: Tensor, size: int | None) -> Tensor:
    """Cuts the middle square out of images (batch, 3, height, width) in 0..1, and scales it to a size."""
    height, width = images.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    images = images[..., top : top + side, left : left + side]
    if size in (None, side):
        return images
    return F.interpolate(images, (size, size), mode="bicubic", antialias=True).clamp(0, 1)
