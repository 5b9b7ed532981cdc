r"""Tells from a picture whether the camera has moved since the training, and by how much.

What never moves in the first images of the training episodes is registered to the picture: first by trying
shifts and turns on small images, then by Gauss-Newton steps on larger ones. Objects and the arm stand
anywhere, so large differences count no more than moderate ones. The camera has moved if the motion is more
than noise, and explains the picture better than none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

_SMALL = 32  # px, of the images on which shifts and turns are tried
_MAX_SHIFT = 8  # px, there
_MAX_TURN, _TURN_STEP = 12, 3  # degrees
_N_REFINED = 3  # of the best shifts and turns
_MEDIUM, _LARGE, _STEPS = 64, 128, 6  # px; Gauss-Newton steps at each
_DETAIL = 1 / 16  # of the image's side: what is smoother counts as lighting
_TOLERATED = 0.06  # difference of colors in 0..1, beyond which a pixel counts as an object's
_STATIC = 0.03  # spread of a pixel's color over episodes, at which it counts half
# The camera has moved if it did by this fraction of the image's width, on average over the picture, and the
# differences become smaller by this factor.
_MIN_MOTION, _MIN_GAIN = 0.009, 0.93


class CameraMotion(NamedTuple):
    """How far the static parts of a picture are from where they were in the training.

    Attributes:
        shift: To the right and downwards, as fractions of the image's width and height.
        turn: Clockwise in the image, degrees.
        motion: Mean distance by which pixels moved, as a fraction of the image's width.
        gain: Mean difference after registration, as a fraction of that before.
        is_significant: Whether the camera has moved.
    """

    shift: tuple[float, float]
    turn: float
    motion: float
    gain: float
    is_significant: bool

    def describe(self, width: int, height: int) -> str:
        """Returns what a person reads, for images of a size in px."""
        parts = []
        for fraction, size, directions in zip(
            self.shift, (width, height), (("left", "right"), ("up", "down")), strict=True
        ):
            pixels = round(abs(fraction) * size)
            if pixels:
                parts.append(f"{pixels} px {directions[fraction > 0]}")
        if abs(self.turn) >= 0.5:
            parts.append(
                f"{abs(self.turn):.0f} degrees {'clockwise' if self.turn > 0 else 'counterclockwise'}"
            )
        return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]])) or "less than a pixel"


def static_reference(images: Tensor) -> tuple[Tensor, Tensor]:
    """Returns what stays in the first images of episodes.

    Args:
        images: (episodes, 3, H, W), uint8 or in 0..1.

    Returns:
        The median image, (3, H, W) in 0..1, and how static each of its pixels is, (H, W) in 0..1.
    """
    images = images.float() / 255 if images.dtype == torch.uint8 else images
    median = images.median(dim=0).values
    spread = (images - median).abs().amax(dim=1).median(dim=0).values
    return median, 1 / (1 + (spread / _STATIC) ** 2)


def estimate_motion(reference: Tensor, weight: Tensor, image: Tensor, aspect: float = 1.0) -> CameraMotion:
    """Registers a picture to what was static in the training.

    Args:
        reference: What was static, (3, H, W) in 0..1.
        weight: How static each pixel was, (H, W) in 0..1.
        image: The picture, (3, H', W') in 0..1.
        aspect: Width of a picture divided by its height, if it was scaled to another shape.
    """
    grays = [each.mean(dim=0, keepdim=True) for each in (reference, image)]
    levels = {}
    for size in (_SMALL, _MEDIUM, _LARGE):
        details = [_details(_resized(each, size)) for each in grays]
        levels[size] = (details[0], details[1], _resized(weight[None], size)[0], aspect)
    none = torch.zeros(1, 3, device=image.device)
    motions = torch.cat([_best_starts(*levels[_SMALL]), none])
    for _ in range(_STEPS):
        motions = _gauss_newton_step(motions, *levels[_MEDIUM])
    best = motions[_cost(motions, *levels[_MEDIUM]).argmin()][None]
    for _ in range(_STEPS):
        best = _gauss_newton_step(best, *levels[_LARGE])
    after, before = _cost(torch.cat([best, none]), *levels[_LARGE]).tolist()
    gain = after / max(before, 1e-9)
    grid = _grid(_SMALL, aspect, image.device)
    moved = (_moved(best, grid)[0] - grid) / (2 * aspect)
    motion = float(moved.norm(dim=1).mean())
    turn, right, down = best[0].tolist()
    return CameraMotion(
        (right / (2 * aspect), down / 2),
        math.degrees(turn),
        motion,
        gain,
        motion > _MIN_MOTION and gain < _MIN_GAIN,
    )


# A motion is (turn in radians, shift to the right, shift downwards), where the image's height is 2.


def _grid(size: int, aspect: float, device: torch.device) -> Tensor:
    """Returns the middles of pixels, (size * size, 2), where the image's height is 2."""
    middles = (torch.arange(size, device=device) + 0.5) / size * 2 - 1
    y, x = torch.meshgrid(middles, middles, indexing="ij")
    return torch.stack([x * aspect, y], dim=-1).view(-1, 2)


def _moved(motions: Tensor, grid: Tensor) -> Tensor:
    """Moves points (n, 2) by motions (m, 3), (m, n, 2)."""
    cos, sin = motions[:, :1].cos(), motions[:, :1].sin()
    x, y = grid[:, 0], grid[:, 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1) + motions[:, None, 1:]


def _sampled(image: Tensor, points: Tensor, aspect: float) -> tuple[Tensor, Tensor]:
    """Returns values (m, c, n) of an image (c, H, W) at points (m, n, 2), and which are inside, (m, n)."""
    at = points / points.new_tensor([aspect, 1.0])
    colors = F.grid_sample(
        image.expand(len(at), *image.shape), at[:, :, None], mode="bilinear", align_corners=False
    )
    return colors[..., 0], (at.abs() < 1 - 1 / image.shape[-1]).all(dim=2)


def _best_starts(reference: Tensor, image: Tensor, weight: Tensor, aspect: float) -> Tensor:
    """Tries shifts by whole pixels, and turns. Returns the best motions, (m, 3)."""
    size, margin = _SMALL, _MAX_SHIFT
    turns = torch.arange(-_MAX_TURN, _MAX_TURN + 1, _TURN_STEP, device=image.device).deg2rad()
    motions = F.pad(turns[:, None], (0, 2))
    colors, inside = _sampled(image, _moved(motions, _grid(size, aspect, image.device)), aspect)
    known = torch.cat([colors, inside[:, None].float()], dim=1).view(-1, 2, size, size)
    known = F.pad(known, (margin,) * 4)
    n_shifts = 2 * margin + 1
    windows = known.unfold(2, size, 1).unfold(3, size, 1)  # (turns, 2, shifts, shifts, size, size)
    costs = []
    for down in range(n_shifts):
        some = windows[:, :, down]
        differences = (some[:, 0] - reference).abs().clamp_max(_TOLERATED)
        weights = weight * some[:, 1]
        overlap = weights.sum(dim=(2, 3))
        cost = (differences * weights).sum(dim=(2, 3)) / overlap.clamp_min(1e-6)
        costs.append(torch.where(overlap > 0.4 * weight.sum(), cost, torch.inf))
    table = torch.stack(costs, dim=1)  # (turns, rows, columns)
    best = table.flatten().topk(_N_REFINED, largest=False).indices
    turn, row, column = torch.unravel_index(best, table.shape)
    shifts = torch.stack([(column - margin) * aspect, row - margin], dim=1) * 2 / size  # of the turned image
    found = []
    for angle, shift in zip(turns[turn].unbind(), shifts.unbind(), strict=True):
        rotation = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
        found.append(torch.cat([angle[None], rotation @ shift]))
    return torch.stack(found)


def _cost(motions: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float) -> Tensor:
    """Returns the mean difference after each motion (m, 3), (m,)."""
    grid = _grid(image.shape[-1], aspect, image.device)
    colors, inside = _sampled(image, _moved(motions, grid), aspect)
    differences = (colors[:, 0] - reference.flatten()).abs().clamp_max(_TOLERATED)
    weights = weight.flatten() * inside
    return (differences * weights).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-6)


def _gauss_newton_step(
    motions: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float
) -> Tensor:
    """Improves motions, (m, 3)."""
    size = image.shape[-1]
    points = _moved(motions, _grid(size, aspect, image.device))  # (m, n, 2)
    slopes = torch.stack(
        [
            F.pad((image[..., 2:] - image[..., :-2]) * size / 4 / aspect, (1, 1)),
            F.pad((image[..., 2:, :] - image[..., :-2, :]) * size / 4, (0, 0, 1, 1)),
        ]
    )
    sampled, inside = _sampled(torch.cat([image, *slopes]), points, aspect)
    colors, along_x, along_y = sampled.unbind(dim=1)  # (m, n)
    offsets = points - motions[:, None, 1:]  # turned about the middle
    by_turn = along_y * offsets[..., 0] - along_x * offsets[..., 1]
    jacobian = torch.stack([by_turn, along_x, along_y], dim=-1)  # (m, n, 3)
    residuals = reference.flatten() - colors
    trust = 1 / (1 + (residuals / _TOLERATED) ** 2) ** 2
    weighted = jacobian * (trust * weight.flatten() * inside)[..., None]
    hessian = weighted.mT @ jacobian + 1e-6 * torch.eye(3, device=image.device)
    gradient = weighted.mT @ residuals[..., None]
    change = torch.linalg.solve(hessian, gradient)[..., 0]
    return motions + change.clamp(-0.1, 0.1)


def _resized(image: Tensor, size: int) -> Tensor:
    """Scales an image (c, H, W) to (c, size, size)."""
    if image.shape[-2:] == (size, size):
        return image
    is_larger = min(image.shape[-2:]) >= size
    mode = {"mode": "area"} if is_larger else {"mode": "bilinear", "align_corners": False}
    return F.interpolate(image[None], (size, size), **mode)[0]


def _details(image: Tensor) -> Tensor:
    """Returns an image (1, H, W) without what is smooth, as lighting is."""
    half = max(1, round(image.shape[-1] * _DETAIL))
    return image - F.avg_pool2d(image[None], 2 * half + 1, 1, half, count_include_pad=False)[0]
