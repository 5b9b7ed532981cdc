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
        acting: How the policy acts. "replay": the demonstration's trajectory is replayed, moved to where the
            policy picks and places; without a demonstrated one, that of the training episode whose grasp and
            release were nearest. "network": the policy network acts. Training is the same: a checkpoint acts
            either way. With None, training chooses "replay" for up to 600 episodes.
        n_demonstrations: Number of demonstrations of each task that are combined in evaluation.
        demo_point: Point [x, y] or box [left, top, right, bottom] on the object to pick, px, in place of a
            demonstration: in the first image of the episode by the camera of demonstrations, or in
            `demo_photo`. The instruction says where to put the object.
        demo_photo: Image file that shows the object, in place of a demonstration. With a box in `demo_point`,
            by any camera; with a point, by the camera of demonstrations; without, the object fills it.
        picture_folder: Folder in which a picture of what was found is written at the start of each episode.
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
    acting: str | None = None
    n_demonstrations: int = 1
    demo_point: list[float] | None = None
    demo_photo: str | None = None
    picture_folder: str | None = None
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
    # Filled in by training: the vocabulary of feature matching (with "" for words of tasks that are not
    # trained on), the tasks after few episodes, the episodes that were held out of its fit, the number of
    # frames of their dataset, and the range of the gripper's commands.
    known_words: list[str] = field(default_factory=list)
    trained_tasks: list[str] = field(default_factory=list)
    held_out_episodes: list[int] = field(default_factory=list)
    n_dataset_frames: int | None = None
    gripper_range: float | None = None

    def check(self) -> None:
        """Checks the options.

        Raises:
            ValueError: An option is invalid; the message says what is valid.
        """
        super().check()
        self.check_choices(acting=(None, "network", "replay"))
        self.check_ranges(
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
        if self.gripper == "auto" and self.action_feature is not None:
            # Made without a dataset, which names dimensions.
            self.gripper = str(self.action_feature.shape[0] - 1)
        super().validate_features()
        if self.gripper_index is None or not self.state_dim:
            raise UserError(
                "`deltaco_match` learns where objects are from when the gripper closes and opens: it needs "
                "the feature 'observation.state' and a gripper among the action's dimensions, which "
                "`gripper` names. Without them, train --policy.type=deltaco."
            )


@dataclass(frozen=True)
class MatchingSettings:
    """Tuned constants of feature matching and of its fit, chosen on folds of the training objects.

    The constants of a single network or measurement stand at the top of its file.

    Args:
        p_other_object: Probability that a demonstration shows another object than the one that the words
            describe, if all of them are known and no proposal matches the demonstrated instance.
        sharpness: Factor of the cosines when the policy acts; 1 in the fit, where dropout makes them noisy.
        p_misdescribed: Probability that words describe another object than is meant: people see other colors
            and shapes in it.
        p_misdemonstrated: Probability that a demonstration shows another object than is meant, where known
            words describe it. With both floors, what words name unmistakably in the scene is picked, whatever
            is demonstrated; where they name nothing or several, the demonstration decides. Only after more
            than `few_episodes`.
        shown_word_weight: Pages mark words above this weight as describing the object.
        map_std: Standard deviation of a candidate in a map, in cells.
        min_coverage: If fewer of the training grasps than this fraction are at something that stands out, a
            warning says so.
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
        place_reaches: How far from a release what stands at the place is looked for, in distances within
            which a proposal stands for a grasped object. The fit chooses one; with 0, places never move.
        moved_place: How much more a place must look like the demonstrated one, as a cosine, than what is now
            where that was.
        grasp_error: Distance from a grasp within which a proposal stands for the grasped object, where an
            image's edges are at -1 and 1, in addition to `grasp_size`.
        grasp_size: Part of that distance that grows with the objects, in their diameters.
        template_weight: Weight of a proposal's correlation with the demonstrated grasp, for new objects: the
            learned descriptors tell less of them.
        few_episodes: Number of training episodes up to which demonstrations are better guides than what was
            learned: words do not outweigh them; and for other tasks than those of the training, grasps look
            like theirs, and they may say where to place.
        template_reach: How far from a proposal the demonstrated grasp is looked for, in diameters.
        refinement_steps: Steps of the fit of where on an object the gripper closes.
        min_matching_steps: Smallest number of steps of the fit of the matching head.
        max_matching_steps: Largest number of steps.
        matching_draws: How often each scene is drawn in them, as far as these bounds allow.
        matching_batch: Pairs of scene and demonstration in a step.
        initial_separation: Distance, as logits, to which the median right and wrong cosines are scaled before
            the fit.
        sharpnesses: Factors of the scores, among which held-out episodes choose.
        learning_rate: Highest learning rate of the matching head.
        scale_learning_rate: Highest learning rate of the scales of the cosines and of the gate.
        word_learning_rate: Highest learning rate of the word weights.
        weight_decay: Weight decay of the matching head.
        warmup_fraction: Fraction of the steps in which the learning rates rise.
        p_drop_word: Probability that a word is left out in a step, so that none is indispensable.
        word_penalty: Loss of a word's weight: words that tell nothing would only add noise.
        common_word_penalty: How much more the weight of a word costs that is in every sentence.
        common_fraction: A word in more than this fraction of the sentences costs more.
    """

    p_other_object: float = 0.5
    sharpness: float = 1.5
    p_misdescribed: float = 0.1
    p_misdemonstrated: float = 0.3
    shown_word_weight: float = 0.5
    map_std: float = 0.8
    min_coverage: float = 0.75
    feature_weight: float = 0.8
    max_variants: int = 5
    variant_scenes: int = 1000
    variant_offset: float = 0.1
    variant_log_scale: float = 0.1
    held_out_every: int = 8
    min_held_out: int = 4
    n_checks: int = 10
    max_episodes: int = 10_000
    place_reaches: tuple[float, ...] = (0.0, 1.0, 2.0)
    moved_place: float = 0.2
    grasp_error: float = 0.06
    grasp_size: float = 0.75
    template_weight: float = 20.0
    template_reach: float = 0.5
    few_episodes: int = 600
    refinement_steps: int = 300
    min_matching_steps: int = 300
    max_matching_steps: int = 1500
    matching_draws: int = 16
    matching_batch: int = 64
    initial_separation: float = 6.0
    sharpnesses: tuple[float, ...] = (0.4, 0.55, 0.7, 0.85, 1.0)
    learning_rate: float = 1e-3
    scale_learning_rate: float = 0.02
    word_learning_rate: float = 3e-3
    weight_decay: float = 0.2
    warmup_fraction: float = 0.1
    p_drop_word: float = 0.3
    word_penalty: float = 0.03
    common_word_penalty: float = 30.0
    common_fraction: float = 0.8
