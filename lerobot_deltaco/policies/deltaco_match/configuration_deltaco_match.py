"""`--policy.type=deltaco_match`; the defaults are for a robot, and the benchmark's recipes change a few."""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig

from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.data.training_data import DemonstrationFormat
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig


@PreTrainedConfig.register_subclass("deltaco_match")
@dataclass
class DeltacoMatchConfig(TaskConditionedConfig):
    """A policy that finds what a demonstration moved, and places it where an instruction says.

    It needs a fixed camera, a robot state, and a gripper among the action's dimensions. It acts on a
    demonstration, an instruction, or both.

    Args:
        acting: "network": the policy network acts. "replay": the demonstration's trajectory is replayed,
            moved to where the policy picks and places. Training is the same, and a checkpoint acts either way.
        crop_size: Side of the square around an object that is compared, in the middle of the first camera's
            image and as a fraction of its side. Used only where objects do not stand out from other scenes,
            such as after a camera was moved during recording; otherwise, the size of objects is measured.
        n_demonstrations: Number of demonstrations of each task that are combined in evaluation.
        grasp_height_bias: Height offset that is added to the estimate when the policy acts, in standard
            deviations over the training episodes; larger is farther along the approach. On a robot, a gripper
            that goes too far presses into the table. The benchmark's recipes choose 0.5, for flat objects.
        location_noise: Standard deviation of the noise on the pick and place locations in training, where the
            image's edges are at -1 and 1; by default, a pixel of 48. If that is more than the gripper's room
            beside an object, choose less, but no less than the error of the locations.
        state_noise: Standard deviation of the noise on half of the numbers of the robot's state in training,
            in their standard deviations over the training episodes. Less is more precise.
        p_color_jitter: Probability that a training sample's observation and demonstration undergo the
            same random change of hue, saturation and brightness.
        frames_after_release: Number of frames after the gripper has opened for the last time in an episode
            that `deltaco train` trains on, at 24 frames per second and proportionally at others; None for
            all.
    """

    chunk_size: int | None = None
    acting: str = "network"
    crop_size: float = 0.17
    n_demonstrations: int = 1
    num_mixture_components: int = 5
    grasp_height_bias: float = 0.0
    location_noise: float = 0.04
    state_noise: float = 0.1
    p_color_jitter: float = 0.7
    frames_after_release: int | None = 2
    p_paraphrase: float = 0.5
    precision: str = "bfloat16"
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 0.2
    scheduler_warmup_steps: int = 200
    # Filled in by training: the vocabulary of feature matching, and the range of the gripper's commands.
    known_words: list[str] = field(default_factory=list)
    gripper_range: float | None = None

    def check(self) -> None:
        """Checks the options.

        Raises:
            ValueError: An option is invalid; the message says what is valid.
        """
        super().check()
        self.check_choices(acting=("network", "replay"))
        self.check_ranges(
            crop_size=(0.01, 1),
            n_demonstrations=(1, 1000),
            grasp_height_bias=(-10, 10),
            location_noise=(0, 1),
            state_noise=(0, 10),
            p_color_jitter=(0, 1),
            frames_after_release=(0, 1_000_000),
        )
        if self.n_demonstrations > 1 and self.demo_episode is not None:
            raise UserError(
                "`demo_episode` names a single demonstration, but `n_demonstrations` is "
                f"{self.n_demonstrations}. Set `demo_episode` to null, or `n_demonstrations` to 1."
            )

    def set_dataset_feature_metadata(
        self, features: dict[str, dict[str, Any]], stats: dict[str, dict[str, Any]] | None = None
    ) -> None:
        """Finds out which dimension is the gripper, how far it moves, and how actions are scaled.

        Raises:
            ValueError: The names of the action's dimensions cannot be read.
        """
        super().set_dataset_feature_metadata(features, stats)
        if stats is not None and self.gripper_index is not None:
            action = stats["action"]
            least, most = (
                torch.as_tensor(action.get(quantile, action[end])).reshape(-1)[self.gripper_index]
                for quantile, end in (("q01", "min"), ("q99", "max"))
            )
            self.gripper_range = float(most - least)

    @property
    def gripper_command(self) -> Gripper | None:
        """How the gripper is read from an action, with the range of its commands in the training dataset."""
        command = super().gripper_command
        return None if command is None else replace(command, usual_range=self.gripper_range)

    @property
    def demonstration_format(self) -> DemonstrationFormat:
        """What the policy takes from an episode as a demonstration: the grasp, too."""
        return super().demonstration_format._replace(gripper=self.gripper_command)

    def validate_features(self) -> None:
        """Checks the inputs and outputs that LeRobot found in the dataset.

        Raises:
            ValueError: There is no camera, no state, or no gripper.
        """
        super().validate_features()
        if self.gripper_index is None or not self.state_dim:
            raise UserError(
                "`deltaco_match` learns where objects are from when the gripper closes and opens: it needs "
                "the feature 'observation.state' and a gripper among the action's dimensions, which "
                "`gripper` names. Without them, train --policy.type=deltaco."
            )
