"""The first stages of EfficientNet-Lite0, whose feature maps describe objects in an image.

Tan & Le, "EfficientNet" (ICML 2019), in its variant for mobile devices: inverted residual blocks with
ReLU6, without squeeze-and-excitation. The network is written out here, so that a checkpoint that contains its
weights needs no further package. A test compares it with the package whose weights it takes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

FINE_CHANNELS, COARSE_CHANNELS = 40, 80
FINE_STRIDE, COARSE_STRIDE = 8, 16
# The mean and the standard deviation of ImageNet, by which the weights expect images to be normalized.
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_BATCH_NORM_EPS = 1e-3
_STEM_CHANNELS = 32


class _Block(NamedTuple):
    """Shape of an inverted residual block."""

    out_channels: int
    expansion: int
    kernel_size: int
    stride: int


_FINE_BLOCKS = (
    _Block(16, 1, 3, 1),
    _Block(24, 6, 3, 2),
    _Block(24, 6, 3, 1),
    _Block(40, 6, 5, 2),
    _Block(40, 6, 5, 1),
)
_COARSE_BLOCKS = (_Block(80, 6, 3, 2), _Block(80, 6, 3, 1))


class EfficientNetLite(nn.Module):
    """Seven of the sixteen blocks of EfficientNet-Lite0, frozen: in evaluation mode, without gradients.

    Its weights are random until `take_weights` or `load_state_dict` sets them.
    """

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        self.stem = _ConvNorm(3, _STEM_CHANNELS, 3, 2)
        channels, stages = _STEM_CHANNELS, []
        for blocks in (_FINE_BLOCKS, _COARSE_BLOCKS):
            stage = []
            for block in blocks:
                stage.append(_InvertedResidual(channels, block))
                channels = block.out_channels
            stages.append(nn.Sequential(*stage))
        self.fine, self.coarse = stages
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> EfficientNetLite:
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def take_weights(self, published: dict[str, Tensor]) -> None:
        """Takes the weights of the whole network, as they are published.

        Args:
            published: Its state, in the order in which images pass its layers.

        Raises:
            ValueError: It is the state of another network.
        """
        own = self.state_dict()
        if len(published) < len(own):
            raise ValueError(
                f"These are not the weights of EfficientNet-Lite0: there are {len(published)} tensors, and "
                f"at least {len(own)} are needed."
            )
        for (name, tensor), (other, value) in zip(own.items(), published.items(), strict=False):
            if tensor.shape != value.shape:
                raise ValueError(
                    f"These are not the weights of EfficientNet-Lite0: {other} has the shape "
                    f"{tuple(value.shape)}, {name} {tuple(tensor.shape)}."
                )
            tensor.copy_(value)

    @torch.no_grad()
    def fine_maps(self, images: Tensor) -> Tensor:
        """Maps of images (batch, 3, H, W) in 0..1: (batch, FINE_CHANNELS, H / 8, W / 8), rounded up."""
        with torch.autocast(images.device.type, enabled=False):
            images = (images.float() - self.mean) / self.std
            maps = self.stem(images.contiguous(memory_format=torch.channels_last))
            return self.fine(F.relu6(maps, inplace=True))

    @torch.no_grad()
    def coarse_maps(self, images: Tensor) -> Tensor:
        """Maps of images (batch, 3, H, W) in 0..1: (batch, COARSE_CHANNELS, H / 16, W / 16), rounded up."""
        with torch.autocast(images.device.type, enabled=False):
            return self.coarse(self.fine_maps(images))


class _ConvNorm(nn.Module):
    """A convolution that pads as TensorFlow's "same" does for even sizes, and batch norm."""

    def __init__(
        self, in_channels: int, out_channels: int, size: int, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__()
        total = max(size - stride, 0)
        # The convolution pads all sides alike; one more row and column are added here, which takes a copy.
        self.extra = total % 2
        self.conv = nn.Conv2d(
            in_channels, out_channels, size, stride, padding=total // 2, groups=groups, bias=False
        )
        self.norm = nn.BatchNorm2d(out_channels, eps=_BATCH_NORM_EPS)

    def forward(self, maps: Tensor) -> Tensor:
        if self.extra:
            maps = F.pad(maps, (0, self.extra, 0, self.extra))
        return self.norm(self.conv(maps))


class _InvertedResidual(nn.Module):
    """Expands the channels, convolves each on its own, and projects them."""

    def __init__(self, channels: int, block: _Block) -> None:
        super().__init__()
        inner = channels * block.expansion
        self.expand = _ConvNorm(channels, inner, 1) if block.expansion > 1 else None
        self.depthwise = _ConvNorm(inner, inner, block.kernel_size, block.stride, groups=inner)
        self.project = _ConvNorm(inner, block.out_channels, 1)
        self.has_skip = block.stride == 1 and channels == block.out_channels

    def forward(self, maps: Tensor) -> Tensor:
        inner = maps if self.expand is None else F.relu6(self.expand(maps), inplace=True)
        projected = self.project(F.relu6(self.depthwise(inner), inplace=True))
        return maps + projected if self.has_skip else projected
