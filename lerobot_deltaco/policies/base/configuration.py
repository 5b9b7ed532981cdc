"""Options shared by both policies, and values inferred from the training dataset."""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

import copy
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.optim import AdamWConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig, LRSchedulerConfig

from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.data.reading import dimension_names
from lerobot_deltaco.data.training_data import DemonstrationFormat
from lerobot_deltaco.errors import UserError

logger = logging.getLogger(__name__)

# Choice of `chunk_size`: its duration and the least duration of the episodes, in s, and its maximum.
_CHUNK_SECONDS, _MIN_CHUNKED_SECONDS, _MAX_CHUNK = 2 / 3, 2.5, 50
# Options that name files and datasets of the training machine, whose contents are in the checkpoint.
SOURCES = ("paraphrases", "demo_repo_id", "demo_root", "demo_point", "demo_photo", "picture_folder")


@dataclass
class TaskConditionedConfig(PreTrainedConfig):
    """Options of a policy that performs the task of a demonstration, an instruction, or both.

    Args:
        paraphrases: CSV file of other sentences for the tasks, from which instructions are drawn in training:
            columns `task` (the task string) and `instruction`, one sentence per row. Other tasks keep their
            task strings.
        p_paraphrase: Probability that a training sample's instruction is such a sentence; otherwise, it is
            the task string.
        image_size: Height and width to which images are scaled, px.
        chunk_size: Number of steps that the policy predicts at once. With None, training chooses two thirds
            of a second, or one step if episodes last less than 2.5 s.
        n_action_steps: Number of steps of a chunk that are carried out before the next one is predicted;
            None for all. If the gripper opens or closes in one of them, the whole chunk is carried out.
        temporal_ensemble_coeff: Coefficient of ACT's temporal ensembling, which predicts a chunk at every
            step and averages what the chunks say about it; None for none. It needs `n_action_steps=1`.
        trim_pauses: Whether `deltaco train` leaves out frames in which the robot has stood still for more
            than 0.1 s.
        num_mixture_components: Number of Gaussians of the action's distribution. One averages two actions
            that are equally good; of several, the policy cycles through the likely ones.
        gripper: Gripper's dimension of the action: an index, "auto" (of those whose name contains "gripper",
            the one that moves most; for `deltaco_match` made without a dataset, the last) or "none".
        gripper_closed: Whether low or high values of the gripper's dimension mean closed.
        demo_camera: Name of the camera of demonstrations, such as "observation.images.front". By default, the
            first.
        demo_repo_id: Dataset of demonstrations for evaluation, with at least one episode of each task. The
            checkpoint keeps them.
        demo_root: Folder of that dataset, if it is not in LeRobot's cache.
        demo_episode: Episode of that dataset to use as the demonstration of every instruction, such as a
            sentence of your own.
        training_episodes: Episodes that the policy is trained on, if not all of the dataset. Only
            `lerobot-train` with --dataset.episodes or --dataset.eval_split needs it, which tells a policy of
            neither; `deltaco train` does.
        tasks_per_batch: Largest number of tasks in a batch of `deltaco train`, with equally many samples of
            each (the paper: 16 tasks x 64 samples); 0 for samples of any tasks.
        upsampled_tasks: Regular expression for the instructions of the tasks that get `upsampled_fraction` of
            each batch of `deltaco train`.
        upsampled_fraction: Fraction of each batch for the upsampled tasks; 0.5 in the paper's scenario B.
        seed: Seed for drawing demonstrations and shifts, and of what is learned before the first step; the
            draws also depend on the step. By default, torch's, which LeRobot's training sets by --seed.
        precision: Precision of training: float32 or bfloat16; the last layers, and evaluation, always use
            float32. So does a CPU without bfloat16 instructions.
        optimizer_lr: Learning rate of AdamW.
        optimizer_weight_decay: Weight decay of AdamW.
        scheduler_warmup_steps: Number of warmup steps of the cosine schedule.
        grad_clip_norm: Maximum norm of the gradient; 0 for no clipping.
    """

    # Options that a policy keeps after its training, and those that only further training may change.
    trained_options: ClassVar[tuple[str, ...]] = ("image_size", "chunk_size", "num_mixture_components")
    dataset_options: ClassVar[tuple[str, ...]] = ("gripper", "gripper_closed", "demo_camera")

    paraphrases: str | None = None
    p_paraphrase: float = 1.0
    image_size: int = 48
    chunk_size: int | None = 1
    n_action_steps: int | None = None
    temporal_ensemble_coeff: float | None = None
    trim_pauses: bool = True
    num_mixture_components: int = 1
    gripper: str = "auto"
    gripper_closed: str = "low"
    demo_camera: str | None = None
    demo_repo_id: str | None = None
    demo_root: str | None = None
    demo_episode: int | None = None
    training_episodes: list[int] | None = None
    tasks_per_batch: int = 16
    upsampled_tasks: str | None = None
    upsampled_fraction: float = 0.5
    seed: int | None = None
    precision: str = "float32"
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 0.0
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

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.precision == "bfloat16" and self.device == "cpu" and not has_bfloat16():
            logger.warning("This CPU has no bfloat16 instructions: training computes in float32.")
            self.precision = "float32"
        try:
            self.check()
        except ValueError as error:
            # LeRobot's parser only says that the class cannot be instantiated.
            logger.error("%s", error)
            raise

    def check(self) -> None:
        """Checks the options.

        Raises:
            ValueError: An option is invalid; the message says what is valid.
        """
        self.check_choices(gripper_closed=("low", "high"), precision=("float32", "bfloat16"))
        if self.gripper not in ("auto", "none") and not self.gripper.isdecimal():
            raise UserError(f"`gripper` must be 'auto', 'none' or an index. Got {self.gripper!r}.")
        self.check_ranges(
            p_paraphrase=(0, 1),
            image_size=(16, 1024),
            num_mixture_components=(1, 1000),
            chunk_size=(1, 1000),
            n_action_steps=(1, self.chunk_size or _MAX_CHUNK),
            optimizer_lr=(1e-12, 10),
            optimizer_weight_decay=(0, 10),
            grad_clip_norm=(0, math.inf),
            # Weights of a chunk's steps are exp(-coefficient * step), which must not overflow.
            temporal_ensemble_coeff=(-0.05, 10),
            upsampled_fraction=(0, 1),
            scheduler_warmup_steps=(0, 10**9),
            tasks_per_batch=(0, 10**9),
            seed=(0, 2**63 - 1),
        )
        if self.temporal_ensemble_coeff is not None and self.n_action_steps != 1:
            raise UserError(
                "`temporal_ensemble_coeff` needs `n_action_steps=1`: it predicts a chunk at every step. "
                f"Got {self.n_action_steps}."
            )
        if self.demo_repo_id is not None and not self.demo_repo_id.strip():
            raise UserError(
                "`demo_repo_id` is empty. Name a dataset, such as USER/NAME, or leave it out. With "
                "--policy.demo_root, any name will do."
            )

        # Images must stay in 0..1, and actions in -1..1: the networks are made for these.
        for kind, valid in {"VISUAL": ("IDENTITY",), "ACTION": ("MIN_MAX", "IDENTITY")}.items():
            mode = self.normalization_mapping.get(kind, NormalizationMode.IDENTITY)
            if mode.name not in valid:
                raise UserError(
                    f"`normalization_mapping` must be {' or '.join(valid)} for {kind}. Got {mode.name}."
                )

    def check_choices(self, **choices: Any) -> None:
        """Checks that options are among their valid values.

        Raises:
            ValueError: One is not.
        """
        for name, valid in choices.items():
            if getattr(self, name) not in valid:
                names = ", ".join(filter(None, valid))
                raise UserError(f"`{name}` must be one of {names}. Got {getattr(self, name)!r}.")

    def check_ranges(self, **ranges: tuple[float, float]) -> None:
        """Checks that options, if given, are between their minimum and maximum valid values.

        Raises:
            ValueError: One is not.
        """
        for name, (least, greatest) in ranges.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= greatest:
                raise UserError(f"`{name}` must be from {least} to {greatest}. Got {value}.")

    # From the dataset

    def set_dataset_feature_metadata(
        self, features: dict[str, dict[str, Any]], stats: dict[str, dict[str, Any]] | None = None
    ) -> None:
        """Finds out which dimension of the action is the gripper.

        LeRobot calls this with the training dataset's features, before it makes the policy. The policy calls
        it again with the statistics, which tell which of several grippers moves.

        Raises:
            ValueError: The names of the action's dimensions cannot be read.
        """
        action = features.get("action", {})
        if self.gripper != "auto":
            return
        names = dimension_names(action)
        found = [index for index, name in enumerate(names) if "gripper" in name.lower()]
        if len(found) < 2:
            self.gripper = str(found[0]) if found else "none"
        elif stats is not None:
            spread = torch.as_tensor(stats["action"]["std"]).reshape(-1).tolist()
            self.gripper = str(max(found, key=lambda index: (spread[index], index)))
            logger.warning(
                "The action has %d grippers. The policy is about the one that moves most, %s. For another "
                "one, set --policy.gripper: %s.",
                len(found),
                self.name_gripper(features),
                ", ".join(f"{index} ({names[index]})" for index in found),
            )

    def name_gripper(self, features: dict[str, dict[str, Any]]) -> str:
        """Returns the gripper's dimension and its name in a dataset with these features, for messages."""
        names = features.get("action", {}).get("names")
        name = dimension_names(features["action"])[int(self.gripper)] if names else "without a name"
        return f"dimension {self.gripper} of the action ({name})"

    def set_dataset_length(self, meta: LeRobotDatasetMetadata) -> None:
        """Chooses `chunk_size` by the length of the training episodes, if it is not given."""
        if self.chunk_size is None:
            is_short = meta.total_frames < _MIN_CHUNKED_SECONDS * meta.fps * meta.total_episodes
            self.chunk_size = 1 if is_short else min(max(1, round(_CHUNK_SECONDS * meta.fps)), _MAX_CHUNK)

    def validate_features(self) -> None:
        """Checks the inputs and outputs that LeRobot found in the dataset.

        Raises:
            ValueError: There is no camera, no action, or no such gripper.
        """
        if not self.image_features:
            raise UserError(
                "The policy needs at least one camera. The dataset's inputs are "
                f"{', '.join(sorted(self.input_features or {})) or 'none'}."
            )
        assert self.action_feature is not None
        check_image_shapes({name: feature.shape for name, feature in self.image_features.items()})
        (action_dim,) = self.action_feature.shape
        if self.gripper_index is not None and not self.gripper_index < action_dim:
            raise UserError(
                f"`gripper` is {self.gripper_index}, but the action has only the dimensions 0 to "
                f"{action_dim - 1}. Name one of these, or 'none'."
            )
        if self.demo_camera is not None and self.demo_camera not in self.image_features:
            raise UserError(
                f"`demo_camera` must be one of the dataset's cameras, {', '.join(self.image_features)}. Got "
                f"{self.demo_camera!r}."
            )

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras; the one used for demonstrations comes first."""
        names = list(self.image_features)
        if self.demo_camera is not None:
            names.sort(key=lambda name: name != self.demo_camera)
        return tuple(names)

    @property
    def gripper_index(self) -> int | None:
        """Dimension of the action that is the gripper; None without one."""
        return int(self.gripper) if self.gripper.isdecimal() else None

    @property
    def gripper_command(self) -> Gripper | None:
        """How the gripper is read from an action; None without one."""
        return None if self.gripper_index is None else Gripper(self.gripper_index, self.gripper_closed)

    @property
    def demonstration_format(self) -> DemonstrationFormat:
        """What the policy takes from an episode as a demonstration."""
        return DemonstrationFormat(self.cameras[0], self.image_size, self.n_demo_frames)

    @property
    def state_dim(self) -> int:
        """Size of the robot's state, 0 without one."""
        return self.robot_state_feature.shape[0] if self.robot_state_feature else 0

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the policy takes demonstrations."""
        return True

    @property
    def n_demo_frames(self) -> int:
        """Number of frames of a demonstration."""
        return 2

    # LeRobot's interface

    def _save_pretrained(self, save_directory: Path) -> None:
        saved = copy.copy(self)
        for name in SOURCES:
            if hasattr(saved, name):
                setattr(saved, name, None)
        PreTrainedConfig._save_pretrained(saved, save_directory)

    def get_optimizer_preset(self) -> AdamWConfig:
        """Returns AdamW, which equals Adam without weight decay."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.grad_clip_norm,
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Returns the cosine schedule of the learning rate."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def observation_delta_indices(self) -> None:
        """Only the current observation is used."""
        return

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Steps of a chunk; None for only the next action."""
        return None if self.chunk_size == 1 else list(range(self.chunk_size or _MAX_CHUNK))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return


def check_image_shapes(shapes: dict[str, Sequence[int]]) -> None:
    """Checks that cameras, unlike depth cameras, give images of three colors.

    Args:
        shapes: Shapes of the cameras' images, by name.

    Raises:
        ValueError: One does not, such as a depth camera.
    """
    wrong = {name: tuple(shape) for name, shape in shapes.items() if len(shape) != 3 or shape[0] != 3}
    if wrong:
        raise UserError(
            f"Images must have the shape (3, height, width). Got {wrong}. Leave out depth and gray cameras: "
            "lerobot-edit-dataset --repo_id=DATASET --operation.type=remove_feature "
            f'--operation.feature_names="{list(wrong)}" makes a dataset without them.'
        )


def has_bfloat16() -> bool:
    """Returns whether this CPU has bfloat16 instructions; without them, bfloat16 is emulated, slowly."""
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
