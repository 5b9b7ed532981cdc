"""Training with goals (ours): those of the training episodes, and the loss of finding them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import torch
from lerobot.processor import NormalizerProcessorStep, TransitionKey, create_transition
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling.task_embedding import TaskEmbedder
from lerobot_deltaco.policy.correspondence import Given
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, RobotData
from lerobot_deltaco.policy.goal_conditioning import GoalConditioning
from lerobot_deltaco.policy.goal_training import GoalBatch, GoalTrainer, draw_given

_LOSSES = ("grasp_loss", "release_loss", "depth_loss", "attention_loss")


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
        ValueError: There are too few episodes in which the gripper closes and opens.
    """

    def normalize(states: Tensor) -> Tensor:
        """Robot states of the dataset (n, state) as the preprocessor makes them, on the CPU."""
        step = NormalizerProcessorStep(
            {OBS_STATE: config.robot_state_feature}, config.normalization_mapping, stats
        )
        normalized = step(create_transition(observation={OBS_STATE: states.cpu()}))
        return normalized[TransitionKey.OBSERVATION][OBS_STATE]

    assert config.gripper_index is not None
    trainer = GoalTrainer(goals, demonstrations, robot_data, config.gripper_index, normalize)
    states, found = trainer.goals.states[:, 0], trainer.goals.found
    demonstrations.grasp_states = torch.where(found[:, None], states, torch.nan)
    return trainer


def learn_goals(
    config: DeltacoConfig,
    trainer: GoalTrainer,
    embedder: TaskEmbedder,
    episodes: Tensor,
    rows: Tensor,
    tasks: Sequence[str],
    instructions: Sequence[str],
    recolorings: Tensor,
    generator: torch.Generator,
    autocast: AbstractContextManager,
) -> LocatorLoss:
    """The locator's loss on a share of a training batch, evenly spaced.

    Args:
        config: Configuration of the policy.
        trainer: Knows the goals of the training episodes.
        embedder: Embeds the instructions.
        episodes: Index of each sample's episode in the dataset, (batch,).
        rows: Row of that episode among the demonstrations, (batch,).
        tasks: Task string of each sample.
        instructions: Instruction of each sample, in whatever words.
        recolorings: Change of each sample's colors, (batch, 3, 3), on the CPU.
        generator: Source of the draws, on the CPU.
        autocast: Context of the precision in which networks compute.

    Raises:
        ValueError: A one-hot policy does not know a task.
    """
    n_samples = len(rows)
    n_located = max(1, round(config.locator_share * n_samples))
    some = torch.arange(n_located) * n_samples // n_located
    here, given = some.to(rows.device), None
    if config.takes_either_modality:
        drawn = draw_given(n_located, config.demo_dropout, config.instruction_dropout, generator)
        given = Given(*(part.to(rows.device) for part in drawn))
    with autocast:
        chosen = GoalBatch(
            episodes[here],
            rows[here],
            [tasks[sample] for sample in some.tolist()],
            embedder.goal_condition([instructions[sample] for sample in some.tolist()], rows.device),
            recolorings[some],
            given,
        )
        losses = trainer.losses(
            chosen, config.uses_demo, config.demo_crop_padding, config.color_blind_tasks, generator
        )
    return LocatorLoss(some, losses)
