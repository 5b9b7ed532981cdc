"""Splits what stands out from the background into objects.

A connected region is an object, or several that touch one another in the image or hide one another. Where it
has a neck, it is split there; where it is larger than an object, also by color. A single object may have a
neck, such as a goblet, or several colors; so the whole region is proposed as well.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from torch import Tensor

_THRESHOLD = 0.5  # from which a pixel of a mask counts
_CLOSING = 1  # px, of gaps within an object
_MIN_AREA = 0.06  # of a region, in areas of a typical object
_NECK = 0.8  # width of a neck, relative to the narrower of the two parts
_SMOOTHING = 0.7  # px, of the distances from a region's edge
_MIN_HALF_WIDTH = 0.18  # of a part, in diameters of a typical object
_MIN_DISTANCE = 0.8  # between two parts' middles, in half widths of the wider
_MAX_PARTS = 6
_SAMPLES_PER_PIXEL = 2  # along a line between two parts' middles
_LARGE_AREA = 1.3  # of a region that is split by color, in areas of a typical object
_MIN_COLOR_AREA = 0.12  # of a part of one color, in the same
_MAX_COLORS = 4
_COLOR_WEIGHT = 3.0  # diameters that a difference in color of 1 is worth
_CLUSTERING_STEPS = 10
_SAME_CENTER = 0.2  # distance between two centers that are one, in diameters

Region = tuple[NDArray[np.int64], NDArray[np.int64]]  # y and x of its pixels


def segment(mask: Tensor, image: Tensor, diameter: float, perspective: Tensor) -> Tensor:
    """Finds objects in a mask.

    Args:
        mask: How clearly each pixel stands out, (side, side) in 0..1, on the CPU.
        image: The scene, (3, side, side) in 0..1, on the CPU.
        diameter: That of a typical object in the middle of the image, as a fraction of its side.
        perspective: How its log changes along x and y, (2,).

    Returns:
        Centers of mass, (objects, 2) in -1..1: of regions and their parts beside necks, the most prominent
        first, and behind them of their parts by color.
    """
    weights, colors, side = mask.numpy(), image.permute(1, 2, 0).numpy(), len(mask)
    stands_out = weights > _THRESHOLD
    stands_out = ndimage.binary_closing(np.pad(stands_out, _CLOSING), iterations=_CLOSING)[
        _CLOSING:-_CLOSING, _CLOSING:-_CLOSING
    ]
    labels, n_regions = ndimage.label(ndimage.binary_fill_holes(stands_out), structure=np.ones((3, 3)))
    found: list[tuple[bool, float, float, float]] = []
    for label in range(1, n_regions + 1):
        y, x = np.nonzero(labels == label)
        middle = (np.array([x.mean(), y.mean()]) + 0.5) * 2 / side - 1
        typical = diameter * side * float(np.exp(middle @ perspective.numpy()))  # px
        area = np.pi / 4 * typical**2
        if len(x) < _MIN_AREA * area:
            continue
        beside_necks = [part for part in _split((y, x), typical) if len(part[0]) >= _MIN_AREA * area]
        if len(beside_necks) != 1:
            beside_necks.append((y, x))
        by_color = _split_by_color((y, x), colors[y, x], typical)
        by_color = [part for part in by_color if len(part[0]) >= _MIN_COLOR_AREA * area]
        centers: list[NDArray[np.float64]] = []
        for n, (py, px) in enumerate(beside_necks + by_color):
            center = np.array([px.mean(), py.mean()])
            if all(np.hypot(*(center - other)) >= _SAME_CENTER * typical for other in centers):
                centers.append(center)
                location = ((center + 0.5) * 2 / side - 1).tolist()
                found.append((n < len(beside_necks), float(weights[py, px].sum()), *location))
    found.sort(reverse=True)
    return torch.tensor(found, dtype=torch.float32).view(-1, 4)[:, 2:]


def _split(region: Region, typical: float) -> list[Region]:
    """Splits a region at its necks. A typical object has a diameter of `typical` px."""
    y, x = region
    first_y, first_x = y.min(), x.min()
    inside = np.zeros((int(np.ptp(y)) + 1, int(np.ptp(x)) + 1), dtype=bool)
    inside[y - first_y, x - first_x] = True
    half_width = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    smooth = ndimage.gaussian_filter(half_width, _SMOOTHING) * inside
    rows, columns = np.mgrid[: inside.shape[0], : inside.shape[1]]
    left = smooth.copy()
    middles: list[tuple[np.intp, ...]] = []
    while len(middles) < _MAX_PARTS:
        at = np.unravel_index(left.argmax(), left.shape)
        if left[at] < _MIN_HALF_WIDTH * typical:
            break
        if all(_is_neck_between(smooth, at, other) for other in middles):
            middles.append(at)
        left[np.hypot(rows - at[0], columns - at[1]) < _MIN_DISTANCE * max(smooth[at], 2.0)] = 0
    if len(middles) < 2:  # noqa: PLR2004
        return [region]
    distances = [np.hypot(rows - at[0], columns - at[1]) - half_width[at] for at in middles]
    part_of = np.argmin(distances, axis=0)[y - first_y, x - first_x]
    return [(y[part_of == part], x[part_of == part]) for part in range(len(middles))]


def _is_neck_between(half_width: NDArray[np.float64], a: tuple[np.intp, ...], b: tuple[np.intp, ...]) -> bool:
    """Returns whether a region is narrow somewhere between two of its pixels."""
    n_samples = _SAMPLES_PER_PIXEL * (int(np.hypot(*np.subtract(a, b))) + 1)
    y, x = (np.linspace(a[n], b[n], n_samples).round().astype(int) for n in range(2))
    return bool(half_width[y, x].min() <= _NECK * min(half_width[a], half_width[b]))


def _split_by_color(region: Region, colors: NDArray[np.float32], typical: float) -> list[Region]:
    """Splits a region that is larger than an object into parts of similar colors, in two parts and in more.

    Args:
        region: The region.
        colors: Colors of its pixels, (pixels, 3) in 0..1.
        typical: Diameter of a typical object, px.
    """
    y, x = region
    points = np.concatenate([_COLOR_WEIGHT * colors, np.stack([x, y], axis=1) / typical], axis=1)
    n_objects = math.ceil(len(x) / (_LARGE_AREA * np.pi / 4 * typical**2))
    parts: list[Region] = []
    for n_parts in range(2, min(n_objects, _MAX_COLORS) + 1):
        # Each begins at the point that is farthest from the others.
        seeds = [points[np.square(points - points.mean(axis=0)).sum(axis=1).argmax()]]
        while len(seeds) < n_parts:
            away = np.min([np.square(points - seed).sum(axis=1) for seed in seeds], axis=0)
            seeds.append(points[away.argmax()])
        _, part_of = kmeans2(points, np.array(seeds), minit="matrix", iter=_CLUSTERING_STEPS)
        for part in range(n_parts):
            shape = np.zeros((int(y.max()) + 1, int(x.max()) + 1), dtype=bool)
            shape[y[part_of == part], x[part_of == part]] = True
            connected, n_connected = ndimage.label(shape, structure=np.ones((3, 3)))
            for label in range(1, n_connected + 1):
                own = np.nonzero(connected == label)
                parts.append((own[0], own[1]))
    return parts
