"""The policy network of the paper (figure 7, appendix B), conditioned on task embeddings or locations.

    image (3, H, W), maps of locations
        |
    conv 7x7, batch norm, pool
        |
    residual block  <--- FiLM: gamma and beta, linear in an embedding
        |   ... 8 of them
    spatial softmax
        |
    feature points, concatenated embeddings, proprioception
        |                         |
    fully connected           gripper
        |
    distribution of the actions of a chunk; the paper's has one step

Task embedding: a unit vector that stands for a task, made from a demonstration or an instruction.
Location: x (to the right) and y (down) in an image, in -1..1 between its edges.

The authors' code that some comments refer to: https://github.com/Alacarter/deltaco, commit a5423d8.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from lerobot_deltaco.policies.base.image_coordinates import (
    LOCATION_STD,
    features_at,
    gaussian_maps,
    mean_location,
    spatial_weights,
)

FILM_INITIAL_STD = 1e-3
MIN_LOG_STD, MAX_LOG_STD = -6.0, 0.0
_NEARLY = 0.5  # as likely as the likeliest
_GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
INITIAL_LOG_STD = -1.0  # ours: of the order of the first errors, so that the first gradients are moderate
# Initial weights of the authors' code, where they differ from PyTorch's.
AUTHORS_BOUND, AUTHORS_INITIAL_STD = 1e-3, 0.05


class Backbone(NamedTuple):
    """Sizes of the convolutional network."""

    channels: tuple[int, ...]  # of the residual blocks
    stem_stride: int  # of the first convolution
    demo_stride: int  # of the first convolution of the paper's demonstration encoder


BACKBONES = {
    "paper": Backbone((16, 16, 32, 32, 64, 64, 128, 128), stem_stride=1, demo_stride=1),
    # Ours: a seventeenth of the arithmetic.
    "strided": Backbone((16, 32, 64, 64), stem_stride=2, demo_stride=2),
}


class ActionDistribution(NamedTuple):
    """A mixture of Gaussians over chunks of actions without the gripper; the paper has a single component."""

    means: Tensor  # (batch, components, steps, dims)
    logits: Tensor  # (batch, components); their softmax is the probability of each component

    @property
    def mode(self) -> Tensor:
        """The mean of the likeliest component, (batch, steps, dims)."""
        return self.likely_mean(0)

    def likely_mean(self, index: int) -> Tensor:
        """Returns the mean of a likely component, (batch, steps, dims).

        Cycles through the components that are nearly as likely as the likeliest, each as often as it is
        likely. Where waiting is a little likelier than going on, a robot that always does the likeliest may
        wait forever.

        Args:
            index: Number of the action in the episode; at 0, it is the likeliest component's.
        """
        probabilities, components = self.logits.float().softmax(dim=1).sort(dim=1, descending=True)
        probabilities = torch.where(probabilities < _NEARLY * probabilities[:, :1], 0.0, probabilities)
        shares = probabilities.cumsum(dim=1) / probabilities.sum(dim=1, keepdim=True)
        # Multiples of the golden ratio are spread evenly over 0..1: none waits long.
        chosen = (shares[:, :-1] <= index * _GOLDEN_RATIO % 1.0).sum(dim=1)
        rows = torch.arange(len(chosen), device=chosen.device)
        return self.means[rows, components[rows, chosen]]


class PolicyNetwork(nn.Module):
    """Predicts a chunk of actions from images, the specification of the task, and proprioception.

    Args:
        n_cameras: Number of images of an observation; their feature points are concatenated.
        film_dim: Size of the embedding that goes through FiLM, 0 for none.
        concat_dim: Size of what is concatenated to the feature points: embeddings and proprioception.
        action_dim: Size of the action without the gripper.
        has_gripper: Whether the action has a gripper.
        channels: Number of channels of each residual block.
        stem_stride: Stride of the first convolution.
        hidden_dims: Sizes of the hidden fully connected layers.
        gripper_hidden_dim: Size of the gripper's hidden layer.
        num_components: Number of Gaussians of the action's distribution.
        n_locations: Number of locations in the first camera's image that specify the task.
        chunk_size: Number of steps of a chunk; 1 in the paper.
    """

    def __init__(
        self,
        n_cameras: int,
        film_dim: int,
        concat_dim: int,
        action_dim: int,
        has_gripper: bool,
        channels: Sequence[int] = BACKBONES["paper"].channels,
        stem_stride: int = 1,
        hidden_dims: Sequence[int] = (1024, 512, 256),
        gripper_hidden_dim: int = 32,
        num_components: int = 1,
        n_locations: int = 0,
        chunk_size: int = 1,
    ) -> None:
        super().__init__()
        self.backbone = FilmResNet(film_dim, channels, stem_stride, in_channels=3 + n_locations)
        self.spatial_softmax = SpatialSoftmax()
        # Each location adds its coordinates and the features there.
        feature_dim = n_cameras * 2 * channels[-1] + concat_dim + n_locations * (2 + channels[-1])
        self.means_shape = (num_components, chunk_size, action_dim)
        n_outputs = math.prod(self.means_shape) + (num_components if num_components > 1 else 0)
        self.action_head = multilayer_perceptron([feature_dim, *hidden_dims, n_outputs])
        # After the authors' code: independent of the observation.
        self.raw_log_std = nn.Parameter(torch.full(self.means_shape, _inverse_log_std(INITIAL_LOG_STD)))
        # After the authors' code: on the concatenated features (the paper's figure 7: after those layers).
        self.gripper_head = (
            multilayer_perceptron([feature_dim, gripper_hidden_dim, chunk_size]) if has_gripper else None
        )

    @property
    def log_std(self) -> Tensor:
        """Log standard deviation, (components, steps, action_dim), strictly between -6 and 0."""
        return MIN_LOG_STD + (MAX_LOG_STD - MIN_LOG_STD) * torch.sigmoid(self.raw_log_std)

    def forward(
        self, images: Tensor, film: Tensor | None, concat: Tensor | None, locations: Tensor | None = None
    ) -> tuple[ActionDistribution, Tensor | None]:
        """Predicts a chunk of actions.

        Args:
            images: Images of all cameras, (batch, cameras, 3, H, W) in 0..1.
            film: Embedding that goes through FiLM, (batch, film_dim); None if `film_dim` is 0.
            concat: Embeddings and proprioception, (batch, concat_dim); None if `concat_dim` is 0.
            locations: Locations in the first camera's image, (batch, n_locations, 2) in -1..1; None if
                `n_locations` is 0.

        Returns:
            The distribution of the actions, and the gripper's logits, (batch, steps), or None. (Their sigmoid
            is the gripper in 0..1.)
        """
        n_cameras = images.shape[1]
        if film is not None:
            film = film.repeat_interleave(n_cameras, dim=0)  # (batch * cameras, film_dim)
        if locations is not None:
            images = _with_location_maps(images, locations)  # (batch, cameras, 3 + locations, H, W)
        maps = self.backbone(
            rearrange(images, "b n c h w -> (b n) c h w"), film
        )  # (batch * cameras, c, h, w)
        parts = [rearrange(self.spatial_softmax(maps), "(b n) p -> b (n p)", n=n_cameras)]
        if locations is not None:
            parts += [features_at(maps[::n_cameras], locations).flatten(1), locations.flatten(1)]
        if concat is not None:
            parts.append(concat)
        features = torch.cat(parts, dim=-1)  # (batch, feature_dim)
        gripper = None if self.gripper_head is None else self.gripper_head(features)
        outputs, n_means = self.action_head(features), math.prod(self.means_shape)
        means = outputs[:, :n_means].unflatten(1, self.means_shape)
        logits = outputs[:, n_means:] if self.means_shape[0] > 1 else torch.zeros_like(means[:, :, 0, 0])
        return ActionDistribution(means, logits), gripper


def _with_location_maps(images: Tensor, locations: Tensor) -> Tensor:
    """Appends a map of each location as a channel; zeros in the images of other cameras than the first."""
    height, width = images.shape[-2:]
    maps = gaussian_maps(locations, height, width, LOCATION_STD).to(images.dtype)  # (batch, locations, H, W)
    others = maps.new_zeros(len(maps), images.shape[1] - 1, *maps.shape[1:])
    return torch.cat([images, torch.cat([maps[:, None], others], dim=1)], dim=2)


class FilmResNet(nn.Module):
    """Residual blocks after a 7x7 convolution, each with FiLM.

    Args:
        film_dim: Size of the embedding, 0 for no FiLM.
        channels: Number of channels of each block.
        stem_stride: Stride of the first convolution. With the paper's 1, the maps have half the image's size.
        in_channels: Number of channels of the image.
    """

    def __init__(
        self, film_dim: int, channels: Sequence[int], stem_stride: int = 1, in_channels: int = 3
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(in_channels, channels[0], kernel_size=7, stride=stem_stride, padding=3, bias=False),
            nn.BatchNorm2d(channels[0]),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(kernel_size=3, stride=2, padding=1),
        )
        inputs = [channels[0], *channels[:-1]]
        self.blocks = nn.ModuleList(FilmBlock(*dims, film_dim) for dims in zip(inputs, channels, strict=True))

    def forward(self, images: Tensor, film: Tensor | None) -> Tensor:
        """Maps images (batch, in_channels, H, W) to features (batch, channels, h, w)."""
        x = self.stem(channels_last(images))
        for block in self.blocks:
            x = block(x, film)
        return x


class FilmBlock(nn.Module):
    """A basic residual block, with FiLM after its second batch norm and before the sum."""

    def __init__(self, in_channels: int, out_channels: int, film_dim: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False)
        self.norm1 = nn.BatchNorm2d(out_channels)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(out_channels)
        self.film = Film(film_dim, out_channels) if film_dim else None
        self.shortcut: nn.Module = nn.Identity()
        if in_channels != out_channels:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, bias=False), nn.BatchNorm2d(out_channels)
            )

    def forward(self, x: Tensor, film: Tensor | None) -> Tensor:
        """Maps (batch, in, h, w) to (batch, out, h, w)."""
        y = F.relu(self.norm1(self.conv1(x)), inplace=True)
        y = self.norm2(self.conv2(y))
        if self.film is not None:
            y = self.film(y, film)
        return F.relu(y + self.shortcut(x), inplace=True)


class Film(nn.Module):
    """Feature-wise linear modulation, (1 + gamma) x + beta, with gamma and beta linear in an embedding.

    It begins close to the identity. (After the authors' code; the paper's figure 7 has gamma x + beta.)
    """

    def __init__(self, embedding_dim: int, channels: int) -> None:
        super().__init__()
        self.project = nn.Linear(embedding_dim, 2 * channels)
        nn.init.normal_(self.project.weight, std=FILM_INITIAL_STD)
        nn.init.zeros_(self.project.bias)

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        """Modulates (batch, channels, h, w) by embeddings (batch, embedding_dim)."""
        gamma, beta = self.project(embedding)[:, :, None, None].chunk(2, dim=1)  # (batch, channels, 1, 1)
        return (1 + gamma) * x + beta


class SpatialSoftmax(nn.Module):
    """The mean location of each channel under a softmax over its map."""

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (batch, channels, h, w) to (batch, 2 channels) in -1..1: all x, then all y."""
        return torch.cat(mean_location(spatial_weights(maps)), dim=-1)


class FullPrecisionLinear(nn.Linear):
    """A linear layer that computes in its weights' precision, even under mixed precision.

    For outputs: bfloat16 rounds a number close to 1 to a multiple of 1/256 or 1/128.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Maps (..., in) to (..., out)."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


class NormalizedProjection(nn.Module):
    """Fully connected layers after a frozen encoder, whose output is scaled to unit length.

    Args:
        feature_dim: Size of the encoder's features.
        hidden_dims: Sizes of the hidden layers, with a ReLU after each; None for no layers at all, so that
            the features are only scaled to unit length.
        embedding_dim: Size of the embedding; without layers, that of the features.
    """

    def __init__(self, feature_dim: int, hidden_dims: Sequence[int] | None, embedding_dim: int) -> None:
        super().__init__()
        self.layers: nn.Module = nn.Identity()
        if hidden_dims is not None:
            self.layers = multilayer_perceptron([feature_dim, *hidden_dims, embedding_dim])

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, feature_dim) to unit vectors (batch, embedding_dim)."""
        return F.normalize(self.layers(features), dim=-1)


def multilayer_perceptron(dims: Sequence[int]) -> nn.Sequential:
    """Returns fully connected layers with ReLU between them; the last one computes in full precision.

    Args:
        dims: Sizes, from the input to the output.
    """
    *hidden_dims, out_dim = dims
    layers: list[nn.Module] = []
    for in_dim, hidden_dim in pairwise(hidden_dims):
        layers += [nn.Linear(in_dim, hidden_dim), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, FullPrecisionLinear(hidden_dims[-1], out_dim))


def conv_norm_relu(in_channels: int, out_channels: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    """Returns a convolution with batch norm and ReLU."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, size, stride, padding=size // 2, bias=False),
        nn.BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    )


def channels_last(images: Tensor) -> Tensor:
    """Returns images (batch, channels, H, W) in the memory format in which convolutions are fastest."""
    return images.contiguous(memory_format=torch.channels_last)


# Weights


@torch.no_grad()
def initialize_as_authors(network: PolicyNetwork) -> None:
    """Sets the initial weights of the authors' code.

    Fully connected layers are uniform within 1e-3; the convolutions are as in torchvision's ResNet (Kaiming);
    the standard deviation of an action is 0.05. FiLM stays close to the identity.
    """
    for layers in (network.action_head, network.gripper_head):
        if layers is not None:
            uniform_linear_layers(layers, AUTHORS_BOUND)
    for module in network.backbone.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    network.raw_log_std.fill_(_inverse_log_std(math.log(AUTHORS_INITIAL_STD)))


@torch.no_grad()
def uniform_linear_layers(network: nn.Module, bound: float) -> None:
    """Draws the weights of all linear layers uniformly within a bound."""
    for module in network.modules():
        if isinstance(module, nn.Linear):
            module.weight.uniform_(-bound, bound)
            module.bias.uniform_(-bound, bound)


def fuse_batch_norms(network: PolicyNetwork) -> PolicyNetwork:
    """Returns a copy in evaluation mode whose batch norms are part of the convolutions, for acting.

    Its outputs equal the network's up to rounding.
    """
    network = copy.deepcopy(network).eval().requires_grad_(False)
    _fuse(network.backbone.stem, "0", "1")
    for block in network.backbone.blocks:
        _fuse(block, "conv1", "norm1")
        _fuse(block, "conv2", "norm2")
        if isinstance(block.shortcut, nn.Sequential):
            _fuse(block.shortcut, "0", "1")
    return network


def _fuse(parent: nn.Module, convolution: str, norm: str) -> None:
    before, after = parent.get_submodule(convolution), parent.get_submodule(norm)
    assert isinstance(before, nn.Conv2d)
    assert isinstance(after, nn.BatchNorm2d)
    setattr(parent, convolution, fuse_conv_bn_eval(before, after))
    setattr(parent, norm, nn.Identity())


def _inverse_log_std(log_std: float) -> float:
    """Returns the value of `raw_log_std` that gives a log standard deviation."""
    fraction = (log_std - MIN_LOG_STD) / (MAX_LOG_STD - MIN_LOG_STD)
    return math.log(fraction / (1 - fraction))
