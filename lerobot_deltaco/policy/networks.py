"""The policy's network (the paper's figure 7, appendix B), which task embeddings condition.

    image (3, H, W)
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
    distribution of the motion

Task embedding: a unit vector that stands for a task, made from a demonstration or an instruction. The caller
chooses what goes through FiLM and what is concatenated.

The authors' code that some comments refer to: https://github.com/Alacarter/deltaco, commit a5423d8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor, nn

FILM_INITIAL_STD = 1e-3
MIN_LOG_STD, MAX_LOG_STD = -6.0, 0.0
GOAL_STD = 1 / 12  # of the map of a goal, where the image's edges are at -1 and 1
INITIAL_LOG_STD = -1.0  # ours: of the order of the first errors, so that the first gradients are moderate


class Motion(NamedTuple):
    """A distribution of motions: Gaussian modes, of which the paper has one."""

    means: Tensor  # (batch, modes, dims)
    logits: Tensor  # (batch, modes); their softmax is how likely each mode is

    @property
    def mean(self) -> Tensor:
        """The mean of the likeliest mode, (batch, dims)."""
        if self.means.shape[1] == 1:
            return self.means[:, 0]
        likeliest = self.logits.argmax(dim=1)
        return self.means[torch.arange(len(likeliest), device=likeliest.device), likeliest]


class ConditionedPolicy(nn.Module):
    """From an image, task embeddings and proprioception to an action.

    Args:
        n_cameras: Number of images of an observation; their feature points are concatenated.
        film_dim: Size of the embedding that goes through FiLM, 0 for none.
        concat_dim: Size of what is concatenated to the feature points: embeddings and proprioception.
        motion_dim: Size of the action without the gripper.
        has_gripper: Whether the action has a gripper.
        channels: Number of channels of each residual block.
        stem_stride: Stride of the first convolution.
        hidden_dims: Sizes of the hidden fully connected layers.
        gripper_hidden_dim: Size of the gripper's hidden layer.
        motion_modes: Number of Gaussians of the motion's distribution.
        n_goals: Number of places in the first camera's image that the policy is given as goals.
    """

    def __init__(
        self,
        n_cameras: int,
        film_dim: int,
        concat_dim: int,
        motion_dim: int,
        has_gripper: bool,
        channels: Sequence[int] = (16, 16, 32, 32, 64, 64, 128, 128),
        stem_stride: int = 1,
        hidden_dims: Sequence[int] = (1024, 512, 256),
        gripper_hidden_dim: int = 32,
        motion_modes: int = 1,
        n_goals: int = 0,
    ) -> None:
        super().__init__()
        self.n_goals = n_goals
        self.backbone = FilmResNet(film_dim, channels, stem_stride, in_channels=3 + n_goals)
        self.spatial_softmax = SpatialSoftmax()
        # Of each goal: its place, and what the maps are there.
        feature_dim = n_cameras * 2 * channels[-1] + concat_dim + n_goals * (2 + channels[-1])
        self.motion_dim, self.motion_modes = motion_dim, motion_modes
        n_outputs = motion_modes * motion_dim + (motion_modes if motion_modes > 1 else 0)
        self.motion = multilayer_perceptron([feature_dim, *hidden_dims, n_outputs])
        # After the authors' code: independent of the observation.
        share = (INITIAL_LOG_STD - MIN_LOG_STD) / (MAX_LOG_STD - MIN_LOG_STD)
        stds = (motion_dim,) if motion_modes == 1 else (motion_modes, motion_dim)
        self.raw_log_std = nn.Parameter(torch.full(stds, math.log(share / (1 - share))))
        # After the authors' code: on the concatenated features (the paper's figure 7: after those layers).
        self.gripper = multilayer_perceptron([feature_dim, gripper_hidden_dim, 1]) if has_gripper else None

    @property
    def log_std(self) -> Tensor:
        """Of the motion, (motion_dim,) or (motion_modes, motion_dim), strictly between -6 and 0."""
        return MIN_LOG_STD + (MAX_LOG_STD - MIN_LOG_STD) * torch.sigmoid(self.raw_log_std)

    def forward(
        self, images: Tensor, film: Tensor | None, concat: Tensor | None, goals: Tensor | None = None
    ) -> tuple[Motion, Tensor | None]:
        """Predicts an action.

        Args:
            images: Images of all cameras, (batch, cameras, 3, H, W) in 0..1.
            film: Embedding that goes through FiLM, (batch, film_dim); None if `film_dim` is 0.
            concat: Embeddings and proprioception, (batch, concat_dim); None if `concat_dim` is 0.
            goals: Places in the first camera's image, x and y in -1..1, (batch, n_goals, 2); None if there
                are none.

        Returns:
            The motion, and the gripper's logit, (batch,), or None. (Its sigmoid is the gripper in 0..1.)
        """
        n_cameras = images.shape[1]
        if film is not None:
            film = film.repeat_interleave(n_cameras, dim=0)  # (batch * cameras, film_dim)
        if goals is not None:
            images = self._with_goals(images, goals)  # (batch, cameras, 3 + goals, H, W)
        maps = self.backbone(
            rearrange(images, "b n c h w -> (b n) c h w"), film
        )  # (batch * cameras, c, h, w)
        parts = [rearrange(self.spatial_softmax(maps), "(b n) p -> b (n p)", n=n_cameras)]
        if goals is not None:
            parts += [features_at(maps[::n_cameras], goals).flatten(1), goals.flatten(1)]
        if concat is not None:
            parts.append(concat)
        features = torch.cat(parts, dim=-1)  # (batch, feature_dim)
        gripper = None if self.gripper is None else self.gripper(features).squeeze(-1)
        outputs = self.motion(features)
        means = rearrange(
            outputs[:, : self.motion_modes * self.motion_dim], "b (m d) -> b m d", d=self.motion_dim
        )
        logits = outputs[:, self.motion_modes * self.motion_dim :]
        return Motion(means, logits if self.motion_modes > 1 else torch.zeros_like(means[..., 0])), gripper

    def _with_goals(self, images: Tensor, goals: Tensor) -> Tensor:
        """Images with a map of each goal as a further channel; zeros in the images of other cameras."""
        height, width = images.shape[-2:]
        maps = gaussian_maps(goals, height, width, GOAL_STD).to(images.dtype)  # (batch, goals, H, W)
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
        """From (batch, 3, H, W) to maps (batch, channels, h, w)."""
        x = self.stem(images.contiguous(memory_format=torch.channels_last))
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
        """From (batch, in, h, w) to (batch, out, h, w)."""
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
        """From (batch, channels, h, w) and (batch, embedding_dim) to (batch, channels, h, w)."""
        gamma, beta = self.project(embedding)[:, :, None, None].chunk(2, dim=1)  # (batch, channels, 1, 1)
        return (1 + gamma) * x + beta


class SpatialSoftmax(nn.Module):
    """Where each channel is active: the mean position under a softmax over the map, -1..1 in x and y."""

    def forward(self, maps: Tensor) -> Tensor:
        """From (batch, channels, h, w) to (batch, 2 channels): all x (to the right), then all y (down)."""
        return torch.cat(mean_position(spatial_weights(maps)), dim=-1)


def spatial_weights(maps: Tensor) -> Tensor:
    """The softmax of each map over its places, of the same shape, (batch, channels, h, w), as float32."""
    weights = rearrange(maps, "b c h w -> b c (h w)").float().softmax(dim=-1)
    return rearrange(weights, "b c (h w) -> b c h w", h=maps.shape[-2])


def mean_position(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Of (batch, channels, h, w) weights: x (to the right) and y (down), each (batch, channels) in -1..1."""
    height, width = weights.shape[-2:]
    # Sums of products, since mixed precision would round the factors of a matrix product.
    x = torch.linspace(-1, 1, width, device=weights.device)
    y = torch.linspace(-1, 1, height, device=weights.device)
    return (weights.sum(dim=2) * x).sum(-1), (weights.sum(dim=3) * y).sum(-1)


def cell_centers(n_cells: int, device: torch.device) -> Tensor:
    """Places of the cells of a row or column of a map whose edges are at -1 and 1, (n_cells,)."""
    return (torch.arange(n_cells, device=device) + 0.5) * 2 / n_cells - 1


def gaussian_maps(places: Tensor, height: int, width: int, std: float | Tensor) -> Tensor:
    """Maps that are 1 at a place and fall off around it.

    Args:
        places: Places, x and y in -1..1 between the edges, (batch, places, 2).
        height: Number of rows.
        width: Number of columns.
        std: Standard deviation, in the same unit; one number, or those of x and y, (2,).

    Returns:
        (batch, places, height, width).
    """
    std = torch.as_tensor(std, device=places.device).expand(2)
    across = torch.exp(-0.5 * ((cell_centers(width, places.device) - places[..., :1]) / std[0]) ** 2)
    down = torch.exp(-0.5 * ((cell_centers(height, places.device) - places[..., 1:]) / std[1]) ** 2)
    return down[..., :, None] * across[..., None, :]


def features_at(maps: Tensor, places: Tensor) -> Tensor:
    """Features at places (batch, places, 2) in maps (batch, channels, h, w): (batch, places, channels)."""
    height, width = maps.shape[-2:]
    weights = gaussian_maps(places, height, width, GOAL_STD)
    weights = weights / weights.sum(dim=(2, 3), keepdim=True).clamp_min(1e-3)
    return torch.einsum("bphw,bchw->bpc", weights.to(maps.dtype), maps)


class FullPrecisionLinear(nn.Linear):
    """A linear layer that computes in its weights' precision, also under mixed precision.

    For outputs: bfloat16 rounds a number close to 1 to a multiple of 1/256 or 1/128.
    """

    def forward(self, x: Tensor) -> Tensor:
        """From (..., in) to (..., out)."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


def multilayer_perceptron(dims: Sequence[int]) -> nn.Sequential:
    """Fully connected layers with ReLU between them; `dims` are the sizes from input to output.

    The last computes in full precision.
    """
    *hidden_dims, out_dim = dims
    layers: list[nn.Module] = []
    for in_dim, hidden_dim in pairwise(hidden_dims):
        layers += [nn.Linear(in_dim, hidden_dim), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, FullPrecisionLinear(hidden_dims[-1], out_dim))


def random_crop(images: Tensor, padding: int, generator: torch.Generator | None = None) -> Tensor:
    """Shifts each image at random by up to `padding` pixels; what comes in at the edges is black.

    Args:
        images: Images, (batch, ..., H, W). All images of a sample are shifted alike.
        padding: Largest shift in x and in y, px.
        generator: Source of the shifts, on the CPU.

    Returns:
        The same shape.
    """
    return shift_images(images, random_shifts(len(images), padding, generator), padding)


def random_shifts(n_samples: int, padding: int, generator: torch.Generator | None = None) -> Tensor:
    """Draws shifts to the right and down, -padding..padding px, (n_samples, 2), on the CPU."""
    # The draws are the top and left edges of crops of padded images, all tops first: `flip` puts x first, and
    # an edge further to the right shifts the image to the left. Another order would change every training.
    return padding - torch.randint(0, 2 * padding + 1, (2, n_samples), generator=generator).flip(0).T


def shift_images(images: Tensor, shifts: Tensor, padding: int) -> Tensor:
    """Shifts images (batch, ..., H, W) by shifts (batch, 2) of up to `padding` pixels; see `random_crop`."""
    batch_size, (height, width) = len(images), images.shape[-2:]
    left, top = (padding - shifts).to(images.device).unbind(dim=1)
    padded = F.pad(images, [padding] * 4)
    rows = top[:, None] + torch.arange(height, device=images.device)  # (batch, H)
    columns = left[:, None] + torch.arange(width, device=images.device)  # (batch, W)
    sample = torch.arange(batch_size, device=images.device)
    flat = padded.flatten(1, -3) if padded.ndim > 4 else padded  # (batch, channels, H + 2p, W + 2p)
    # Advanced indices on both sides of a slice put the batch, rows and columns first.
    cropped = flat[sample[:, None, None], :, rows[:, :, None], columns[:, None, :]]  # (batch, H, W, channels)
    return rearrange(cropped, "b h w c -> b c h w").reshape(images.shape)
