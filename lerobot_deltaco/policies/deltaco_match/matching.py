r"""Feature matching: finds the object that a task asks for among the things that could be grasped.

    scene                          demonstration's first image          instruction
      |                                    |                                |
    proposals                       where it grasped                     words, weighed
      |                                    |                                |
    crops -> EfficientNet-Lite0       crop -> EfficientNet-Lite0            |
      |      (frozen), colors              |                                |
    descriptors -------- cosines ------ descriptors                         |
      |                    |                                                |
    log probability of each word of the vocabulary ------------------- those said
                           |                                                |
                           +------------ sum: score of a proposal ----------+

There are two descriptors. One tells whether a proposal is the very object that was demonstrated. The other
tells whether it is like it, as tasks by color or shape need, and counts as far as the first finds none.

The small networks behind the frozen encoder are fitted before the policy is trained, to the first images of
the training episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.networks import gaussian_maps
from lerobot_deltaco.policies.deltaco_match import proposals
from lerobot_deltaco.policies.deltaco_match.crops import (
    COLOR_DIM,
    FEATURE_DIM,
    crop_features,
    fit_perspective,
)
from lerobot_deltaco.policies.deltaco_match.grasp_height import GraspHeightEstimator
from lerobot_deltaco.policies.deltaco_match.proposals import ProposalNetwork
from lerobot_deltaco.policies.deltaco_match.words import (
    UNKNOWN_WORD,
    WordWeights,
    encode_words,
    understand,
    words_of,
)

_DESCRIPTOR_DIM, _HIDDEN_DIM = 64, 256
_MIN_STD, _MAX_FEATURE, _MIN_PROBABILITY = 1e-3, 6.0, 1e-9
# Probability that a demonstration shows another object than the one that the words describe, if all of them
# are known and no proposal is the very object; and how much more similarities count than in the fit, where
# dropout disturbs them. Chosen on folds of the training objects, as are the settings of the fit.
_P_OTHER_OBJECT, _SHARPNESS = 0.5, 1.5
# Probability that words describe another object than is meant: people see other colors and shapes in it.
_P_MISDESCRIBED = 0.1
_COLOR_WEIGHT = 2.0  # of colors among the features
_INITIAL_GATE = (8.0, -5.0)  # slope and offset of the logit that a proposal is the very object, by its cosine
# Of the fit.
_MIN_STEPS, _MAX_STEPS = 400, 1500  # of the comparison
_DRAWS = 16  # of each scene, as far as these bounds allow
MAX_EPISODES = 10_000
_SCENES_PER_STEP = 64
_LEARNING_RATE, _WORD_LEARNING_RATE, _WEIGHT_DECAY, _WARMUP_FRACTION = 1e-3, 3e-3, 0.2, 0.1
_P_DROP_WORD = 0.3
_WORD_PENALTY = 0.03  # of each word's weight
_COUNTS = 0.5  # weight from which on a word is shown as one that describes the object
_MAP_STD = 0.8  # of a candidate, in cells
_ENCODED_AT_A_TIME, _NORMALIZED_AT_A_TIME = 16, 256


class Candidates(NamedTuple):
    """What could be picked.

    Attributes:
        locations: The proposals, (batch, n, 2) in -1..1.
        log_probabilities: How likely each is what the task asks for, (batch, n).
        heights: Height offset of a grasp of each, (batch, n).
    """

    locations: Tensor
    log_probabilities: Tensor
    heights: Tensor

    @property
    def best(self) -> tuple[Tensor, Tensor, Tensor]:
        """Location (batch, 2), probability (batch,) and height offset (batch,) of the likeliest."""
        log_p, best = self.log_probabilities.max(dim=1)
        rows = torch.arange(len(best), device=best.device)
        return self.locations[rows, best], log_p.exp(), self.heights[rows, best]

    def map(self, shape: Sequence[int]) -> Tensor:
        """Returns the candidates as maps of a shape (h, w), as logits (batch, h, w)."""
        height, width = shape
        std = 2 * _MAP_STD / torch.tensor([width, height], device=self.locations.device)
        each = gaussian_maps(self.locations, height, width, std)
        return (self.log_probabilities.exp()[..., None, None] * each).sum(dim=1).clamp_min(1e-9).log()


class FeatureMatching(nn.Module):
    """Finds what demonstrations moved, and what words describe, in scenes.

    It stays in evaluation mode, and receives no gradient while a policy is trained.

    Args:
        vocabulary: Known words.
        crop_size: Side of a crop in the middle of an image, as a fraction of the image's.

    Attributes:
        perspective: How the log of the size of things changes along x and y in the image, (2,).
        fitted: Whether it has been fitted, () bool.
    """

    perspective: Tensor
    fitted: Tensor

    def __init__(self, vocabulary: Sequence[str], crop_size: float) -> None:
        super().__init__()
        self.vocabulary, self.crop_size = list(vocabulary), crop_size
        self.propose = ProposalNetwork()
        self.compare = Comparison(len(vocabulary))
        self.word_weights = WordWeights(len(vocabulary))
        self.grasp_height = GraspHeightEstimator(_HIDDEN_DIM)
        self.register_buffer("perspective", torch.zeros(2))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> FeatureMatching:
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def find(
        self,
        scenes: Tensor,
        native: Tensor,
        instructions: Sequence[str],
        described: Tensor | None,
        demonstrated: Tensor | None,
    ) -> Candidates:
        """Finds what tasks ask for.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1, as small as the policy's.
            native: The same at the camera's own resolution, (batch, 3, H', W').
            instructions: Instruction of each sample, "" for none.
            described: Descriptors of the demonstrated objects, (batch, descriptor); None without
                demonstrations.
            demonstrated: Height offsets of the demonstrated grasps, (batch,), NaN where they are not known;
                None without demonstrations.
        """
        with torch.autocast(scenes.device.type, enabled=False):  # as exact for one scene as for many
            locations = self.propose(scenes)
            crops = self.compare(self._features(native, locations))
            said = encode_words(instructions, self.vocabulary).to(scenes.device)
            weights = self.word_weights(said)
            scores = _word_scores(crops.words, said, weights)
            matches = similarity = torch.zeros_like(scores)
            if described is None or demonstrated is None:
                demonstrated = torch.full_like(scores[:, 0], torch.nan)
            else:
                # How well known words describe the object. A new noun leaves the demonstration in charge.
                p_unknown = (weights * (said == UNKNOWN_WORD)).amax(dim=1)
                p_described = (1 - p_unknown) * (weights * (said > UNKNOWN_WORD)).amax(dim=1)
                matches, similarity = self.compare.match(
                    crops, described, _SHARPNESS, _P_OTHER_OBJECT * p_described
                )
                scores = (1 - p_unknown)[:, None] * scores
            by_words = (1 - _P_MISDESCRIBED) * scores.softmax(dim=1) + _P_MISDESCRIBED / scores.shape[1]
            scores = matches + by_words.log()
            heights = self.grasp_height(crops.hidden, similarity, demonstrated[:, None])
            return Candidates(locations, scores.log_softmax(dim=1), heights)

    @torch.no_grad()
    def understood(self, instruction: str) -> list[tuple[str, str]]:
        """Returns the words of an instruction that describe the object, and what each is understood as."""
        said = encode_words([instruction], self.vocabulary).to(self.fitted.device)
        meanings = zip(words_of(instruction), understand(instruction, self.vocabulary), strict=True)
        weights = self.word_weights(said)[0].tolist()
        return [
            (word, meant)
            for (word, meant), weight in zip(meanings, weights, strict=False)
            if meant is not None and weight > _COUNTS
        ]

    @torch.no_grad()
    def describe(self, images: Tensor, native: Tensor, grasps: Tensor, attended: Tensor) -> Tensor:
        """Returns descriptors of what was grasped in demonstrations, (batch, descriptor).

        An object that was pushed before it was grasped, as by an attempt that failed, is no longer where it
        was in the first image: no proposal is near the grasp. The attention then tells where it was.

        Args:
            images: First images, (batch, 3, H, W) in 0..1, as small as the policy's.
            native: The same at the camera's own resolution, (batch, 3, H', W').
            grasps: Locations of the grasps, (batch, 2) in -1..1; NaN where they are not known.
            attended: Locations of what moved, by the attention, (batch, 2) in -1..1.
        """
        with torch.autocast(images.device.type, enabled=False):
            proposed = self.propose(images)
            by_grasp, is_near = _nearest(proposed, grasps)
            by_attention, is_attended = _nearest(proposed, attended)
            nearest = torch.where(is_near, by_grasp, by_attention)
            # A gripper is not always above the middle of an object, but a proposal is.
            near = proposed[torch.arange(len(proposed), device=proposed.device), nearest]
            locations = torch.where((is_near | is_attended)[:, None], near, attended)
            return self.compare(self._features(native, locations[:, None])).descriptors[:, 0]

    def _features(self, native: Tensor, locations: Tensor) -> Tensor:
        """Returns features of the crops at locations (batch, n, 2), (batch, n, FEATURE_DIM)."""
        # Not as a product of matrices, which autocast would round.
        sizes = self.crop_size * (locations * self.perspective).sum(dim=-1).exp()
        return crop_features(native, locations, sizes)

    def fit(
        self,
        images: Tensor,
        last: Tensor,
        native: Tensor,
        locations: Tensor,
        heights: Tensor,
        tasks: Sequence[str],
        sentences: Mapping[str, Sequence[str]],
        seed: int,
        *,
        in_bfloat16: bool = False,
    ) -> None:
        """Fits the proposals, and then the comparison.

        The comparison learns to tell the object grasped in one episode of a task from the other proposals in
        the scene of another episode, by the demonstration and by words. Some words are left out at random in
        each step, so that none is indispensable.

        Args:
            images: First images of episodes, (episodes, 3, H, W) uint8, as small as the policy's.
            last: Last images of the same episodes.
            native: The first images at the camera's own resolution, (episodes, 3, H', W') uint8.
            locations: Locations of their grasps, (episodes, 2) in -1..1; NaN where there is none.
            heights: Height offsets of their grasps, (episodes,).
            tasks: Task of each episode.
            sentences: Instructions of each task, one of which is drawn for an episode in each step.
            seed: Seed of the initial weights and of the draws.
            in_bfloat16: Whether convolutions and linear layers compute in bfloat16, which takes half the time
                on a CPU that has it.

        Raises:
            UserError: No task has two episodes with a grasp, or no proposal is near a grasp.
            PretrainedWeightsError: The encoder's weights are missing.
        """
        generator, device = torch.Generator().manual_seed(seed), images.device
        # Without its cache, which would keep the weights of the first step: it is only emptied at the end of
        # the outermost context, here the one in which the policy is trained.
        autocast = torch.autocast(device.type, torch.bfloat16, enabled=in_bfloat16, cache_enabled=False)
        grasps = (~locations.isnan().any(dim=1)).nonzero().flatten().cpu()
        drawn = grasps[torch.randperm(len(grasps), generator=generator)[:MAX_EPISODES]].sort().values
        _Pairs([tasks[row] for row in drawn.tolist()])  # fails before the slow part
        steps = min(max(_MIN_STEPS, _DRAWS * len(drawn) // _SCENES_PER_STEP), _MAX_STEPS)
        with torch.random.fork_rng(devices=[]), torch.enable_grad():
            torch.manual_seed(seed)
            for layer in self.modules():
                if isinstance(layer, (nn.Conv2d, nn.Linear, nn.BatchNorm2d)):
                    layer.reset_parameters()
            self.requires_grad_(True)
            rows = grasps.to(device)
            self.perspective.copy_(fit_perspective(images[rows], last[rows], locations[rows]))
            rows = drawn.to(device)
            self.propose.fit(images[rows], locations[rows], generator, autocast)
            features, target, kept = self._crops_of_proposals(images, native, locations, drawn, autocast)
            of_kept = [tasks[row] for row in kept.tolist()]
            heights = heights[kept.to(heights.device)]
            self._fit_comparison(features, target, heights, of_kept, sentences, generator, steps, autocast)
        self.requires_grad_(False)
        for weights in self.parameters():
            weights.grad = None
        self.eval()
        self.fitted.fill_(True)

    @torch.no_grad()
    def _crops_of_proposals(
        self, images: Tensor, native: Tensor, locations: Tensor, drawn: Tensor, autocast: torch.autocast
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns features of the proposals in scenes, which of them was grasped, and the scenes' rows.

        A scene in which no proposal is near the grasp is left out.
        """
        features, targets, kept = [], [], []
        with tqdm(total=len(drawn), desc="Encoding crops", unit="scene", leave=False) as progress:
            for some in drawn.split(_ENCODED_AT_A_TIME):
                rows = some.to(images.device)
                proposed = self.propose(images[rows].float() / 255)
                nearest, near = _nearest(proposed, locations[rows])
                if bool(near.any()):
                    of_some = native[rows[near].to(native.device)]
                    with autocast:
                        features.append(self._features(of_some, proposed[near]).half())
                    targets.append(nearest[near])
                    kept.append(some[near.cpu()])
                progress.update(len(some))
        if not kept:
            raise UserError(
                "Feature matching finds nothing to grasp in the first images where the gripper closes. Check "
                "that the first camera stands still and shows the objects, or name another with "
                "--policy.demo_camera."
            )
        return torch.cat(features), torch.cat(targets), torch.cat(kept)

    def _fit_comparison(
        self,
        features: Tensor,
        target: Tensor,
        heights: Tensor,
        tasks: Sequence[str],
        sentences: Mapping[str, Sequence[str]],
        generator: torch.Generator,
        steps: int,
        autocast: torch.autocast,
    ) -> None:
        pairs, device = _Pairs(tasks), features.device
        self.compare.set_statistics(features)
        for some in features.split(_NORMALIZED_AT_A_TIME):  # once and in place: they are large
            some.copy_(self.compare.inputs(some))
        said, spans = self._encoded_sentences(tasks, sentences, device)
        groups: list[dict[str, Any]] = [
            {"params": self.compare.parameters(), "lr": _LEARNING_RATE, "weight_decay": _WEIGHT_DECAY},
            {"params": self.grasp_height.parameters(), "lr": _LEARNING_RATE, "weight_decay": _WEIGHT_DECAY},
            {"params": self.word_weights.parameters(), "lr": _WORD_LEARNING_RATE, "weight_decay": 0.0},
        ]
        optimizer = torch.optim.AdamW(groups, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, [group["lr"] for group in groups], steps, pct_start=_WARMUP_FRACTION
        )
        for _ in tqdm(range(steps), desc="Fitting the comparison", unit="step", leave=False):
            scenes, others = (rows.to(device) for rows in pairs.draw(_SCENES_PER_STEP, generator))
            crops = torch.cat([features[scenes], features[others, target[others]][:, None]], dim=1).float()
            with autocast:
                described = self.compare.describe(crops, generator)
            matches, _ = self.compare.match(described.among(slice(-1)), described.descriptors[:, -1])
            loss = F.nll_loss(matches, target[scenes])
            draws = torch.rand(len(scenes), generator=generator)
            drawn = (spans[scenes.cpu(), 0] + draws * spans[scenes.cpu(), 1]).long()
            dropped = torch.rand(len(scenes), said.shape[1], generator=generator) < _P_DROP_WORD
            sentence = said[drawn.to(device)]
            left = torch.where(dropped.to(device) & (sentence > 0), UNKNOWN_WORD, sentence)
            loss = loss + self._word_losses(described.words[:, :-1], left, sentence, target[scenes])
            rows = torch.arange(len(scenes), device=device)
            with torch.no_grad():  # as similar as they are without dropout
                both = torch.stack([crops[rows, target[scenes]], crops[:, -1]], dim=1)
                with autocast:
                    plain = self.compare.describe(both)
                _, similarity = self.compare.match(plain.among(slice(1)), plain.descriptors[:, 1])
            height_losses = self.grasp_height.losses(
                described.hidden[rows, target[scenes]],
                similarity[:, 0],
                heights[others],
                heights[scenes],
            )
            loss = loss + height_losses.mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()

    def _word_losses(self, words: Tensor, said: Tensor, sentence: Tensor, target: Tensor) -> Tensor:
        """Returns the losses of choosing a proposal by words, of naming what was grasped, and of the weights.

        Args:
            words: Log probabilities of the vocabulary for each proposal, (batch, n, vocabulary).
            said: Indices of the words, of which some are left out, (batch, length).
            sentence: The same with all words.
            target: The right proposal, (batch,).
        """
        weights = self.word_weights(said)
        loss = F.cross_entropy(_word_scores(words, said, weights), target)
        named = words[torch.arange(len(words)), target]  # (batch, vocabulary)
        known_weights = weights.detach() * (said > UNKNOWN_WORD)
        log_probabilities = named.gather(1, (said - UNKNOWN_WORD - 1).clamp_min(0))
        naming = -(known_weights * log_probabilities).sum(dim=1) / known_weights.sum(dim=1).clamp_min(1e-6)
        # Words that tell nothing would only add noise.
        penalty = _WORD_PENALTY * (weights * (said > UNKNOWN_WORD)).sum(dim=1).mean()
        # What an unknown word is about follows from its neighbors.
        unknown = (self.word_weights(sentence).detach() - weights).square() * (said == UNKNOWN_WORD)
        return loss + naming.mean() + penalty + unknown.sum(dim=1).mean()

    def _encoded_sentences(
        self, tasks: Sequence[str], sentences: Mapping[str, Sequence[str]], device: torch.device
    ) -> tuple[Tensor, Tensor]:
        """Returns the words of all sentences, and the first row and the number of those of each episode."""
        spans: dict[str, tuple[int, int]] = {}
        every: list[str] = []
        for task in dict.fromkeys(tasks):
            spans[task] = (len(every), len(sentences[task]))
            every.extend(sentences[task])
        return encode_words(every, self.vocabulary).to(device), torch.tensor([spans[task] for task in tasks])


class Crops(NamedTuple):
    """Descriptions of crops.

    Attributes:
        descriptors: Two unit vectors one after the other: which object it is, and what it is like,
            (batch, n, 2 descriptor).
        words: Log probabilities of the words of the vocabulary, (batch, n, words).
        hidden: Features of a crop's appearance, (batch, n, hidden).
    """

    descriptors: Tensor
    words: Tensor
    hidden: Tensor

    def among(self, chosen: slice) -> Crops:
        """Returns some of the crops of each sample."""
        return Crops(*(part[:, chosen] for part in self))


class Comparison(nn.Module):
    """Maps features of crops to descriptors, and to log probabilities of words.

    Args:
        n_words: Size of the vocabulary.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, n_words: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURE_DIM))
        self.register_buffer("std", torch.ones(FEATURE_DIM))
        self.hidden = nn.Linear(FEATURE_DIM, _HIDDEN_DIM)
        self.linear = nn.Linear(FEATURE_DIM, 2 * _DESCRIPTOR_DIM)
        self.from_hidden = nn.Linear(_HIDDEN_DIM, 2 * _DESCRIPTOR_DIM)
        self.words = nn.Linear(_HIDDEN_DIM, n_words)
        self.log_scale = nn.Parameter(torch.full((2,), math.log(10.0)))
        self.gate = nn.Parameter(torch.tensor(_INITIAL_GATE))

    def set_statistics(self, features: Tensor) -> None:
        """Sets the mean and the standard deviation of features (scenes, n, FEATURE_DIM)."""
        some = features[:: max(1, len(features) // 1000)].flatten(0, 1).float()
        self.mean.copy_(some.mean(dim=0))
        self.std.copy_(some.std(dim=0).clamp_min(_MIN_STD))

    def forward(self, features: Tensor) -> Crops:
        """Describes crops by their features (batch, n, FEATURE_DIM)."""
        return self.describe(self.inputs(features))

    def inputs(self, features: Tensor) -> Tensor:
        """Normalizes features, (batch, n, FEATURE_DIM)."""
        inputs = ((features.float() - self.mean) / self.std).clamp(-_MAX_FEATURE, _MAX_FEATURE)
        return torch.cat([inputs[..., :-COLOR_DIM], _COLOR_WEIGHT * inputs[..., -COLOR_DIM:]], dim=-1)

    def describe(self, inputs: Tensor, generator: torch.Generator | None = None) -> Crops:
        """Describes crops.

        Args:
            inputs: Normalized features, (batch, n, FEATURE_DIM).
            generator: Source of dropout's draws, on the CPU; None for no dropout.
        """
        inputs = _dropout(inputs, generator)
        hidden = _dropout(F.relu(self.hidden(inputs)), generator)
        descriptors = self.linear(inputs) + self.from_hidden(hidden)
        words = self.words(hidden).float().log_softmax(dim=-1)
        return Crops(_unit(descriptors.float()), words, hidden.float())

    def match(
        self,
        crops: Crops,
        described: Tensor,
        sharpness: float = 1.0,
        p_other: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compares crops with what was demonstrated.

        Args:
            crops: The proposals.
            described: Descriptors of the demonstrated objects, (batch, 2 descriptor).
            sharpness: Factor of the similarities.
            p_other: Probability that a demonstration shows another object, if none is the very one, (batch,).

        Returns:
            Log probabilities that the proposals are meant, and cosines of the first descriptors, (batch, n).
        """
        each, wanted = crops.descriptors.unflatten(-1, (2, -1)), _unit(described).unflatten(-1, (2, -1))
        cosines = torch.einsum("bnkd,bkd->kbn", each, wanted)
        is_same, is_alike = (
            (sharpness * self.log_scale.exp()[:, None, None] * cosines).softmax(dim=2).unbind()
        )
        if p_other is not None:
            is_alike = (1 - p_other)[:, None] * is_alike + p_other[:, None] / is_alike.shape[1]
        # Whether any proposal is the very object.
        p_same = torch.sigmoid(self.gate[0] * cosines[0].amax(dim=1, keepdim=True) + self.gate[1])
        probabilities = p_same * is_same + (1 - p_same) * is_alike
        return probabilities.clamp_min(_MIN_PROBABILITY).log(), cosines[0]


def _unit(descriptors: Tensor) -> Tensor:
    """Scales both descriptors (..., 2 descriptor) to unit length."""
    return F.normalize(descriptors.unflatten(-1, (2, -1)), dim=-1).flatten(-2)


def _word_scores(words: Tensor, said: Tensor, weights: Tensor) -> Tensor:
    """Returns weighed sums of the log probabilities of the words said, (batch, n).

    Args:
        words: Log probabilities of the vocabulary, (batch, n, vocabulary).
        said: Indices of the words said, (batch, length).
        weights: Their weights, (batch, length).
    """
    index = (said - UNKNOWN_WORD - 1).clamp_min(0)[:, None].expand(-1, words.shape[1], -1)
    known_weights = weights * (said > UNKNOWN_WORD)
    return (words.gather(2, index) * known_weights[:, None]).sum(dim=2)


def _nearest(proposed: Tensor, locations: Tensor) -> tuple[Tensor, Tensor]:
    """Returns which proposal is nearest to locations (batch, 2), and whether it is near, (batch,) each."""
    distance, nearest = (proposed - locations[:, None]).norm(dim=2).min(dim=1)
    return nearest, distance < proposals.GRASP_RADIUS


def _dropout(values: Tensor, generator: torch.Generator | None) -> Tensor:
    """Sets half of the values to 0 and doubles the others; without a generator, returns them unchanged."""
    if generator is None:
        return values
    # One bit of a random byte for each value: eight bytes are drawn at once.
    draws = torch.empty(-(-values.numel() // 8), dtype=torch.int64).random_(generator=generator)
    kept = draws.view(torch.uint8)[: values.numel()].view(values.shape) & 1
    return values * kept.to(values).mul_(2)


class _Pairs:
    """Draws pairs of different episodes of a task.

    Args:
        tasks: Task of each episode; all have a grasp.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        rows: dict[str, list[int]] = {}
        for row, task in enumerate(tasks):
            rows.setdefault(task, []).append(row)
        self._rows = [torch.tensor(own) for own in rows.values() if len(own) > 1]
        if not self._rows:
            raise UserError(
                "Feature matching needs tasks with at least two episodes in which the gripper closes on "
                f"an object. The {len(tasks)} such episodes are of {len(rows)} different tasks. Add episodes."
            )

    def draw(self, n_pairs: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draws rows of scenes and demonstrations, (n_pairs,) each, of tasks that are equally likely."""
        scenes, demonstrations = [], []
        for task in torch.randint(len(self._rows), (n_pairs,), generator=generator).tolist():
            rows = self._rows[task]
            first = int(torch.randint(len(rows), (), generator=generator))
            further = int(torch.randint(1, len(rows), (), generator=generator))
            scenes.append(rows[first])
            demonstrations.append(rows[(first + further) % len(rows)])
        return torch.stack(scenes), torch.stack(demonstrations)
