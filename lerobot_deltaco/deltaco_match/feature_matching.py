r"""Feature matching: finds the object that a task asks for with features learned on ImageNet.

A network that learns from a few hundred objects compares them by color: among objects of one color, it picks
nearly at random. The features of a network that was trained on photographs tell shapes apart, too. They are
frozen; small networks on top of them learn which features to compare. `fit` trains these before the policy.

    demonstration's first image     scene                     instruction
            |                         |                            |
        encoder (frozen) <-------> encoder (frozen)          words it has
            |                         |        \                   |
    compared features <- same -> compared   compared        sum of the words' descriptors
            |                         |           |                |
    descriptor of what was grasped    |           |                |
            |________ cosine _________|           |____ cosine ____|
                        |                                 |
                by the demonstration                 by the words
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.efficientnet_lite import IMAGENET_MEAN, IMAGENET_STD, EfficientNetLite0
from lerobot_deltaco.losses import location_loss
from lerobot_deltaco.networks import gaussian_maps

# Blocks of the encoder whose maps are used: of stride 8 and 40 channels, of stride 16 and 80.
_FINE_BLOCKS, _FINE_STRIDE, _FINE_CHANNELS = 5, 8, 40
_COARSE_BLOCKS, _COARSE_STRIDE, _COARSE_CHANNELS = 7, 16, 80
_DESCRIPTOR_DIM, _HIDDEN_DIM = 64, 128
_POOLING_STD = 1.2  # of the cells around a grasp that describe what was grasped
_MIN_STD = 1e-3
# Cells per side of the maps. The encoder's work and the memory of a fit grow with its square.
_MAX_CELLS = 24
_WORD_WEIGHT = 3.0  # of the words' log probabilities; chosen on validation tasks
# Of the fit; chosen on validation tasks.
FIT_STEPS = 2000
_MAX_EPISODES = 10_000
_PAIRS_PER_STEP = 32
_LEARNING_RATE, _WARMUP_FRACTION, _WEIGHT_DECAY = 2e-3, 0.1, 0.2
_P_DROP_WORD = 0.3
_WORD_STD = 0.1  # of the words' descriptors before the fit
_ENCODED_AT_A_TIME = 32
_N_FOR_STATISTICS = 256  # images whose maps give the channels' means and standard deviations


class BagOfWords(NamedTuple):
    """A bag-of-words encoding over the training vocabulary.

    Attributes:
        present: Which words of the vocabulary each instruction has, (instructions, words) float: 0 or 1.
        is_known: Whether an instruction has words, and no others, (instructions,) bool.
    """

    present: Tensor
    is_known: Tensor


class FeatureMaps(NamedTuple):
    """Maps of images, of the size (h, w): a quarter of their sides, at most 24.

    Attributes:
        fine: (batch, 40, h, w).
        coarse: (batch, 80, h, w), of images of twice the size.
    """

    fine: Tensor
    coarse: Tensor

    def rows(self, rows: Tensor) -> FeatureMaps:
        """Returns the maps of some of the images."""
        return FeatureMaps(self.fine[rows], self.coarse[rows])


class FeatureMatching(nn.Module):
    """Finds what a demonstration moved, or what words name, in scenes.

    It receives no gradient while a policy is trained.

    Args:
        n_words: Size of the vocabulary, 0 for a policy without instructions.

    Attributes:
        fitted: Whether it has been fitted, () bool.
    """

    fitted: Tensor
    image_mean: Tensor
    image_std: Tensor

    def __init__(self, n_words: int = 0) -> None:
        super().__init__()
        self.encoder = EfficientNetLite0(_COARSE_BLOCKS)
        self.by_demonstration = ComparedFeatures()
        self.by_words = ComparedFeatures() if n_words else None
        if n_words:
            # With a bias, which belongs to no word.
            self.words = nn.Parameter(torch.zeros(n_words + 1, _DESCRIPTOR_DIM))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        self.register_buffer("image_mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("image_std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        for name, channels in (("fine", _FINE_CHANNELS), ("coarse", _COARSE_CHANNELS)):
            self.register_buffer(f"{name}_mean", torch.zeros(channels, 1, 1))
            self.register_buffer(f"{name}_std", torch.ones(channels, 1, 1))
        self.requires_grad_(False)

    def pick_map(
        self,
        pick: Tensor,
        scenes: Tensor,
        ends: Tensor | None,
        locations: Tensor | None,
        words: BagOfWords | None,
    ) -> Tensor:
        """Multiplies a pick map by the maps found from the demonstrations and from the words.

        Words outside the vocabulary are ignored. With a demonstration, an instruction with such words is
        ignored altogether, since its remaining words may fit other objects as well.

        Args:
            pick: Pick map of the correspondence network, as logits (batch, h, w).
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            ends: First and last images of demonstrations, (batch, demonstrations, 2, 3, H, W) in 0..1; None
                without them.
            locations: Locations of their grasps, (batch, demonstrations, 2) in -1..1.
            words: Words of the instructions; None without instructions.

        Returns:
            Logits, (batch, h, w).
        """
        total, shape = log_probabilities(pick), pick.shape[1:]
        with torch.autocast(scenes.device.type, enabled=False):  # it was fitted in float32
            maps = self._normalized(self._encode(scenes))
            if ends is not None:
                assert locations is not None
                first = self._normalized(self._encode(ends[:, :, 0].flatten(0, 1)))
                each = F.normalize(self._describe(first, locations.flatten(0, 1)), dim=1)
                descriptors = each.unflatten(0, (-1, ends.shape[1])).mean(dim=1)
                found = self.by_demonstration.similarity(self.by_demonstration(maps), descriptors)
                total = total + log_probabilities(_resized(found, shape))
            if words is not None and self.by_words is not None:
                found = self._find_by_words(maps, words.present)
                counts = words.present.any(dim=1) & (words.is_known | (ends is None))
                named = _WORD_WEIGHT * log_probabilities(_resized(found, shape))
                total = total + torch.where(counts[:, None, None], named, 0.0)
        return total

    def fit(
        self,
        images: Tensor,
        locations: Tensor,
        tasks: Sequence[str],
        present: Tensor | None,
        seed: int,
        steps: int = FIT_STEPS,
    ) -> None:
        """Fits the compared features and the words to episodes.

        The networks learn to find the object grasped in one episode of a task in the scene of another, and
        from the words of the task. Some words are left out at random in each step, so that none is
        indispensable.

        Args:
            images: First images of episodes, (episodes, 3, H, W) uint8.
            locations: Locations of their grasps, (episodes, 2) in -1..1; NaN where there is none.
            tasks: Task of each episode.
            present: Which words of the vocabulary each task has, (episodes, words); None without words.
            seed: Seed of the initial weights and of the draws.
            steps: Number of training steps.

        Raises:
            ValueError: No task has two episodes with a grasp.
            PretrainedWeightsError: The encoder's weights are missing.
        """
        self.encoder.load_imagenet_weights()
        generator, device = torch.Generator().manual_seed(seed), images.device
        grasps = (~locations.isnan().any(dim=1)).nonzero().flatten().cpu()
        drawn = grasps[torch.randperm(len(grasps), generator=generator)[:_MAX_EPISODES]].sort().values
        pairs = _Pairs([tasks[row] for row in drawn.tolist()])
        images, locations = images[drawn.to(device)], locations[drawn.to(device)]
        present = None if present is None else present[drawn.to(device)]
        with torch.enable_grad(), torch.autocast(device.type, enabled=False):
            maps = self._encode_all(images)
            self._set_statistics(maps)
            self._initialize(generator)
            frozen = {id(weights) for weights in self.encoder.parameters()}
            learned = [weights for weights in self.parameters() if id(weights) not in frozen]
            for weights in learned:
                weights.requires_grad_(True)
            optimizer = torch.optim.AdamW(learned, lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
            schedule = torch.optim.lr_scheduler.OneCycleLR(
                optimizer, _LEARNING_RATE, steps, pct_start=_WARMUP_FRACTION
            )
            for _ in tqdm(range(steps), desc="Fitting the feature matching", unit="step", leave=False):
                scenes, others = (rows.to(device) for rows in pairs.draw(_PAIRS_PER_STEP, generator))
                here, scene_maps = locations[scenes][:, None], self._normalized(maps.rows(scenes))
                descriptors = self._describe(self._normalized(maps.rows(others)), locations[others])
                found = self.by_demonstration.similarity(self.by_demonstration(scene_maps), descriptors)
                loss = location_loss(found[:, None], here).mean()
                if present is not None:
                    kept = torch.rand(_PAIRS_PER_STEP, present.shape[1], generator=generator) >= _P_DROP_WORD
                    found = self._find_by_words(scene_maps, present[scenes] * kept.to(present))
                    loss = loss + location_loss(found[:, None], here).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
            for weights in learned:
                weights.requires_grad_(False)
                weights.grad = None
            if present is not None:
                self.words[:-1][~present.any(dim=0)] = 0  # words of no episode say nothing
        self.fitted.fill_(True)

    def _encode(self, images: Tensor) -> FeatureMaps:
        """Returns maps of images (batch, 3, H, W) in 0..1, after scaling them to the encoder's strides."""
        size = [min(_MAX_CELLS, max(1, side // 4)) for side in images.shape[-2:]]

        def scaled(stride: int) -> Tensor:
            sides = [stride * cells for cells in size]
            is_smaller = any(new < old for new, old in zip(sides, images.shape[-2:], strict=True))
            resized = F.interpolate(
                images.float(), size=sides, mode="bicubic", align_corners=False, antialias=is_smaller
            )
            return (resized.clamp(0, 1) - self.image_mean) / self.image_std

        return FeatureMaps(
            self.encoder(scaled(_FINE_STRIDE), _FINE_BLOCKS),
            self.encoder(scaled(_COARSE_STRIDE), _COARSE_BLOCKS),
        )

    def _encode_all(self, images: Tensor) -> FeatureMaps:
        """Returns maps of images (n, 3, H, W) uint8, not normalized, in float16."""
        found: FeatureMaps | None = None
        with tqdm(total=len(images), desc="Encoding scenes", unit="image", leave=False) as progress:
            for first in range(0, len(images), _ENCODED_AT_A_TIME):
                some = images[first : first + _ENCODED_AT_A_TIME]
                maps = self._encode(some.float() / 255)
                if found is None:
                    # At once, since there is no room for two copies of many large maps.
                    found = FeatureMaps(
                        *(kind.new_empty(len(images), *kind.shape[1:], dtype=torch.half) for kind in maps)
                    )
                for all_maps, kind in zip(found, maps, strict=True):
                    all_maps[first : first + len(some)] = kind
                progress.update(len(some))
        assert found is not None
        return found

    @torch.no_grad()
    def _set_statistics(self, maps: FeatureMaps) -> None:
        """Sets the means and standard deviations of the channels to those of some of the maps."""
        n_maps = len(maps.fine)
        rows = torch.arange(0, n_maps, math.ceil(n_maps / _N_FOR_STATISTICS), device=maps.fine.device)
        for name, kind in zip(("fine", "coarse"), maps.rows(rows), strict=True):
            values = kind.float().transpose(0, 1).flatten(1)  # (channels, images * cells)
            self.get_buffer(f"{name}_mean").copy_(values.mean(dim=1)[:, None, None])
            self.get_buffer(f"{name}_std").copy_(values.std(dim=1).clamp_min(_MIN_STD)[:, None, None])

    @torch.no_grad()
    def _initialize(self, generator: torch.Generator) -> None:
        """Draws initial weights as PyTorch's layers do, but from a generator."""
        for network in (self.by_demonstration, self.by_words):
            for layer in [] if network is None else network.modules():
                if isinstance(layer, nn.Conv2d):
                    bound = layer.weight[0].numel() ** -0.5
                    for weights in layer.parameters():
                        weights.copy_(bound * (2 * torch.rand(weights.shape, generator=generator) - 1))
        if self.by_words is not None:
            self.words.copy_(_WORD_STD * torch.randn(self.words.shape, generator=generator))
            self.words[-1] = 0

    def _normalized(self, maps: FeatureMaps) -> FeatureMaps:
        """Returns maps with channels of mean 0 and standard deviation 1, in float32."""
        return FeatureMaps(
            (maps.fine.float() - self.get_buffer("fine_mean")) / self.get_buffer("fine_std"),
            (maps.coarse.float() - self.get_buffer("coarse_mean")) / self.get_buffer("coarse_std"),
        )

    def _describe(self, maps: FeatureMaps, locations: Tensor) -> Tensor:
        """Returns descriptors of what was grasped at locations (batch, 2), (batch, descriptor)."""
        features = self.by_demonstration(maps)
        height, width = features.shape[-2:]
        std = 2 * _POOLING_STD / torch.tensor([width, height], device=features.device)
        weights = gaussian_maps(locations[:, None], height, width, std)  # (batch, 1, h, w)
        weights = weights / weights.sum(dim=(2, 3), keepdim=True).clamp_min(1e-6)
        return (features * weights).sum(dim=(2, 3))

    def _find_by_words(self, maps: FeatureMaps, present: Tensor) -> Tensor:
        """Returns where scenes look like what words (batch, words) name, as logits (batch, h, w)."""
        assert self.by_words is not None
        descriptors = present @ self.words[:-1] + self.words[-1]
        return self.by_words.similarity(self.by_words(maps), descriptors)


class ComparedFeatures(nn.Module):
    """Features for comparing objects: a linear layer, and a small network that sees the surroundings.

    The network lets words find shapes. Finding demonstrated objects works as well without it.
    """

    def __init__(self) -> None:
        super().__init__()
        channels = _FINE_CHANNELS + _COARSE_CHANNELS
        self.linear = nn.Conv2d(channels, _DESCRIPTOR_DIM, 1)
        self.around = nn.Sequential(
            nn.Conv2d(channels, _HIDDEN_DIM, 1),
            nn.ReLU(),
            nn.Conv2d(_HIDDEN_DIM, _DESCRIPTOR_DIM, 3, padding=1),
        )
        self.log_scale = nn.Parameter(torch.tensor(math.log(10.0)))

    def forward(self, maps: FeatureMaps) -> Tensor:
        """Maps normalized maps (batch, channels, h, w) to features (batch, descriptor, 2 h, 2 w)."""
        both = torch.cat(maps, dim=1)
        features = self.linear(both) + self.around(both)
        return F.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)

    def similarity(self, features: Tensor, descriptors: Tensor) -> Tensor:
        """Returns the scaled cosine of features and descriptors (batch, descriptor), (batch, h, w)."""
        cosine = torch.einsum("bchw,bc->bhw", F.normalize(features, dim=1), F.normalize(descriptors, dim=1))
        return self.log_scale.exp() * cosine


class _Pairs:
    """Draws pairs of different episodes of a task.

    Args:
        tasks: Task of each episode; all have a grasp.

    Raises:
        ValueError: No task has two episodes with a grasp.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        rows: dict[str, list[int]] = {}
        for row, task in enumerate(tasks):
            rows.setdefault(task, []).append(row)
        self._rows = [torch.tensor(found) for found in rows.values() if len(found) > 1]
        if not self._rows:
            raise ValueError(
                "Feature matching needs tasks with at least two episodes in which the gripper closes on "
                f"an object. The {len(tasks)} such episodes are of {len(rows)} different tasks. Add "
                "episodes, or set --policy.feature_matching=false."
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


def log_probabilities(logits: Tensor) -> Tensor:
    """Returns the log probabilities of the cells of maps (batch, h, w), of the same shape."""
    return logits.flatten(1).log_softmax(dim=1).view_as(logits)


def words_of(sentence: str) -> frozenset[str]:
    """Returns the words of a sentence, in lower case, without digits and punctuation."""
    return frozenset(re.findall(r"[^\W\d_]+", sentence.lower()))


def vocabulary_of(sentences: Iterable[str]) -> list[str]:
    """Returns all words of sentences, in alphabetical order."""
    return sorted(frozenset[str]().union(*map(words_of, sentences)))


def bag_of_words(vocabulary: Sequence[str], instructions: Sequence[str]) -> BagOfWords:
    """Encodes instructions as bags of words.

    Args:
        vocabulary: Words.
        instructions: Instructions.
    """
    index = {word: n for n, word in enumerate(vocabulary)}
    present = torch.zeros(len(instructions), len(vocabulary))
    for row, instruction in enumerate(instructions):
        for word in words_of(instruction) & index.keys():
            present[row, index[word]] = 1
    is_known = torch.tensor([frozenset() < words_of(text) <= index.keys() for text in instructions])
    return BagOfWords(present, is_known.reshape(len(instructions)))


def _resized(logits: Tensor, shape: torch.Size) -> Tensor:
    """Returns maps (batch, h, w) at another height and width.

    They differ if an image's side is no multiple of 4, or so large that the encoder sees it scaled down.
    """
    if logits.shape[1:] == shape:
        return logits
    return F.interpolate(logits[:, None], size=tuple(shape), mode="bilinear", align_corners=False)[:, 0]
