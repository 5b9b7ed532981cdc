"""Random changes of training images: shifts, and color jitter, which turns known objects into new ones."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor

SATURATION = (0.5, 1.5)
GAIN = (0.7, 1.3)


def random_shift(images: Tensor, padding: int, generator: torch.Generator | None = None) -> Tensor:
    """Shifts each image at random by up to `padding` pixels; the uncovered edges are black.

    Args:
        images: Images, (batch, ..., H, W). All images of a sample are shifted alike.
        padding: Largest shift in x and in y, px.
        generator: Source of the shifts, on the CPU.

    Returns:
        Shifted images, of the same shape.
    """
    return shift_images(images, random_shifts(len(images), padding, generator), padding)


def random_shifts(n_samples: int, padding: int, generator: torch.Generator | None = None) -> Tensor:
    """Draws shifts to the right and down, -padding..padding px, (n_samples, 2), on the CPU."""
    # The draws are the top and left edges of crops of padded images, all tops first: `flip` puts x first, and
    # an edge further to the right shifts the image to the left. Another order would change every training.
    return padding - torch.randint(0, 2 * padding + 1, (2, n_samples), generator=generator).flip(0).T


def shift_images(images: Tensor, shifts: Tensor, padding: int) -> Tensor:
    """Shifts images (batch, ..., H, W) by shifts (batch, 2) of up to `padding` pixels."""
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


def random_color_changes(n_samples: int, probability: float, generator: torch.Generator) -> Tensor:
    """Draws a change of colors for each sample: a rotation of the hue, a saturation and a gain.

    Args:
        n_samples: Number of samples.
        probability: Probability that the colors of a sample change; the others get the identity.
        generator: Source of the draws, on the CPU.

    Returns:
        Matrices that map RGB to RGB, (n_samples, 3, 3), on the CPU.
    """
    draws = torch.rand(4, n_samples, generator=generator)
    angle = (2 * draws[0] - 1) * math.pi
    cosine, sine = angle.cos()[:, None, None], angle.sin()[:, None, None]
    gray = torch.full((3, 3), 1 / 3)  # projects onto the gray axis, around which the hue turns
    across = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3)
    rotation = gray + cosine * (torch.eye(3) - gray) + sine * across
    saturation = _between(SATURATION, draws[1])
    changed = _between(GAIN, draws[2]) * ((saturation * torch.eye(3) + (1 - saturation) * gray) @ rotation)
    return torch.where(draws[3, :, None, None] < probability, changed, torch.eye(3))


def change_colors(images: Tensor, changes: Tensor) -> Tensor:
    """Applies changes of color to images (n_samples, ..., 3, H, W) in 0..1; values beyond are clipped."""
    flat = images.flatten(0, -4) if images.ndim > 4 else images
    matrices = changes.to(flat).repeat_interleave(len(flat) // len(changes), dim=0)
    changed = torch.baddbmm(flat.new_zeros(()), matrices, flat.flatten(2)).clamp(0, 1)
    return changed.view(images.shape)


def _between(limits: tuple[float, float], draws: Tensor) -> Tensor:
    low, high = limits
    return (low + (high - low) * draws)[:, None, None]
