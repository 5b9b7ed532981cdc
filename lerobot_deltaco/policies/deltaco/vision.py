"""Frozen image encoders for demonstrations, whose weights are neither trained nor saved.

Each gets a demonstration's grid of frames as one image, and returns features: a vector that describes it.
They are computed once: the paper draws the crop and the frames between the ends anew for each sample; here, a
fixed number of such variants of each demonstration is drawn beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

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

# Size of the features of each encoder: the authors' two, and one that comes as a Python package.
VISION_ENCODERS = MappingProxyType(
    {"clip-vit-base-patch32": 512, "r3m-resnet18": 512, "efficientnet-lite0": HEAD_CHANNELS}
)
# Format of R3M's images: that of its own example, or that of DeL-TaCo's authors.
VISION_INPUTS = ("published", "authors")
_BATCH_SIZE = 64
_CLIP = "openai/clip-vit-base-patch32"
_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_R3M_URL = "https://pytorch.s3.amazonaws.com/models/rl/r3m/r3m_18.pt"
_R3M_PREFIX = "module.convnet."


# From images (batch, 3, height, width) in 0..1 to features (batch, features) in float32.
VisionEncoder = Callable[[Tensor], Tensor]


@torch.random.fork_rng(devices=[])  # initial weights of a policy do not depend on draws of its encoder's
def load_vision_encoder(
    name: str, image_size: int | None = None, input_kind: str = "published"
) -> VisionEncoder:
    """Loads a frozen image encoder.

    Args:
        name: One of `VISION_ENCODERS`.
        image_size: Height and width to which images are scaled, px; by default, those of the encoder.
        input_kind: Format of R3M's images: "published"; or "authors", as in the code of DeL-TaCo's authors,
            in 0..1 instead of 0..255, at their own size.

    Raises:
        PretrainedWeightsError: A package is missing, or the model can be neither found nor downloaded, or is
            not the published one.
        ValueError: The arguments do not fit together.
    """
    size: int | None = 224
    mean: Sequence[float] = IMAGENET_MEAN
    std: Sequence[float] = IMAGENET_STD
    if name == "efficientnet-lite0":
        network = EfficientNetLite0()
        network.load_imagenet_weights()
        mean, std = (127 / 255,) * 3, (128 / 255,) * 3  # its input is (x - 127) / 128 for x in 0..255
        return _frozen(network, _mean_over_locations, image_size or size, mean, std)
    if name == "r3m-resnet18":
        if input_kind == "authors":
            # They give 0..1 to a network that first divides by 255: its input is (x / 255 - mean) / std.
            size, mean, std = None, [255 * value for value in mean], [255 * value for value in std]
        return _frozen(_load(name, _r3m), nn.Module.__call__, image_size or size, mean, std)
    return _frozen(_load(name, _clip), _projected, image_size or size, _CLIP_MEAN, _CLIP_STD)


def _frozen(
    network: nn.Module,
    features: Callable[[Any, Tensor], Tensor],
    size: int | None,
    mean: Sequence[float],
    std: Sequence[float],
) -> VisionEncoder:
    """Makes an encoder of a network and a function from it and normalized images to features."""
    network.eval().requires_grad_(False)

    @torch.no_grad()
    def encode(images: Tensor) -> Tensor:
        device = images.device
        network.to(device)
        center, scale = (torch.tensor(values, device=device)[:, None, None] for values in (mean, std))
        parts = images.float().split(_BATCH_SIZE)
        with torch.autocast(device.type, enabled=False):
            return torch.cat(
                [features(network, (_square(part, size) - center) / scale).float() for part in parts]
            )

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


def _mean_over_locations(network: nn.Module, images: Tensor) -> Tensor:
    return network(images).mean(dim=(2, 3))


def _projected(network: nn.Module, images: Tensor) -> Tensor:
    return network(pixel_values=images).image_embeds


def _load(name: str, load: Callable[[], nn.Module]) -> nn.Module:
    try:
        return load()
    except OSError as error:
        raise PretrainedWeightsError(
            f"The image encoder {name} cannot be downloaded: {str(error).splitlines()[0]} Without a network, "
            "choose efficientnet-lite0, or fill the caches of Hugging Face and torch.hub elsewhere."
        ) from error


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
