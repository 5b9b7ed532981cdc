"""Frozen image encoders for demonstrations, whose weights are neither trained nor saved.

Each gets a demonstration's grid of frames as one image, and returns features: a vector that describes it.
They are computed once: the paper draws the crop and the frames between the ends anew for each sample; here, a
fixed number of such variants of each demonstration is drawn beforehand.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.efficientnet_lite import (
    HEAD_CHANNELS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    EfficientNetLite0,
    PretrainedWeightsError,
)

_BATCH_SIZE = 64
_R3M_URL = "https://pytorch.s3.amazonaws.com/models/rl/r3m/r3m_{}.pt"


class VisionEncoderSpec(NamedTuple):
    """An image encoder."""

    kind: str  # how it is loaded: "transformers", "r3m" or "efficientnet_lite0"
    source: str  # on the Hugging Face Hub, a folder, or the number of layers of R3M's ResNet
    feature_dim: int | None  # None where only the loaded model knows


VISION_ENCODERS = MappingProxyType(
    {
        # The authors'.
        "clip-vit-base-patch32": VisionEncoderSpec("transformers", "openai/clip-vit-base-patch32", 512),
        "r3m-resnet18": VisionEncoderSpec("r3m", "18", 512),
        "r3m-resnet34": VisionEncoderSpec("r3m", "34", 512),
        "r3m-resnet50": VisionEncoderSpec("r3m", "50", 2048),
        # Ours. The last one comes as a Python package.
        "dinov2-small": VisionEncoderSpec("transformers", "facebook/dinov2-small", 384),
        "siglip2-base": VisionEncoderSpec("transformers", "google/siglip2-base-patch16-224", 768),
        "efficientnet-lite0": VisionEncoderSpec("efficientnet_lite0", "", HEAD_CHANNELS),
    }
)
# Format of R3M's images: that of its own example, or that of DeL-TaCo's authors.
VISION_INPUTS = ("published", "authors")


class InputFormat(NamedTuple):
    """The format of the images that an encoder was trained on."""

    size: int | None  # height and width, px; None for those of the image
    mean: tuple[float, ...]  # of the three color channels, 0..1
    std: tuple[float, ...]


class VisionEncoder:
    """A frozen image encoder. It is not a module, so it is neither trained nor saved.

    Args:
        network: The model.
        features: Function of the model and normalized images, (batch, 3, height, width), that returns
            features, (batch, features).
        input_format: Format of the images that the model was trained on.
    """

    def __init__(
        self,
        network: nn.Module,
        features: Callable[[Any, Tensor], Tensor],
        input_format: InputFormat,
    ) -> None:
        self.network = network.eval().requires_grad_(False)
        self.input_format = input_format
        self._features = features

    @property
    def feature_dim(self) -> int:
        """Size of the features, determined with an image."""
        side = self.input_format.size or 64
        return self(torch.zeros(1, 3, side, side)).shape[1]

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Returns features (batch, features) float32 of images (batch, 3, height, width) in 0..1."""
        device = images.device
        self.network.to(device)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in self.input_format[1:])
        with torch.autocast(device.type, enabled=False):
            return torch.cat(
                [
                    self._features(self.network, (_square(part, self.input_format.size) - mean) / std).float()
                    for part in images.float().split(_BATCH_SIZE)
                ]
            )


def _square(images: Tensor, size: int | None) -> Tensor:
    """Cuts the middle square out of images (batch, 3, height, width) in 0..1, and scales it to a size."""
    height, width = images.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    images = images[..., top : top + side, left : left + side]
    if size in (None, side):
        return images
    return F.interpolate(images, (size, size), mode="bicubic", antialias=True).clamp(0, 1)


@torch.random.fork_rng(devices=[])  # initial weights of a policy do not depend on draws of its encoder's
def load_vision_encoder(
    name: str, weights: str | None = None, image_size: int | None = None, input_kind: str = "published"
) -> VisionEncoder:
    """Loads a frozen image encoder.

    Args:
        name: One of `VISION_ENCODERS`, or an image model of transformers: a folder, or its name on the Hub.
        weights: File with the weights of R3M; by default, it is downloaded.
        image_size: Height and width to which images are scaled, px; by default, those of the encoder.
        input_kind: Format of R3M's images: "published"; or "authors", as in the code of DeL-TaCo's authors,
            in 0..1 instead of 0..255, at their own size.

    Raises:
        PretrainedWeightsError: A package is missing, or the model can be neither found nor downloaded, or is
            not the published one.
        ValueError: The arguments do not fit together.
    """
    spec = VISION_ENCODERS.get(name, VisionEncoderSpec("transformers", name, None))
    if (weights is not None or input_kind == "authors") and spec.kind != "r3m":
        raise ValueError(
            f"`vision_encoder_weights` and `vision_input=authors` are for R3M alone. Got {name!r}."
        )
    features: Callable[[Any, Tensor], Tensor]
    if spec.kind == "r3m":
        network, input_format = _load_r3m(spec.source, weights), InputFormat(224, IMAGENET_MEAN, IMAGENET_STD)
        if input_kind == "authors":
            # They give 0..1 to a network that first divides by 255: its input is (x / 255 - mean) / std.
            scaled = (tuple(255 * value for value in values) for values in (IMAGENET_MEAN, IMAGENET_STD))
            input_format = InputFormat(None, *scaled)
        features = _call
    elif spec.kind == "efficientnet_lite0":
        network = EfficientNetLite0()
        network.load_imagenet_weights()
        features = _mean_over_places
        # Its input is (x - 127) / 128 for x in 0..255.
        input_format = InputFormat(224, (127 / 255,) * 3, (128 / 255,) * 3)
    else:
        network, input_format = _load_transformers(spec.source)
        features = _transformers_features
    return VisionEncoder(
        network, features, input_format if image_size is None else input_format._replace(size=image_size)
    )


def _call(network: nn.Module, images: Tensor) -> Tensor:
    return network(images)


def _mean_over_places(network: nn.Module, images: Tensor) -> Tensor:
    return network(images).mean(dim=(2, 3))


# R3M: a ResNet of torchvision


def _load_r3m(layers: str, weights: str | None) -> nn.Module:
    import torchvision

    network = getattr(torchvision.models, f"resnet{layers}")(weights=None)
    network.fc = nn.Identity()
    source = weights or _R3M_URL.format(layers)
    try:
        if weights is None:
            content = torch.hub.load_state_dict_from_url(source, map_location="cpu", weights_only=True)
        elif Path(weights).suffix == ".safetensors":
            from safetensors.torch import load_file

            content = load_file(weights)
        else:
            content = torch.load(weights, map_location="cpu", weights_only=True)
        network.load_state_dict(r3m_weights(content))
    except Exception as error:  # of the network, the file, the archive, the pickle or its content
        raise PretrainedWeightsError(
            f"The weights of R3M's ResNet-{layers} cannot be read from {source}: "
            f"{str(error).splitlines()[0]} "
            "Download them elsewhere, and name the file (.safetensors, or one that `torch.load(..., "
            "weights_only=True)` reads) with `vision_encoder_weights`."
        ) from error
    return network


def r3m_weights(content: dict[str, Any]) -> dict[str, Tensor]:
    """Returns the ResNet's weights from an R3M file, where they are under "r3m" as "module.convnet.*".

    Args:
        content: Content of the file; a ResNet's weights under their plain names are accepted, too.
    """
    content = content.get("r3m", content)
    prefix = "module.convnet." if any(name.startswith("module.convnet.") for name in content) else ""
    return {
        name.removeprefix(prefix): value
        for name, value in content.items()
        if name.startswith(prefix)
        and isinstance(value, Tensor)
        and not name.removeprefix(prefix).startswith("fc.")
    }


# Any image model of transformers: CLIP, SigLIP 2, DINOv2 and others


def _load_transformers(source: str) -> tuple[nn.Module, InputFormat]:
    from transformers import AutoImageProcessor, AutoModel

    try:
        network = AutoModel.from_pretrained(source)
        processor = AutoImageProcessor.from_pretrained(source)
    except (OSError, ValueError) as error:
        raise PretrainedWeightsError(
            f"The image encoder {source} cannot be loaded: {str(error).splitlines()[0]} Valid are "
            f"{', '.join(VISION_ENCODERS)}, a folder with an image model of transformers, or its name on the "
            "Hub. Without a network, choose efficientnet-lite0."
        ) from error
    # The text encoders of CLIP and SigLIP are not needed.
    if hasattr(network, "text_model"):
        del network.text_model
    mean, std = (tuple(getattr(processor, f"image_{name}", None) or (0.5,) * 3) for name in ("mean", "std"))
    size = getattr(processor, "crop_size", None) or processor.size
    side = next((int(size[name]) for name in ("height", "shortest_edge") if name in size), 224)
    return network, InputFormat(side, mean, std)


def _transformers_features(network: Any, images: Tensor) -> Tensor:
    if hasattr(network, "get_image_features"):
        found = network.get_image_features(pixel_values=images)
    else:
        found = network(pixel_values=images)
    if isinstance(found, Tensor):
        return found
    pooled = getattr(found, "pooler_output", None)
    return found.last_hidden_state.mean(dim=1) if pooled is None else pooled.flatten(1)
