"""The frozen image encoders that a policy can use. `policy/vision.py` loads them."""

from types import MappingProxyType
from typing import NamedTuple


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
        # Ours. The last one comes as a Python package, with the extra `offline`.
        "dinov2-small": VisionEncoderSpec("transformers", "facebook/dinov2-small", 384),
        "siglip2-base": VisionEncoderSpec("transformers", "google/siglip2-base-patch16-224", 768),
        "efficientnet-lite0": VisionEncoderSpec("efficientnet_lite0", "", 1280),
    }
)
# How images are given to R3M: as its own example does, or as DeL-TaCo's authors do.
VISION_INPUTS = ("published", "authors")
