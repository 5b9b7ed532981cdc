"""A second look at what is picked: where on the object the gripper closes.

A proposal is somewhere on an object. A small network sees its surroundings, enlarged from the full
resolution, and finds the grasp in them. It learns from the training episodes, whose grasps are known, at
centers and sizes that are off at random, so that it learns to center objects that it has never seen.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.policies.base.augmentation import change_colors, random_color_changes
from lerobot_deltaco.policies.base.image_coordinates import mean_near
from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.networks import channels_last, conv_norm_relu
from lerobot_deltaco.policies.deltaco_match.crop_encoder import cut_crops

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


class GraspRefiner(nn.Module):
    """Finds where on an object the gripper closes.

    Attributes:
        is_used: Whether it comes nearer to the grasps of held-out episodes than the proposals do, () bool.
        errors: Median distance from the grasps of held-out episodes, of proposals and of refined locations,
            where an image's edges are at -1 and 1, (2,).
    """

    is_used: Tensor
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
        self.register_buffer("errors", torch.zeros(2))

    def forward(self, images: Tensor, locations: Tensor, sizes: Tensor) -> Tensor:
        """Returns where the gripper closes, (batch, 2) in -1..1.

        Args:
            images: Images at full resolution, (batch, 3, H, W), uint8 or in 0..1.
            locations: Proposals, (batch, 2) in -1..1.
            sizes: Diameters of typical objects there, as fractions of the image's side, (batch,).
        """
        if not bool(self.is_used):
            return locations
        return self._refine(images, locations, sizes)

    @torch.no_grad()
    def _refine(self, images: Tensor, locations: Tensor, sizes: Tensor) -> Tensor:
        extent, proposals = _EXTENT * sizes, locations
        for _ in range(_N_LOOKS):
            crops = cut_crops(images, locations[:, None], extent[:, None], _RESOLUTION)[:, 0]
            maps = self.layers(channels_last(crops))[:, 0].float()
            best, cells = maps.flatten(1).max(dim=1)
            weights = (maps - best[:, None, None]).exp()
            locations = locations + extent[:, None] * mean_near(weights, cells, _PEAK_RADIUS)
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
        rows = held_out.nonzero().flatten().to(images.device)
        if len(rows):
            refined = self._refine(images[rows], proposals[rows], sizes[rows])
            errors = [(each - grasps[rows]).norm(dim=1).median() for each in (proposals[rows], refined)]
            self.errors.copy_(torch.stack(errors))
            self.is_used.copy_(errors[1] < errors[0])
