r"""Finds the object that a task asks for among the objects that could be grasped.

    scene                          demonstration's first image          instruction
      |                                    |                                |
    proposals                       where it grasped                  weighted words
      |                                    |                                |
    crops -> EfficientNet-Lite0       crop -> EfficientNet-Lite0            |
      |      (frozen), colors              |                                |
    descriptors -------- cosines ------ descriptors                         |
      |                    |                                                |
    log probability of each word of the vocabulary ------- words of the instruction
                           |                                                |
                           +------------ sum: score of a proposal ----------+

There are two descriptors. The instance descriptor tells whether a proposal is the demonstrated object. The
category descriptor measures similarity of color and shape, which tasks by color or shape need, and is used to
the extent that the first finds no match.

Called once at the start of an episode. What is learned is fitted before the policy is trained, to the first
images of the training episodes: see `fit`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.base.image_coordinates import gaussian_maps
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import MatchingSettings
from lerobot_deltaco.policies.deltaco_match.matching_head import (
    HIDDEN_DIM,
    Crops,
    GraspHeightEstimator,
    MatchingHead,
    uniform,
    word_scores,
)
from lerobot_deltaco.policies.deltaco_match.refinement import GraspRefiner, correlations, cut_templates
from lerobot_deltaco.policies.deltaco_match.words import (
    UNKNOWN_WORD,
    WordWeights,
    encode_words,
    understand,
    words_of,
)
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion, is_moved
from lerobot_deltaco.policies.scene.crops import EfficientNetCropEncoder
from lerobot_deltaco.policies.scene.proposals import (
    Background,
    changed_areas,
    demonstrated_centers,
    nearest_proposals,
)

logger = logging.getLogger(__name__)

_MIN_PROBABILITY = 1e-9
_MIN_NOVELTY = 0.01  # of an object, below which templates are not compared with proposals
_NOVEL = 0.5  # novelty of an object above which its grasp is taken to look like the demonstrated one


class Candidates(NamedTuple):
    """What could be picked.

    Attributes:
        locations: The proposals, (batch, n, 2) in -1..1; NaN where there is none.
        log_probabilities: How likely each is what the task asks for, (batch, n). The probabilities sum to
            less than 1; the rest is that of none of these.
        heights: Height offset of a grasp of each, (batch, n).
        radius: Distance from a candidate within which others are of the same object.
    """

    locations: Tensor
    log_probabilities: Tensor
    heights: Tensor
    radius: float

    @property
    def best(self) -> tuple[Tensor, Tensor, Tensor]:
        """Location (batch, 2) of the likeliest, its object's probability, and its height offset, (batch,)."""
        best = self.log_probabilities.argmax(dim=1)
        rows = torch.arange(len(best), device=best.device)
        chosen = self.locations[rows, best]
        of_object = (self.locations - chosen[:, None]).norm(dim=2) < self.radius
        probability = (self.log_probabilities.exp() * of_object).sum(dim=1)
        return chosen.nan_to_num(), probability, self.heights[rows, best]

    def map(self, shape: Sequence[int], cells: float) -> Tensor:
        """Returns the candidates as maps of a shape (h, w), blurred by some cells: logits (batch, h, w)."""
        height, width = shape
        std = 2 * cells / torch.tensor([width, height], device=self.locations.device)
        each = gaussian_maps(self.locations, height, width, std).nan_to_num()
        return (self.log_probabilities.exp()[..., None, None] * each).sum(dim=1).clamp_min(1e-9).log()


class Described(NamedTuple):
    """What demonstrations grasped.

    Attributes:
        centers: Centers of the objects, (batch, 2) in -1..1.
        descriptors: Descriptors of the objects, (batch, descriptor).
        templates: Surroundings of the grasps, (batch, 3, h, w); NaN where the grasp is not known. None where
            templates are not used.
    """

    centers: Tensor
    descriptors: Tensor
    templates: Tensor | None


class FeatureMatching(nn.Module):
    """Finds what demonstrations moved, and what words describe, in scenes.

    It stays in evaluation mode, and receives no gradient while a policy is trained.

    Args:
        vocabulary: Known words.
        settings: Constants of the method; by default, those of `MatchingSettings`.

    Attributes:
        encoder: Describes crops of images.
        fitted: Whether it has been fitted, () bool.
        sharpness: Factor of the scores, (), and
        error_rate: how often even the surest choice is wrong, (), by held-out episodes.
        held_out: Number of held-out episodes in which the object was found, and of all, (2,) int64.
        n_episodes: Number of training episodes, () int64.
    """

    fitted: Tensor
    sharpness: Tensor
    error_rate: Tensor
    held_out: Tensor
    n_episodes: Tensor

    def __init__(self, vocabulary: Sequence[str], settings: MatchingSettings | None = None) -> None:
        super().__init__()
        self.vocabulary = list(vocabulary)
        self.settings = settings or MatchingSettings()
        self.background = Background()
        self.refine = GraspRefiner()
        self.encoder = EfficientNetCropEncoder()
        self.compare = MatchingHead(len(vocabulary), self.encoder.feature_dim, self.encoder.color_dim)
        self.word_weights = WordWeights(len(vocabulary))
        self.grasp_height = GraspHeightEstimator(HIDDEN_DIM)
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        self.register_buffer("sharpness", torch.ones(()))
        self.register_buffer("error_rate", torch.zeros(()))
        self.register_buffer("held_out", torch.zeros(2, dtype=torch.int64))
        self.register_buffer("n_episodes", torch.zeros((), dtype=torch.int64))
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> FeatureMatching:
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def find(
        self,
        scenes: Tensor,
        instructions: Sequence[str],
        described: Tensor | None,
        demonstrated: Tensor | None,
        templates: Tensor | None = None,
        novelty: Tensor | None = None,
    ) -> Candidates:
        """Finds what tasks ask for.

        Args:
            scenes: First images of episodes at full resolution, (batch, 3, H, W) in 0..1.
            instructions: Instruction of each sample, "" for none.
            described: Descriptors of the demonstrated objects, (batch, descriptor); None without
                demonstrations.
            demonstrated: Height offsets of the demonstrated grasps, (batch,), NaN where they are not known;
                None without demonstrations.
            templates: Surroundings of the demonstrated grasps, (batch, demonstrations, 3, h, w). See
                `Described`.
            novelty: How likely each demonstrated object is new to the training, (batch,). See `novelty`.
        """
        with torch.autocast(
            scenes.device.type, enabled=False
        ):  # a scene's result must not depend on its batch
            locations = self.background(scenes)
            crops = self.compare(self.features(scenes, locations))
            words = encode_words(instructions, self.vocabulary).to(scenes.device)
            scores, similarity = self.scores(crops, words, described)
            if templates is not None and novelty is not None and bool((novelty > _MIN_NOVELTY).any()):
                alike = self._correlations(scenes, locations, templates)
                scores = scores + self.settings.template_weight * novelty[:, None] * alike
            if demonstrated is None:
                demonstrated = torch.full_like(scores[:, 0], torch.nan)
            heights = self.grasp_height(crops.hidden, similarity, demonstrated[:, None])
            log_p = (self.sharpness * scores).masked_fill(~crops.exists, -torch.inf).log_softmax(dim=1)
            # The object may be none of these, however few they are.
            p = torch.lerp(log_p.exp(), crops.exists / crops.exists.shape[1], self.error_rate)
            return Candidates(locations, p.log(), heights, self.grasp_radius)

    def scores(self, crops: Crops, words: Tensor, described: Tensor | None) -> tuple[Tensor, Tensor]:
        """Scores the crops of proposals by demonstrations and words.

        Args:
            crops: The crops.
            words: Indices of the words of the instructions, (batch, length).
            described: Descriptors of the demonstrated objects, (batch, descriptor); None without
                demonstrations.

        Returns:
            Log probabilities, up to a constant, and similarities to the demonstrated objects, (batch, n).
        """
        settings, weights = self.settings, self.word_weights(words)
        scores = word_scores(crops.words, words, weights)
        matches = similarity = torch.zeros_like(scores)
        if described is not None:
            # How surely known words describe the object. With a new noun, the demonstration decides.
            p_unknown = self._p_unknown(words)
            p_described = (1 - p_unknown) * (weights * (words > UNKNOWN_WORD)).amax(dim=1)
            matches, similarity = self.compare.match(
                crops, described, settings.sharpness, settings.p_other_object * p_described
            )
            # Of an object that known words describe, the demonstration may show another. After few episodes,
            # words are known by heart, and the demonstration is the better guide.
            p_other = settings.p_misdemonstrated * p_described[:, None] * ~self.has_few_episodes
            matches = (
                torch.lerp(matches.exp(), uniform(crops.exists), p_other).clamp_min(_MIN_PROBABILITY).log()
            )
            scores = (1 - p_unknown)[:, None] * scores
        by_words = (scores + crops.objectness).masked_fill(~crops.exists, -torch.inf).softmax(dim=1)
        by_words = torch.lerp(by_words, uniform(crops.exists), settings.p_misdescribed)
        return matches + by_words.clamp_min(_MIN_PROBABILITY).log(), similarity

    def _p_unknown(self, words: Tensor) -> Tensor:
        """Returns how likely an unknown word describes the object, (batch,)."""
        return (self.word_weights(words) * (words == UNKNOWN_WORD)).amax(dim=1)

    def _correlations(self, scenes: Tensor, locations: Tensor, templates: Tensor) -> Tensor:
        """Returns how well the surroundings of proposals agree with templates, (batch, n); 0 for none."""
        n_each, flat = locations.shape[1], locations.nan_to_num().flatten(0, 1)
        images, repeated = (part.repeat_interleave(n_each, 0) for part in (scenes, templates))
        reach = self.settings.template_reach
        found = correlations(images, flat, self.object_sizes(flat), repeated, reach)
        return found.flatten(1).amax(dim=1).view(-1, n_each)

    def camera_motion(self, scene: Tensor) -> CameraMotion | None:
        """Returns how far the camera has moved since the training, and warns if it has.

        Args:
            scene: First image of an episode, (3, H, W) in 0..1, at full resolution.

        Returns:
            The motion; None if it is not known.
        """
        motion = self.background.camera_motion(scene)
        if is_moved(motion):
            height, width = scene.shape[-2:]
            logger.warning(
                "The camera seems to have moved since the training: the picture is off by %s. The policy "
                "corrects its pictures, which is exact only for a camera that was turned on the spot. Better "
                "move it back, or train on episodes of where it is now.",
                motion.describe(width, height),
            )
        return motion

    def grasps(
        self,
        full_resolution: Tensor,
        proposals: Tensor,
        templates: Tensor | None = None,
        novelty: Tensor | None = None,
        is_new_task: Tensor | None = None,
    ) -> Tensor:
        """Returns where the gripper closes on proposed objects, (batch, 2) in -1..1.

        Args:
            full_resolution: First images of episodes, (batch, 3, H, W), uint8 or in 0..1.
            proposals: A proposal in each, (batch, 2) in -1..1.
            templates: Surroundings of demonstrated grasps, (batch, demonstrations, 3, h, w); None without
                demonstrations. See `Described`.
            novelty: How likely each object is new, (batch,). See `novelty`.
            is_new_task: Whether each task is none of the training's, (batch,) bool; None if all are.
        """
        sizes = self.object_sizes(proposals)
        expected = self.refine(full_resolution, proposals, sizes)
        if templates is None or novelty is None:
            return expected
        # After few episodes, the network knows how trained objects are grasped in trained tasks alone.
        is_new_task = torch.ones_like(novelty, dtype=torch.bool) if is_new_task is None else is_new_task
        is_alike = (novelty > _NOVEL) | (self.has_few_episodes & is_new_task)
        if not bool(is_alike.any()):
            return expected
        alike = self.refine(full_resolution, proposals, sizes, templates)
        return torch.where(is_alike[:, None], alike, expected)

    def find_places(
        self,
        scenes: Tensor,
        first_images: Tensor,
        grasps: Tensor,
        releases: Tensor,
        reaches: Sequence[float],
    ) -> list[Tensor]:
        """Finds where demonstrated places are now, (batch, 2) in -1..1 for each reach.

        What stands where a demonstration released its object, in its first image, is looked for among the
        proposals in the scene, and where it stood then: it may not stand out, as whatever never moves.

        Args:
            scenes: First images of episodes at full resolution, (batch, 3, H, W), uint8 or in 0..1.
            first_images: Those of the demonstrations, (batch, 3, H', W').
            grasps: Where they grasped, (batch, 2) in -1..1; NaN where that is not known.
            releases: Where they released, (batch, 2).
            reaches: How far from a release what stands at the place may be, in `grasp_radius`. With 0, places
                never move.
        """
        if not any(reaches):
            return [releases] * len(reaches)
        rows = torch.arange(len(scenes), device=scenes.device)
        shown, proposed = self.background(first_images), self.background(scenes)
        is_grasped = (shown - grasps[:, None]).norm(dim=2) < self.grasp_radius
        shown = shown.masked_fill(is_grasped[..., None], torch.nan)
        features = self.compare.inputs(self.features(scenes, proposed))

        def find(reach: float) -> Tensor:
            nearest, is_near = nearest_proposals(shown, releases, reach * self.grasp_radius)
            at = torch.where(is_near[:, None], shown[rows, nearest], releases)
            stays = self.compare.inputs(self.features(scenes, at[:, None]))
            demonstrated = self.compare.inputs(self.features(first_images, at[:, None]))
            cosines = F.cosine_similarity(torch.cat([features, stays], dim=1), demonstrated, dim=2)
            candidates = torch.cat([proposed, at[:, None]], dim=1)
            cosines = cosines.masked_fill(candidates[..., 0].isnan(), -1)
            # Where nothing stands out, or where it looks as it did, the place has not moved.
            best, chosen = cosines.max(dim=1)
            has_moved = is_near & (cosines[:, -1] < best - self.settings.moved_place)
            chosen = torch.where(has_moved, chosen, candidates.shape[1] - 1)
            found = candidates[rows, chosen]
            scale = self.object_sizes(found) / self.object_sizes(at)
            return (found + scale[:, None] * (releases - at)).clamp(-1, 1)

        return [find(reach) if reach else releases for reach in reaches]

    def novelty(self, instructions: Sequence[str]) -> Tensor:
        """Returns how likely demonstrated objects are new to the training, (batch,) in 0..1.

        They are new if an unknown word describes them or, without an instruction, after few training
        episodes.
        """
        words = encode_words(instructions, self.vocabulary).to(self.fitted.device)
        of_few = self.has_few_episodes.to(self.sharpness)
        is_empty = torch.tensor([not text for text in instructions], device=self.fitted.device)
        return torch.where(is_empty, of_few, self._p_unknown(words))

    @property
    def has_few_episodes(self) -> Tensor:
        """Whether demonstrations are better guides than what was learned from so few episodes, () bool."""
        return self.n_episodes <= self.settings.few_episodes

    @property
    def report(self) -> str:
        """How often the object was found in held-out episodes."""
        n_right, n_all = self.held_out.tolist()
        if not n_all:
            return "too few episodes to hold some out"
        found = f"object found in {n_right} of {n_all} held-out episodes"
        if not bool(self.refine.is_used):
            return found
        before, after = (50 * self.refine.errors).tolist()
        return f"grasps located to {after:.1f} % of the image's side (proposals: {before:.1f} %), {found}"

    @property
    def grasp_radius(self) -> float:
        """Distance from a grasp within which a proposal stands for the grasped object, in -1..1."""
        return self.settings.grasp_error + self.settings.grasp_size * float(self.background.object_size)

    @torch.no_grad()
    def describe(self, ends: Tensor, full_resolution: Tensor, grasps: Tensor, attended: Tensor) -> Described:
        """Describes what was grasped in demonstrations.

        An object that was pushed before it was grasped, as by an attempt that failed, is no longer where it
        was in the first image: no proposal is near the grasp. The attention then tells where it was.

        Args:
            ends: First and last images, (batch, 2, 3, H, W) in 0..1, as small as the policy's.
            full_resolution: The first images at full resolution, (batch, 3, H', W').
            grasps: Locations of the grasps, (batch, 2) in -1..1; NaN where they are not known.
            attended: Locations of what moved, by the attention, (batch, 2) in -1..1.
        """
        with torch.autocast(ends.device.type, enabled=False):
            centers, is_near = self.demonstrated(ends, full_resolution, grasps, attended)
            features = self.features(full_resolution, centers[:, None])
            shown = torch.where(is_near[:, None], grasps, torch.nan)
            templates = None
            if bool(self.refine.uses_templates):
                templates = cut_templates(full_resolution, shown, self.object_sizes(grasps))
            return Described(centers, self.compare(features).descriptors[:, 0], templates)

    def demonstrated(
        self, ends: Tensor, full_resolution: Tensor, grasps: Tensor, attended: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Finds what was grasped in demonstrations. See `describe` for the arguments.

        Returns:
            The centers of the objects, (batch, 2) in -1..1, and whether the grasp was there, (batch,) bool.
        """
        masks = self.background.masks(full_resolution)
        proposed = self.background.objects(masks, full_resolution)
        changed = self.background.objects(masks * changed_areas(ends), full_resolution)
        usual_error = float(self.refine.errors[0])
        return demonstrated_centers(proposed, changed, grasps, attended, self.grasp_radius, usual_error)

    @torch.no_grad()
    def understood(self, instruction: str) -> list[tuple[str, str]]:
        """Returns the words of an instruction that describe the object, and what each is understood as."""
        words = encode_words([instruction], self.vocabulary).to(self.fitted.device)
        meanings = zip(words_of(instruction), understand(instruction, self.vocabulary), strict=True)
        weights = self.word_weights(words)[0].tolist()
        return [
            (word, meant)
            for (word, meant), weight in zip(meanings, weights, strict=False)
            if meant is not None and weight > self.settings.shown_word_weight
        ]

    def features(self, images: Tensor, locations: Tensor, sizes: Tensor | None = None) -> Tensor:
        """Returns features of crops, (batch, n, features).

        Args:
            images: Images at full resolution, (batch, 3, H, W), uint8 or in 0..1.
            locations: Centers of the crops, (batch, n, 2) in -1..1.
            sizes: Sides of the crops as fractions of the image's, (batch, n); by default, diameters of
                objects there.
        """
        return self.encoder(images, locations, self.object_sizes(locations) if sizes is None else sizes)

    def object_sizes(self, locations: Tensor) -> Tensor:
        """Returns the diameters of objects at locations (..., 2), as fractions of the image's side."""
        # Not as a product of matrices, which autocast would round.
        return self.background.object_size * (locations * self.background.perspective).sum(dim=-1).exp()


def other_episodes(tasks: Sequence[str]) -> Tensor:
    """Returns the row of the next episode of the same task, (episodes,); its own if there is none."""
    of_task: dict[str, list[int]] = {}
    for row, task in enumerate(tasks):
        of_task.setdefault(task, []).append(row)
    others = torch.arange(len(tasks))
    for rows in of_task.values():
        others[rows] = torch.tensor(rows).roll(-1)
    return others
