"""Goals of a policy (ours): fitted to the training episodes, learned to be found, and found in a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from lerobot.processor import NormalizerProcessorStep, TransitionKey, create_transition
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling.task_embedding import TaskEmbedder
from lerobot_deltaco.policy.demonstration_choice import goal_demonstrations
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, RobotData
from lerobot_deltaco.policy.goals.conditioning import FoundGoals, GoalConditioning
from lerobot_deltaco.policy.goals.correspondence import Given
from lerobot_deltaco.policy.goals.matching_fit import fit_matching
from lerobot_deltaco.policy.goals.pretrained_matching import PretrainedMatching
from lerobot_deltaco.policy.goals.recoloring import random_recolorings
from lerobot_deltaco.policy.goals.training import GoalBatch, GoalInputs, GoalTrainer, draw_given
from lerobot_deltaco.policy.goals.words import KnownWords, known_words
from lerobot_deltaco.policy.precision import autocast
from lerobot_deltaco.policy.vision import load_efficientnet_lite0

_LOSSES = ("grasp_loss", "release_loss", "depth_loss", "attention_loss")


class GoalSamples(NamedTuple):
    """A batch, as far as its goals are concerned.

    Attributes:
        images: Images of all cameras, that of the goals first, (batch, cameras, 3, H, W) in 0..1.
        episodes: Index of each sample's episode in the dataset, (batch,).
        rows: Row of that episode among the demonstrations, (batch,); -1 if it is not among them.
        tasks: Task string of each sample.
        instructions: Instruction of each sample: its task string, or a paraphrase.
    """

    images: Tensor
    episodes: Tensor
    rows: Tensor
    tasks: Sequence[str]
    instructions: Sequence[str]


class LocatorLoss(NamedTuple):
    """How well the goals of a share of the samples are found.

    Attributes:
        samples: Indices of these samples in the batch, (some,) int64, on the CPU.
        losses: Losses of the grasp, the release, the depth and the attention, (some, 4).
    """

    samples: Tensor
    losses: Tensor

    def added_to(self, loss: Tensor) -> Tensor:
        """The loss of all samples, (batch,), with that of these, weighted as if all had been taken."""
        share = len(loss) / len(self.samples)
        return loss.index_add(0, self.samples.to(loss.device), share * self.losses.sum(dim=1))

    def logged(self) -> dict[str, Tensor]:
        """Means of the four, each of shape (), by the names under which they are logged."""
        return dict(zip(_LOSSES, self.losses.mean(dim=0), strict=True))


def fit_goals(
    config: DeltacoConfig,
    goals: GoalConditioning,
    demonstrations: DemonstrationSet,
    robot_data: RobotData,
    stats: dict[str, dict[str, Tensor]] | None,
) -> GoalTrainer:
    """Finds the goals of the training episodes, and notes the robot's states there in the demonstrations.

    Args:
        config: Configuration of the policy.
        goals: Networks that find goals; their states at goals are fitted.
        demonstrations: The training episodes.
        robot_data: States and actions of the robot in them.
        stats: Statistics of the dataset, by which the preprocessor normalizes.

    Raises:
        ValueError: There are too few episodes in which the gripper closes and opens, or, for pretrained
            matching, no task with two of them.
        VisionEncoderError: The weights that pretrained matching needs are missing.
    """

    def normalize(states: Tensor) -> Tensor:
        """Robot states of the dataset (n, state) as the preprocessor makes them, on the CPU."""
        step = NormalizerProcessorStep(
            {OBS_STATE: config.robot_state_feature}, config.normalization_mapping, stats
        )
        normalized = step(create_transition(observation={OBS_STATE: states.cpu()}))
        return normalized[TransitionKey.OBSERVATION][OBS_STATE]

    gripper = config.gripper_opening(robot_data.actions)
    trainer = GoalTrainer(goals, demonstrations, robot_data, gripper, normalize)
    states, found = trainer.goals.states[:, 0], trainer.goals.found
    demonstrations.grasp_states = torch.where(found[:, None], states, torch.nan)
    if goals.matching is not None and not goals.matching.fitted:
        places = torch.where(found[:, None], trainer.goals.places[:, 0], torch.nan)
        fit_pretrained_matching(goals.matching, demonstrations, places, config.known_words, config.seed)
    return trainer


def fit_pretrained_matching(
    matching: PretrainedMatching,
    demonstrations: DemonstrationSet,
    places: Tensor,
    vocabulary: Sequence[str],
    seed: int,
) -> None:
    """Fits matching by the features of EfficientNet-Lite0 to episodes.

    Args:
        matching: What is fitted.
        demonstrations: The episodes.
        places: Places of their grasps, (episodes, 2); NaN where there is none.
        vocabulary: Words that it knows, none for a policy without instructions.
        seed: Seed of the draws.

    Raises:
        ValueError: No task has two episodes with a grasp.
        VisionEncoderError: The weights of EfficientNet-Lite0 are missing.
    """
    matching.encoder.take_weights(load_efficientnet_lite0().state_dict())
    present = known_words(vocabulary, demonstrations.tasks).present.to(places) if vocabulary else None
    fit_matching(matching, demonstrations.frames[:, 0], places, demonstrations.tasks, present, seed)


def learn_goals(
    config: DeltacoConfig,
    trainer: GoalTrainer,
    embedder: TaskEmbedder,
    samples: GoalSamples,
    generator: torch.Generator,
) -> tuple[GoalInputs, Tensor, LocatorLoss]:
    """Prepares a training batch with goals.

    The policy's network gets the goals of each sample's own episode, with noise. The locator learns to find
    them by other episodes' demonstrations. So neither waits for the other.

    Args:
        config: Configuration of the policy.
        trainer: Knows the goals of the training episodes.
        embedder: Embeds the instructions.
        samples: The batch.
        generator: Source of the draws, on the CPU.

    Returns:
        Inputs of the policy's network; whether each sample's goals are known, (batch,) bool, since it learns
        nothing from other samples; and the locator's loss on a share of the samples.

    Raises:
        ValueError: A one-hot policy does not know a task.
    """
    recolorings = random_recolorings(len(samples.rows), config.recolor_share, generator)
    loss = _locator_loss(config, trainer, embedder, samples, recolorings, generator)
    places, depths, known = trainer.goals_of(samples.rows)
    inputs = trainer.vary(
        GoalInputs(samples.images, places, depths),
        recolorings,
        config.goal_noise,
        config.depth_noise,
        config.crop_padding,
        generator,
    )
    return inputs, known, loss


def _locator_loss(
    config: DeltacoConfig,
    trainer: GoalTrainer,
    embedder: TaskEmbedder,
    samples: GoalSamples,
    recolorings: Tensor,
    generator: torch.Generator,
) -> LocatorLoss:
    """The locator's loss on samples of a batch that are evenly spaced in it."""
    n_samples, device = len(samples.rows), samples.rows.device
    n_located = max(1, round(config.locator_share * n_samples))
    some = torch.arange(n_located) * n_samples // n_located
    here, given = some.to(device), None
    if config.takes_either_modality:
        drawn = draw_given(n_located, config.demo_dropout, config.instruction_dropout, generator)
        given = Given(*(part.to(device) for part in drawn))
    with autocast(config.dtype, device):
        chosen = GoalBatch(
            samples.episodes[here],
            samples.rows[here],
            [samples.tasks[sample] for sample in some.tolist()],
            embedder.goal_condition([samples.instructions[sample] for sample in some.tolist()], device),
            recolorings[some],
            given,
        )
        losses = trainer.losses(
            chosen, config.uses_demo, config.demo_crop_padding, config.color_blind_tasks, generator
        )
    return LocatorLoss(some, losses)


def validation_goals(
    trainer: GoalTrainer, samples: GoalSamples, find: Callable[[], FoundGoals]
) -> GoalInputs:
    """Inputs of the policy's network for a validation loss.

    Of episodes that are held back for it, no goals are known. Those that are found in the present image stand
    in for them.

    Args:
        trainer: Knows the goals of the training episodes.
        samples: The batch.
        find: Finds the goals of all samples in their images; called only if they are needed.
    """
    places, depths, known = trainer.goals_of(samples.rows)
    if not known.all():
        found = find()
        places = torch.where(known[:, None, None], places, found.places)
        if depths is not None and found.depths is not None:
            depths = torch.where(known, depths, found.depths)
    return GoalInputs(samples.images, places, depths)


def find_goals(
    config: DeltacoConfig,
    goals: GoalConditioning,
    embedder: TaskEmbedder,
    scenes: Tensor,
    tasks: Sequence[str],
    choose: Callable[[int], tuple[DemonstrationSet, Tensor]],
) -> FoundGoals:
    """Finds the goals of tasks in scenes.

    Args:
        config: Configuration of the policy.
        goals: Networks that find goals.
        embedder: Embeds the instructions.
        scenes: First images of episodes, (batch, 3, H, W) in 0..1.
        tasks: Instruction of each sample.
        choose: Chooses the first, second, ... demonstration of each sample: a set, and rows of it, (batch,).

    Raises:
        ValueError: A task has no demonstration, or a one-hot policy does not know it.
    """
    demonstrations = condition = words = None
    if config.uses_demo and config.leave_out != "demo":
        chosen = [choose(number) for number in range(config.n_demonstrations)]
        demonstrations = goal_demonstrations(chosen, goals, scenes.device)
    if config.leave_out != "instruction":
        condition = embedder.goal_condition(tasks, scenes.device)
        if config.known_words:
            known = known_words(config.known_words, tasks)
            words = KnownWords(*(part.to(scenes.device) for part in known))
    return goals.find(scenes, demonstrations, condition, words)
