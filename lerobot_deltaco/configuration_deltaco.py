"""`--policy.type=deltaco`: every method, baseline and ablation of the paper as a configuration."""

# No `from __future__ import annotations`: see `modeling_deltaco.py`.

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig

from gym_deltaco.instructions import INSTRUCTION_SPLITS
from lerobot_deltaco.collect import ACTION_NAMES
from lerobot_deltaco.common.checks import check_choices
from lerobot_deltaco.common.typed_fields import check_field_types, check_ranges
from lerobot_deltaco.lerobot_internals import log_refusals
from lerobot_deltaco.policy.language.encoder_names import DEFAULT_LANGUAGE_ENCODER, LANGUAGE_ENCODERS
from lerobot_deltaco.policy.optimization import CosineSchedulerConfig, FusedAdamWConfig
from lerobot_deltaco.policy.options import (
    BACKBONES,
    CORRESPONDENCE,
    DEMO_CROPS,
    DEMO_ENCODERS,
    DTYPES,
    ENCODER_LOSSES,
    ENCODERS_OF_OPTIONS,
    FRAMES_BETWEEN,
    GOAL_SOURCES,
    GRIPPER_CLOSED,
    GRIPPER_LOSSES,
    INITIAL_WEIGHTS,
    INPUTS,
    METHODS,
    MODALITIES,
    PATHS,
    SCHEDULERS,
    Conditioning,
)
from lerobot_deltaco.policy.upsampling import count_upsampled_tasks
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS, VISION_INPUTS

GOAL_DETAILS = (1, 2, 4, 8)  # by which `goal_image_size` may be larger than `image_size`
MAX_LAYER_SIZE = 100_000  # of `language_head` and `demo_head`
ACTION_TOLERANCE = 1e-3  # by which actions in -1..1 may be beyond
# Valid modes of `normalization_mapping`; that of the state is free.
NORMALIZATIONS = MappingProxyType(
    {
        "VISUAL": (NormalizationMode.IDENTITY,),
        "ACTION": (NormalizationMode.MIN_MAX, NormalizationMode.IDENTITY),
    }
)
# The least and the greatest valid value. Beyond them, memory would not do, or arithmetic would overflow.
RANGES = MappingProxyType(
    {
        "demo_rows": (1, 64),
        "demo_columns": (1, 64),
        "vision_image_size": (16, 4096),
        "demo_variants": (1, 1000),
        "demo_feature_dim": (1, 1_000_000),
        "image_size": (16, 1024),
        "goal_image_size": (16, 8192),
        "motion_modes": (1, 1000),
        "gripper_weight": (0, 1e6),
        "encoder_loss_weight": (0, 1e6),
        "temperature": (1e-3, 1e3),
        "crop_padding": (0, 1024),
        "demo_crop_padding": (0, 1024),
        "n_demonstrations": (1, 1000),
        "goal_noise": (0, 10),
        "depth_noise": (0, 10),
        "depth_margin": (-10, 10),
        "locator_share": (1e-6, 1),
        "demo_dropout": (0, 1),
        "instruction_dropout": (0, 1),
        "recolor_share": (0, 1),
        "frames_after_release": (0, 1_000_000),
        "demos_per_task": (0, 10_000),
        "demo_episode": (0, 2**63 - 1),
        "drop_n_last_frames": (0, 1_000_000),
        "tasks_per_batch": (0, 1_000_000),
        "seed": (0, 2**63 - 1),
        "optimizer_lr": (1e-12, 10),
        "optimizer_weight_decay": (0, 1e3),
        "optimizer_l2": (0, 1e3),
        "scheduler_warmup_steps": (0, 1_000_000_000),
        "grad_clip_norm": (0, 1e6),
    }
)


@PreTrainedConfig.register_subclass("deltaco")
@dataclass
class DeltacoConfig(PreTrainedConfig):
    """DeL-TaCo (Yu & Mooney, ICLR 2023): a policy conditioned on a demonstration and an instruction.

    The defaults are the paper's (tables 5 to 7), for images of 48 x 48 pixels. On a small machine, choose
    `backbone=strided`: half of the residual blocks, with up to 64 channels, on maps of half the size, for a
    seventeenth of the arithmetic, and, with `demo_encoder=cnn`, a demonstration encoder on maps of half the
    size.

    Args:
        method: Method of the paper: deltaco, language_only, demo_only, one_hot, bc_z or mcil.
        film: Ablation: input through FiLM, instead of the method's: none, demo, language or demo+language.
        concat: Ablation: input that is concatenated to the feature points, instead of the method's; the same
            values.
        encoder_loss: Ablation: encoder loss, instead of the method's: contrastive, cosine or none.
        language_encoder: Frozen sentence encoder: paraphrase-MiniLM-L3-v2 (the authors'),
            all-MiniLM-L6-v2, all-distilroberta-v1, distilbert-base-uncased or clip-vit-base-patch32. The
            extra `offline` brings the first two, which are then not downloaded.
        instruction_embeddings: File with embeddings of instructions, which are then not computed: a
            checkpoint's tasks.safetensors, or one that `deltaco-embed` wrote. A machine with it needs no
            language model.
        instructions: CSV file with human-written instructions for the benchmark's tasks, as
            `deltaco-instructions` downloads or checks it. In training, each sample's instruction is drawn
            from the sentences of its task. In evaluation, a sentence gets the demonstrations of its task.
        instructions_split: Split of the file's sentences for training: train, the sentences that are not held
            out for any task; held_out, the last sentence of each task; or all.
        instructions_templates: Whether to also train on the task string itself, as often as on each sentence.
        language_head: Sizes of the hidden layers of fully connected layers after the language encoder, whose
            output has unit length, such as [512]; none by default. MCIL always has such layers; by default
            [384], as in the authors' code.
        normalize_language: Whether to scale instructions' embeddings to unit length, as in the paper. (The
            authors' code does so only where an encoder loss compares them with demonstrations.)
        demo_encoder: Encoder of demonstrations. cnn: the paper's. attention (ours): an encoder that compares
            the frames at each place, and attends to a few places. correspondence (ours): no embedding;
            instead, the policy looks in the scene for the object that the demonstration moved, the
            instruction says where it goes, and both places are goals of the policy network. This needs a
            camera that does not move, a robot state, and a gripper; without demonstrations (language_only,
            one_hot), the method's other input says what to look for. pretrained: a frozen image encoder.
        vision_encoder: Frozen image encoder for `demo_encoder=pretrained`: clip-vit-base-patch32,
            r3m-resnet18, r3m-resnet34, r3m-resnet50, dinov2-small, siglip2-base, efficientnet-lite0 (which
            the extra `offline` brings), a folder with an image model of transformers, or
            its name on the Hugging Face Hub.
        vision_encoder_weights: File with R3M's weights, which are otherwise downloaded.
        vision_image_size: Height and width to which the array of a demonstration's frames is scaled for that
            encoder; by default, the size of the images that it was trained on.
        vision_input: Format of R3M's images: published, that of R3M; or authors, as in the authors' code, in
            0..1 instead of 0..255 and not scaled to 224 pixels.
        demo_variants: Number of variants of each demonstration (random crops, and random frames between the
            ends) that a pretrained encoder encodes before training; each sample gets one of them.
        demo_features_dir: Folder that keeps those features for further training runs; none by default.
        demo_head: Sizes of the hidden layers of fully connected layers after a pretrained encoder, such as
            [256]; by default, there are no layers at all.
        demo_rows: Number of rows of the array of a demonstration's frames, m in the paper.
        demo_columns: Number of columns of that array, n in the paper. Its m n frames are the first, the last,
            and random ones between them; `attention` takes as many frames, without an array.
        image_size: Height and width to which images are scaled, if they differ.
        backbone: Convolutional network: paper or strided.
        motion_modes: Number of Gaussians of the motion's distribution. The paper has one, which averages two
            motions that are equally good; of several, the policy takes the likeliest.
        gripper: Gripper's dimension of the action: an index, "auto" (the last one whose name contains
            "gripper", if any) or "none".
        gripper_closed: Which values of the gripper's dimension mean closed: low or high. Grasps and releases
            are found by them.
        gripper_loss: Loss of the gripper: squared_error, or cross_entropy (ours).
        gripper_weight: Weight of the gripper loss in the policy loss; by default 30, or 3 for cross_entropy.
        encoder_loss_weight: Weight of the encoder loss, alpha_d in the paper's equation 3.
        temperature: Temperature of the contrastive loss.
        crop_padding: Largest random shift of observations in training, in pixels; 0 for none.
        demo_crop_padding: Largest random shift of demonstrations in training, in pixels of images of
            `image_size`; 0 for none. Without it, the encoder overfits to a small dataset.
        demo_camera: Name of the camera for demonstrations and goals, such as "observation.images.front". By
            default, the first.
        n_demonstrations: Number of demonstrations of each task that are combined in evaluation, with
            `demo_encoder=correspondence`.
        goal_image_size: Height and width to which the first image of an episode and those of the
            demonstrations are scaled for finding goals: `image_size`, or 2, 4 or 8 times as much. The
            dataset's images must be at least as large. By default, `image_size`. On the benchmark, 96
            instead of 48 did not help.
        pretrained_matching: Whether what a demonstration moved, and what the instruction names by words of
            training tasks, is also looked for by the features of EfficientNet-Lite0, which was trained on
            ImageNet, with `demo_encoder=correspondence`. Before the training, this takes a few minutes
            for images of 48 px, and needs the extra `offline`; afterwards, the checkpoint is enough.
        known_words: Words of the training tasks, for `pretrained_matching`; filled in by training.
        goal_noise: Standard deviation of the noise on goals in training, in coordinates in which an image's
            edges are at -1 and 1; 0.04 is a pixel of 48.
        grasp_depth: Whether goals include the depth of the grasp (`policy/goals/states.py`), estimated from
            the demonstration and from what the object looks like.
        depth_margin: Depth that is added to the estimate in evaluation, in standard deviations of depths over
            the training episodes. A gripper that closes too high misses flat objects; on a robot, one that
            goes too low may touch the table.
        depth_noise: Standard deviation of the noise on depths in training, in standard deviations of depths.
        locator_share: Share of each batch's samples on which the policy learns to find goals. With 0.125, a
            training step of a small policy on a CPU takes a fifth less time (docs/experiment-log.md).
        demo_dropout: Share of the samples for finding goals that have no demonstration in training, with
            `method=deltaco` and `demo_encoder=correspondence`. A policy that has learned without can do
            without (`leave_out`).
        instruction_dropout: The same for the instruction; no sample is without both.
        leave_out: Modality that is left out in evaluation: demo or instruction; None for none.
        recolor_share: Share of training samples in which one random change of hue, saturation and brightness
            is applied to the observation and the demonstration alike, with `demo_encoder=correspondence`.
        color_blind_tasks: Regular expression for the instructions in which color does not count; the
            demonstrations of these tasks are recolored in another way than the scene.
        frames_after_release: Number of frames after the gripper's last opening in an episode that
            `deltaco-train` trains on, instead of leaving out the last `drop_n_last_frames`; None for all.
        demo_crop: Part of a demonstration that a random crop shifts, if its frames are laid out in an array
            (`cnn` and `pretrained`): array, the whole array, as in the authors' code; or frame, each frame.
        demo_frames_between: Choice of the frames between the first and the last: spread, one from each of as
            many equal parts of the time between, as in the authors' code; or any, drawn independently.
        demos_per_task: Number of demonstrations that the samples of a task share in a training batch, at
            least 2, so that none gets its own episode; 0 for a new one for every sample. Sharing saves most
            of the demonstration encoder's time.
        demo_repo_id: Dataset of demonstrations for evaluation, with at least one episode of each task.
        demo_root: Folder of that dataset, if it is not in LeRobot's cache.
        demo_episode: Episode of that dataset to use as the demonstration of every instruction, such as a
            paraphrase or a sentence of your own.
        demo_task: Task string whose demonstrations are used for every instruction.
        demo_episodes: Episodes of the training dataset from which demonstrations are drawn. By default, those
            that are trained on.
        drop_n_last_frames: Number of frames at the end of each episode that are not trained on.
        tasks_per_batch: Number of tasks in a batch of `deltaco-train`, with equally many samples of each (the
            paper: 16 tasks x 64 samples); 0 for samples of any tasks.
        upsampled_tasks: Regular expression for the instructions of the tasks that get `upsampled_share` of
            each batch of `deltaco-train`.
        upsampled_share: Share of each batch for the upsampled tasks; 0.5 in the paper's scenario B.
        initial_weights: Initial weights of the networks: authors, as in the authors' code
            (`policy/initial_weights.py`); or torch, PyTorch's. By default, the authors' for the paper's
            backbone.
        seed: Seed of the draws of demonstrations and crops, which also depend on the step.
        dtype: Precision of the networks: float32 or bfloat16; their last layers always use float32.
        compile: Whether to compile the networks, which makes training on a GPU faster.
        optimizer_lr: Learning rate of Adam.
        optimizer_weight_decay: Weight decay of AdamW.
        optimizer_l2: Weight of an L2 penalty in Adam's gradients, instead of AdamW's weight decay; 1e-4 in
            the authors' code, none in the paper.
        scheduler_name: Schedule of the learning rate: constant, or cosine, which decays to 0.
        scheduler_warmup_steps: Number of warmup steps of the cosine schedule.
        grad_clip_norm: Maximum norm of the gradient; 0 for no clipping.
    """

    method: str = "deltaco"
    film: str | None = None
    concat: str | None = None
    encoder_loss: str | None = None
    language_encoder: str = DEFAULT_LANGUAGE_ENCODER
    instruction_embeddings: str | None = None
    instructions: str | None = None
    instructions_split: str = "train"
    instructions_templates: bool = False
    language_head: list[int] | None = None
    normalize_language: bool = True
    demo_encoder: str = "cnn"
    vision_encoder: str = "clip-vit-base-patch32"
    vision_encoder_weights: str | None = None
    vision_image_size: int | None = None
    vision_input: str = "published"
    demo_variants: int = 8
    demo_features_dir: str | None = None
    demo_head: list[int] | None = None
    demo_rows: int = 1
    demo_columns: int = 2
    image_size: int = 48
    backbone: str = "paper"
    motion_modes: int = 1
    gripper: str = "auto"
    gripper_closed: str = "low"
    gripper_loss: str = "squared_error"
    gripper_weight: float | None = None
    encoder_loss_weight: float = 10.0
    temperature: float = 0.1
    crop_padding: int = 4
    demo_crop_padding: int = 4
    demo_camera: str | None = None
    n_demonstrations: int = 1
    goal_image_size: int | None = None
    pretrained_matching: bool = False
    known_words: list[str] = field(default_factory=list)
    goal_noise: float = 0.04
    grasp_depth: bool = True
    depth_noise: float = 0.1
    depth_margin: float = 0.0
    locator_share: float = 0.25
    demo_dropout: float = 0.0
    instruction_dropout: float = 0.0
    leave_out: str | None = None
    recolor_share: float = 0.0
    color_blind_tasks: str | None = None
    frames_after_release: int | None = None
    demo_crop: str = "array"
    demo_frames_between: str = "spread"
    demos_per_task: int = 0
    demo_repo_id: str | None = None
    demo_root: str | None = None
    demo_episode: int | None = None
    demo_task: str | None = None
    demo_episodes: list[int] | None = None
    drop_n_last_frames: int = 0
    tasks_per_batch: int = 0
    upsampled_tasks: str | None = None
    upsampled_share: float = 0.5
    initial_weights: str | None = None
    seed: int = 0
    dtype: str = "float32"
    compile: bool = False
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 0.0
    optimizer_l2: float = 0.0
    scheduler_name: str = "constant"
    scheduler_warmup_steps: int = 0
    grad_clip_norm: float = 0.0
    push_to_hub: bool = False
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    # Found out from the datasets and the pretrained encoder, and saved with the checkpoint.
    one_hot_tasks: list[str] = field(default_factory=list)
    demo_feature_dim: int | None = None

    @log_refusals
    def __post_init__(self) -> None:
        super().__post_init__()
        for name in PATHS:
            if isinstance(getattr(self, name), Path):
                setattr(self, name, str(getattr(self, name)))
        check_field_types(self)
        if self.initial_weights is None:
            self.initial_weights = "authors" if self.backbone == "paper" else "torch"
        check_choices(
            self,
            method=METHODS,
            language_encoder=LANGUAGE_ENCODERS,
            instructions_split=INSTRUCTION_SPLITS,
            demo_encoder=DEMO_ENCODERS,
            vision_input=VISION_INPUTS,
            demo_crop=DEMO_CROPS,
            demo_frames_between=FRAMES_BETWEEN,
            initial_weights=INITIAL_WEIGHTS,
            backbone=BACKBONES,
            gripper_closed=GRIPPER_CLOSED,
            gripper_loss=GRIPPER_LOSSES,
            scheduler_name=SCHEDULERS,
            dtype=DTYPES,
        )
        ablations = {"film": INPUTS, "concat": INPUTS, "encoder_loss": ENCODER_LOSSES}
        check_choices(
            self, **{name: ablations[name] for name in ablations if getattr(self, name) is not None}
        )
        if self.leave_out is not None:
            check_choices(self, leave_out=MODALITIES)
        if self.gripper_weight is None:
            self.gripper_weight = GRIPPER_LOSSES[self.gripper_loss]
        if self.gripper not in ("auto", "none") and not self.gripper.isdecimal():
            raise ValueError(f"`gripper` must be 'auto', 'none' or an index. Got {self.gripper!r}.")
        check_ranges(self, RANGES)
        self._check_normalization()
        for name in ("language_head", "demo_head"):
            sizes = getattr(self, name) or []
            if not all(1 <= size <= MAX_LAYER_SIZE for size in sizes):
                raise ValueError(f"`{name}` must be sizes of layers, 1 to {MAX_LAYER_SIZE}. Got {sizes}.")
        if self.optimizer_l2 and self.optimizer_weight_decay:
            raise ValueError(
                "`optimizer_l2` and `optimizer_weight_decay` exclude each other. Set one of them to 0."
            )
        if self.demos_per_task == 1:
            raise ValueError(
                "`demos_per_task` cannot be 1: samples of that episode would be demonstrated by themselves. "
                "Set it to 2 or more, or to 0 for a demonstration per sample."
            )
        if self.n_demo_frames < 2:
            raise ValueError(
                "A demonstration has its first and its last frame: `demo_rows` * `demo_columns` must be "
                f"at least 2. Got {self.n_demo_frames}."
            )
        if self.n_demonstrations > 1 and self.demo_episode is not None:
            raise ValueError(
                "`demo_episode` names a single demonstration, but `n_demonstrations` is "
                f"{self.n_demonstrations}. Set `demo_episode` to null, or `n_demonstrations` to 1."
            )
        self._check_upsampling()
        self._check_conditioning()
        self._check_dropout()
        self._check_pretrained()

    def _check_normalization(self) -> None:
        """Images must stay in 0..1, and actions in -1..1: the networks are made for these."""
        for kind, valid in NORMALIZATIONS.items():
            mode = self.normalization_mapping.get(kind, NormalizationMode.IDENTITY)
            if mode not in valid:
                names = " or ".join(each.value for each in valid)
                raise ValueError(f"`normalization_mapping` must be {names} for {kind}. Got {mode.value}.")

    def _check_upsampling(self) -> None:
        for name in ("upsampled_tasks", "color_blind_tasks"):
            try:
                re.compile(getattr(self, name) or "")
            except re.error as error:
                raise ValueError(
                    f"`{name}` must be a regular expression. Got {getattr(self, name)!r}: {error}."
                ) from None
        if self.upsampled_tasks is None:
            return
        if not 0 < self.upsampled_share < 1:
            raise ValueError(f"`upsampled_share` must be between 0 and 1. Got {self.upsampled_share}.")
        if self.tasks_per_batch < 2:
            raise ValueError(
                "`upsampled_tasks` get a share of the tasks of a batch: `tasks_per_batch` must be at least "
                f"2. Got {self.tasks_per_batch}."
            )
        count_upsampled_tasks(self.upsampled_share, self.tasks_per_batch)  # now, not after the decoding

    def _check_dropout(self) -> None:
        dropouts = {"demo": self.demo_dropout, "instruction": self.instruction_dropout}
        if any(dropouts.values()) and not (self.locates_goals and self.method == "deltaco"):
            raise ValueError(
                "`demo_dropout` and `instruction_dropout` need `method=deltaco` and "
                f"`demo_encoder={CORRESPONDENCE}`. Set them to 0, or choose these. Got {self.method!r} and "
                f"{self.demo_encoder!r}."
            )
        film, concat, _ = self.conditioning
        if self.instruction_dropout and (film, concat) != ("none", "none"):
            raise ValueError(
                "With `instruction_dropout`, the instruction is an input of the locator alone: `film` and "
                f"`concat` must be 'none'. Got {film!r} and {concat!r}."
            )
        if sum(dropouts.values()) >= 1:
            raise ValueError(
                "`demo_dropout` and `instruction_dropout` must sum to less than 1, so that some samples have "
                f"both. Got {self.demo_dropout} and {self.instruction_dropout}."
            )
        if self.leave_out is not None and not dropouts[self.leave_out]:
            raise ValueError(
                f"`leave_out` is {self.leave_out!r}, but this policy was not trained without it: "
                f"`{self.leave_out}_dropout` is 0. Leave `leave_out` away, or train with a dropout."
            )

    def _check_pretrained(self) -> None:
        if self.demo_encoder == "pretrained" and self.demo_feature_dim is None:
            spec = VISION_ENCODERS.get(self.vision_encoder)
            self.demo_feature_dim = None if spec is None else spec.feature_dim
        self.check_demo_dim()

    def check_demo_dim(self) -> None:
        """Checks that embeddings of demonstrations have the size that the method needs.

        Raises:
            ValueError: They are compared with embeddings of instructions, which have another size.
        """
        if not self.uses_demo or self.demo_dim in (None, self.embedding_dim):
            return
        if self.conditioning.encoder_loss != "none" or self.method == "mcil":
            raise ValueError(
                f"The demonstrations' embeddings, of {self.vision_encoder!r}, have {self.demo_dim} numbers, "
                f"and the instructions' have {self.embedding_dim}. To compare them, give `demo_head` layers, "
                "such as [256]; or set `encoder_loss` to 'none'."
            )

    def _check_conditioning(self) -> None:
        overridden = [name for name in ("film", "concat", "encoder_loss") if getattr(self, name) is not None]
        if overridden and self.method in ("one_hot", "mcil"):
            raise ValueError(f"`{overridden[0]}` cannot be changed in the method {self.method!r}.")
        self._check_options_of_encoders()
        film, concat, encoder_loss = self.conditioning
        if self.locates_goals:
            self._check_correspondence(film, concat, encoder_loss)
            return
        if film == concat == "none":
            raise ValueError("`film` and `concat` are both 'none': the policy would get no task.")
        if encoder_loss != "none" and not self.uses_demo:
            raise ValueError(
                f"`encoder_loss` is {encoder_loss!r}, but no demonstration is used. Set it to 'none', or use "
                "one in `film` or `concat`."
            )

    def _check_options_of_encoders(self) -> None:
        for name, encoders in ENCODERS_OF_OPTIONS.items():
            value, default = getattr(self, name), getattr(type(self), name)
            if value != default and self.demo_encoder not in encoders:
                raise ValueError(
                    f"`{name}` has no effect with `demo_encoder={self.demo_encoder}`: it is for "
                    f"{' and '.join(f'`demo_encoder={encoder}`' for encoder in encoders)}. Leave it out (its "
                    f"default is {default}), or choose another `demo_encoder`. Got {value!r}."
                )

    def _check_correspondence(self, film: str, concat: str, encoder_loss: str) -> None:
        if self.demo_image_size not in (factor * self.image_size for factor in GOAL_DETAILS):
            sizes = [factor * self.image_size for factor in GOAL_DETAILS]
            raise ValueError(
                f"`goal_image_size` must be `image_size` times {', '.join(map(str, GOAL_DETAILS))}: one of "
                f"{sizes}. Got {self.goal_image_size}."
            )
        if self.method not in GOAL_SOURCES:
            raise ValueError(
                f"`demo_encoder` cannot be {CORRESPONDENCE!r} in the method {self.method!r}. It can in "
                f"{', '.join(GOAL_SOURCES)}."
            )
        if self.pretrained_matching and GOAL_SOURCES[self.method][0] != "demo":
            raise ValueError(
                "`pretrained_matching` looks for what a demonstration moved. The method "
                f"{self.method!r} gets none: leave it out."
            )
        if "demo" in film or "demo" in concat or encoder_loss != "none":
            raise ValueError(
                f"With `demo_encoder={CORRESPONDENCE}`, demonstrations have no embedding: `film` and "
                f"`concat` can be 'none' or 'language', and `encoder_loss` 'none'. Got {film!r}, "
                f"{concat!r} and {encoder_loss!r}."
            )

    @property
    def locates_goals(self) -> bool:
        """Whether the policy is given places in the image as goals, which a locator finds."""
        return self.demo_encoder == CORRESPONDENCE

    @property
    def takes_either_modality(self) -> bool:
        """Whether the policy has learned to do without a demonstration, or without an instruction."""
        return self.demo_dropout > 0 or self.instruction_dropout > 0

    @property
    def goal_detail(self) -> int:
        """Factor by which images in which goals are found are larger than those of the policy's network."""
        return self.demo_image_size // self.image_size

    @property
    def demo_image_size(self) -> int:
        """Height and width of the images of demonstrations, px."""
        return self.goal_image_size or self.image_size

    @property
    def n_goals(self) -> int:
        """Number of goals that the policy is given: a grasp and a release, or none."""
        return 2 if self.locates_goals else 0

    @property
    def conditioning(self) -> Conditioning:
        """The method's, with what an ablation changes."""
        changed = {
            name: getattr(self, name) for name in Conditioning._fields if getattr(self, name) is not None
        }
        if self.locates_goals:
            return Conditioning("none", "none", "none")._replace(**changed)
        return METHODS[self.method]._replace(**changed)

    @property
    def uses_demo(self) -> bool:
        """Whether demonstrations are needed."""
        if self.locates_goals:
            return "demo" in GOAL_SOURCES[self.method]
        return any("demo" in source for source in self.conditioning[:2])

    @property
    def uses_language(self) -> bool:
        """Whether instructions are embedded: as an input, or for the encoder's loss."""
        film, concat, encoder_loss = self.conditioning
        if self.locates_goals and "language" in METHODS[self.method]:
            return True
        return "language" in film or "language" in concat or encoder_loss != "none"

    @property
    def language_is_input(self) -> bool:
        """Whether the network gets the instructions' embeddings, through FiLM or concatenated."""
        return any("language" in part for part in self.conditioning[:2])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, that of the demonstrations first."""
        names = list(self.image_features)
        if self.demo_camera is not None:
            names.sort(key=lambda name: name != self.demo_camera)
        return tuple(names)

    @property
    def n_demo_frames(self) -> int:
        """Frames of a demonstration."""
        return self.demo_rows * self.demo_columns

    @property
    def embedding_dim(self) -> int:
        """Size of a task embedding: the language encoder's."""
        return LANGUAGE_ENCODERS[self.language_encoder].embedding_dim

    @property
    def demo_dim(self) -> int | None:
        """Size of a demonstration's embedding; None until a pretrained encoder has been loaded."""
        if self.demo_encoder == "pretrained" and self.demo_head is None:
            return self.demo_feature_dim
        return self.embedding_dim

    @property
    def has_unit_language(self) -> bool:
        """Whether instructions' embeddings are scaled to unit length: always, where a loss compares them."""
        return self.normalize_language or self.conditioning.encoder_loss != "none"

    @property
    def gripper_index(self) -> int | None:
        """Dimension of the action that is the gripper, once it is known; None is none."""
        return int(self.gripper) if self.gripper.isdecimal() else None

    def gripper_opening(self, actions: Any) -> Any:
        """The gripper's commands in actions (frames, action), so that greater is more open, (frames,)."""
        assert self.gripper_index is not None
        command = actions[:, self.gripper_index]
        return command if self.gripper_closed == "low" else -command

    def resolve(
        self,
        dataset_features: dict[str, dict] | None,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Decides what the training dataset tells: which dimension is the gripper, how actions are scaled.

        Args:
            dataset_features: Features of the training dataset; None in evaluation, where all is known.
            dataset_stats: Its statistics, if they are known.

        Raises:
            ValueError: The features are not those of a policy, or actions that are not scaled are not in
                -1..1.
        """
        names = (dataset_features or {}).get("action", {}).get("names")
        if isinstance(names, dict):
            names = next(iter(names.values()))
        if names and list(names) == ACTION_NAMES:
            # The benchmark's actions are in -1..1 already.
            self.normalization_mapping["ACTION"] = NormalizationMode.IDENTITY
        elif dataset_features is not None:
            self._check_scaled_actions((dataset_stats or {}).get("action", {}))
        if self.gripper == "auto":
            found = [index for index, name in enumerate(names or ()) if "gripper" in str(name).lower()]
            self.gripper = str(found[-1]) if found else "none"
        self.validate_features()

    def _check_scaled_actions(self, stats: Mapping[str, Any]) -> None:
        """Checks that actions are in -1..1, if they are not scaled to it."""
        if self.normalization_mapping.get("ACTION", NormalizationMode.IDENTITY) == NormalizationMode.MIN_MAX:
            return
        ends = [float(number) for name in ("min", "max") for number in stats.get(name, ())]
        if any(abs(number) > 1 + ACTION_TOLERANCE for number in ends):
            raise ValueError(
                f"The dataset's actions are in {min(ends):g}..{max(ends):g}, but the policy predicts them in "
                "-1..1. Set `normalization_mapping` to MIN_MAX for ACTION."
            )

    def validate_features(self) -> None:
        """Checks the inputs and outputs that were found in the dataset.

        Raises:
            ValueError: There is no camera, no action, or no such gripper.
        """
        if not self.image_features:
            raise ValueError(
                "The policy needs at least one camera. The dataset's inputs are "
                f"{sorted(self.input_features or {})}."
            )
        if self.action_feature is None:
            raise ValueError(
                "The policy needs the feature 'action'. The outputs are "
                f"{sorted(self.output_features or {})}."
            )
        shapes = {name: tuple(feature.shape) for name, feature in self.image_features.items()}
        if any(len(shape) != 3 or shape[0] != 3 for shape in shapes.values()):
            raise ValueError(f"Images must have the shape (3, height, width). Got {shapes}.")
        for name, feature in (
            ("action", self.action_feature),
            ("observation.state", self.robot_state_feature),
        ):
            if feature is not None and (len(feature.shape) != 1 or feature.shape[0] < 1):
                raise ValueError(
                    f"`{name}` must be a vector, of the shape (n,). The dataset's has the shape "
                    f"{tuple(feature.shape)}."
                )
        (action_dim,) = self.action_feature.shape
        if self.gripper_index is not None and not self.gripper_index < action_dim:
            raise ValueError(
                f"`gripper` is {self.gripper_index}, but the action has only the dimensions 0 to "
                f"{action_dim - 1}. Name one of these, or 'none'."
            )
        if self.demo_camera is not None and self.demo_camera not in self.image_features:
            raise ValueError(
                f"`demo_camera` must be one of the dataset's cameras, {', '.join(self.image_features)}. Got "
                f"{self.demo_camera!r}."
            )
        height, width = shapes[self.cameras[0]][1:]
        if self.goal_image_size is not None and min(height, width) < self.goal_image_size:
            raise ValueError(
                f"`goal_image_size` is {self.goal_image_size}, but the images of {self.cameras[0]} have "
                f"{height} x {width} pixels. It must be at most {min(height, width)}; leave it out to find "
                "goals in the images that the policy's network gets."
            )
        if self.locates_goals and (self.gripper_index is None or self.robot_state_feature is None):
            raise ValueError(
                f"`demo_encoder={CORRESPONDENCE}` learns where things are from when the gripper closes "
                "and opens: it needs the feature 'observation.state' and a gripper among the action's "
                "dimensions, which `gripper` names. Without them, choose another `demo_encoder`."
            )
        if action_dim == 1 and self.gripper_index is not None:
            raise ValueError(
                "The action is nothing but a gripper. Set `gripper` to 'none' to learn it as a motion."
            )

    def check_episodes(self, n_episodes: int) -> None:
        """Checks the episodes that demonstrations are drawn from.

        Args:
            n_episodes: Number of episodes of the training dataset.

        Raises:
            ValueError: One is not in the dataset, or is named twice.
        """
        episodes = self.demo_episodes
        if episodes is None:
            return
        wrong = [episode for episode in episodes if not 0 <= episode < n_episodes]
        if not episodes or wrong or len(set(episodes)) < len(episodes):
            raise ValueError(
                f"`demo_episodes` must be different episodes of the training dataset, 0 to {n_episodes - 1}. "
                f"Got {wrong[:5] or episodes[:5]}."
            )

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """Adam; without weight decay by default."""
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            l2=self.optimizer_l2,
            grad_clip_norm=self.grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineSchedulerConfig | None:
        """The schedule of the learning rate; None is a constant."""
        if self.scheduler_name == "constant":
            return None
        return CosineSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def observation_delta_indices(self) -> None:
        """Only the present observation is used."""
        return

    @property
    def action_delta_indices(self) -> None:
        """Only the next action is predicted."""
        return

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return
