"""`--policy.type=deltaco`: every method, baseline and ablation of the paper as a configuration."""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, NamedTuple

from lerobot.configs import PreTrainedConfig
from lerobot.optim.schedulers import LRSchedulerConfig

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig
from lerobot_deltaco.policies.base.language import LANGUAGE_ENCODERS, MINILM_L3
from lerobot_deltaco.policies.base.losses import GRIPPER_LOSSES
from lerobot_deltaco.policies.base.networks import BACKBONES
from lerobot_deltaco.policies.deltaco.vision import VISION_ENCODERS


class Conditioning(NamedTuple):
    """How a method conditions the policy network."""

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
        # The mean of two imitation losses: with the instruction (through a projection) and with the
        # demonstration.
        "mcil": Conditioning("language_or_demo", "none", "none"),
    }
)
INPUTS = ("none", "demo", "language", "demo+language")
ENCODER_LOSSES = ("contrastive", "cosine", "none")
DEMO_ENCODERS = ("cnn", "attention", "pretrained")
DEMO_COLUMNS = 2  # of the grid of a demonstration's frames, n in the paper


@PreTrainedConfig.register_subclass("deltaco")
@dataclass
class DeltacoConfig(TaskConditionedConfig):
    """DeL-TaCo (Yu & Mooney, ICLR 2023): a policy conditioned on a demonstration and an instruction.

    The defaults are the paper's (tables 5 to 7), for images of 48 x 48 pixels. On a small machine, choose
    `backbone=strided`: half of the residual blocks, with up to 64 channels, on maps of half the size, for a
    seventeenth of the arithmetic.

    Args:
        language_encoder: Frozen sentence encoder: paraphrase-MiniLM-L3-v2 (the authors'), all-MiniLM-L6-v2,
            all-distilroberta-v1, distilbert-base-uncased or clip-vit-base-patch32. The extra `language`
            includes the first two.
        method: Method of the paper: deltaco, language_only, demo_only, one_hot, bc_z or mcil.
        film: Ablation: input through FiLM, instead of the method's: none, demo, language or demo+language.
            With `film`, `concat` and `encoder_loss` none, the policy sees the scene alone.
        concat: Ablation: input that is concatenated to the feature points, instead of the method's; same
            values as `film`.
        encoder_loss: Ablation: encoder loss, instead of the method's: contrastive, cosine or none.
        language_head: Sizes of the hidden layers of fully connected layers after the language encoder, whose
            output has unit length, such as [512]; none by default. MCIL always has such layers, by default
            [384], as in the authors' code.
        demo_encoder: Encoder of demonstrations: cnn, the paper's; attention, this project's, which compares
            the frames at each location and attends to a few locations; or pretrained, a frozen image encoder.
        vision_encoder: Frozen image encoder for `demo_encoder=pretrained`: efficientnet-lite0; or
            clip-vit-base-patch32, r3m-resnet18 or r3m-resnet18-authors, which are downloaded. The last gets
            images as in the authors' code: in 0..1 instead of 0..255, and not scaled.
        vision_image_size: Height and width to which the grid of a demonstration's frames is scaled for that
            encoder; by default, the size of the images that it was trained on.
        demo_variants: Number of variants of each demonstration (random shifts, and random frames between the
            ends) that a pretrained encoder encodes before training; each sample gets one of them.
        demo_head: Sizes of the hidden layers of fully connected layers after a pretrained encoder, such as
            [256]; by default, there are no layers at all.
        demo_rows: Number of rows of the grid of a demonstration's frames, m in the paper; it has two columns.
            The frames are the first, the last, and random ones between them; `attention` takes as many,
            without a grid.
        backbone: Convolutional network: paper or strided.
        gripper_loss: Loss of the gripper: squared_error, the paper's; or cross_entropy.
        shift_padding: Largest random shift of observations in training, px; 0 for none.
        demo_shift_padding: Largest random shift of demonstrations in training, px; 0 for none.
        drop_n_last_frames: Number of frames at the end of each episode that are left out of training.
        scheduler_name: Schedule of the learning rate: constant, or cosine, which decays to 0.
    """

    trained_options: ClassVar[tuple[str, ...]] = (
        *TaskConditionedConfig.trained_options,
        *("method", "film", "concat", "language_encoder", "backbone"),
        *("demo_encoder", "demo_rows", "vision_encoder", "vision_image_size"),
    )

    method: str = "deltaco"
    film: str | None = None
    concat: str | None = None
    encoder_loss: str | None = None
    language_encoder: str = MINILM_L3
    language_head: list[int] | None = None
    demo_encoder: str = "cnn"
    vision_encoder: str = "clip-vit-base-patch32"
    vision_image_size: int | None = None
    demo_variants: int = 8
    demo_head: list[int] | None = None
    demo_rows: int = 1
    backbone: str = "paper"
    gripper_loss: str = "squared_error"
    shift_padding: int = 4
    demo_shift_padding: int = 4
    drop_n_last_frames: int = 0
    scheduler_name: str = "constant"
    # The tasks known to a one-hot policy.
    one_hot_tasks: list[str] = field(default_factory=list)

    def check(self) -> None:
        """Checks the options.

        Raises:
            ValueError: An option is invalid; the message says what is valid.
        """
        super().check()
        self.check_choices(
            language_encoder=LANGUAGE_ENCODERS,
            method=METHODS,
            film=(None, *INPUTS),
            concat=(None, *INPUTS),
            encoder_loss=(None, *ENCODER_LOSSES),
            demo_encoder=DEMO_ENCODERS,
            vision_encoder=VISION_ENCODERS,
            backbone=BACKBONES,
            gripper_loss=GRIPPER_LOSSES,
            scheduler_name=("constant", "cosine"),
        )
        self.check_ranges(
            demo_variants=(1, 1000), demo_rows=(1, 64), shift_padding=(0, 1024), demo_shift_padding=(0, 1024)
        )
        self._check_conditioning()

    def _check_conditioning(self) -> None:
        overridden = [name for name in ("film", "concat", "encoder_loss") if getattr(self, name) is not None]
        if overridden and self.method in ("one_hot", "mcil"):
            raise UserError(f"`{overridden[0]}` cannot be changed in the method {self.method!r}.")
        encoder_loss = self.conditioning.encoder_loss
        if encoder_loss != "none" and not self.uses_demonstrations:
            raise UserError(
                f"`encoder_loss` is {encoder_loss!r}, but no demonstration is used. Set it to 'none', or use "
                "one in `film` or `concat`."
            )
        is_compared = encoder_loss != "none" or self.method == "mcil"
        if is_compared and self.demo_dim != self.embedding_dim:
            raise UserError(
                f"The demonstrations' embeddings, of {self.vision_encoder!r}, have {self.demo_dim} numbers, "
                f"and the instructions' have {self.embedding_dim}. To compare them, give `demo_head` layers, "
                "such as [256]; or set `encoder_loss` to 'none'."
            )

    @property
    def embedding_dim(self) -> int:
        """Size of an instruction's embedding."""
        return LANGUAGE_ENCODERS[self.language_encoder].embedding_dim

    @property
    def conditioning(self) -> Conditioning:
        """The method's conditioning, with the changes of an ablation."""
        changed = {
            name: getattr(self, name) for name in Conditioning._fields if getattr(self, name) is not None
        }
        return METHODS[self.method]._replace(**changed)

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the policy takes demonstrations."""
        return any("demo" in source for source in self.conditioning[:2])

    @property
    def uses_language(self) -> bool:
        """Whether instructions are embedded: as an input, or for the encoder loss."""
        film, concat, encoder_loss = self.conditioning
        return "language" in film or "language" in concat or encoder_loss != "none"

    @property
    def n_demo_frames(self) -> int:
        """Number of frames of a demonstration."""
        return self.demo_rows * DEMO_COLUMNS

    @property
    def demo_dim(self) -> int:
        """Size of a demonstration's embedding."""
        if self.demo_encoder == "pretrained" and self.demo_head is None:
            return VISION_ENCODERS[self.vision_encoder].feature_dim
        return self.embedding_dim

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Returns the schedule of the learning rate; None for a constant one."""
        return None if self.scheduler_name == "constant" else super().get_scheduler_preset()
