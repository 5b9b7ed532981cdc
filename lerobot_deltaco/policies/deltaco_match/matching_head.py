"""The networks that compare crops around proposals: descriptors, words, and heights of grasps."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policies.deltaco_match.words import UNKNOWN_WORD

HIDDEN_DIM = 256
_DESCRIPTOR_DIM = 64
_MIN_STD, _MAX_FEATURE, _MIN_PROBABILITY = 1e-3, 6.0, 1e-9
_COLOR_WEIGHT = 2.0  # of colors among the features
_INITIAL_SCALE = 10.0  # of cosines, as logits
_INITIAL_GATE = (8.0, -5.0)  # slope and offset of the logit that a proposal matches, by its cosine
_MIN_LOG_STD, _MAX_LOG_STD = -3.0, 1.0  # of the error of a demonstration's height
# Standard deviation of the error of the estimate from appearance on novel objects; heights have one of 1.
_APPEARANCE_STD = 0.7


class Crops(NamedTuple):
    """Descriptions of crops.

    Attributes:
        descriptors: Unit vectors, joined: instance descriptor, category descriptor, normalized features,
            (batch, n, descriptor).
        words: Log probabilities of the words of the vocabulary, (batch, n, words).
        objectness: Log odds that a crop shows something to grasp, up to a constant, (batch, n).
        hidden: Features of a crop's appearance, (batch, n, hidden).
        exists: Whether there is a crop; no other is chosen, (batch, n) bool.
    """

    descriptors: Tensor
    words: Tensor
    objectness: Tensor
    hidden: Tensor
    exists: Tensor

    def among(self, chosen: slice) -> Crops:
        """Returns some of the crops of each sample."""
        return Crops(*(part[:, chosen] for part in self))


class MatchingHead(nn.Module):
    """Maps features of crops to descriptors, and to log probabilities of words.

    Args:
        n_words: Size of the vocabulary.
        feature_dim: Number of features of a crop.
        color_dim: Number of those that are colors, the last ones.

    Attributes:
        feature_weight: Weight of the features' own cosine beside that of the learned descriptors, 0..1, ().
    """

    mean: Tensor
    std: Tensor
    feature_weight: Tensor

    def __init__(self, n_words: int, feature_dim: int, color_dim: int) -> None:
        super().__init__()
        self.color_dim = color_dim
        self.register_buffer("mean", torch.zeros(feature_dim))
        self.register_buffer("std", torch.ones(feature_dim))
        self.register_buffer("feature_weight", torch.zeros(()))
        self.hidden = nn.Linear(feature_dim, HIDDEN_DIM)
        self.linear = nn.Linear(feature_dim, 2 * _DESCRIPTOR_DIM)
        self.from_hidden = nn.Linear(HIDDEN_DIM, 2 * _DESCRIPTOR_DIM)
        self.words = nn.Linear(HIDDEN_DIM, n_words)
        self.objectness = nn.Linear(HIDDEN_DIM, 1)
        nn.init.zeros_(self.objectness.weight)
        nn.init.zeros_(self.objectness.bias)
        self.log_scale = nn.Parameter(torch.full((2,), math.log(_INITIAL_SCALE)))
        self.gate = nn.Parameter(torch.tensor(_INITIAL_GATE))

    def set_statistics(self, features: Tensor) -> None:
        """Sets the mean and the standard deviation of features (scenes, n, feature_dim); NaN for no crop."""
        some = features[:: max(1, len(features) // 1000)].flatten(0, 1).float()
        some = some[~some[:, 0].isnan()]
        self.mean.copy_(some.mean(dim=0))
        self.std.copy_(some.std(dim=0).clamp_min(_MIN_STD))

    def forward(self, features: Tensor) -> Crops:
        """Describes crops by their features (batch, n, feature_dim)."""
        return self.describe(self.inputs(features))

    def inputs(self, features: Tensor) -> Tensor:
        """Normalizes features, (batch, n, feature_dim): NaN, for no crop, becomes 0."""
        inputs = ((features.float() - self.mean) / self.std).clamp(-_MAX_FEATURE, _MAX_FEATURE).nan_to_num()
        others, colors = inputs.tensor_split((inputs.shape[-1] - self.color_dim,), dim=-1)
        return torch.cat([others, _COLOR_WEIGHT * colors], dim=-1)

    def describe(self, inputs: Tensor, generator: torch.Generator | None = None) -> Crops:
        """Describes crops.

        Args:
            inputs: Normalized features, (batch, n, feature_dim); 0 for no crop.
            generator: Source of dropout's draws, on the CPU; None for no dropout.
        """
        exists = (inputs != 0).any(dim=-1)
        features = inputs[exists]  # most scenes have few
        inputs = _dropout(features, generator)
        hidden = _dropout(F.relu(self.hidden(inputs)), generator)
        descriptors = self.linear(inputs) + self.from_hidden(hidden)
        descriptors = torch.cat([descriptors.float(), features.float()], dim=-1)
        words = self.words(hidden).float().log_softmax(dim=-1)
        objectness = self.objectness(hidden)[..., 0]
        descriptors, words, objectness, hidden = (
            _scatter(part.float(), exists) for part in (_unit(descriptors.float()), words, objectness, hidden)
        )
        return Crops(descriptors, words, objectness, hidden, exists)

    def match(
        self,
        crops: Crops,
        described: Tensor,
        sharpness: float = 1.0,
        p_other: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compares crops with what was demonstrated.

        Args:
            crops: Crops of the proposals.
            described: Descriptors of the demonstrated objects, (batch, descriptor).
            sharpness: Factor of the similarities.
            p_other: Probability, where no crop shows the demonstrated object, that the category descriptor
                tells nothing either, (batch,).

        Returns:
            Log probabilities that the crops are meant, and cosines of the instance descriptors, (batch, n).
        """
        wanted, n_learned = _unit(described), 2 * _DESCRIPTOR_DIM
        learned = (part[..., :n_learned].unflatten(-1, (2, -1)) for part in (crops.descriptors, wanted))
        cosines = torch.einsum("bnkd,bkd->kbn", *learned)
        of_features = torch.einsum("bnd,bd->bn", crops.descriptors[..., n_learned:], wanted[..., n_learned:])
        cosines = torch.lerp(cosines, of_features.expand_as(cosines), self.feature_weight)
        is_instance, is_category = (
            (sharpness * self.log_scale.exp()[:, None, None] * cosines)
            .masked_fill(~crops.exists, -torch.inf)
            .softmax(dim=2)
            .unbind()
        )
        cosines = cosines.masked_fill(~crops.exists, -1.0)
        if p_other is not None:
            is_category = (1 - p_other)[:, None] * is_category + p_other[:, None] * uniform(crops.exists)
        # Whether any crop shows the demonstrated object.
        p_instance = torch.sigmoid(self.gate[0] * cosines[0].amax(dim=1, keepdim=True) + self.gate[1])
        probabilities = p_instance * is_instance + (1 - p_instance) * is_category
        return probabilities.clamp_min(_MIN_PROBABILITY).log(), cosines[0]


class GraspHeightEstimator(nn.Module):
    """Estimates the height offset of a grasp, from the demonstration and from the object's appearance.

    If the demonstration moved the same object, its height is the right one. If it moved another object of
    that color or shape, the appearance of the object in the scene is a better guide. So two estimates are
    averaged, weighted by the inverse of their variances. The variance of the estimate from the demonstration
    is learned, from the similarity of the two objects. The variance of the other is fixed: training objects
    have hardly any error to learn it from.

    Args:
        feature_dim: Size of the features of an object's appearance.
    """

    def __init__(self, feature_dim: int) -> None:
        super().__init__()
        self.by_appearance = nn.Linear(feature_dim, 1)
        self.demonstration_error = nn.Sequential(nn.Linear(1, 16), nn.ReLU(inplace=True), nn.Linear(16, 1))

    def losses(self, features: Tensor, similarity: Tensor, demonstrated: Tensor, heights: Tensor) -> Tensor:
        """Returns the loss of each sample, (batch,).

        Args:
            features: Features of the objects to grasp, (batch, feature_dim).
            similarity: Cosine of their descriptors with those of the demonstrated objects, (batch,).
            demonstrated: Height offsets of the demonstrations, (batch,).
            heights: Height offsets of the grasps, (batch,).
        """
        by_appearance = 0.5 * (self.by_appearance(features)[:, 0] - heights).square()
        log_std = self._log_std(similarity)
        error = (demonstrated - heights) * torch.exp(-log_std)
        return by_appearance + 0.5 * error.square() + log_std

    def forward(self, features: Tensor, similarity: Tensor, demonstrated: Tensor) -> Tensor:
        """Estimates height offsets, (...).

        Args:
            features: Features of the objects to grasp, (..., feature_dim).
            similarity: Cosine of their descriptors with those of the demonstrated objects, (...).
            demonstrated: Height offsets of the demonstrations, (...); NaN where they are not known.
        """
        by_appearance = self.by_appearance(features)[..., 0]
        variance = torch.exp(2 * self._log_std(similarity))
        # Where they contradict each other, the object looks like none of the training, whose heights misled.
        surprise = (demonstrated - by_appearance).square() / (_APPEARANCE_STD**2 + variance)
        of_appearance = _APPEARANCE_STD**2 * surprise.clamp_min(1)
        weight = of_appearance / (of_appearance + variance)
        weight = torch.where(demonstrated.isnan(), 0.0, weight)
        return weight * demonstrated.nan_to_num() + (1 - weight) * by_appearance

    def _log_std(self, similarity: Tensor) -> Tensor:
        """Returns the log standard deviation of the error of the demonstrations' estimate, (...)."""
        log_std = self.demonstration_error(similarity[..., None])[..., 0]
        return _MIN_LOG_STD + (_MAX_LOG_STD - _MIN_LOG_STD) * torch.sigmoid(log_std)


def uniform(exists: Tensor) -> Tensor:
    """Returns the uniform distribution over the crops that exist, (batch, n)."""
    return exists / exists.sum(dim=1, keepdim=True)


def _scatter(values: Tensor, exists: Tensor) -> Tensor:
    """Returns values (crops, ...) where crops exist (batch, n), and 0 elsewhere, (batch, n, ...)."""
    scattered = values.new_zeros(*exists.shape, *values.shape[1:])
    scattered[exists] = values
    return scattered


def _unit(descriptors: Tensor) -> Tensor:
    """Scales each part of descriptors (..., descriptor) to unit length."""
    parts = descriptors.tensor_split((_DESCRIPTOR_DIM, 2 * _DESCRIPTOR_DIM), dim=-1)
    return torch.cat([F.normalize(part, dim=-1) for part in parts], dim=-1)


def word_scores(words: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
    """Returns weighed sums of the log probabilities of words, (batch, n).

    Args:
        words: Log probabilities of the vocabulary, (batch, n, vocabulary).
        indices: Indices of the words, (batch, length).
        weights: Their weights, (batch, length).
    """
    index = (indices - UNKNOWN_WORD - 1).clamp_min(0)[:, None].expand(-1, words.shape[1], -1)
    known_weights = weights * (indices > UNKNOWN_WORD)
    return (words.gather(2, index) * known_weights[:, None]).sum(dim=2)


def _dropout(values: Tensor, generator: torch.Generator | None) -> Tensor:
    """Sets half of the values to 0 and doubles the others; without a generator, returns them unchanged."""
    if generator is None:
        return values
    # One bit of a random byte for each value: eight bytes are drawn at once.
    draws = torch.empty(-(-values.numel() // 8), dtype=torch.int64).random_(generator=generator)
    kept = draws.view(torch.uint8)[: values.numel()].view(values.shape) & 1
    return values * kept.to(values).mul_(2)
