"""Proposals: where in a scene something stands that could be grasped, whatever the task."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.base.image_coordinates import grid_of_centers
from lerobot_deltaco.policies.geometry.regression import robust_regression
from lerobot_deltaco.policies.scene.camera_motion import (
    CameraMotion,
    StaticReference,
    estimate_motion,
    static_reference,
    undo_motion,
)
from lerobot_deltaco.policies.scene.segmentation import segment

N_OBJECTS = 14  # proposed in a scene by `Background`, at most
_SIDE = 128  # px, of the images as they are compared
MAX_REMEMBERED, MAX_MEASURED = 48, 400  # images
_MIN_IMAGES = 8
# A pixel stands out if at most this fraction of the images has its color. Objects cover a pixel in fewer, a
# container with four possible places in more (25 %).
_COMMON = 0.17
_MIN_CONTRAST = 0.03  # of colors in 0..1
_NOISE_FACTOR = 4.0  # by which a contrast exceeds the median of a scene
_SEED_RADIUS, _GROWING_STEPS = 0.12, 40  # around a grasp, in -1..1; px by which an object's region grows
_EDGE = 1.0  # px, by which images blur an object
_SIZE_LIMITS = (0.02, 0.4)  # of an object's diameter, as a fraction of the image's side
_MAX_SLOPE = 1.5  # of the log of a size along an image's half
_LEAST_ERROR = 0.02  # of the log of a size, below which errors are all alike
_DEFAULT_SIZE = 0.12
_AT_A_TIME = 16
_UNUSUAL = 2.0  # median distances of proposals from grasps, from which on a distance is unusual
_CHANGE = 0.1  # of a pixel (in 0..1) between the first and the last image that counts


class Background(nn.Module):
    """Proposes what differs from the first images of other episodes.

    The camera is fixed, so a pixel shows the same surface in most scenes, and now and then an object. A pixel
    stands out if few of the remembered images have its color there. That needs no training, and holds for
    objects that were never grasped.

    Attributes:
        images: First images of training episodes, (48, 3, 128, 128) uint8.
        n_images: Number of them, ().
        contrast: Difference from which a pixel counts as an object's, ().
        object_size: Diameter of a typical object in the middle of the image, as a fraction of its side, ().
        perspective: How the log of the apparent size of objects changes along x and y in the image, (2,).
    """

    images: Tensor
    n_images: Tensor
    contrast: Tensor
    object_size: Tensor
    perspective: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("images", torch.zeros(MAX_REMEMBERED, 3, _SIDE, _SIDE, dtype=torch.uint8))
        self.register_buffer("n_images", torch.zeros((), dtype=torch.int64))
        self.register_buffer("contrast", torch.tensor(_MIN_CONTRAST))
        self.register_buffer("object_size", torch.tensor(_DEFAULT_SIZE))
        self.register_buffer("perspective", torch.zeros(2))
        self._bounds: tuple[Tensor, Tensor] | None = None  # of the remembered colors around each pixel
        self._static: StaticReference | None = None
        self.register_load_state_dict_post_hook(self._forget_bounds)

    @staticmethod
    def _forget_bounds(module: Background, _: object) -> None:
        module._bounds = module._static = None

    def forward(self, scenes: Tensor) -> Tensor:
        """Proposes objects. See `objects`."""
        return self.objects(self.masks(scenes), scenes)

    def objects(self, masks: Tensor, scenes: Tensor) -> Tensor:
        """Proposes what masks show.

        Args:
            masks: How clearly each pixel stands out, (batch, 128, 128) in 0..1.
            scenes: The scenes, (batch, 3, H, W), uint8 or in 0..1.

        Returns:
            Locations in -1..1, the most prominent first, (batch, N_OBJECTS, 2); NaN behind the last object.
            Without any, that of the clearest pixel.
        """
        diameter, perspective = float(self.object_size), self.perspective.cpu()
        centers = grid_of_centers(_SIDE, _SIDE, masks.device)
        locations = masks.new_full((len(masks), N_OBJECTS, 2), torch.nan)
        for row, mask, scene in zip(locations, masks, _scaled(scenes), strict=True):
            found = segment(mask.cpu(), scene.cpu(), diameter, perspective)[:N_OBJECTS]
            row[: len(found)] = found.to(row)
            if not len(found):
                row[0] = centers[mask.argmax()]
        return locations

    def masks(self, scenes: Tensor, remembered: Tensor | None = None) -> Tensor:
        """Returns how clearly each pixel stands out, (batch, 128, 128) in 0..1.

        Args:
            scenes: First images, (batch, 3, H, W), uint8 or in 0..1, at full resolution.
            remembered: Row of each scene among the remembered images, which is left out, (batch,); -1 for a
                scene that is not among them.
        """
        parts = []
        for first in range(0, len(scenes), _AT_A_TIME):
            some = slice(first, first + _AT_A_TIME)
            differences = self._differences(scenes[some], None if remembered is None else remembered[some])
            parts.append(((differences - self.contrast) / self.contrast).clamp(0, 1))
        return torch.cat(parts)

    def camera_motion(self, scene: Tensor) -> CameraMotion | None:
        """Compares a scene with what never moved; None if that is not known, or too little of it to tell.

        Args:
            scene: First image, (3, H, W), uint8 or in 0..1, at full resolution.
        """
        if self.n_images < _MIN_IMAGES:
            return None
        height, width = scene.shape[-2:]
        scaled = _scaled(scene[None].to(self.images.device))[0]
        return estimate_motion(self._static_reference(), scaled, width / height)

    def undo_motion(self, images: Tensor, motion: CameraMotion) -> Tensor:
        """Returns pictures of a moved camera as the training's camera would show them. See `undo_motion`."""
        return undo_motion(images, motion, self._static_reference())

    def _static_reference(self) -> StaticReference:
        if self._static is None or self._static.median.device != self.images.device:
            self._static = static_reference(self.images[: int(self.n_images)])
        return self._static

    def fit(self, images: Tensor, locations: Tensor) -> None:
        """Remembers images, and measures objects in all of them.

        Args:
            images: First images of episodes, (episodes, 3, H, W) uint8, at full resolution; the first 48 are
                remembered.
            locations: Locations of their grasps, (episodes, 2) in -1..1.
        """
        remembered = torch.arange(len(images))
        remembered[MAX_REMEMBERED:] = -1
        self.images.zero_()
        some = _scaled(images[:MAX_REMEMBERED])
        self.images[: len(some)] = some.mul(255).round().to(self.images)
        self.n_images.fill_(len(some))
        self._bounds = self._static = None
        differences = self._differences(images, remembered)
        noise = _NOISE_FACTOR * differences.flatten(1).median(dim=1).values.median()
        self.contrast.copy_(noise.clamp_min(_MIN_CONTRAST))
        self._measure(differences > 1.5 * self.contrast, locations.to(self.images.device))

    def _measure(self, stands_out: Tensor, locations: Tensor) -> None:
        """Measures the regions around grasps."""
        centers = grid_of_centers(_SIDE, _SIDE, locations.device)  # (cells, 2)
        near = (centers - locations[:, None]).norm(dim=2).view(-1, _SIDE, _SIDE) < _SEED_RADIUS
        allowed = stands_out.float()[:, None]
        region = near.float()[:, None] * allowed
        for _ in range(_GROWING_STEPS):
            smaller, region = region, F.max_pool2d(region, 3, 1, 1) * allowed
            if torch.equal(region, smaller):
                break
        diameter = ((region.sum(dim=(1, 2, 3)) * 4 / torch.pi).sqrt() - _EDGE) / _SIDE
        low, high = _SIZE_LIMITS
        seen = (diameter > low) & (diameter < high)
        self.perspective.zero_()
        self.object_size.fill_(_DEFAULT_SIZE)
        if int(seen.sum()) >= _MIN_IMAGES:
            self.object_size.copy_(diameter[seen].median())
            if int(seen.sum()) >= 3 * _MIN_IMAGES:
                size, slopes = _perspective(diameter[seen], locations[seen])
                self.perspective.copy_(slopes)
                self.object_size.copy_(size.clamp(*_SIZE_LIMITS))

    def _differences(self, scenes: Tensor, remembered: Tensor | None) -> Tensor:
        """Returns the difference of each pixel from the colors that are common there, (batch, 128, 128)."""
        if not int(self.n_images):  # before the fit, everything stands out
            return torch.ones(len(scenes), _SIDE, _SIDE, device=self.images.device)
        if self._bounds is None or self._bounds[0].device != self.images.device:
            images = self.images[: int(self.n_images)]
            # Colors between a pixel's and its neighbors' are common, too, as far as neighbors differ in the
            # median image: an object that stood there once must not widen the range.
            least, most = (_over_neighbors(images, extreme) for extreme in (torch.minimum, torch.maximum))
            usual = (most.short() - least).median(dim=0).values  # (3, 128, 128)
            bounds = (
                torch.maximum(least.short(), images.short() - usual).float() / 255,
                torch.minimum(most.short(), images.short() + usual).float() / 255,
            )
            self._bounds = bounds[0].transpose(0, 1).contiguous(), bounds[1].transpose(0, 1).contiguous()
        low, high = self._bounds  # (3, images, 128, 128)
        n_images = low.shape[1]
        n_common = min(max(2, round(_COMMON * n_images)), n_images)
        results = []
        for n, scene in enumerate(_scaled(scenes).to(low.device)):
            away = _distance(low, high, scene)
            if remembered is not None and remembered[n] >= 0:
                away[remembered[n]] = 2.0
            results.append(_kth_smallest(away, n_common))
        return torch.stack(results).clamp_min(0)


def _distance(low: Tensor, high: Tensor, scene: Tensor) -> Tensor:
    """Returns how far a scene (3, h, w) is outside ranges of colors (3, n, h, w) each, (n, h, w)."""
    away, other = torch.empty_like(low[0]), torch.empty_like(low[0])  # few passes over memory
    for channel, (least, most, color) in enumerate(zip(low, high, scene, strict=True)):
        if channel == 0:
            torch.sub(least, color, out=away)
        else:
            torch.maximum(away, torch.sub(least, color, out=other), out=away)
        torch.maximum(away, torch.sub(color, most, out=other), out=away)
    return away


def changed_areas(ends: Tensor) -> Tensor:
    """Returns where the first and the last images of episodes differ, (batch, 128, 128) bool.

    Args:
        ends: First and last images, (batch, 2, 3, H, W) in 0..1.
    """
    change = (ends[:, 1] - ends[:, 0]).abs().amax(dim=1, keepdim=True)
    return F.interpolate(change, (_SIDE, _SIDE), mode="bilinear", align_corners=False)[:, 0] > _CHANGE


def _over_neighbors(images: Tensor, extreme: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Returns the extreme value of 3 x 3 pixels of images (..., h, w)."""
    for dim in (-1, -2):
        size = images.shape[dim]
        first, last = images.narrow(dim, 0, size - 1), images.narrow(dim, 1, size - 1)
        pairs = extreme(first, last)
        ends = images.narrow(dim, 0, 1), images.narrow(dim, size - 1, 1)
        images = extreme(torch.cat([ends[0], pairs], dim=dim), torch.cat([pairs, ends[1]], dim=dim))
    return images


def _kth_smallest(maps: Tensor, k: int) -> Tensor:
    """Returns the k-th smallest value of each pixel of maps (n, h, w), (h, w); faster than `kthvalue`."""
    smallest = list(maps.new_full((k, *maps.shape[1:]), torch.inf))  # ascending
    spare = torch.empty_like(smallest[0]), torch.empty_like(smallest[0])
    for n, values in enumerate(maps):
        for rank in range(min(n + 1, k)):
            greater = spare[rank % 2]
            torch.maximum(smallest[rank], values, out=greater)
            torch.minimum(smallest[rank], values, out=smallest[rank])
            values = greater  # noqa: PLW2901
    return smallest[-1]


def _scaled(images: Tensor) -> Tensor:
    """Scales images to 128 x 128 px, in 0..1."""
    images = images.float() / 255 if images.dtype == torch.uint8 else images
    if images.shape[-2:] == (_SIDE, _SIDE):
        return images
    if min(images.shape[-2:]) >= _SIDE:
        return F.interpolate(images, (_SIDE, _SIDE), mode="area")
    return F.interpolate(images, (_SIDE, _SIDE), mode="bilinear", align_corners=False)


def _perspective(sizes: Tensor, locations: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the size of objects in the middle of the image, (), and the slopes of its log, (2,)."""
    features = torch.cat([torch.ones_like(locations[:, :1]), locations], dim=1)
    degrees = torch.tensor([0, 1, 1], device=features.device)
    fitted = robust_regression(features, sizes.log()[:, None], degrees, _LEAST_ERROR)[:, 0]
    return fitted[0].exp(), fitted[1:].clamp(-_MAX_SLOPE, _MAX_SLOPE)


def nearest_proposals(proposed: Tensor, locations: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Returns the nearest proposal to locations (batch, 2), and whether it is near, (batch,) each."""
    distance, nearest = (proposed - locations[:, None]).norm(dim=2).nan_to_num(nan=torch.inf).min(dim=1)
    return nearest, distance < radius


def demonstrated_centers(
    proposed: Tensor, changed: Tensor, grasps: Tensor, attended: Tensor, radius: float, usual_error: float
) -> tuple[Tensor, Tensor]:
    """Returns the centers of what was grasped, (batch, 2), and whether the grasp was there, (batch,) bool.

    A gripper is not always above the middle of an object, but a proposal is. Where the nearest one is
    unusually far from the grasp, the object touched others; what has disappeared is the object alone.

    Args:
        proposed: Proposals in the first images, (batch, n, 2) in -1..1.
        changed: Those in what has changed by the end, (batch, n, 2).
        grasps: Locations of the grasps, (batch, 2); NaN where they are not known.
        attended: Where the object was otherwise, (batch, 2).
        radius: Distance within which a proposal stands for the object.
        usual_error: Median distance of a proposal from the grasp.
    """
    rows = torch.arange(len(proposed), device=proposed.device)
    by_grasp, is_near = nearest_proposals(proposed, grasps, radius)
    by_change, is_changed = nearest_proposals(changed, grasps, radius)
    by_attention, is_attended = nearest_proposals(proposed, attended, radius)
    centers = torch.where(is_attended[:, None], proposed[rows, by_attention], attended)
    centers = torch.where(is_near[:, None], proposed[rows, by_grasp], centers)
    distance, of_changed = (
        (found[rows, nearest] - grasps).norm(dim=1)
        for found, nearest in ((proposed, by_grasp), (changed, by_change))
    )
    is_better = is_changed & (of_changed < distance) & (distance > _UNUSUAL * usual_error)
    return torch.where(is_better[:, None], changed[rows, by_change], centers), is_near | is_changed
