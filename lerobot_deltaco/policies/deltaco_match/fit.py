"""The fit: everything that feature matching learns before the first step of a policy's training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.policies.deltaco_match.crops import fit_perspective
from lerobot_deltaco.policies.deltaco_match.matching import word_scores
from lerobot_deltaco.policies.deltaco_match.proposals import nearest_proposals
from lerobot_deltaco.policies.deltaco_match.words import UNKNOWN_WORD, encode_words

if TYPE_CHECKING:
    from lerobot_deltaco.policies.deltaco_match.localization import FeatureMatching

_SCENES_AT_A_TIME, _NORMALIZED_AT_A_TIME = 16, 256


def fit_feature_matching(
    matching: FeatureMatching,
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
    """Fits the proposals, and then the matching head.

    The head learns to tell the object grasped in one episode of a task from the other proposals in the scene
    of another episode, by the demonstration and by words.

    Args:
        matching: What is fitted.
        images: First images of episodes, (episodes, 3, H, W) uint8, as small as the policy's.
        last: Last images of the same episodes.
        native: The first images at full resolution, (episodes, 3, H', W') uint8.
        locations: Locations of their grasps, (episodes, 2) in -1..1; NaN where there is none.
        heights: Height offsets of their grasps, (episodes,).
        tasks: Task of each episode.
        sentences: Instructions of each task, one of which is drawn for an episode in each step.
        seed: Seed of the initial weights and of the draws.
        in_bfloat16: Whether convolutions and linear layers compute in bfloat16, which takes half the time on
            a CPU that has it.

    Raises:
        ValueError: No task has two episodes with a grasp, or no proposal is near a grasp.
        PretrainedWeightsError: The encoder's weights are missing.
    """
    settings = matching.settings
    generator, device = torch.Generator().manual_seed(seed), images.device
    # Without its cache, which would keep the weights of the first step: it is only emptied at the end of the
    # outermost context, here the one in which the policy is trained.
    autocast = torch.autocast(device.type, torch.bfloat16, enabled=in_bfloat16, cache_enabled=False)
    grasps = (~locations.isnan().any(dim=1)).nonzero().flatten().cpu()
    drawn = grasps[torch.randperm(len(grasps), generator=generator)[: settings.max_episodes]].sort().values
    EpisodePairs([tasks[row] for row in drawn.tolist()])  # fails before the slow part
    steps = settings.matching_draws * len(drawn) // settings.matching_batch
    steps = min(max(settings.min_matching_steps, steps), settings.max_matching_steps)
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(seed)
        for layer in matching.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear, nn.BatchNorm2d)):
                layer.reset_parameters()
        matching.requires_grad_(True)
        rows = grasps.to(device)
        matching.perspective.copy_(fit_perspective(images[rows], last[rows], locations[rows]))
        rows = drawn.to(device)
        matching.propose.fit(images[rows], locations[rows], generator, autocast, settings)
        features, target, kept = _crops_of_proposals(matching, images, native, locations, drawn, autocast)
        fit_matching_head(
            *(matching, features, target, heights[kept.to(heights.device)]),
            *([tasks[row] for row in kept.tolist()], sentences, generator, steps, autocast),
        )
    matching.requires_grad_(False)
    for weights in matching.parameters():
        weights.grad = None
    matching.eval()
    matching.fitted.fill_(True)


@torch.no_grad()
def _crops_of_proposals(
    matching: FeatureMatching,
    images: Tensor,
    native: Tensor,
    locations: Tensor,
    drawn: Tensor,
    autocast: torch.autocast,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns features of the proposals in scenes, which of them was grasped, and the scenes' rows.

    A scene in which no proposal is near the grasp is left out.
    """
    features, targets, kept = [], [], []
    with tqdm(total=len(drawn), desc="Encoding crops", unit="scene", leave=False) as progress:
        for some in drawn.split(_SCENES_AT_A_TIME):
            rows = some.to(images.device)
            proposed = matching.propose(images[rows].float() / 255)
            nearest, near = nearest_proposals(proposed, locations[rows], matching.settings.grasp_radius)
            if bool(near.any()):
                of_some = native[rows[near].to(native.device)]
                with autocast:
                    features.append(matching.features(of_some, proposed[near]).half())
                targets.append(nearest[near])
                kept.append(some[near.cpu()])
            progress.update(len(some))
    if not kept:
        raise ValueError(
            "Feature matching finds nothing to grasp in the first images where the gripper closes. Check "
            "that the first camera stands still and shows the objects, or name another with "
            "--policy.demo_camera."
        )
    return torch.cat(features), torch.cat(targets), torch.cat(kept)


def fit_matching_head(
    matching: FeatureMatching,
    features: Tensor,
    target: Tensor,
    heights: Tensor,
    tasks: Sequence[str],
    sentences: Mapping[str, Sequence[str]],
    generator: torch.Generator,
    steps: int,
    autocast: torch.autocast,
) -> None:
    """Fits the matching head, the word weights and the grasp heights to crops.

    Args:
        matching: What is fitted.
        features: Features of the crops of the proposals, (scenes, n, FEATURE_DIM); they are overwritten.
        target: The proposal that was grasped in each scene, (scenes,).
        heights: Height offsets of the grasps, (scenes,).
        tasks: Task of each scene.
        sentences: Instructions of each task.
        generator: Source of the draws, on the CPU.
        steps: Number of steps.
        autocast: Context of the forward pass.
    """
    settings, head, device = matching.settings, matching.compare, features.device
    pairs = EpisodePairs(tasks)
    head.set_statistics(features)
    for some in features.split(_NORMALIZED_AT_A_TIME):  # once and in place: they are large
        some.copy_(head.inputs(some))
    encoded, spans = _encode_sentences(matching.vocabulary, tasks, sentences, device)
    rate, decay = settings.learning_rate, settings.weight_decay
    groups: list[dict[str, Any]] = [
        {"params": head.parameters(), "lr": rate, "weight_decay": decay},
        {"params": matching.grasp_height.parameters(), "lr": rate, "weight_decay": decay},
        {
            "params": matching.word_weights.parameters(),
            "lr": settings.word_learning_rate,
            "weight_decay": 0.0,
        },
    ]
    optimizer = torch.optim.AdamW(groups, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, [group["lr"] for group in groups], steps, pct_start=settings.warmup_fraction
    )
    for _ in tqdm(range(steps), desc="Fitting the matching head", unit="step", leave=False):
        scenes, others = (rows.to(device) for rows in pairs.draw(settings.matching_batch, generator))
        crops = torch.cat([features[scenes], features[others, target[others]][:, None]], dim=1).float()
        with autocast:
            described = head.describe(crops, generator)
        matches, _ = head.match(described.among(slice(-1)), described.descriptors[:, -1])
        loss = F.nll_loss(matches, target[scenes])
        draws = torch.rand(len(scenes), generator=generator)
        drawn = (spans[scenes.cpu(), 0] + draws * spans[scenes.cpu(), 1]).long()
        dropped = torch.rand(len(scenes), encoded.shape[1], generator=generator) < settings.p_drop_word
        sentence = encoded[drawn.to(device)]
        left = torch.where(dropped.to(device) & (sentence > 0), UNKNOWN_WORD, sentence)
        loss = loss + _word_losses(matching, described.words[:, :-1], left, sentence, target[scenes])
        rows = torch.arange(len(scenes), device=device)
        with torch.no_grad():  # as similar as they are without dropout
            both = torch.stack([crops[rows, target[scenes]], crops[:, -1]], dim=1)
            with autocast:
                plain = head.describe(both)
            _, similarity = head.match(plain.among(slice(1)), plain.descriptors[:, 1])
        height_losses = matching.grasp_height.losses(
            described.hidden[rows, target[scenes]], similarity[:, 0], heights[others], heights[scenes]
        )
        loss = loss + height_losses.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def _word_losses(
    matching: FeatureMatching, log_probabilities: Tensor, words: Tensor, sentence: Tensor, target: Tensor
) -> Tensor:
    """Returns the losses of choosing a proposal by words, of naming what was grasped, and of the weights.

    Args:
        matching: What is fitted.
        log_probabilities: Log probabilities of the vocabulary for each proposal, (batch, n, vocabulary).
        words: Indices of the words, of which some are left out, (batch, length).
        sentence: The same with all words.
        target: The right proposal, (batch,).
    """
    weights = matching.word_weights(words)
    loss = F.cross_entropy(word_scores(log_probabilities, words, weights), target)
    named = log_probabilities[torch.arange(len(target)), target]  # (batch, vocabulary)
    known_weights = weights.detach() * (words > UNKNOWN_WORD)
    of_words = named.gather(1, (words - UNKNOWN_WORD - 1).clamp_min(0))
    naming = -(known_weights * of_words).sum(dim=1) / known_weights.sum(dim=1).clamp_min(1e-6)
    penalty = matching.settings.word_penalty * (weights * (words > UNKNOWN_WORD)).sum(dim=1).mean()
    # What an unknown word is about follows from its neighbors.
    unknown = (matching.word_weights(sentence).detach() - weights).square() * (words == UNKNOWN_WORD)
    return loss + naming.mean() + penalty + unknown.sum(dim=1).mean()


def _encode_sentences(
    vocabulary: Sequence[str],
    tasks: Sequence[str],
    sentences: Mapping[str, Sequence[str]],
    device: torch.device,
) -> tuple[Tensor, Tensor]:
    """Returns the words of all sentences, and the first row and the number of those of each episode."""
    spans: dict[str, tuple[int, int]] = {}
    every: list[str] = []
    for task in dict.fromkeys(tasks):
        spans[task] = (len(every), len(sentences[task]))
        every.extend(sentences[task])
    return encode_words(every, vocabulary).to(device), torch.tensor([spans[task] for task in tasks])


class EpisodePairs:
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
            raise ValueError(
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
