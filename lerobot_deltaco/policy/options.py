"""Valid values of the policy's options: methods, networks and losses by name, and what each stands for."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple


class Conditioning(NamedTuple):
    """Conditioning of a method."""

    film: str  # input through FiLM
    concat: str  # input concatenated to the feature points
    encoder_loss: str  # loss that aligns demonstrations with instructions


# The methods of the paper's tables 1 and 2.
METHODS = MappingProxyType(
    {
        "deltaco": Conditioning("demo", "language", "contrastive"),
        "language_only": Conditioning("language", "none", "none"),
        "demo_only": Conditioning("demo", "none", "contrastive"),
        "one_hot": Conditioning("one_hot", "none", "none"),
        "bc_z": Conditioning("demo", "none", "cosine"),
        # The mean of two imitation losses: of the language (through a projection) and of the demonstration.
        "mcil": Conditioning("language_or_demo", "none", "none"),
    }
)
# With `demo_encoder=correspondence`: what says what is to be grasped, and where it is to be released.
GOAL_SOURCES = MappingProxyType(
    {
        "deltaco": ("demo", "condition"),
        "demo_only": ("demo", "demo"),
        "language_only": ("condition", "condition"),
        "one_hot": ("condition", "condition"),
    }
)
INPUTS = ("none", "demo", "language", "demo+language")
ENCODER_LOSSES = ("contrastive", "cosine", "none")


class Backbone(NamedTuple):
    """Sizes of a convolutional network."""

    channels: tuple[int, ...]  # of the residual blocks
    stem_stride: int  # of the first convolution
    demo_stride: int  # of the first convolution of the demonstration encoder `cnn`


BACKBONES = MappingProxyType(
    {
        "paper": Backbone((16, 16, 32, 32, 64, 64, 128, 128), stem_stride=1, demo_stride=1),
        "strided": Backbone((16, 32, 64, 64), stem_stride=2, demo_stride=2),
    }
)
CORRESPONDENCE = "correspondence"
DEMO_ENCODERS = ("cnn", "attention", CORRESPONDENCE, "pretrained")
_EMBEDDINGS = ("cnn", "attention", "pretrained")
# Options that have an effect with some encoders of demonstrations alone.
ENCODERS_OF_OPTIONS = MappingProxyType(
    {
        "vision_encoder": ("pretrained",),
        "vision_encoder_weights": ("pretrained",),
        "vision_image_size": ("pretrained",),
        "vision_input": ("pretrained",),
        "demo_variants": ("pretrained",),
        "demo_features_dir": ("pretrained",),
        "demo_head": ("pretrained",),
        "demo_crop": ("cnn", "pretrained"),
        "demo_frames_between": _EMBEDDINGS,
        "demos_per_task": _EMBEDDINGS,
        "n_demonstrations": (CORRESPONDENCE,),
        "goal_image_size": (CORRESPONDENCE,),
        "pretrained_matching": (CORRESPONDENCE,),
        "goal_noise": (CORRESPONDENCE,),
        "grasp_depth": (CORRESPONDENCE,),
        "depth_margin": (CORRESPONDENCE,),
        "depth_noise": (CORRESPONDENCE,),
        "locator_share": (CORRESPONDENCE,),
        "recolor_share": (CORRESPONDENCE,),
        "color_blind_tasks": (CORRESPONDENCE,),
    }
)
GRIPPER_LOSSES = MappingProxyType({"squared_error": 30.0, "cross_entropy": 3.0})  # and their usual weights
GRIPPER_CLOSED = ("low", "high")
MODALITIES = ("demo", "instruction")
DEMO_CROPS = ("array", "frame")
FRAMES_BETWEEN = ("spread", "any")
INITIAL_WEIGHTS = ("authors", "torch")
SCHEDULERS = ("constant", "cosine")
DTYPES = ("float32", "bfloat16")
# Options that may be files and folders of this machine.
PATHS = (
    "demo_root",
    "instruction_embeddings",
    "instructions",
    "vision_encoder",
    "vision_encoder_weights",
    "demo_features_dir",
)
# Options that name files or a dataset whose contents a checkpoint holds.
FILE_OPTIONS = (*(name for name in PATHS if name != "vision_encoder"), "demo_repo_id")
