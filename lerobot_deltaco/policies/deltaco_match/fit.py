"""The fit: everything that feature matching learns before the first step of a policy's training."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.augmentation import change_colors, random_color_changes
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import MatchingSettings
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching, other_episodes
from lerobot_deltaco.policies.deltaco_match.matching_head import Crops, MatchingHead, word_scores
from lerobot_deltaco.policies.deltaco_match.words import UNKNOWN_WORD, encode_words
from lerobot_deltaco.policies.scene.proposals import (
    MAX_MEASURED,
    MAX_REMEMBERED,
    changed_areas,
    demonstrated_centers,
    nearest_proposals,
)

logger = logging.getLogger(__name__)

_SCENES_AT_A_TIME, _NORMALIZED_AT_A_TIME = 16, 256
_LOOKS = 2  # at each held-out episode
_MIN_DIFFERENCE = 0.1  # between the cosines of right and wrong proposals


def fit_feature_matching(
    matching: FeatureMatching,
    images: Tensor,
    last: Tensor,
    full_resolution: Tensor,
    locations: Tensor,
    heights: Tensor,
    tasks: Sequence[str],
    sentences: Mapping[str, Sequence[str]],
    seed: int,
    *,
    in_bfloat16: bool = False,
) -> Tensor:
    """Measures the background and objects, and fits the matching head.

    The head learns to tell the object grasped in one episode of a task from the other proposals in the scene
    of another episode, by the demonstration and by words.

    Args:
        matching: What is fitted.
        images: First images of episodes, (episodes, 3, H, W) uint8, as small as the policy's.
        last: Last images of the same episodes.
        full_resolution: The first images at full resolution, (episodes, 3, H', W') uint8.
        locations: Locations of their grasps, (episodes, 2) in -1..1; NaN where there is none.
        heights: Height offsets of their grasps, (episodes,).
        tasks: Task of each episode.
        sentences: Instructions of each task, one of which is drawn for an episode in each step.
        seed: Seed of the initial weights and of the draws.
        in_bfloat16: Whether convolutions and linear layers compute in bfloat16, which takes half the time on
            a CPU that has it.

    Returns:
        Rows of the episodes that were held out, (held-out,).

    Raises:
        ValueError: No task has two episodes with a grasp, or no proposal is near a grasp.
        PretrainedWeightsError: The encoder's weights are missing.
    """
    settings = matching.settings
    generator, device = torch.Generator().manual_seed(seed), images.device
    # No weight cache: it is emptied only when the outermost autocast ends, so that the weights of the first
    # step would stay.
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
        proposed, shown = _propose(matching, images, last, full_resolution, locations, drawn, generator)
        matching.compare.feature_weight.fill_(settings.feature_weight)
        features, distances, kept = _crops_of_proposals(
            *(matching, full_resolution, locations, drawn, proposed, shown, generator, autocast)
        )
        held_out = _held_out([tasks[row] for row in drawn.tolist()], settings)
        is_kept, kept_tasks = torch.isin(drawn, kept), [tasks[row] for row in kept.tolist()]
        matching.held_out.copy_(torch.tensor([0, int(held_out.sum())]))
        matching.n_episodes.fill_(len(grasps))
        matching.sharpness.fill_(1.0)
        matching.error_rate.zero_()
        fit_matching_head(
            matching,
            features,
            distances,
            heights[kept.to(heights.device)],
            kept_tasks,
            sentences,
            generator,
            steps,
            autocast,
            held_out=held_out[is_kept],
        )
        nearest = proposed[is_kept.to(device)][torch.arange(len(kept)), distances.argmin(dim=1)]
        grasped = (
            full_resolution[kept.to(full_resolution.device)],
            locations[kept.to(device)],
            nearest,
            matching.object_sizes(nearest),
        )
        steps = settings.refinement_steps
        matching.refine.fit(*grasped, held_out[is_kept], steps, generator, autocast)
        matching.refine.measure_templates(*grasped, other_episodes(kept_tasks).to(device))
    matching.requires_grad_(False)
    for weights in matching.parameters():
        weights.grad = None
    matching.eval()
    matching.fitted.fill_(True)
    if int(matching.held_out[1]):
        logger.info("Feature matching: %s.", matching.report)
    return drawn[held_out]


@torch.no_grad()
def _propose(
    matching: FeatureMatching,
    images: Tensor,
    last: Tensor,
    full_resolution: Tensor,
    locations: Tensor,
    drawn: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Fits the background.

    Returns:
        Proposals in the drawn scenes, (drawn, n, 2), and the centers of what was grasped, (drawn, 2).
    """
    background, grasps = matching.background, locations[drawn.to(locations.device)]
    chosen = torch.randperm(len(drawn), generator=generator)[:MAX_MEASURED]
    remembered = torch.full((len(drawn),), -1)
    remembered[chosen[:MAX_REMEMBERED]] = torch.arange(min(len(chosen), MAX_REMEMBERED))
    some = drawn[chosen]
    background.fit(full_resolution[some.to(full_resolution.device)], locations[some.to(locations.device)])
    parts = []
    batches = list(zip(drawn.split(_SCENES_AT_A_TIME), remembered.split(_SCENES_AT_A_TIME), strict=True))
    for some, own in tqdm(batches, desc="Looking for objects", unit="batch", leave=False):
        scenes, here = full_resolution[some.to(full_resolution.device)], some.to(images.device)
        masks = background.masks(scenes, own)
        changed = changed_areas(torch.stack([images[here], last[here]], dim=1).float() / 255)
        parts.append([background.objects(each, scenes) for each in (masks, masks * changed.to(masks))])
    proposed, changed = (torch.cat(each).to(images.device) for each in zip(*parts, strict=True))
    nearest, stands_out = nearest_proposals(proposed, grasps, matching.grasp_radius)
    coverage = float(stands_out.float().mean())
    if coverage < matching.settings.min_coverage:
        logger.warning(
            "Only %.0f %% of the grasped objects stand out from what the camera sees in other episodes; the "
            "others are not trained on. Feature matching needs a camera that stands still, and objects that "
            "do not lie in the same place in most episodes. Look at the circles of `deltaco look`.",
            100 * coverage,
        )
    errors = (proposed[torch.arange(len(drawn)), nearest] - grasps).norm(dim=1)
    usual_error = float(errors[stands_out].median()) if stands_out.any() else 0.0
    shown, _ = demonstrated_centers(proposed, changed, grasps, grasps, matching.grasp_radius, usual_error)
    return proposed, shown


def _held_out(tasks: Sequence[str], settings: MatchingSettings) -> Tensor:
    """Chooses evenly spaced episodes to hold out; each task keeps at least two, (episodes,) bool."""
    held_out, left = torch.zeros(len(tasks), dtype=torch.bool), Counter(tasks)
    n_wanted = max(settings.min_held_out, len(tasks) // settings.held_out_every)
    if len(tasks) < settings.held_out_every * settings.min_held_out * 0.75:
        return held_out
    for row in sorted(range(len(tasks)), key=lambda row: (row % settings.held_out_every, row)):
        if int(held_out.sum()) < n_wanted and left[tasks[row]] > 2:
            held_out[row] = True
            left[tasks[row]] -= 1
    return held_out


@torch.no_grad()
def _crops_of_proposals(
    matching: FeatureMatching,
    full_resolution: Tensor,
    locations: Tensor,
    drawn: Tensor,
    proposed: Tensor,
    shown: Tensor,
    generator: torch.Generator,
    autocast: torch.autocast,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns features of the proposals in scenes, how far they are from the grasps, and the scenes' rows.

    The last crop of each scene is of what was grasped, as a demonstration shows it.

    A scene in which no proposal is near the grasp is left out. If there are few scenes, each has variants,
    whose crops are a little off; variants 2, 4, ... have other colors, too, as of new objects.

    Returns:
        (variants, scenes, n + 1, features), (scenes, n) in radii within which a proposal stands for what was
        grasped, infinite where there is none, and (scenes,).
    """
    settings = matching.settings
    n_variants = min(max(settings.variant_scenes // len(drawn), 1), settings.max_variants)
    changes = random_color_changes(n_variants, 1.0, generator)
    features, distances, kept = [], [], []
    with tqdm(total=len(drawn), desc="Encoding crops", unit="scene", leave=False) as progress:
        every = torch.cat([proposed, shown[:, None]], dim=1)
        for some, of_some in zip(drawn.split(_SCENES_AT_A_TIME), every.split(_SCENES_AT_A_TIME), strict=True):
            rows = some.to(locations.device)
            away = (of_some[:, :-1] - locations[rows, None]).norm(dim=2) / matching.grasp_radius
            near = (away < 1).any(dim=1)
            if bool(near.any()):
                scenes = full_resolution[rows[near].to(full_resolution.device)]
                variants = []
                for n in range(n_variants):
                    images, at = scenes, of_some[near]
                    sizes = matching.object_sizes(at)
                    if n > 0:
                        noise = torch.randn((*at.shape[:2], 3), generator=generator).to(at.device)
                        sizes = sizes * (settings.variant_log_scale * noise[..., 2]).exp()
                        at = at + 2 * settings.variant_offset * sizes[..., None] * noise[..., :2]
                    if has_other_colors(n):
                        change = changes[n].expand(len(images), 3, 3)
                        images = change_colors(images.float() / 255, change)
                    with autocast:
                        variants.append(matching.features(images, at, sizes).half())
                features.append(torch.stack(variants))
                distances.append(away[near].nan_to_num(nan=torch.inf))
                kept.append(some[near.cpu()])
            progress.update(len(some))
    if not kept:
        raise UserError(
            "Nothing stands out from the background in the first images where the gripper closes. Check "
            "that the first camera stands still and shows the objects, or name another with "
            "--policy.demo_camera."
        )
    return torch.cat(features, dim=1), torch.cat(distances), torch.cat(kept)


def has_other_colors(variant: int) -> bool:
    """Returns whether the colors of a variant of scenes are changed."""
    return variant > 0 and variant % 2 == 0


def fit_matching_head(
    matching: FeatureMatching,
    features: Tensor,
    distances: Tensor,
    heights: Tensor,
    tasks: Sequence[str],
    sentences: Mapping[str, Sequence[str]],
    generator: torch.Generator,
    steps: int,
    autocast: torch.autocast,
    held_out: Tensor | None = None,
) -> None:
    """Fits the matching head, the word weights and the grasp heights to crops.

    Args:
        matching: What is fitted.
        features: Features of the crops of the proposals, and behind them of what a demonstration shows,
            (variants, scenes, n + 1, features); they are overwritten. Every second variant from the third on
            has other colors.
        distances: Distances of the proposals from the grasp of their scene, (scenes, n), in radii within
            which a proposal stands for what was grasped: several may. Infinite for no proposal.
        heights: Height offsets of the grasps, (scenes,).
        tasks: Task of each scene.
        sentences: Instructions of each task.
        generator: Source of the draws, on the CPU.
        steps: Number of steps.
        autocast: Context of the forward pass.
        held_out: Scenes that are not fitted, but tell when to stop, (scenes,) bool; None for none.
    """
    settings, head, device = matching.settings, matching.compare, features.device
    if held_out is None:
        held_out = torch.zeros(len(tasks), dtype=torch.bool)
    pairs = EpisodePairs(tasks, (~held_out).nonzero().flatten().tolist())
    head.set_statistics(features[0, :, :-1])
    is_grasped, target = distances < 1, distances.argmin(dim=1)
    for some in features.flatten(0, 1).split(_NORMALIZED_AT_A_TIME):  # once and in place: they are large
        some.copy_(head.inputs(some))
    encoded, spans = _encode_sentences(matching.vocabulary, tasks, sentences, device)
    check = None
    if held_out.any():
        check = HeldOut(matching, features[0], is_grasped, tasks, encoded, spans, held_out)
    each_word = torch.arange(int(encoded.max()) + 1, device=device)
    frequency = (encoded[..., None] == each_word).any(dim=1).float().mean(dim=0)
    some = pairs.draw(settings.matching_batch, generator)
    _begin_at_features(head, features[0], is_grasped, some, settings.initial_separation)
    rate, decay = settings.learning_rate, settings.weight_decay
    scales = [head.log_scale, head.gate]
    groups: list[dict[str, Any]] = [
        {
            "params": [own for own in head.parameters() if all(own is not scale for scale in scales)],
            "lr": rate,
            "weight_decay": decay,
        },
        {"params": scales, "lr": settings.scale_learning_rate, "weight_decay": 0.0},
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
    for step in tqdm(range(steps), desc="Fitting the matching head", unit="step", leave=False):
        scenes, others = (rows.to(device) for rows in pairs.draw(settings.matching_batch, generator))
        variant = torch.randint(len(features), (len(scenes),), generator=generator).to(device)
        shown = features[variant, others, -1:]
        crops = torch.cat([features[variant, scenes, :-1], shown], dim=1).float()
        named = torch.tensor([not has_other_colors(n) for n in variant.tolist()], device=device)
        with autocast:
            described = head.describe(crops, generator)
        matches, _ = head.match(described.among(slice(-1)), described.descriptors[:, -1])
        loss = object_loss(matches, is_grasped[scenes]).mean()
        draws = torch.rand(len(scenes), generator=generator)
        drawn = (spans[scenes.cpu(), 0] + draws * spans[scenes.cpu(), 1]).long()
        dropped = torch.rand(len(scenes), encoded.shape[1], generator=generator) < settings.p_drop_word
        sentence = encoded[drawn.to(device)]
        left = torch.where(dropped.to(device) & (sentence > 0), UNKNOWN_WORD, sentence)
        proposals = described.among(slice(-1))
        if named.any():
            loss = loss + _word_losses(
                *(matching, Crops(*(part[named] for part in proposals)), left[named], sentence[named]),
                *(is_grasped[scenes][named], target[scenes][named], frequency),
            )
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
        if check is not None and (step + 1) % max(1, steps // settings.n_checks) == 0:
            check.look()
    if check is not None:
        check.finish()


def object_loss(log_probabilities: Tensor, is_object: Tensor) -> Tensor:
    """Returns the negative log probability that one of the proposals of an object is chosen, (...).

    Args:
        log_probabilities: Log probabilities of proposals, (..., n).
        is_object: Whether each is of the object, (..., n) bool.
    """
    return -log_probabilities.masked_fill(~is_object, -torch.inf).logsumexp(dim=-1)


@torch.no_grad()
def _begin_at_features(
    head: MatchingHead, features: Tensor, is_grasped: Tensor, pairs: tuple[Tensor, Tensor], separation: float
) -> None:
    """Sets scales and gate so that they separate right from wrong proposals before the first step."""
    scenes, others = (rows.to(features.device) for rows in pairs)
    crops = head.describe(features[scenes, :-1].float())
    shown = head.describe(features[others, -1:].float())
    _, cosines = head.match(crops, shown.descriptors[:, 0])
    right = cosines.masked_fill(~is_grasped[scenes], -1.0).amax(dim=1)
    wrong = cosines.masked_fill(is_grasped[scenes], -1.0).amax(dim=1)
    high, low = right.median(), wrong.median()
    slope = (separation / (high - low).clamp_min(_MIN_DIFFERENCE)).clamp_min(1.0)
    head.log_scale.fill_(float(slope.log()))
    head.gate.copy_(torch.stack([slope, -slope * (high + low) / 2]))


def _word_losses(
    matching: FeatureMatching,
    crops: Crops,
    words: Tensor,
    sentence: Tensor,
    is_grasped: Tensor,
    target: Tensor,
    frequency: Tensor,
) -> Tensor:
    """Returns the losses of choosing a proposal by words, of naming what was grasped, and of the weights.

    Args:
        matching: What is fitted.
        crops: The proposals.
        words: Indices of the words, of which some are left out, (batch, length).
        sentence: The same with all words.
        is_grasped: Whether each proposal is of what was grasped, (batch, n) bool.
        target: The proposal nearest to the grasp, (batch,).
        frequency: Fraction of the sentences in which each word occurs, (vocabulary and special words,).
    """
    settings, weights = matching.settings, matching.word_weights(words)
    named = crops.words[torch.arange(len(target)), target]  # (batch, vocabulary)
    logits = word_scores(crops.words, words, weights) + crops.objectness
    by_words = logits.masked_fill(~crops.exists, -torch.inf).log_softmax(dim=1)
    loss = object_loss(by_words, is_grasped).mean()
    known_weights = weights.detach() * (words > UNKNOWN_WORD)
    of_words = named.gather(1, (words - UNKNOWN_WORD - 1).clamp_min(0))
    naming = -(known_weights * of_words).sum(dim=1) / known_weights.sum(dim=1).clamp_min(1e-6)
    # A word of every sentence, such as "the", tells nothing apart.
    common = settings.common_fraction
    is_common = ((frequency[words] - common) / (1 - common)).clamp_min(0)
    cost = settings.word_penalty * (1 + settings.common_word_penalty * is_common)
    penalty = (cost * weights * (words > UNKNOWN_WORD)).sum(dim=1).mean()
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


class HeldOut:
    """Looks for the objects of episodes that are not fitted, keeps the best weights, and calibrates.

    Args:
        matching: What is fitted.
        features: Normalized features of the proposals of all scenes, and behind them of what demonstrations
            show, (scenes, n + 1, features).
        is_grasped: Whether each proposal is of what was grasped, (scenes, n) bool.
        tasks: Task of each scene.
        encoded: Words of all sentences.
        spans: First row and number of the sentences of each scene, (scenes, 2).
        held_out: Which scenes are held out, (scenes,) bool.
    """

    def __init__(
        self,
        matching: FeatureMatching,
        features: Tensor,
        is_grasped: Tensor,
        tasks: Sequence[str],
        encoded: Tensor,
        spans: Tensor,
        held_out: Tensor,
    ) -> None:
        fitted = [row for row in range(len(tasks)) if not held_out[row]]
        of_task: dict[str, list[int]] = {}
        for row in fitted:
            of_task.setdefault(tasks[row], []).append(row)
        scenes = [row for row in held_out.nonzero().flatten().tolist() if tasks[row] in of_task]
        # Each with two demonstrations and two sentences, for scores that depend less on chance
        pairs = [(row, n, of_task[tasks[row]]) for row in scenes for n in range(_LOOKS)]
        first, numbers = spans.T.tolist()
        looks = [
            (row, own[n * len(own) // _LOOKS], first[row] + n * numbers[row] // _LOOKS)
            for row, n, own in pairs
        ]
        self._scenes, shown, texts = torch.tensor(looks, dtype=torch.int64).view(-1, 3).T
        self._matching, self._is_grasped = matching, is_grasped[self._scenes]
        self._inputs = features[self._scenes, :-1]
        self._shown = features[shown, -1:]
        self._words = encoded[texts]
        self._best = math.inf
        self._state: dict[str, Tensor] = {}

    @torch.no_grad()
    def _scores(self) -> Tensor:
        """Returns scores by demonstration, by words and by both, (3, looks, n)."""
        head = self._matching.compare
        crops = head.describe(self._inputs.float())
        described = head.describe(self._shown.float()).descriptors[:, 0]
        nothing = torch.zeros_like(self._words[:, :1])
        given = ((nothing, described), (self._words, None), (self._words, described))
        return torch.stack([self._matching.scores(crops, *each)[0] for each in given])

    def look(self) -> None:
        """Keeps the weights if they are the best so far."""
        loss = float(object_loss(self._scores().log_softmax(dim=2), self._is_grasped).mean())
        if loss < self._best:  # False without a look
            self._best = loss
            self._state = {name: value.clone() for name, value in self._matching.state_dict().items()}

    @torch.no_grad()
    def finish(self) -> None:
        """Restores the best weights, and sets how far they can be trusted."""
        matching = self._matching
        if self._state:
            matching.load_state_dict(self._state)
        scores = self._scores()
        chosen = scores.argmax(dim=2, keepdim=True)
        n_right = self._is_grasped.expand(3, -1, -1).gather(2, chosen).float().sum(dim=(1, 2)) / _LOOKS
        n_all = int(matching.held_out[1])  # those without a proposal at the grasp, too
        matching.held_out[0] = round(float(n_right[2]))
        n_wrong = n_all - float(n_right[0] + n_right[2]) / 2
        error_rate = torch.tensor((n_wrong + 0.5) / (n_all + 1))  # with Jeffreys' prior
        losses = {}
        for sharpness in matching.settings.sharpnesses:
            p = (sharpness * scores).softmax(dim=2)
            p = torch.lerp(p, torch.full_like(p, 1 / p.shape[2]), error_rate.to(p))
            losses[sharpness] = float(object_loss(p.log(), self._is_grasped).mean())
        matching.sharpness.fill_(min(losses, key=lambda sharpness: losses[sharpness]))
        matching.error_rate.copy_(error_rate)


class EpisodePairs:
    """Draws pairs of different episodes of a task.

    Args:
        tasks: Task of each episode; all have a grasp.
        fitted: Episodes that are drawn; by default, all.
    """

    def __init__(self, tasks: Sequence[str], fitted: Iterable[int] | None = None) -> None:
        rows: dict[str, list[int]] = {}
        for row in range(len(tasks)) if fitted is None else fitted:
            rows.setdefault(tasks[row], []).append(row)
        self._rows = [torch.tensor(own) for own in rows.values() if len(own) > 1]
        if not self._rows:
            n_episodes = sum(map(len, rows.values()))
            raise UserError(
                "Feature matching needs tasks with at least two episodes in which the gripper closes on "
                f"an object. The {n_episodes} such episodes are of {len(rows)} different tasks. Add episodes."
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
