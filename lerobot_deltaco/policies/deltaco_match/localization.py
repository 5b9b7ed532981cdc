r"""Finds where to pick and where to place, once, at the start of an episode.

Feature matching chooses what to pick among proposals, by the demonstration and by the instruction's words.
The place network finds where to place it, by the instruction, or by the demonstration if there is none; after
few training episodes, the demonstrated place itself is looked for (`FeatureMatching.find_places`):

    demonstration's first and last image                 instruction
               |              |                               |
           attention         stem                           words
               |______________|                               |
                       |                                      |
          what is there, and where  _____ one of both ________|
                                            |
                                            | FiLM
    scene -> stem -> convolutions with coordinates -> place map

The attention also tells what a demonstration moved, if the robot's state at its grasp is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.augmentation import change_colors, random_shifts, shift_images
from lerobot_deltaco.policies.base.image_coordinates import (
    gaussian_maps,
    grid_of_centers,
    mean_location,
    mean_near,
    spatial_weights,
)
from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.networks import Film, channels_last, conv_norm_relu
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching, other_episodes
from lerobot_deltaco.policies.deltaco_match.prompts import choose_prompted, describe_prompts
from lerobot_deltaco.policies.deltaco_match.words import INSTRUCTION_DIM, InstructionEncoder, encode_words
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion

_CHANNELS = 32  # of the networks
TARGET_DIM = _CHANNELS + 2
_PEAK_RADIUS = 1  # of the cells around the maximum whose mean is a location
_SHIFT_PADDING = 4  # px, of the random shifts of images in training
_P_PLACE_BY_DEMONSTRATION = 0.25  # of samples in training; in the others, the instruction says where
_MIN_ATTENTION = 1e-9
_MAX_MEASURED = 24  # episodes in which places are measured, at most


class PickPlace(NamedTuple):
    """Where to pick and place in the scenes of a batch, and why.

    Attributes:
        locations: Pick and place, (batch, 2, 2) in -1..1.
        heights: Height offset of each grasp, (batch,).
        maps: Pick and place maps over the scenes, as logits (batch, 2, h, w).
        attention: Maps of what the (first) demonstration moved and where it was put, (batch, 2, h, w); None
            without demonstrations.
        by_demonstration: Whether a demonstration was used for the pick, and its attention for the place;
            where not, that map of `attention` means nothing.
        confidence: Probability of the object at the pick location among what is proposed, (batch,).
        place_confidence: Probability of the place map within an object's radius of the place location,
            (batch,).
        is_same_place: Whether the place is the (first) demonstration's, found again, (batch,) bool.
        proposal: The proposal that was chosen, (batch, 2) in -1..1.
        demonstrated: Center of what the (first) demonstration grasped, in its first image, (batch, 2); None
            without demonstrations.
        demonstrated_grasp: Where it grasped, (batch, 2); NaN where that is not known.
        camera_motion: How far the camera has moved since the training, by the first scene; None if it is not
            known. All locations are in the pictures of the training's camera.
    """

    locations: Tensor
    heights: Tensor
    maps: Tensor
    attention: Tensor | None
    by_demonstration: tuple[bool, bool]
    confidence: Tensor
    place_confidence: Tensor
    is_same_place: Tensor
    proposal: Tensor
    demonstrated: Tensor | None = None
    demonstrated_grasp: Tensor | None = None
    camera_motion: CameraMotion | None = None


class DemonstrationBatch(NamedTuple):
    """Demonstrations of a batch of tasks, as many of each.

    Attributes:
        ends: First and last images, (batch, demonstrations, 2, 3, H, W) in 0..1.
        first_images: First images at the camera's own resolution, (batch, demonstrations, 3, H', W') uint8.
        picks: Locations of the grasps, (batch, demonstrations, 2) in -1..1; NaN where they are not known.
        places: Locations of the releases, (batch, demonstrations, 2) in -1..1; NaN where they are not known.
        heights: Height offsets of the grasps, (batch, demonstrations); NaN where they are not known.
    """

    ends: Tensor
    first_images: Tensor
    picks: Tensor
    places: Tensor
    heights: Tensor


class Localizer(nn.Module):
    """Finds where to pick and place in the first images of episodes.

    Args:
        vocabulary: Known words.

    Attributes:
        matching: Finds what to pick. It is fitted before the others are trained.
        attention: Finds what demonstrations moved, and where to.
        place: Finds where to place it.
        instruction_encoder: Embeds instructions for `place`.
        demonstrates_places: Whether demonstrations say where to place, () bool. See `measure_places`.
        place_reach: How far from a release what stands at the place may be, (). See `find_places`.
    """

    demonstrates_places: Tensor
    place_reach: Tensor

    def __init__(self, vocabulary: Sequence[str]) -> None:
        super().__init__()
        self.matching = FeatureMatching(vocabulary)
        self.attention = DemonstrationAttention()
        self.place = PlaceNetwork(INSTRUCTION_DIM)
        self.instruction_encoder = InstructionEncoder(len(vocabulary))
        self.register_buffer("demonstrates_places", torch.zeros((), dtype=torch.bool))
        self.register_buffer("place_reach", torch.zeros(()))

    @torch.no_grad()
    def forward(
        self,
        scenes: Tensor,
        full_resolution: Tensor,
        instructions: Sequence[str],
        given: DemonstrationBatch | None,
        prompts: Sequence[ObjectPrompt] = (),
        is_trained: Tensor | None = None,
    ) -> PickPlace:
        """Finds where to pick and place.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1, as small as the policy's.
            full_resolution: The same at the camera's own resolution, (batch, 3, H', W') in 0..1.
            instructions: Instruction of each sample; an empty string leaves it out.
            given: Demonstrations; None without.
            prompts: What shows the object of each sample instead; empty for nothing.
            is_trained: Whether each instruction is that of a training task, (batch,) bool; None for no one.

        Raises:
            ValueError: A sample has neither an instruction nor a demonstration.
        """
        matching = self.matching
        by_instruction = torch.tensor([bool(text) for text in instructions], device=scenes.device)
        attention = last = centers = descriptors = heights = templates = None
        if prompts:
            descriptors = describe_prompts(matching, prompts, full_resolution)
        elif given is None:
            if not bool(by_instruction.all()):
                raise UserError("Neither a demonstration nor an instruction is given. Pass one of them.")
        else:
            n_each, ends = given.ends.shape[1], given.ends.flatten(0, 1)
            attentions = self.attention(ends)
            attended = peak_locations(attentions.clamp_min(_MIN_ATTENTION).log())[:, 0]
            described = matching.describe(
                ends, given.first_images.flatten(0, 1), given.picks.flatten(0, 1), attended
            )
            descriptors = described.descriptors.unflatten(0, (-1, n_each)).mean(dim=1)
            if described.templates is not None:
                templates = described.templates.unflatten(0, (-1, n_each))
            heights = given.heights.nanmean(dim=1)
            # Of several demonstrations, the first says where.
            centers, attention, last = described.centers[::n_each], attentions[::n_each], ends[::n_each, 1]
        novelty = matching.novelty(instructions)
        candidates = matching.find(full_resolution, instructions, descriptors, heights, templates, novelty)
        if prompts:
            candidates = choose_prompted(candidates, prompts)
        proposal, confidence, height = candidates.best
        is_new_task = None if is_trained is None else ~is_trained
        pick = matching.grasps(full_resolution, proposal, templates, novelty, is_new_task)
        target = None if attention is None or last is None else self.place.target(last, attention[:, 1])
        place_maps = self._place_maps(scenes, by_instruction, instructions, target)
        is_same_place = torch.zeros_like(by_instruction)
        if given is not None and bool(self.demonstrates_places):
            is_same_place = ~given.places[:, 0].isnan().any(dim=1)
            assert centers is not None
            # An object that is held elsewhere than in the demonstration is released elsewhere.
            held = (pick - proposal) - (given.picks[:, 0] - centers)
            is_other = held.norm(dim=1) > matching.object_sizes(proposal) / 2
            held = torch.where(is_other[:, None], held, 0.0)
            demonstrated = self._demonstrated_place_maps(place_maps, full_resolution, given, held)
            place_maps = torch.where(is_same_place[:, None, None], demonstrated, place_maps)
        place = peak_locations(place_maps[:, None])[:, 0]
        grid = grid_of_centers(place_maps.shape[1], place_maps.shape[2], place_maps.device)
        at_place = torch.cdist(place[:, None], grid)[:, 0] < matching.grasp_radius
        pick_maps = candidates.map(place_maps.shape[1:], matching.settings.map_std)
        return PickPlace(
            locations=torch.stack([pick, place], dim=1),
            heights=height,
            maps=torch.stack([pick_maps, place_maps], dim=1),
            attention=attention,
            by_demonstration=(given is not None, given is not None and not bool(by_instruction.all())),
            confidence=confidence,
            place_confidence=(place_maps.flatten(1).softmax(dim=1) * at_place).sum(dim=1),
            is_same_place=is_same_place,
            proposal=proposal,
            demonstrated=centers,
            demonstrated_grasp=None if given is None else given.picks[:, 0],
        )

    def _place_maps(
        self,
        scenes: Tensor,
        by_instruction: Tensor,
        instructions: Sequence[str],
        target: Tensor | None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Returns maps of where to place the object, as logits (batch, h, w).

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            by_instruction: Whether the instruction says where, and not the demonstration, (batch,) bool.
            instructions: Instruction of each sample.
            target: What `PlaceNetwork.target` says of demonstrations, (batch, TARGET_DIM); None without.
            generator: In training, source of the draws of words that are left out, on the CPU.
        """
        words = encode_words(instructions, self.matching.vocabulary).to(scenes.device)
        instruction = torch.where(by_instruction[:, None], self.instruction_encoder(words, generator), 0.0)
        if target is None:
            target = torch.zeros(len(scenes), TARGET_DIM, device=scenes.device)
        return self.place(scenes, instruction, torch.where(by_instruction[:, None], 0.0, target))

    def _demonstrated_place_maps(
        self, like: Tensor, scenes: Tensor, given: DemonstrationBatch, offsets: Tensor
    ) -> Tensor:
        """Returns maps that peak beside where demonstrated places are now, as logits like other maps."""
        first_images, picks, places = (part[:, 0] for part in (given.first_images, given.picks, given.places))
        given_places = (scenes, first_images, picks, places.nan_to_num())
        (found,) = self.matching.find_places(*given_places, [float(self.place_reach)])
        found = found + offsets
        height, width = like.shape[1:]
        std = 2 * self.matching.settings.map_std / torch.tensor([width, height], device=like.device)
        return gaussian_maps(found[:, None], height, width, std)[:, 0].clamp_min(_MIN_ATTENTION).log()

    @torch.no_grad()
    def measure_places(self, images: Tensor, locations: Tensor, tasks: Sequence[str]) -> None:
        """Decides whether demonstrations say where to place, and whether places move.

        Demonstrations do after few episodes, if that is right; after many, the place network is better. Where
        a container stands somewhere else in each episode and does not stand out, they say nothing.

        Args:
            images: First images of training episodes at full resolution, (episodes, 3, H, W) uint8.
            locations: Their pick and place locations, (episodes, 2, 2) in -1..1.
            tasks: Task of each episode.
        """
        matching = self.matching
        self.demonstrates_places.zero_()
        others = other_episodes(tasks)
        rows = (others != torch.arange(len(others))).nonzero().flatten()
        rows = rows[:: max(1, -(-len(rows) // _MAX_MEASURED))]
        if not bool(matching.has_few_episodes) or not len(rows):
            return
        shown = others[rows]
        grasps, releases = locations[shown].unbind(dim=1)
        reaches = matching.settings.place_reaches
        found = matching.find_places(images[rows], images[shown], grasps, releases, reaches)
        errors = {
            reach: (places - locations[rows, 1]).norm(dim=1).clamp(max=1.0)
            for reach, places in zip(reaches, found, strict=True)
        }
        best = min(errors, key=lambda reach: float(errors[reach].mean()))
        self.place_reach.fill_(best)
        self.demonstrates_places.copy_(errors[best].median() < matching.grasp_radius)

    def losses(
        self,
        scenes: Tensor,
        places: Tensor,
        instructions: Sequence[str],
        ends: Tensor,
        demonstrated: Tensor,
        changes: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Computes the losses of the place maps, and of the attention to demonstrations.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) uint8.
            places: Their place locations, (batch, 2) in -1..1.
            instructions: Their instructions.
            ends: First and last images of other episodes of the tasks, (batch, 2, 3, H, W) uint8.
            demonstrated: Their pick and place locations, (batch, 2, 2) in -1..1.
            changes: Changes of the colors that the attention sees, (batch, 3, 3), on the CPU.
            generator: Source of the draws, on the CPU.

        Returns:
            Losses of the place and of the attention, (batch, 2).
        """
        scenes, places = _augment(scenes.float() / 255, places[:, None], generator)
        ends, demonstrated = _augment(ends.float() / 255, demonstrated, generator)
        attention = self.attention(change_colors(ends, changes))
        draws = torch.rand(len(scenes), generator=generator)
        by_instruction = (draws >= _P_PLACE_BY_DEMONSTRATION).to(scenes.device)
        target = self.place.target(ends[:, 1], attention[:, 1])
        maps = self._place_maps(scenes, by_instruction, instructions, target, generator)
        # Without a loss of its own, the attention would take thousands of steps.
        log_attention = attention.clamp_min(_MIN_ATTENTION).log()
        attention_losses = location_loss(log_attention, demonstrated).sum(dim=1, keepdim=True)
        return torch.cat([location_loss(maps[:, None], places), attention_losses], dim=1)


class DemonstrationAttention(nn.Module):
    """Finds what moved between the first and the last image of a demonstration, and where it was put."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv_norm_relu(6, _CHANNELS, 5, 2),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            conv_norm_relu(_CHANNELS, _CHANNELS),
            nn.Conv2d(_CHANNELS, 2, 1),
        )

    def forward(self, ends: Tensor) -> Tensor:
        """Maps first and last images (batch, 2, 3, H, W) to two maps that sum to 1, (batch, 2, h, w)."""
        return spatial_weights(self.layers(channels_last(ends.flatten(1, 2))))


class PlaceNetwork(nn.Module):
    """Predicts where in a scene an object is to go: convolutions with coordinates and FiLM.

    Args:
        instruction_dim: Size of the embedding of an instruction.
    """

    def __init__(self, instruction_dim: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_norm_relu(3, _CHANNELS, 5, 2), conv_norm_relu(_CHANNELS, _CHANNELS))
        self.locate = conv_norm_relu(_CHANNELS + 2, _CHANNELS)
        self.refine = conv_norm_relu(_CHANNELS, _CHANNELS)
        self.films = nn.ModuleList(Film(instruction_dim + TARGET_DIM, _CHANNELS) for _ in range(2))
        self.output = nn.Conv2d(_CHANNELS, 1, 1)

    def target(self, last: Tensor, attention: Tensor) -> Tensor:
        """Describes where demonstrations put the object: the features there, and the location.

        Args:
            last: Last images, (batch, 3, H, W) in 0..1.
            attention: Maps of where the object was put, (batch, h, w); each sums to 1.

        Returns:
            (batch, TARGET_DIM).
        """
        weights = attention[:, None]
        features = (self.stem(channels_last(last)) * weights).sum(dim=(2, 3))
        return torch.cat([features.float(), *mean_location(weights)], dim=1)

    def forward(self, scenes: Tensor, instruction: Tensor, target: Tensor) -> Tensor:
        """Predicts place maps.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            instruction: Embeddings of instructions, (batch, instruction_dim); zeros where the demonstration
                says where.
            target: Results of `target`, (batch, TARGET_DIM); zeros where the instruction says where.

        Returns:
            Logits, (batch, h, w), where h and w are half the height and width of the images.
        """
        condition = torch.cat([instruction.float(), target], dim=1)
        maps = self.stem(channels_last(scenes))
        height, width = maps.shape[-2:]
        y, x = torch.meshgrid(
            torch.linspace(-1, 1, height, device=maps.device),
            torch.linspace(-1, 1, width, device=maps.device),
            indexing="ij",
        )
        coordinates = torch.stack([x, y]).to(maps.dtype).expand(len(maps), -1, -1, -1)
        maps = F.relu(self.films[0](self.locate(torch.cat([maps, coordinates], dim=1)), condition))
        maps = F.relu(self.films[1](self.refine(maps), condition))
        return self.output(maps)[:, 0].float()


def peak_locations(logits: Tensor) -> Tensor:
    """Returns the peaks of maps: the means of the cells around them.

    Args:
        logits: (batch, maps, h, w).

    Returns:
        (batch, maps, 2) in -1..1.
    """
    weights = spatial_weights(logits)
    cells = F.avg_pool2d(weights, 3, 1, 1).flatten(2).argmax(dim=2)  # (batch, maps)
    return mean_near(weights.flatten(0, 1), cells.flatten(), _PEAK_RADIUS).unflatten(0, cells.shape)


def _augment(images: Tensor, locations: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Shifts images (batch, ..., H, W) and locations in them (batch, n, 2) at random."""
    shifts = random_shifts(len(images), _SHIFT_PADDING, generator)
    height, width = images.shape[-2:]
    moved = (shifts * 2 / torch.tensor([width, height])).to(locations.device)  # (batch, 2)
    return shift_images(images, shifts, _SHIFT_PADDING), locations + moved[:, None]
