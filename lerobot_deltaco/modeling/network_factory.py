"""Makes the networks of a policy as its configuration says."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from torch import nn

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.demo_encoders import ArrayEncoder, AttentionEncoder
from lerobot_deltaco.policy.frozen_features import FrozenFeatures, Variants
from lerobot_deltaco.policy.goals.conditioning import GoalConditioning
from lerobot_deltaco.policy.goals.correspondence import GoalLocator
from lerobot_deltaco.policy.goals.pretrained_matching import PretrainedMatching
from lerobot_deltaco.policy.heads import UnitHead
from lerobot_deltaco.policy.networks import ConditionedPolicy
from lerobot_deltaco.policy.options import BACKBONES, GOAL_SOURCES
from lerobot_deltaco.policy.vision import load_vision_encoder


def make_policy_network(config: DeltacoConfig) -> ConditionedPolicy:
    """The network that predicts actions."""
    film, concat, _ = config.conditioning
    demo_dim = config.demo_dim or 0
    dims = {
        "none": 0,
        "demo": demo_dim,
        "language": config.embedding_dim,
        "demo+language": demo_dim + config.embedding_dim,
        "language_or_demo": config.embedding_dim,
        "one_hot": len(config.one_hot_tasks),
    }
    backbone = BACKBONES[config.backbone]
    return ConditionedPolicy(
        n_cameras=len(config.image_features),
        film_dim=dims[film],
        # With goals: the distance of the state from each of them.
        concat_dim=dims[concat] + _state_dim(config) * (1 + config.n_goals),
        motion_dim=config.action_feature.shape[0] - (config.gripper_index is not None),
        has_gripper=config.gripper_index is not None,
        channels=backbone.channels,
        stem_stride=backbone.stem_stride,
        motion_modes=config.motion_modes,
        n_goals=config.n_goals,
    )


def make_demo_encoder(config: DeltacoConfig) -> nn.Module | None:
    """The encoder of demonstrations, or the layers behind a frozen one; None without a task embedding."""
    if not config.uses_demo or config.locates_goals:
        return None
    if config.demo_encoder == "pretrained":
        assert config.demo_feature_dim is not None
        assert config.demo_dim is not None
        return UnitHead(config.demo_feature_dim, config.demo_head, config.demo_dim)
    if config.demo_encoder == "attention":
        return AttentionEncoder(config.n_demo_frames, config.embedding_dim)
    size, stride = config.image_size, BACKBONES[config.backbone].demo_stride
    return ArrayEncoder(size, size, config.demo_rows, config.demo_columns, config.embedding_dim, stride)


def make_goal_conditioning(config: DeltacoConfig) -> GoalConditioning | None:
    """The locator of goals; None unless `demo_encoder=correspondence`."""
    if not config.locates_goals:
        return None
    condition_dim = len(config.one_hot_tasks) if config.method == "one_hot" else 0
    if config.uses_language:
        condition_dim = config.embedding_dim
    locator = GoalLocator(
        *GOAL_SOURCES[config.method],
        condition_dim,
        takes_either=config.takes_either_modality,
        detail=config.goal_detail,
    )
    matching = None
    if config.pretrained_matching:
        # All other weights are the same with and without it.
        with torch.random.fork_rng(devices=[]):
            matching = PretrainedMatching(len(config.known_words), detail=config.goal_detail)
    return GoalConditioning(
        locator, _state_dim(config), condition_dim, config.grasp_depth, config.depth_margin, matching
    )


def make_frozen_encoder(config: DeltacoConfig) -> FrozenFeatures | None:
    """The pretrained image encoder; None without one. Sets `demo_feature_dim` in the configuration."""
    if not config.uses_demo or config.demo_encoder != "pretrained":
        return None
    load = partial(
        load_vision_encoder,
        config.vision_encoder,
        config.vision_encoder_weights,
        config.vision_image_size,
        config.vision_input,
    )
    variants = Variants(
        config.n_demo_frames,
        config.demo_rows,
        config.demo_variants,
        config.demo_crop_padding,
        config.demo_crop == "array",
        config.demo_frames_between == "spread",
        config.seed,
    )
    folder = None if config.demo_features_dir is None else Path(config.demo_features_dir)
    frozen = FrozenFeatures(load, variants, folder)
    if config.demo_feature_dim is None:
        config.demo_feature_dim = frozen.encoder.feature_dim
        config.check_demo_dim()
    return frozen


def make_language_head(config: DeltacoConfig) -> UnitHead | None:
    """Layers behind the language encoder; MCIL brings both modalities into one space by them."""
    hidden_dims = config.language_head
    if config.method == "mcil" and hidden_dims is None:
        hidden_dims = [config.embedding_dim]
    if hidden_dims is None or not config.uses_language:
        return None
    return UnitHead(config.embedding_dim, hidden_dims, config.embedding_dim)


def _state_dim(config: DeltacoConfig) -> int:
    return config.robot_state_feature.shape[0] if config.robot_state_feature else 0
