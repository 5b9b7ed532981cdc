"""A second look at what is picked: where on the object the gripper closes.

A proposal is somewhere on an object. Two things tell where its grasp is. A small network sees its
surroundings, enlarged from the full resolution; it learns from the training episodes, whose grasps are known,
at centers and sizes that are off at random. And the demonstration shows what the grasp looked like: its
surroundings there are a template, which is correlated with those of the proposal. The network is more exact
on objects of the training, and can be wrong on others. Each is used only if it comes nearer to other
episodes' grasps than the proposals do; templates do not where the demonstrator grasps anywhere.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.policies.base.augmentation import change_colors, random_color_changes
from lerobot_deltaco.policies.base.image_coordinates import mean_near
from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.networks import channels_last, conv_norm_relu
from lerobot_deltaco.policies.scene.crops import cut_crops

_RESOLUTION = 64  # px, of the enlarged surroundings
_EXTENT = 2.0  # side of the surroundings, in diameters of a typical object
_CHANNELS = 32
# Standard deviations in training: of centers, in diameters, and of the log of sizes.
_OFFSET, _LOG_SCALE = 0.25, 0.1
_P_OTHER_COLORS = 0.7
_BATCH = 32
_LEARNING_RATE, _WEIGHT_DECAY, _WARMUP_FRACTION = 4e-3, 0.05, 0.1
_MAX_MOVE = 1.0  # from a proposal, in diameters
_PEAK_RADIUS = 2.6  # of the cells around a peak whose mean is the location
_N_LOOKS = 2
_TEMPLATE_EXTENT, _TEMPLATE_RESOLUTION = 1.0, 24  # in diameters, and px
_TEMPLATE_WINDOW = 0.7  # standard deviation of the weights of a template's pixels, in half extents
_CORRELATION_WEIGHT = 40.0  # of a correlation, as a logit beside the network's
_LEAST_LOG_PROBABILITY = -8.0  # of a cell, by the network: it may be wrong
_MIN_VARIANCE = 1e-4  # of colors in 0..1
_N_MEASURED = 200  # episodes, at most, in which templates are measured


class GraspRefiner(nn.Module):
    """Finds where on an object the gripper closes.

    Attributes:
        is_used: Whether it comes nearer to the grasps of held-out episodes than the proposals do, () bool.
        uses_templates: Whether templates of other episodes of a task come nearer to its grasps than the
            proposals do, () bool.
        errors: Median distance from the grasps of held-out episodes (of all, if none are), of proposals and
            of refined locations, where an image's edges are at -1 and 1, (2,).
    """

    is_used: Tensor
    uses_templates: Tensor
    errors: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv_norm_relu(3, _CHANNELS, 5, 2),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            conv_norm_relu(_CHANNELS, _CHANNELS, 3, 2),
            conv_norm_relu(_CHANNELS, _CHANNELS, 5),
            conv_norm_relu(_CHANNELS, _CHANNELS, 5),
            nn.Upsample(scale_factor=2, mode="bilinear"),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            nn.Conv2d(_CHANNELS, 1, 1),
        )
        self.register_buffer("is_used", torch.zeros((), dtype=torch.bool))
        self.register_buffer("uses_templates", torch.zeros((), dtype=torch.bool))
        self.register_buffer("errors", torch.zeros(2))

    def forward(
        self, images: Tensor, locations: Tensor, sizes: Tensor, templates: Tensor | None = None
    ) -> Tensor:
        """Returns where the gripper closes, (batch, 2) in -1..1.

        Args:
            images: Images at full resolution, (batch, 3, H, W), uint8 or in 0..1.
            locations: Proposals, (batch, 2) in -1..1.
            sizes: Diameters of typical objects there, as fractions of the image's side, (batch,).
            templates: Surroundings of demonstrated grasps that these ones look like, (batch, demonstrations,
                3, h, w); NaN where the grasp is not known. See `cut_templates`.
        """
        if templates is None and not bool(self.is_used):
            return locations
        return self._refine(images, locations, sizes, templates, uses_network=bool(self.is_used))

    @torch.no_grad()
    def _refine(
        self,
        images: Tensor,
        locations: Tensor,
        sizes: Tensor,
        templates: Tensor | None = None,
        *,
        uses_network: bool = True,
    ) -> Tensor:
        extent, proposals = _EXTENT * sizes, locations
        for _ in range(_N_LOOKS):
            maps = images.new_zeros(len(images), *[_RESOLUTION // 2] * 2, dtype=torch.float32)
            if uses_network:
                crops = cut_crops(images, locations[:, None], extent[:, None], _RESOLUTION)[:, 0]
                logits = self.layers(channels_last(crops))[:, 0].float()
                maps = logits.flatten(1).log_softmax(dim=1).view_as(logits)
            if templates is not None:
                found = correlations(images, locations, sizes, templates, _EXTENT / 2)
                found = F.interpolate(found[:, None], maps.shape[1:], mode="bilinear", align_corners=True)
                maps = maps.clamp_min(_LEAST_LOG_PROBABILITY) + _CORRELATION_WEIGHT * found[:, 0]
            best, cells = maps.flatten(1).max(dim=1)
            likelihoods = (maps - best[:, None, None]).exp()
            moves = extent[:, None] * mean_near(likelihoods, cells, _PEAK_RADIUS)
            tells_nothing = (best == maps.flatten(1).amin(dim=1))[:, None]  # no template, and no network
            locations = torch.where(tells_nothing, locations, locations + moves)
        # Another object would be another choice.
        is_near = (locations - proposals).norm(dim=1) < 2 * _MAX_MOVE * sizes
        return torch.where(is_near[:, None], locations, proposals).clamp(-1, 1)

    def fit(
        self,
        images: Tensor,
        grasps: Tensor,
        proposals: Tensor,
        sizes: Tensor,
        held_out: Tensor,
        steps: int,
        generator: torch.Generator,
        autocast: torch.autocast,
    ) -> None:
        """Fits the network, and decides whether it is used.

        Args:
            images: First images of episodes at full resolution, (episodes, 3, H, W) uint8.
            grasps: Where their grasps are, (episodes, 2) in -1..1.
            proposals: The nearest proposals, (episodes, 2) in -1..1.
            sizes: Diameters of typical objects there, as fractions of the image's side, (episodes,).
            held_out: Episodes that are not fitted, (episodes,) bool.
            steps: Number of steps.
            generator: Source of the draws, on the CPU.
            autocast: Context of the forward pass.
        """
        fitted = (~held_out).nonzero().flatten()
        self.layers.train()
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, _LEARNING_RATE, steps, pct_start=_WARMUP_FRACTION
        )
        for _ in tqdm(range(steps), desc="Fitting where grasps are", unit="step", leave=False):
            rows = fitted[torch.randint(len(fitted), (_BATCH,), generator=generator)].to(images.device)
            noise = torch.randn(_BATCH, 3, generator=generator).to(images.device)
            extent = _EXTENT * sizes[rows] * (_LOG_SCALE * noise[:, 2]).exp()
            offsets = 2 * _OFFSET * sizes[rows, None] * noise[:, :2]
            crops = cut_crops(images[rows], (grasps[rows] + offsets)[:, None], extent[:, None], _RESOLUTION)
            crops = change_colors(crops[:, 0], random_color_changes(_BATCH, _P_OTHER_COLORS, generator))
            with autocast:
                maps = self.layers(channels_last(crops)).float()
            loss = location_loss(maps, (-offsets / extent[:, None])[:, None]).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.layers.eval()
        self.is_used.zero_()
        # Proposals learn nothing from grasps: without held-out episodes, all tell how far they are.
        self.errors.fill_((proposals - grasps).norm(dim=1).median())
        rows = held_out.nonzero().flatten().to(images.device)
        if len(rows):
            refined = self._refine(images[rows], proposals[rows], sizes[rows])
            errors = [(each - grasps[rows]).norm(dim=1).median() for each in (proposals[rows], refined)]
            self.errors.copy_(torch.stack(errors))
            self.is_used.copy_(errors[1] < errors[0])

    def measure_templates(
        self, images: Tensor, grasps: Tensor, proposals: Tensor, sizes: Tensor, others: Tensor
    ) -> None:
        """Decides whether templates are used.

        The arguments are those of `fit`, and the row of another episode of the task of each, (episodes,); its
        own if there is none.
        """
        rows = (others != torch.arange(len(others), device=others.device)).nonzero().flatten()
        rows = rows[:: max(1, len(rows) // _N_MEASURED)]
        if not len(rows):
            self.uses_templates.zero_()
            return
        shown = others[rows]
        templates = cut_templates(images[shown.to(images.device)], grasps[shown], sizes[shown])[:, None]
        given = (images[rows.to(images.device)], proposals[rows], sizes[rows], templates)
        refined = self._refine(*given, uses_network=False)
        errors = [(each - grasps[rows]).norm(dim=1).median() for each in (proposals[rows], refined)]
        self.uses_templates.copy_(errors[1] < errors[0])


def cut_templates(images: Tensor, grasps: Tensor, sizes: Tensor) -> Tensor:
    """Cuts out the surroundings of demonstrated grasps, (batch, 3, h, w); NaN where a grasp is not known.

    Args:
        images: First images of demonstrations at full resolution, (batch, 3, H, W), uint8 or in 0..1.
        grasps: Locations of their grasps, (batch, 2) in -1..1; NaN where they are not known.
        sizes: Diameters of typical objects there, as fractions of the image's side, (batch,).
    """
    is_known = ~grasps.isnan().any(dim=1)
    extent = torch.where(is_known, _TEMPLATE_EXTENT * sizes, 1.0)
    crops = cut_crops(images, grasps.nan_to_num()[:, None], extent[:, None], _TEMPLATE_RESOLUTION)[:, 0]
    return torch.where(is_known[:, None, None, None], crops, torch.nan)


def correlations(images: Tensor, locations: Tensor, sizes: Tensor, templates: Tensor, reach: float) -> Tensor:
    """Correlates templates with the surroundings of locations.

    Args:
        images: Images at full resolution, (batch, 3, H, W), uint8 or in 0..1.
        locations: Locations, (batch, 2) in -1..1.
        sizes: Diameters of typical objects there, as fractions of the image's side, (batch,).
        templates: Templates, (batch, demonstrations, 3, h, w); those that are NaN do not count.
        reach: How far from a location templates are laid, to each side, in diameters.

    Returns:
        Mean correlation coefficients of colors, (batch, n, n) in -1..1; 0 without a template.
    """
    n_pixels = templates.shape[-1]
    side = 2 * round(n_pixels * (0.5 + reach / _TEMPLATE_EXTENT))
    extent = side / n_pixels * _TEMPLATE_EXTENT * sizes
    crops = cut_crops(images, locations[:, None], extent[:, None], side)[:, 0]  # (batch, 3, side, side)
    offsets = torch.linspace(-1, 1, n_pixels, device=images.device) / _TEMPLATE_WINDOW
    window = torch.exp(-(offsets[:, None].square() + offsets.square()) / 2)
    window = window / window.sum()
    usable = ~templates.isnan().flatten(2).any(dim=2)  # (batch, demonstrations)
    templates = templates.nan_to_num()
    centered = templates - (window * templates).sum(dim=(3, 4), keepdim=True)
    variance = (window * centered.square()).sum(dim=(2, 3, 4))
    # Each sample has templates of its own.
    covariances = F.conv2d(
        crops.flatten(0, 1)[None], (window * centered).flatten(0, 1), groups=len(crops)
    ).unflatten(1, usable.shape)[0]  # (batch, demonstrations, n, n)
    sums = F.conv2d(torch.cat([crops, crops.square()]).flatten(0, 1)[:, None], window[None, None])[:, 0]
    means, squares = sums.unflatten(0, (2, -1, 3)).unbind()
    variances = (squares - means.square()).sum(dim=1).clamp_min(_MIN_VARIANCE)  # (batch, n, n)
    found = covariances / (variances[:, None] * variance.clamp_min(_MIN_VARIANCE)[..., None, None]).sqrt()
    weights = usable / usable.sum(dim=1, keepdim=True).clamp_min(1)
    return (weights[..., None, None] * found).sum(dim=1)
