r"""Tells from a picture whether the camera has moved since the training, by how much, and moves it back.

The static parts of the training's first images are registered to the current image: first by trying shifts
and rotations at a low resolution, then by Gauss-Newton steps on larger images, and at last by a homography.
Objects and the arm stand anywhere, so large differences count no more than moderate ones. The camera has
moved if the motion is more than noise, and explains the picture better than none.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeGuard

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
_USUAL = 0.95  # of the training's pictures, which differ less from what is static than one that is searched
_STIFFNESS = 1e-3  # of homographies, relative to what pictures tell
_MIN_STRUCTURE = 0.01  # mean detail of what is static, below which nothing tells


class CameraMotion(NamedTuple):
    """How far the static parts of a picture are from where they were in the training.

    Attributes:
        homography: Maps points of the training's pictures to points of the moved camera's, homogeneous
            coordinates, (3, 3), where the image's height is 2 and its middle 0. It is exact for a camera that
            rotated about its own center and, in the plane of the table, for any motion.
        aspect: Width of a picture divided by its height.
        gain: Mean difference after registration, as a fraction of that before.
        is_significant: Whether the camera has moved.
    """

    homography: Tensor
    aspect: float
    gain: float
    is_significant: bool

    @property
    def shift(self) -> tuple[float, float]:
        """How far the middle moved to the right and downwards, in widths and heights of the image."""
        right, down = (self.homography[:2, 2] / self.homography[2, 2]).tolist()
        return right / (2 * self.aspect), down / 2

    @property
    def turn(self) -> float:
        """How far the picture turned about its middle, clockwise, degrees."""
        (xx, xy, x), (yx, yy, y), (wx, wy, w) = self.homography.tolist()
        return math.degrees(math.atan2(yx - wx * y / w - xy + wy * x / w, xx - wx * x / w + yy - wy * y / w))

    @property
    def distance(self) -> float:
        """Mean distance by which pixels moved, as a fraction of the image's width."""
        grid = _grid(_SMALL, self.aspect, self.homography.device)
        return float((_mapped(self.homography, grid) - grid).norm(dim=-1).mean()) / (2 * self.aspect)

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

    def to_picture(self, locations: Tensor) -> Tensor:
        """Returns where the moved camera sees what the training's camera saw at locations.

        Args:
            locations: (..., 2) in -1..1.
        """
        sides = locations.new_tensor([self.aspect, 1.0])
        return _mapped(self.homography.to(locations), locations * sides) / sides

    def from_picture(self, locations: Tensor) -> Tensor:
        """Returns where the training's camera saw what the moved camera sees at locations.

        Args:
            locations: (..., 2) in -1..1.
        """
        sides = locations.new_tensor([self.aspect, 1.0])
        return _mapped(torch.linalg.inv(self.homography).to(locations), locations * sides) / sides


def is_moved(motion: CameraMotion | None) -> TypeGuard[CameraMotion]:
    """Returns whether a camera is known to have moved."""
    return motion is not None and motion.is_significant


class StaticReference(NamedTuple):
    """What never moves in the first images of the training episodes.

    Attributes:
        median: Median image, (3, H, W) in 0..1.
        levels: Its details, and how static each pixel is in 0..1, (1, size, size) and (size, size), for each
            size at which pictures are registered.
        structure: Where static details are, (size, size) in 0..1, at the largest of these sizes.
        usual: Difference from the details up to which pictures are not searched for a motion.
    """

    median: Tensor
    levels: dict[int, tuple[Tensor, Tensor]]
    structure: Tensor
    usual: float


def static_reference(images: Tensor) -> StaticReference:
    """Returns what stays in the first images of episodes.

    Args:
        images: (episodes, 3, H, W), uint8 or in 0..1.
    """
    images = images.float() / 255 if images.dtype == torch.uint8 else images
    median = images.median(dim=0).values
    spread = (images - median).abs().amax(dim=1).median(dim=0).values
    reference = weighted_reference(median, 1 / (1 + (spread / _STATIC) ** 2))
    grays = images.mean(dim=1, keepdim=True)
    usual = [_difference(reference, _details(_resized(gray, _LARGE))) for gray in grays]
    return reference._replace(usual=float(torch.tensor(usual).quantile(_USUAL)))


def weighted_reference(median: Tensor, weight: Tensor) -> StaticReference:
    """Returns a reference.

    Args:
        median: Image, (3, H, W) in 0..1.
        weight: How static each of its pixels is, (H, W) in 0..1.
    """
    gray = median.mean(dim=0, keepdim=True)
    sizes = (_SMALL, _MEDIUM, _LARGE)
    levels = {size: (_details(_resized(gray, size)), _resized(weight[None], size)[0]) for size in sizes}
    details, static = levels[_LARGE]
    structure = static * (details[0].abs() / _TOLERATED).clamp_max(1)
    return StaticReference(median, levels, structure, usual=0.0)


def _difference(reference: StaticReference, details: Tensor) -> float:
    """Returns how much the details of a picture, (1, size, size), differ where static ones are."""
    static, _ = reference.levels[_LARGE]
    differences = (details - static)[0].abs().clamp_max(_TOLERATED)
    return float((differences * reference.structure).sum() / reference.structure.sum().clamp_min(1e-6))


def estimate_motion(reference: StaticReference, image: Tensor, aspect: float = 1.0) -> CameraMotion | None:
    """Registers a picture to what was static in the training.

    Args:
        reference: What was static.
        image: The picture, (3, H, W) in 0..1.
        aspect: Width of a picture divided by its height, if it was scaled to another shape.

    Returns:
        The motion; None if too little is static, as on a plain table, to tell.
    """
    gray = image.mean(dim=0, keepdim=True)
    details = {_LARGE: _details(_resized(gray, _LARGE))}
    unmoved = torch.eye(3, device=image.device)
    if float(reference.structure.mean()) < _MIN_STRUCTURE:
        return None
    if _difference(reference, details[_LARGE]) <= reference.usual:
        return CameraMotion(unmoved, aspect, 1.0, is_significant=False)
    details |= {size: _details(_resized(gray, size)) for size in (_SMALL, _MEDIUM)}
    levels = {
        size: (static, details[size], weight, aspect) for size, (static, weight) in reference.levels.items()
    }
    none = torch.zeros(1, 3, device=image.device)
    motions = torch.cat([_best_starts(*levels[_SMALL]), none])
    for _ in range(_STEPS):
        motions = _gauss_newton_step(motions, *levels[_MEDIUM])
    best = _homographies(motions[_cost(_homographies(motions), *levels[_MEDIUM]).argmin()][None])[0]
    for size in (_MEDIUM, _LARGE):
        best = _refine_homography(best, *levels[size])
    # Only static details tell: objects that leave the picture would make any motion better.
    static, seen, _, _ = levels[_LARGE]
    both = torch.stack([best, unmoved])
    after, before = _cost(both, static, seen, reference.structure, aspect).tolist()
    motion = CameraMotion(best, aspect, after / max(before, 1e-9), is_significant=False)
    return motion._replace(is_significant=motion.gain < _MIN_GAIN and motion.distance > _MIN_MOTION)


def undo_motion(images: Tensor, motion: CameraMotion, reference: StaticReference) -> Tensor:
    """Returns pictures of a moved camera as the training's camera would show them.

    That is exact for a camera that was turned on the spot. If it was displaced, it is exact for the table
    alone: what stands high is off.

    Args:
        images: (batch, 3, H, W) in 0..1.
        motion: The camera's motion.
        reference: What was static in the training. It fills what the moved camera does not see.
    """
    height, width = images.shape[-2:]
    y, x = torch.meshgrid(
        *((torch.arange(side, device=images.device) + 0.5) / side * 2 - 1 for side in (height, width)),
        indexing="ij",
    )
    at = motion.to_picture(torch.stack([x, y], dim=-1)).expand(len(images), -1, -1, -1)
    moved = F.grid_sample(
        images.float(), at, mode="bicubic", padding_mode="border", align_corners=False
    ).clamp(0, 1)
    is_seen = (at[0].abs() <= 1).all(dim=-1)
    return torch.where(is_seen, moved, F.interpolate(reference.median[None].to(moved), (height, width)))


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


def _homographies(motions: Tensor) -> Tensor:
    """Returns motions (m, 3) as homographies, (m, 3, 3)."""
    turn, right, down = motions.unbind(dim=1)
    cos, sin, one, zero = turn.cos(), turn.sin(), torch.ones_like(turn), torch.zeros_like(turn)
    return torch.stack([cos, -sin, right, sin, cos, down, zero, zero, one], dim=1).view(-1, 3, 3)


def _mapped(homographies: Tensor, points: Tensor) -> Tensor:
    """Maps points (..., 2) by a homography (3, 3), or points (n, 2) by several (m, 3, 3), (m, n, 2)."""
    homogeneous = F.pad(points, (0, 1), value=1.0) @ homographies.mT
    return homogeneous[..., :2] / homogeneous[..., 2:]


def _cost(homographies: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float) -> Tensor:
    """Returns the mean difference after each motion, given as a homography (m, 3, 3), (m,)."""
    grid = _grid(image.shape[-1], aspect, image.device)
    colors, inside = _sampled(image, _mapped(homographies, grid), aspect)
    differences = (colors[:, 0] - reference.flatten()).abs().clamp_max(_TOLERATED)
    weights = weight.flatten() * inside
    return (differences * weights).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-6)


def _gauss_newton_step(
    motions: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float
) -> Tensor:
    """Improves motions, (m, 3)."""
    points = _moved(motions, _grid(image.shape[-1], aspect, image.device))  # (m, n, 2)
    slopes, residuals, weights = _linearize(points, reference, image, weight, aspect)
    x, y = (points - motions[:, None, 1:]).unbind(dim=-1)  # turned about the middle
    by_turn = slopes[..., 1] * x - slopes[..., 0] * y
    jacobian = torch.cat([by_turn[..., None], slopes], dim=-1)  # (m, n, 3)
    weighted = jacobian * weights[..., None]
    hessian = weighted.mT @ jacobian + 1e-6 * torch.eye(3, device=image.device)
    change = torch.linalg.solve(hessian, weighted.mT @ residuals[..., None])[..., 0]
    return motions + change.clamp(-0.1, 0.1)


def _refine_homography(
    start: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float
) -> Tensor:
    """Improves a homography (3, 3) by Gauss-Newton steps, or returns it unchanged if that does not help."""
    grid, found = _grid(image.shape[-1], aspect, image.device), start
    x, y = grid.unbind(dim=-1)
    ones = torch.ones_like(x)
    for _ in range(_STEPS):
        scale = grid @ found[2, :2] + found[2, 2]
        points = _mapped(found, grid)
        slopes, residuals, weights = _linearize(points[None], reference, image, weight, aspect)
        right, down = slopes[0].unbind(dim=-1)
        along = -(slopes[0] * points).sum(dim=-1)
        columns = [*(right * each for each in (x, y, ones)), *(down * each for each in (x, y, ones))]
        jacobian = torch.stack([*columns, along * x, along * y], dim=-1) / scale[:, None]  # (n, 8)
        weighted = jacobian * weights[0][:, None]
        hessian = weighted.mT @ jacobian
        # Where little detail tells, the motion stays what it was.
        prior = _STIFFNESS * hessian.trace() / 8 + 1e-9
        gradient = weighted.mT @ residuals[0] - prior * (found - start).flatten()[:8]
        change = torch.linalg.solve(hessian + prior * torch.eye(8, device=image.device), gradient)
        found = found + F.pad(change.clamp(-0.1, 0.1), (0, 1)).view(3, 3)
    after, before = _cost(torch.stack([found, start]), reference, image, weight, aspect).tolist()
    return found if after < before else start


def _linearize(
    points: Tensor, reference: Tensor, image: Tensor, weight: Tensor, aspect: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns slopes (m, n, 2) of an image at points (m, n, 2), and residuals and their weights, (m, n)."""
    size = image.shape[-1]
    along_x = F.pad((image[..., 2:] - image[..., :-2]) * size / 4 / aspect, (1, 1))
    along_y = F.pad((image[..., 2:, :] - image[..., :-2, :]) * size / 4, (0, 0, 1, 1))
    sampled, inside = _sampled(torch.cat([image, along_x, along_y]), points, aspect)
    residuals = reference.flatten() - sampled[:, 0]
    trust = 1 / (1 + (residuals / _TOLERATED) ** 2) ** 2
    return sampled[:, 1:].mT, residuals, trust * weight.flatten() * inside


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
