"""Conditioning by goals (ours): what a `GoalLocator` finds, as inputs of the policy's network."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.goals.correspondence import (
    GOALS,
    Description,
    Given,
    GoalLocator,
    goal_loss,
    peak_places,
)
from lerobot_deltaco.policy.goals.grasp_depth import DepthEstimator
from lerobot_deltaco.policy.goals.pretrained_matching import PretrainedMatching, log_probabilities
from lerobot_deltaco.policy.goals.states import GoalStates
from lerobot_deltaco.policy.goals.words import KnownWords

# Standard deviation of the error of depths by looks on novel objects; depths have a standard deviation of 1.
LOOKS_STD = 0.7
_LEAST_ATTENTION = 1e-9
_WEIGHT_OF_WORDS = 3.0  # of their map's log probabilities; chosen on validation tasks


class FoundGoals(NamedTuple):
    """Goals of the scenes of a batch, and why.

    Attributes:
        places: Grasp and release, x and y in -1..1, (batch, 2, 2).
        depths: Depth of each grasp, (batch,); None without depths.
        logits: Maps of both over the scene, (batch, 2, h, w).
        attention: Maps of where the object was and where it was put in the demonstration,
            (batch, 2, h, w); None without a demonstration.
        from_demonstration: Whether the grasp and the release were found by the demonstration. Attention on
            what was not says nothing.
    """

    places: Tensor
    depths: Tensor | None
    logits: Tensor
    attention: Tensor | None
    from_demonstration: tuple[bool, bool] = (True, True)

    def of_sample(self, sample: int) -> FoundGoals:
        """The goals of one sample of the batch, as a batch of one."""
        one = slice(sample, sample + 1)
        depths = None if self.depths is None else self.depths[one]
        attention = None if self.attention is None else self.attention[one]
        return FoundGoals(self.places[one], depths, self.logits[one], attention, self.from_demonstration)


class Demonstrations(NamedTuple):
    """What goals are found by.

    Attributes:
        ends: First and last images of one or more demonstrations of each task,
            (batch, demonstrations, 2, 3, H, W) in 0..1.
        depths: Depths of their grasps, (batch, demonstrations); NaN where they are not known.
        places: In training, places of their goals, (batch, demonstrations, 2, 2).
        grasps: In evaluation, places of their grasps by the robot's states, (batch, demonstrations, 2); NaN
            where they are not known.
    """

    ends: Tensor
    depths: Tensor
    places: Tensor | None = None
    grasps: Tensor | None = None


class GoalConditioning(nn.Module):
    """A locator of goals, and which state the robot has at them.

    Args:
        locator: Finds goals in the first images of episodes.
        state_dim: Size of the robot's state.
        condition_dim: Size of the locator's condition, 0 for none.
        has_depth: Whether depths of grasps are estimated.
        depth_margin: Depth that is added to the estimates when goals are found.
        matching: Finds what is to be grasped by pretrained features as well; None for the locator alone.
    """

    def __init__(
        self,
        locator: GoalLocator,
        state_dim: int,
        condition_dim: int,
        has_depth: bool,
        depth_margin: float = 0.0,
        matching: PretrainedMatching | None = None,
    ) -> None:
        super().__init__()
        self.locator, self.condition_dim, self.depth_margin = locator, condition_dim, depth_margin
        self.matching = matching
        self.states = GoalStates(state_dim, len(GOALS), has_depth)
        self.depth = None
        if has_depth:
            has_demonstration = "demo" in (locator.grasp_source, locator.release_source)
            self.depth = DepthEstimator(locator.descriptor_dim, condition_dim, has_demonstration)

    def offsets(self, places: Tensor, depths: Tensor | None, state: Tensor) -> Tensor:
        """How far the robot's state is from where it would be at its goals.

        Args:
            places: Places of the goals, (batch, 2, 2).
            depths: Depth of each grasp, (batch,); None without depths.
            state: Present state, normalized, (batch, state).

        Returns:
            (batch, 2 * state).
        """
        return (self.states(places, depths) - state[:, None]).flatten(1)

    def losses(
        self,
        scenes: Tensor,
        plain_scenes: Tensor,
        places: Tensor,
        depths: Tensor | None,
        demonstrations: Demonstrations | None,
        condition: Tensor | None,
        generator: torch.Generator,
        given: Given | None = None,
    ) -> Tensor:
        """How well the goals are found: losses of the grasp, the release, the depth and the attention.

        The attention is to be where the demonstration's own goals are; without this loss, it takes thousands
        of steps to find what was moved.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1, recolored like the demonstrations.
            plain_scenes: The same in their own colors.
            places: Places of the goals, (batch, 2, 2).
            depths: Depths of the grasps, (batch,); None without depths.
            demonstrations: One demonstration of each task; None if the locator takes none.
            condition: Embeddings of the instructions, or one-hot tasks; None if the locator takes none.
            generator: Source of the noise, on the CPU.
            given: What is given of each task; None for all that the locator takes.

        Returns:
            (batch, 4); 0 for what there is not.
        """
        description = demonstrated = descriptors = None
        attention_losses = depth_losses = torch.zeros(len(scenes), device=scenes.device)
        if demonstrations is not None:
            assert demonstrations.places is not None
            description = self.locator.describe(demonstrations.ends[:, 0])
            demonstrated, descriptors = demonstrations.depths[:, 0], description.moved
            log_attention = description.attention.clamp_min(_LEAST_ATTENTION).log()
            attention_losses = goal_loss(log_attention, demonstrations.places[:, 0]).sum(dim=1)
        if given is not None:
            assert condition is not None
            assert demonstrated is not None
            demonstrated = torch.where(given.demo, demonstrated, torch.nan)
            condition = torch.where(given.condition[:, None], condition, 0.0)
        located = self.locator(scenes, plain_scenes, description, condition, generator, given)
        if self.depth is not None:
            assert depths is not None
            depth_losses = self.depth.losses(
                located.features, places[:, 0], depths, descriptors, demonstrated, condition, generator
            )
        losses = goal_loss(located.logits, places)  # (batch, 2)
        return torch.cat([losses, torch.stack([depth_losses, attention_losses], dim=1)], dim=1)

    @torch.no_grad()
    def find(
        self,
        scenes: Tensor,
        demonstrations: Demonstrations | None,
        condition: Tensor | None,
        words: KnownWords | None = None,
    ) -> FoundGoals:
        """Finds the goals of tasks in scenes.

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            demonstrations: Demonstrations of each task; None if the locator takes none, or takes either.
            condition: Embeddings of the instructions, or one-hot tasks; None if the locator takes none, or
                takes either.
            words: Words of the instructions, for matching by pretrained features; None without instructions.
        """
        description = demonstrated = given = None
        condition_is_missing = condition is None
        if demonstrations is not None:
            n_each = demonstrations.ends.shape[1]
            each = self.locator.describe(demonstrations.ends.flatten(0, 1))
            moved = F.normalize(each.moved, dim=1).unflatten(0, (-1, n_each)).mean(dim=1)
            target = each.target
            if target is not None:
                target = target.unflatten(0, (-1, n_each)).mean(dim=1)
            description = Description(moved, target, each.attention[::n_each])
            demonstrated = demonstrations.depths.nanmean(dim=1)
        if self.locator.takes_either:
            everything = torch.ones(len(scenes), dtype=torch.bool, device=scenes.device)
            given = Given(everything & (description is not None), everything & (condition is not None))
            if condition is None:
                condition = torch.zeros(len(scenes), self.condition_dim, device=scenes.device)
            if description is None:
                description = self.locator.no_description(len(scenes), scenes.device)
                demonstrated = torch.full((len(scenes),), torch.nan, device=scenes.device)
        located = self.locator(scenes, scenes, description, condition, given=given)
        logits = located.logits
        if self.matching is not None:
            attention = None if demonstrations is None else each.attention
            grasp_map = self._matched(self.matching, logits[:, 0], scenes, demonstrations, attention, words)
            logits = torch.stack([grasp_map, logits[:, 1]], dim=1)
        places, depths = peak_places(logits), None
        if self.depth is not None:
            descriptors = None if description is None else description.moved
            depths = self.depth(
                located.features, places[:, 0], descriptors, demonstrated, condition, LOOKS_STD
            )
            depths = depths + self.depth_margin
        attention = None if demonstrations is None or description is None else description.attention
        sources = (self.locator.grasp_source, self.locator.release_source)
        if self.locator.takes_either and condition_is_missing:
            sources = ("demo", "demo")
        grasp, release = (demonstrations is not None and source == "demo" for source in sources)
        return FoundGoals(places, depths, logits, attention, (grasp, release))

    @staticmethod
    def _matched(
        matching: PretrainedMatching,
        located: Tensor,
        scenes: Tensor,
        demonstrations: Demonstrations | None,
        attention: Tensor | None,
        words: KnownWords | None,
    ) -> Tensor:
        """The map of the grasp, with what pretrained features find: the product of their probabilities.

        Words that training does not know say nothing. Where a demonstration shows what is meant, an
        instruction with such words does not count, since the words that remain may fit other things as well.

        Args:
            matching: Finds it.
            located: What the locator finds, as logits (batch, h, w).
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            demonstrations: Demonstrations of each task; None without them.
            attention: The locator's attention on them, (batch * demonstrations, 2, h, w), which stands in for
                the places of grasps that are not known.
            words: Words of the instructions; None without them.

        Returns:
            Logits, (batch, h, w).
        """
        logits = log_probabilities(located)
        with torch.autocast(scenes.device.type, enabled=False):  # it was fitted in float32
            maps = matching.normalized(matching.encode(scenes))
            if demonstrations is not None:
                assert attention is not None
                n_each = demonstrations.ends.shape[1]
                places = peak_places(attention.clamp_min(_LEAST_ATTENTION).log())[:, 0]
                if demonstrations.grasps is not None:
                    known = demonstrations.grasps.flatten(0, 1)
                    places = torch.where(known.isnan(), places, known)
                first = matching.normalized(matching.encode(demonstrations.ends[:, :, 0].flatten(0, 1)))
                each = F.normalize(matching.describe(first, places), dim=1)
                descriptors = each.unflatten(0, (-1, n_each)).mean(dim=1)
                logits = logits + log_probabilities(_resized(matching.find(maps, descriptors), located))
            if words is not None and matching.named is not None:
                named = log_probabilities(_resized(matching.find_named(maps, words.present), located))
                counts = words.present.any(dim=1) & (words.are_all | (demonstrations is None))
                logits = logits + torch.where(counts[:, None, None], _WEIGHT_OF_WORDS * named, 0.0)
        return logits


def _resized(logits: Tensor, like: Tensor) -> Tensor:
    """Maps (batch, h, w) at the size of others.

    It differs if an image's side is no multiple of 4, or so large that the encoder sees it scaled down.
    """
    if logits.shape == like.shape:
        return logits
    return F.interpolate(logits[:, None], size=like.shape[-2:], mode="bilinear", align_corners=False)[:, 0]
