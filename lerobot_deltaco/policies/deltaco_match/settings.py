"""Tuned constants of finding objects, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MatchingSettings:
    """Constants of feature matching and of its fit. They were chosen on folds of the training objects.

    Args:
        p_other_object: Probability that a demonstration shows another object than the one that the words
            describe, if all of them are known and no proposal matches the demonstrated instance.
        sharpness: How much more similarities count than in the fit, where dropout disturbs them.
        p_misdescribed: Probability that words describe another object than is meant: people see other colors
            and shapes in it.
        shown_word_weight: Pages mark words above this weight as describing the object.
        map_std: Standard deviation of a candidate in a map, in cells.
        crop_factor: Side of a crop in diameters of a typical object.
        min_coverage: Fraction of the grasps of training episodes that stand out from the background from
            which on proposals are what stands out; below, a network is fitted to the grasps as well.
        feature_weight: Weight of the cosine of the encoder's features beside that of learned descriptors.
        max_variants: Number of variants of each scene, of which some have other colors, at most.
        variant_scenes: Scenes and variants together are about this many, at most.
        variant_offset: Standard deviation of the offset of a variant's crops, in their sides.
        variant_log_scale: Standard deviation of the log of the factor of their sides.
        held_out_every: Every so many episodes, one is held out from the fit of the matching head, to stop it
            and to tell how often the object is found.
        min_held_out: Smallest number of episodes that are held out.
        n_checks: How often the held-out episodes are looked at.
        max_episodes: Number of episodes that are drawn for the fit, at most.
        proposal_steps: Steps of the fit of the proposal network.
        proposal_draws: How often each scene is drawn in them, as far as the bounds of the batch allow.
        min_proposal_batch: Smallest number of scenes in a step.
        max_proposal_batch: Largest number of scenes in a step.
        grasp_radius: Distance from a grasp within which a proposal stands for the grasped object, where an
            image's edges are at -1 and 1; 4.5 px of 48.
        min_matching_steps: Smallest number of steps of the fit of the matching head.
        max_matching_steps: Largest number of steps.
        matching_draws: How often each scene is drawn in them, as far as these bounds allow.
        matching_batch: Pairs of scene and demonstration in a step.
        learning_rate: Highest learning rate of the matching head.
        scale_learning_rate: Highest learning rate of the scales of the cosines and of the gate.
        word_learning_rate: Highest learning rate of the word weights.
        weight_decay: Weight decay of the matching head.
        warmup_fraction: Fraction of the steps in which the learning rates rise.
        p_drop_word: Probability that a word is left out in a step, so that none is indispensable.
        word_penalty: Loss of a word's weight: words that tell nothing would only add noise.
        common_word_penalty: How much more the weight of a word costs that is in every sentence.
    """

    p_other_object: float = 0.5
    sharpness: float = 1.5
    p_misdescribed: float = 0.1
    shown_word_weight: float = 0.5
    map_std: float = 0.8
    crop_factor: float = 1.0
    min_coverage: float = 0.9
    feature_weight: float = 0.8
    max_variants: int = 5
    variant_scenes: int = 1000
    variant_offset: float = 0.1
    variant_log_scale: float = 0.1
    held_out_every: int = 8
    min_held_out: int = 4
    n_checks: int = 10
    max_episodes: int = 10_000
    proposal_steps: int = 800
    proposal_draws: int = 10
    min_proposal_batch: int = 24
    max_proposal_batch: int = 48
    grasp_radius: float = 0.19
    min_matching_steps: int = 300
    max_matching_steps: int = 1500
    matching_draws: int = 16
    matching_batch: int = 64
    learning_rate: float = 1e-3
    scale_learning_rate: float = 0.02
    word_learning_rate: float = 3e-3
    weight_decay: float = 0.2
    warmup_fraction: float = 0.1
    p_drop_word: float = 0.3
    word_penalty: float = 0.03
    common_word_penalty: float = 30.0


DEFAULT_SETTINGS = MatchingSettings()
