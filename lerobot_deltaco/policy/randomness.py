"""What training draws at random: shifts of pictures, and what PyTorch itself draws, as in dropout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.nn.functional as F  # noqa: N812
from einops import rearrange
from torch import Tensor


def random_crop(images: Tensor, padding: int, generator: torch.Generator | None = None) -> Tensor:
    """Shifts each picture at random by up to `padding` pixels; what comes in at the edges is black.

    Args:
        images: (batch, ..., H, W). All pictures of a sample are shifted alike.
        padding: px.
        generator: Source of the shifts, on the CPU.

    Returns:
        The same shape.
    """
    batch_size, (height, width) = len(images), images.shape[-2:]
    shifts = torch.randint(0, 2 * padding + 1, (2, batch_size), generator=generator).to(images.device)
    padded = F.pad(images, [padding] * 4)
    rows = shifts[0, :, None] + torch.arange(height, device=images.device)  # (batch, H)
    columns = shifts[1, :, None] + torch.arange(width, device=images.device)  # (batch, W)
    sample = torch.arange(batch_size, device=images.device)
    flat = padded.flatten(1, -3) if padded.ndim > 4 else padded  # (batch, channels, H + 2p, W + 2p)
    # Advanced indices on both sides of a slice put the batch, rows and columns first.
    cropped = flat[sample[:, None, None], :, rows[:, :, None], columns[:, None, :]]  # (batch, H, W, channels)
    return rearrange(cropped, "b h w c -> b c h w").reshape(images.shape)


@contextmanager
def seeded(generator: torch.Generator, device: torch.device) -> Iterator[None]:
    """What draws from PyTorch's own generators, as dropout does, is a function of this one meanwhile.

    Args:
        generator: On the CPU.
        device: Whose generator is drawn from, besides the CPU's.
    """
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
