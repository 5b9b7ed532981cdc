"""Training of goals: those of the training episodes, and the loss of finding them by other demonstrations."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_deltaco.policy.demonstrations import DemonstrationSet, RobotData, resize_images
from lerobot_deltaco.policy.goals.calibration import StateToImage
from lerobot_deltaco.policy.goals.conditioning import Demonstrations, GoalConditioning
from lerobot_deltaco.policy.goals.correspondence import Given
from lerobot_deltaco.policy.goals.keyframes import follows_gripper
from lerobot_deltaco.policy.goals.recoloring import random_recolorings, recolor
from lerobot_deltaco.policy.goals.training_goals import TrainingGoals, find_training_goals
from lerobot_deltaco.policy.networks import random_shifts, shift_images

_RESIZED_AT_A_TIME = 256


class GoalBatch(NamedTuple):
    """Samples on which goals are learned to be found.

    Attributes:
        episodes: Index of each sample's episode in the dataset, (batch,).
        rows: Row of that episode among the demonstrations, (batch,).
        tasks: Task string of each sample.
        condition: Embeddings of the instructions, or one-hot tasks, (batch, condition); None without them.
        recolorings: Change of each sample's colors, (batch, 3, 3), on the CPU.
        given: What is given of each sample's task; None for all that the policy takes.
    """

    episodes: Tensor
    rows: Tensor
    tasks: Sequence[str]
    condition: Tensor | None
    recolorings: Tensor
    given: Given | None = None


class GoalInputs(NamedTuple):
    """Images and goals that the policy's network gets.

    Attributes:
        images: Images of all cameras, that of the goals first, (batch, cameras, 3, H, W) in 0..1.
        places: Grasp and release, x and y in -1..1, (batch, 2, 2).
        depths: Depth of each grasp, (batch,); None without depths.
    """

    images: Tensor
    places: Tensor
    depths: Tensor | None


def draw_given(
    n_samples: int, demo_dropout: float, instruction_dropout: float, generator: torch.Generator
) -> Given:
    """Draws what is given of the tasks of samples, on the CPU.

    Args:
        n_samples: Number of samples.
        demo_dropout: Share of the samples without a demonstration, 0..1.
        instruction_dropout: Share of the samples without an instruction, 0..1; none is without both.
        generator: Source of the draws, on the CPU.
    """
    draws = torch.rand(n_samples, generator=generator)
    return Given(draws >= demo_dropout, draws < 1 - instruction_dropout)


class GoalTrainer:
    """Teaches a policy to find the goals of its training episodes.

    Args:
        conditioning: Networks that are taught; their states at goals are fitted at once.
        demonstrations: The training episodes.
        robot_data: States and actions of the robot in them.
        gripper: Commands to the gripper in all frames, greater for more open, (frames,).
        normalize: Normalizes robot states (n, state) as the policy's input, by scaling and shifting each
            dimension.

    Raises:
        ValueError: There are too few episodes in which the gripper closes and opens.
    """

    def __init__(
        self,
        conditioning: GoalConditioning,
        demonstrations: DemonstrationSet,
        robot_data: RobotData,
        gripper: Tensor,
        normalize: Callable[[Tensor], Tensor],
    ) -> None:
        self._conditioning, self._demonstrations = conditioning, demonstrations
        frames, device = demonstrations.frames, demonstrations.frames.device
        states = robot_data.states.to(device)
        gripper = gripper.to(device)
        to_image = conditioning.states.to_image
        if to_image is None:
            to_image = StateToImage(states.shape[1]).to(device)
        self._detail = conditioning.locator.detail
        size = frames.shape[-1] // self._detail  # without the detail, of which the calibration needs none
        self.goals: TrainingGoals = find_training_goals(
            to_image,
            _resized(frames[:, 0], size),
            _resized(frames[:, -1], size),
            states,
            gripper,
            robot_data.spans,
        )
        zero_and_one = torch.stack([torch.zeros(states.shape[1]), torch.ones(states.shape[1])])
        shift, end = normalize(zero_and_one).to(device)
        is_arm = ~follows_gripper(states, gripper, robot_data.spans)
        conditioning.states.fit(self.goals, end - shift, shift, is_arm)
        self.depths: Tensor | None = None  # of the episodes' grasps, (episodes,); NaN where there is none
        if conditioning.depth is not None:
            depths = conditioning.states.depths(self.goals.states[:, 0])
            self.depths = torch.where(self.goals.found, depths, torch.nan)

    def goals_of(self, rows: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        """The goals of episodes.

        Args:
            rows: Rows of the episodes among the demonstrations, (batch,); -1 for others.

        Returns:
            Places of the grasp and the release, (batch, 2, 2); depths of the grasps, (batch,), or None
            without depths; and whether the goals are known, (batch,) bool. Where they are not, the rest does
            not count.
        """
        known = (rows >= 0) & self.goals.found[rows]
        depths = None if self.depths is None else self.depths[rows].nan_to_num()
        return self.goals.places[rows], depths, known

    def vary(
        self,
        inputs: GoalInputs,
        recolorings: Tensor,
        goal_noise: float,
        depth_noise: float,
        crop_padding: int,
        generator: torch.Generator,
    ) -> GoalInputs:
        """Training samples with noisy goals, as if they had been found, in images that are changed at random.

        Args:
            inputs: Images, and the goals as they are.
            recolorings: Changes of the samples' colors, (batch, 3, 3), on the CPU.
            goal_noise: Standard deviation of the noise of places.
            depth_noise: Standard deviation of the noise of depths.
            crop_padding: Largest random shift of the images, with their goals, px.
            generator: Source of the draws, on the CPU.
        """
        images, places, depths = inputs
        device = places.device
        places = places + goal_noise * torch.randn(places.shape, generator=generator).to(device)
        if depths is not None:
            depths = depths + depth_noise * torch.randn(depths.shape, generator=generator).to(device)
        if crop_padding:
            images, places = self._shifted(images, places, crop_padding, generator)
        return GoalInputs(recolor(images, recolorings), places, depths)

    def losses(
        self,
        batch: GoalBatch,
        uses_demonstrations: bool,
        crop_padding: int,
        color_blind_tasks: str | None,
        generator: torch.Generator,
    ) -> Tensor:
        """How well the goals of samples are found in the first images of their episodes.

        Args:
            batch: The samples.
            uses_demonstrations: Whether they are found by a demonstration, which is another episode.
            crop_padding: Largest random shift of scenes and demonstrations, px of images without detail.
            color_blind_tasks: Regular expression that is found in the tasks in which color does not count.
            generator: Source of the draws, on the CPU.

        Returns:
            Losses of the grasp, the release, the depth and the attention, (batch, 4); 0 where an episode has
            no goals.
        """
        known, own = self._demonstrations, batch.rows
        crop_padding *= self._detail
        plain = known.frames[own, 0].float() / 255  # (batch, 3, H, W)
        plain, places = self._shifted(plain, self.goals.places[own], crop_padding, generator)
        scenes, demonstrations, others = plain, None, None
        if uses_demonstrations:
            # By an instruction alone, colors are what they are.
            scenes = recolor(plain, batch.recolorings)
            if batch.given is not None:
                scenes = torch.where(batch.given.demo[:, None, None, None], scenes, plain)
            others = known.sample_other_episodes(batch.episodes, generator, check=False)
            ends = known.frames[others][:, [0, -1]].float() / 255  # (batch, 2, 3, H, W)
            ends, their_places = self._shifted(ends, self.goals.places[others], crop_padding, generator)
            recolorings = batch.recolorings
            if color_blind_tasks is not None:
                apart = random_recolorings(len(own), 1.0, generator)
                blind = [re.search(color_blind_tasks, task) is not None for task in batch.tasks]
                recolorings = torch.where(torch.tensor(blind)[:, None, None], apart, recolorings)
            ends = recolor(ends, recolorings)
            unknown = torch.full((len(own),), torch.nan, device=own.device)
            demonstrated = unknown if self.depths is None else self.depths[others]
            demonstrations = Demonstrations(ends[:, None], demonstrated[:, None], their_places[:, None])
        depths = None if self.depths is None else self.depths[own].nan_to_num()
        losses = self._conditioning.losses(
            scenes, plain, places, depths, demonstrations, batch.condition, generator, batch.given
        )
        found = self.goals.found[own] if others is None else self.goals.found[own] & self.goals.found[others]
        return torch.where(found[:, None], losses, 0.0)

    @staticmethod
    def _shifted(
        images: Tensor, places: Tensor, padding: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Shifts images (batch, ..., H, W) and places in them (batch, n, 2) by up to `padding` px."""
        shifts = random_shifts(len(images), padding, generator)
        height, width = images.shape[-2:]
        moved = (shifts * 2 / torch.tensor([width, height])).to(places.device)  # (batch, 2)
        return shift_images(images, shifts, padding), places + moved[:, None]


def _resized(images: Tensor, size: int) -> Tensor:
    """Images (n, 3, H, W), uint8, as (n, 3, size, size): a few at a time, since they are floats meanwhile."""
    return torch.cat([resize_images(part, size) for part in images.split(_RESIZED_AT_A_TIME)])
