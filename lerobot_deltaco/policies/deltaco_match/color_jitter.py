"""Hue augmentation: turns known objects into new ones by one random color change per sample."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SATURATION = (0.5, 1.5)
GAIN = (0.7, 1.3)


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
