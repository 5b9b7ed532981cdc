"""Splits what stands out from the background into objects.

A connected region is an object, or several that touch one another in the image. Where it has a neck, it is
split there. A single object may have a neck, too, such as a goblet; so the whole region is proposed as well.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
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


def segment(mask: Tensor, diameter: float, perspective: Tensor) -> Tensor:
    """Finds objects in a mask.

    Args:
        mask: How clearly each pixel stands out, (side, side) in 0..1, on the CPU.
        diameter: That of a typical object in the middle of the image, as a fraction of its side.
        perspective: How its log changes along x and y, (2,).

    Returns:
        Centers of mass of the regions, the most prominent first, (regions, 2) in -1..1.
    """
    weights, side = mask.numpy(), len(mask)
    stands_out = weights > _THRESHOLD
    stands_out = ndimage.binary_closing(np.pad(stands_out, _CLOSING), iterations=_CLOSING)[
        _CLOSING:-_CLOSING, _CLOSING:-_CLOSING
    ]
    labels, _ = ndimage.label(ndimage.binary_fill_holes(stands_out), structure=np.ones((3, 3)))
    found: list[tuple[float, float, float]] = []
    for label, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        region = labels[rows, columns] == label
        y, x = np.nonzero(region)
        middle = (np.array([x.mean() + columns.start, y.mean() + rows.start]) + 0.5) * 2 / side - 1
        typical = diameter * side * float(np.exp(middle @ perspective.numpy()))  # px
        area = np.pi / 4 * typical**2
        if len(x) < _MIN_AREA * area:
            continue
        part_of = _split(region, typical)[y, x]
        candidates = [part_of == part for part in range(part_of.max() + 1)]
        candidates = [part for part in candidates if part.sum() >= _MIN_AREA * area]
        if len(candidates) != 1:
            candidates.append(np.ones(len(x), dtype=bool))
        for part in candidates:
            px, py = x[part] + columns.start, y[part] + rows.start
            center = ((np.array([px.mean(), py.mean()]) + 0.5) * 2 / side - 1).tolist()
            found.append((float(weights[py, px].sum()), *center))
    found.sort(reverse=True)
    return torch.tensor(found, dtype=torch.float32).view(-1, 3)[:, 1:]


def _split(region: NDArray[np.bool_], typical: float) -> NDArray[np.int64]:
    """Splits a region at its necks.

    Args:
        region: (h, w).
        typical: Diameter of a typical object, px.

    Returns:
        The part that each pixel belongs to, (h, w).
    """
    half_width = ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    smooth = ndimage.gaussian_filter(half_width, _SMOOTHING) * region
    y, x = np.mgrid[: region.shape[0], : region.shape[1]]
    left = smooth.copy()
    middles: list[tuple[np.intp, ...]] = []
    while len(middles) < _MAX_PARTS:
        at = np.unravel_index(left.argmax(), left.shape)
        if left[at] < _MIN_HALF_WIDTH * typical:
            break
        if all(_is_neck_between(smooth, at, other) for other in middles):
            middles.append(at)
        left[np.hypot(y - at[0], x - at[1]) < _MIN_DISTANCE * max(smooth[at], 2.0)] = 0
    if not middles:
        return np.zeros(region.shape, dtype=np.int64)
    distances = [np.hypot(y - at[0], x - at[1]) - half_width[at] for at in middles]
    return np.argmin(distances, axis=0)


def _is_neck_between(half_width: NDArray[np.float64], a: tuple[np.intp, ...], b: tuple[np.intp, ...]) -> bool:
    """Returns whether a region is narrow somewhere between two of its pixels."""
    n_samples = _SAMPLES_PER_PIXEL * (int(np.hypot(*np.subtract(a, b))) + 1)
    y, x = (np.linspace(a[n], b[n], n_samples).round().astype(int) for n in range(2))
    return bool(half_width[y, x].min() <= _NECK * min(half_width[a], half_width[b]))
