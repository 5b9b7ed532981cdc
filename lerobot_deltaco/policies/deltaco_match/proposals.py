"""Proposals: where in a scene the gripper might close, whatever the task."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.networks import channels_last, conv_norm_relu, grid_of_centers
from lerobot_deltaco.policies.deltaco_match.settings import MatchingSettings

N_PROPOSALS = 5
_CHANNELS = 32
_MIN_DISTANCE = 1 / 6  # between two proposals, where an image's edges are at -1 and 1
_PEAK_RADIUS = 1.6  # of the cells around a peak whose mean is a proposal
_LEARNING_RATE, _WEIGHT_DECAY, _WARMUP_FRACTION = 4e-3, 0.05, 0.1


class ProposalNetwork(nn.Module):
    """Proposes pick locations. It is fitted to where the gripper closed in training scenes.

    The network is not told what to look for, so its map has a peak at each thing that can be grasped.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv_norm_relu(3, _CHANNELS, 5, 2),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            conv_norm_relu(_CHANNELS, _CHANNELS, 5),
            nn.Conv2d(_CHANNELS, 1, 1),
        )

    def forward(self, scenes: Tensor) -> Tensor:
        """Returns the proposals in scenes (batch, 3, H, W), the likeliest first: (batch, 5, 2) in -1..1."""
        return peaks(self.layers(channels_last(scenes))[:, 0].float(), N_PROPOSALS)

    def fit(
        self,
        images: Tensor,
        locations: Tensor,
        generator: torch.Generator,
        autocast: torch.autocast,
        settings: MatchingSettings,
    ) -> None:
        """Fits the network.

        Args:
            images: First images of episodes, (episodes, 3, H, W) uint8.
            locations: Locations of their grasps, (episodes, 2) in -1..1.
            generator: Source of the draws, on the CPU.
            autocast: Context of the forward pass.
            settings: Number of steps, and size of the batches.
        """
        steps = settings.proposal_steps
        self.layers.train()
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, _LEARNING_RATE, steps, pct_start=_WARMUP_FRACTION
        )
        n_scenes = settings.proposal_draws * len(images) // steps
        n_scenes = min(max(n_scenes, settings.min_proposal_batch), settings.max_proposal_batch)
        for _ in tqdm(range(steps), desc="Fitting the proposals", unit="step", leave=False):
            rows = torch.randint(len(images), (n_scenes,), generator=generator).to(images.device)
            with autocast:
                maps = self.layers(channels_last(images[rows].float() / 255)).float()
            loss = location_loss(maps, locations[rows, None]).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.layers.eval()


def peaks(maps: Tensor, n_peaks: int) -> Tensor:
    """Returns the highest peaks of maps, at a distance from one another.

    Args:
        maps: Logits, (batch, h, w).
        n_peaks: Number of peaks.

    Returns:
        Means of the cells around each peak, the highest first, (batch, n_peaks, 2) in -1..1.
    """
    height, width = maps.shape[1:]
    centers = grid_of_centers(height, width, maps.device)
    radius = _PEAK_RADIUS * 2 / torch.tensor([width, height], device=maps.device)
    values = maps.flatten(1)
    left, locations = values.clone(), []
    for _ in range(n_peaks):
        best, cell = left.max(dim=1)
        away = centers - centers[cell][:, None]  # (batch, cells, 2)
        # Beyond the last peak, all cells may be taken; then the highest is proposed again.
        weights = (values - best[:, None]).clamp(max=0).exp() * (away.abs() <= radius).all(dim=2)
        locations.append((weights[..., None] * centers).sum(dim=1) / weights.sum(dim=1, keepdim=True))
        left = left.masked_fill(away.norm(dim=2) < _MIN_DISTANCE, -1e9)
    return torch.stack(locations, dim=1)


def nearest_proposals(proposed: Tensor, locations: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Returns the nearest proposal to locations (batch, 2), and whether it is near, (batch,) each."""
    distance, nearest = (proposed - locations[:, None]).norm(dim=2).min(dim=1)
    return nearest, distance < radius
