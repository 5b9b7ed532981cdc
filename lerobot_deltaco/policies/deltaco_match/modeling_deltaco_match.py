r"""`deltaco_match`: describes what a demonstration moved, finds it in the scene, and acts.

    demonstration ---- describe ---> descriptor, height of the grasp
                                         |
    first image of the episode --- localize ---> pick and place locations, grasp height
                                         |                    |
    instruction -------------------------+                    |
                                                              v
    image, robot state ------------------------------------- act ----> action

Localization happens once, at the start of an episode. Feature matching chooses what to pick among proposals,
by the demonstration and by the instruction's words; the place network finds where to place it, by the
instruction, or by the demonstration if there is none or if training episodes were few. The policy network is
given both locations, and how far the robot's state is from the state that it would have at each of them.
After training on few episodes, the demonstration's trajectory is replayed instead, moved to both locations.

In training, feature matching is fitted first. The policy network is given the locations of each sample's own
episode, with noise; they follow from the robot's states when the gripper closed and opened. So it does not
have to wait for the place network, which learns beside it.
"""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

import logging
from collections.abc import Iterable, Sequence
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.processor import NormalizerProcessorStep, TransitionKey, create_transition
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration, RobotData
from lerobot_deltaco.data.grasps import Grasp, find_grasps, warn_of_missing
from lerobot_deltaco.data.gripper_direction import warn_if_inverted
from lerobot_deltaco.data.gripper_states import find_gripper_states, find_positions
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.data.object_prompts import ObjectPrompt, read_prompt
from lerobot_deltaco.data.reading import open_dataset, warn_of_equal_instructions
from lerobot_deltaco.data.training_data import DatasetEpisodes, TrainingData
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.lerobot_versions import PREDICTION
from lerobot_deltaco.policies.base.augmentation import (
    change_colors,
    random_color_changes,
)
from lerobot_deltaco.policies.base.modeling import DemonstrationsOfTasks, TaskConditionedPolicy
from lerobot_deltaco.policies.base.networks import BACKBONES, PolicyNetwork
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.policies.deltaco_match.findings import describe_findings, predicted_boxes, write_picture
from lerobot_deltaco.policies.deltaco_match.fit import fit_feature_matching
from lerobot_deltaco.policies.deltaco_match.localization import DemonstrationBatch, Localizer, PickPlace
from lerobot_deltaco.policies.deltaco_match.prompts import prompts_of, registered_prompt
from lerobot_deltaco.policies.deltaco_match.words import (
    encode_words,
    vocabulary_of,
    words_of,
)
from lerobot_deltaco.policies.geometry.calibration import MIN_EPISODES
from lerobot_deltaco.policies.geometry.replay import Reference, Trajectory, TrajectoryReplay
from lerobot_deltaco.policies.geometry.states import N_LOCATIONS, StateRegressor, TrainingLocations
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion, is_moved

logger = logging.getLogger(__name__)

_GRIPPER_LOSS = "cross_entropy"
_PLACE_FRACTION = 0.25  # of a batch's samples, which train the place network and the attention
# Training episodes up to which demonstrations are replayed, unless `acting` says otherwise.
_MAX_REPLAYED = 600
_HEIGHT_NOISE = 0.1  # of the policy network's heights, in standard deviations over the training episodes


class RunningEpisode(NamedTuple):
    """What is computed once, at the start of an episode."""

    instructions: tuple[str, ...]
    localization: PickPlace
    network: PolicyNetwork
    reference: Reference | None
    replayed: Tensor


class DeltacoMatchPolicy(TaskConditionedPolicy):
    """The project's own policy. See `TaskConditionedPolicy` for its arguments.

    Attributes:
        state_regressor: The robot's states at locations.
        replay: Replays demonstrations, if `acting` is "replay".
        localizer: Finds where to pick and place.
        training_locations: Locations of the training episodes; None before `fit`.
    """

    config_class = DeltacoMatchConfig
    name = "deltaco_match"
    takes_prompts = True

    def __init__(
        self,
        config: DeltacoMatchConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        self.config: DeltacoMatchConfig = config
        if dataset_meta is not None:
            sentences = self._sentences(dataset_meta.tasks.index)
            config.known_words = config.known_words or vocabulary_of(chain.from_iterable(sentences.values()))
            tasks = list(sentences)
            warn_of_equal_instructions(tasks, encode_words(tasks, config.known_words))
        backbone = BACKBONES["strided"]
        assert config.action_feature is not None
        self.policy_network = PolicyNetwork(
            n_cameras=len(config.image_features),
            film_dim=0,
            # The state, and its offset from the state at each location.
            concat_dim=config.state_dim * (1 + N_LOCATIONS),
            action_dim=config.action_feature.shape[0] - 1,
            has_gripper=True,
            channels=backbone.channels,
            stem_stride=backbone.stem_stride,
            num_components=config.num_mixture_components,
            chunk_size=config.chunk_size or 1,
            n_locations=N_LOCATIONS,
        )
        self.state_regressor = StateRegressor(config.state_dim)
        self.replay = TrajectoryReplay(config.state_dim, config.action_feature.shape[0])
        self.localizer = Localizer(config.known_words)
        self.training_locations: TrainingLocations | None = None
        self._held_out: dict[int, TrainingLocations] = {}
        self._given_states: Tensor | None = None  # by `set_pick_and_place`
        self._prompt = self._read_prompt()

    def _read_prompt(self) -> ObjectPrompt | None:
        """Returns the object that the options show in place of a demonstration."""
        config = self.config
        if config.demo_point is None and config.demo_photo is None:
            return None
        _, height, width = config.image_features[config.cameras[0]].shape
        return read_prompt(config.demo_point, config.demo_photo, (width, height))

    # Training

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Returns the loss of a batch: of the actions, and in training of the place maps.

        Args:
            batch: Batch from the preprocessor; it is not changed.
                `observation.image`, or any cameras: (batch, 3, H, W) float in 0..1.
                `observation.state`: (batch, state), normalized.
                `action`: (batch, action), -1..1.
                `task`: list of task strings, (batch,).
                `episode_index`: (batch,) int64.
            reduction: "mean", or "none" for the loss of each sample.

        Returns:
            The loss, () or (batch,), and the scalars to log.

        Raises:
            ValueError: The training data do not fit; the message says why.
            TrainingDivergedError: The loss is not finite.
        """
        rows = self._training_rows(batch["episode_index"])
        generator = self._step_generator()
        with self._autocast(batch[ACTION].device):
            if self.training:
                loss, logged = self._training_loss(batch, rows, generator)
            else:  # at the recorded locations of episodes that are held out
                recorded = self._recorded_locations(batch["episode_index"].tolist(), rows.tolist())
                loss, logged = self._acting_loss(batch, self._images(batch), recorded)
        return self._finish_step(batch, loss, logged, reduction)

    def _training_loss(
        self, batch: dict[str, Any], rows: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the loss of each sample, (batch,), and its parts to log."""
        config, located = self.config, self.training_locations
        assert located is not None
        instructions = self._draw_instructions(list(batch["task"]), generator)
        changes = random_color_changes(len(rows), config.p_color_jitter, generator)
        # Some samples, evenly spaced in the batch, train the place network and the attention.
        n_some = max(1, round(_PLACE_FRACTION * len(rows)))
        some = torch.arange(n_some) * len(rows) // n_some
        place_losses = self._place_losses(
            batch["episode_index"][some.to(rows.device)],
            [batch["task"][sample] for sample in some.tolist()],
            [instructions[sample] for sample in some.tolist()],
            changes[some],
            generator,
        )  # (some, 2)
        location_noise = torch.randn(located.locations[rows].shape, generator=generator).to(rows.device)
        height_noise = torch.randn(len(rows), generator=generator).to(rows.device)
        noisy = TrainingLocations(
            located.locations[rows] + config.location_noise * location_noise,
            located.heights[rows] + _HEIGHT_NOISE * height_noise,
            located.has_grasp[rows],
        )
        images = change_colors(self._images(batch), changes)
        loss, logged = self._acting_loss(batch, images, noisy, generator)
        loss = loss.index_add(0, some.to(rows.device), len(rows) / n_some * place_losses.sum(dim=1))
        names = ("place_loss", "attention_loss")
        return loss, logged | dict(zip(names, place_losses.mean(dim=0), strict=True))

    def _acting_loss(
        self,
        batch: dict[str, Any],
        images: Tensor,
        located: TrainingLocations,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the imitation loss of each sample, (batch,), and its parts to log.

        An episode without a grasp has no locations, and no loss.
        """
        inputs = self._fuse_inputs(batch, located.locations, located.heights, generator)
        predicted, gripper = self.policy_network(images, None, inputs, located.locations)
        loss, logged = self._imitation_loss(batch, predicted, gripper, _GRIPPER_LOSS)
        return torch.where(located.has_grasp, loss, 0.0), logged

    def _place_losses(
        self,
        episodes: Tensor,
        tasks: Sequence[str],
        instructions: Sequence[str],
        changes: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Returns the losses of the localizer, with another episode of each task as its demonstration.

        Args:
            episodes: Episodes of the samples, (batch,), as indices of the dataset.
            tasks: Task string of each sample.
            instructions: Instruction of each sample.
            changes: Change of the colors of each sample's demonstration, (batch, 3, 3), on the CPU.
            generator: Source of the draws, on the CPU.

        Returns:
            Losses of the place and of the attention, (batch, 2); 0 for an episode without a grasp.
        """
        assert self.training_data is not None
        assert self.training_locations is not None
        bank, located = self.training_data.demonstrations, self.training_locations
        rows = bank.episode_rows(episodes)
        others = bank.draw_other_episodes(episodes, tasks, generator)
        losses = self.localizer.losses(
            bank.frames[rows, 0],
            located.locations[rows, 1],
            instructions,
            bank.frames[others][:, [0, -1]],
            located.locations[others],
            changes,
            generator,
        )
        both_grasp = located.has_grasp[rows] & located.has_grasp[others]
        return torch.where(both_grasp[:, None], losses, 0.0)

    # Acting

    def select_action(self, batch: dict[str, Any], **options: Any) -> Any:
        """Returns the next action; where LeRobot draws predictions (`PREDICTION`), a dict with boxes."""
        action = super().select_action(batch, **options)
        if PREDICTION is None or self.localization is None:
            return action
        camera = self.config.cameras[0]
        boxes = predicted_boxes(self.localizer.matching, self.localization, camera)
        return {ACTION: action, PREDICTION: boxes}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Returns the actions of a chunk, (batch, steps, action). See `select_action`."""
        if self._begins_episode(batch):
            self._begin_episode(batch)
        episode: RunningEpisode = self._episode
        batch = self.undo_camera_motion(batch, episode.localization.camera_motion)
        replay = None
        if episode.reference is not None:
            reference, replay = self.replay.follow(episode.reference, self._unlimited_state(batch))
            self._episode = episode._replace(reference=reference)
            if bool(episode.replayed.all()):
                return self._checked_action(batch, replay[:, None])
        locations, heights = episode.localization.locations, episode.localization.heights
        inputs = self._fuse_inputs(batch, locations, heights)
        actions = self._sample_action(batch, *episode.network(self._images(batch), None, inputs, locations))
        if replay is not None:
            actions = torch.where(episode.replayed[:, None, None], replay[:, None], actions[:, :1])
        return actions

    def _begin_episode(self, batch: dict[str, Any]) -> None:
        """Finds where to pick and place, and what trajectory to follow."""
        instructions, demonstrations = self._tasks_of(batch)
        if demonstrations is None and self._prompt is not None:
            demonstrations = [[self._prompt]] * len(instructions)
        elif demonstrations is None:
            demonstrations = self.banked_demonstrations(instructions, self.config.n_demonstrations)
        localization = self.localize(batch, instructions, demonstrations)
        if (states := self._given_states) is not None:
            locations = self.state_regressor.to_image(states).clamp(-1, 1)
            heights = self.state_regressor.heights(states[:, 0])
            localization = localization._replace(locations=locations, heights=heights)
        reference, replayed = None, torch.zeros(len(instructions), dtype=torch.bool)
        if self.config.acting == "replay":
            reference, replayed = self._move_demonstrations(demonstrations, localization, batch)
        network = self._inference_network()
        self._start(RunningEpisode(instructions, localization, network, reference, replayed))
        if len(instructions) == 1:
            shown = demonstrations[0][0] if demonstrations[0] else None
            self._report_findings(batch[self.config.cameras[0]][0], instructions[0], shown)

    def _report_findings(
        self, image: Tensor, instruction: str, shown: Demonstration | ObjectPrompt | None
    ) -> None:
        """Logs what was found in the running episode, and draws it if `picture_folder` says where."""
        episode, config, matching = self._episode, self.config, self.localizer.matching
        camera = config.cameras[0]
        if logger.isEnabledFor(logging.INFO):
            given = (camera, image.shape[-2:], instruction, shown)
            lines = describe_findings(matching, episode.localization, *given)
            is_own = isinstance(shown, Demonstration) and shown.states is not None
            replay = f"replays {'the demonstration' if is_own else 'a training episode'}"
            acting = replay if bool(episode.replayed.all()) else "the policy network acts"
            residual = self.state_regressor.to_image.residual.item()
            lines.append(f"  acting: {acting}")
            if residual >= 0:
                lines.append(f"  states to image: off by {residual:.1%} of its side in training")
            logger.info("%s", "\n".join(lines))
        if config.picture_folder is not None:
            seen = self.undo_camera_motion({camera: image[None]}, episode.localization.camera_motion)[camera]
            path = write_picture(Path(config.picture_folder), seen[0], shown, episode.localization)
            logger.info("Where the policy looked: %s.", path)

    def reset(self) -> None:
        """Ends the episode. The next action begins a new one."""
        self._given_states = None
        super().reset()

    def set_pick_and_place(self, states: Tensor) -> None:
        """Sets where to pick and place in the episodes that begin with the next action, until `reset`.

        Args:
            states: The robot's states there, as in the dataset, (batch, 2, state).
        """
        self._start(None)
        self._given_states = states

    @property
    def localized_states(self) -> Tensor | None:
        """The robot's states where the policy picks and places, as in the dataset, (batch, 2, state)."""
        if self.localization is None:
            return None
        states = self.state_regressor(self.localization.locations, self.localization.heights)
        return (states - self.state_regressor.state_shift) / self.state_regressor.state_scale

    @property
    def localization(self) -> PickPlace | None:
        """Where the policy picks and places in the running episode; None before its first action."""
        return None if self._episode is None else self._episode.localization

    @property
    def needs_images(self) -> bool:
        """Whether the running episode needs further images: not while demonstrations are replayed."""
        return self._episode is None or not bool(self._episode.replayed.all())

    @property
    def pick_confidence(self) -> Tensor | None:
        """Probability of the pick location among the proposals, (batch,); None before the first action."""
        return None if self._episode is None else self._episode.localization.confidence

    @torch.no_grad()
    def localize(
        self, batch: dict[str, Any], instructions: Sequence[str], demonstrations: DemonstrationsOfTasks
    ) -> PickPlace:
        """Finds where to pick and place in the first images of episodes.

        Args:
            batch: As in `select_action`, at the start of the episodes.
            instructions: Instruction of each sample; an empty string leaves it out.
            demonstrations: Demonstrations of each sample, the same number for each, or one `ObjectPrompt`; an
                empty list leaves them out.

        Raises:
            ValueError: Neither is given, or samples have different numbers of demonstrations.
        """
        camera, matching = self.config.cameras[0], self.localizer.matching
        motion = matching.camera_motion(batch[camera][0])  # warns
        batch = self.undo_camera_motion(batch, motion)
        scenes = self._camera_image(batch, camera)
        prompts = prompts_of(instructions, demonstrations)
        if is_moved(motion):
            prompts = [registered_prompt(prompt, motion) for prompt in prompts]
        given = None if prompts else self.batch_demonstrations(demonstrations, scenes.device)
        trained = list(map(words_of, self.config.trained_tasks))
        is_trained = torch.tensor([words_of(text) in trained for text in instructions], device=scenes.device)
        if given is not None:  # The sentence of another task says where to place, as that of a trained one.
            first = [own[0] for own in demonstrations]
            is_its_task = [
                not text or (isinstance(shown, Demonstration) and words_of(text) == words_of(shown.task))
                for text, shown in zip(instructions, first, strict=True)
            ]
            is_shown = torch.tensor(is_its_task, device=scenes.device) & ~is_trained
            given = given._replace(places=torch.where(is_shown[:, None, None], given.places, torch.nan))
        found = self.localizer(scenes, batch[camera], instructions, given, prompts, is_trained)
        heights = found.heights + self.config.grasp_height_bias
        return found._replace(heights=heights, camera_motion=motion)

    def undo_camera_motion(self, batch: dict[str, Any], motion: CameraMotion | None) -> dict[str, Any]:
        """Returns a batch with the pictures that the training's camera would show.

        Args:
            batch: As in `select_action`; it is not changed.
            motion: The camera's motion, such as `localization.camera_motion`.
        """
        if not is_moved(motion):
            return batch
        camera = self.config.cameras[0]
        return batch | {camera: self.localizer.matching.background.undo_motion(batch[camera], motion)}

    def batch_demonstrations(
        self, demonstrations: DemonstrationsOfTasks, device: torch.device
    ) -> DemonstrationBatch | None:
        """Batches the demonstrations of several tasks; None if they are left out."""
        counts = {len(shown) for shown in demonstrations}
        if len(counts) != 1:
            raise UserError(
                f"The samples of a batch must have as many demonstrations each. Got {sorted(counts)}."
            )
        (n_each,) = counts
        if not n_each:
            return None
        flat = [each for given in demonstrations for each in given if isinstance(each, Demonstration)]
        ends, first_images = zip(*map(self._seen_by_training_camera, flat), strict=True)
        unknown = torch.full((self.config.state_dim,), torch.nan)
        states = torch.stack([unknown if s.pick_state is None else s.pick_state.cpu() for s in flat])
        states = states.to(device)
        parts = (
            torch.stack(ends).to(device).float() / 255,
            torch.stack(first_images).to(device),
            self.state_regressor.pick_locations(states),
            self._release_locations(flat).to(device),
            self.state_regressor.heights(states),
        )
        return DemonstrationBatch(*(part.unflatten(0, (-1, n_each)) for part in parts))

    def _seen_by_training_camera(self, demonstration: Demonstration) -> tuple[Tensor, Tensor]:
        """Returns first and last image of a demonstration (2, 3, H, W), and the first at full resolution."""
        ends, first = demonstration.frames[[0, -1]], demonstration.first_image
        first = ends[0] if first is None else first
        background = self.localizer.matching.background
        motion = background.camera_motion(first)
        if not is_moved(motion):
            return ends, first
        ends, first = (
            as_uint8(background.undo_motion(images.float() / 255, motion)) for images in (ends, first[None])
        )
        return ends, first[0]

    def _release_locations(self, demonstrations: Sequence[Demonstration]) -> Tensor:
        """Returns where demonstrations released what they moved, (demonstrations, 2); NaN if unknown."""
        locations = torch.full((len(demonstrations), 2), torch.nan)
        command = self.config.gripper_command
        if bool(self.localizer.demonstrates_places) and command is not None:
            for row, demonstration in zip(locations, demonstrations, strict=True):
                found = self.replay.trajectory(demonstration, command)
                if isinstance(found, Trajectory):
                    row.copy_(self.state_regressor.to_image(found.grasp_states[1:]).clamp(-1, 1)[0])
        return locations

    def _fuse_inputs(
        self,
        batch: dict[str, Any],
        locations: Tensor,
        heights: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Returns the robot's state, and its offsets from the states at the locations, (batch, 3 state)."""
        state = self.state_limits(batch[OBS_STATE])
        if generator is not None:
            state = self.state_limits.add_noise(state, self.config.state_noise, generator)
        offsets = self.state_regressor(locations, heights) - state.float()[:, None]
        return torch.cat([state, offsets.flatten(1)], dim=-1)

    def _unlimited_state(self, batch: dict[str, Any]) -> Tensor:
        """Returns the robot's state, normalized but not clipped, (batch, state).

        A novel task may lead beyond the states of training, such as to another rotation of the hand.
        """
        return batch[OBS_STATE].float() * self.state_limits.scale

    def _move_demonstrations(
        self, demonstrations: DemonstrationsOfTasks, localization: PickPlace, batch: dict[str, Any]
    ) -> tuple[Reference | None, Tensor]:
        """Moves the trajectory of each sample's first demonstration to where the policy picks and places.

        Returns:
            The moved trajectories, None if there are none, and whether each sample has one, (batch,) bool.

        Raises:
            ValueError: The policy was trained before it could replay.
        """
        command = self.config.gripper_command
        assert command is not None
        first = [given[0] if given else None for given in demonstrations]
        read = [self.replay.trajectory(shown, command) for shown in first]
        reasons = {each for each in read if isinstance(each, str)}
        if reasons and self.replay.n_trajectories:
            logger.info("The nearest training episode is replayed: %s.", "; ".join(sorted(reasons)))
            at = self.state_regressor.to_image(self.replay.grasp_states).clamp(-1, 1)  # (trajectories, 2, 2)
            nearest = torch.cdist(localization.locations.flatten(1), at.flatten(1)).argmin(dim=1).tolist()
            read = [
                self.replay.stored_trajectory(row, command) if isinstance(each, str) else each
                for each, row in zip(read, nearest, strict=True)
            ]
        elif reasons:
            logger.warning(
                "The policy network acts, since no demonstration can be replayed: %s.",
                "; ".join(sorted(reasons)),
            )
        replayed = torch.tensor([isinstance(each, Trajectory) for each in read], device=self.step.device)
        trajectories = [each for each in read if isinstance(each, Trajectory)]
        if not trajectories:
            return None, replayed
        # Samples without one get a stand-in, whose actions are not used.
        trajectories = [each if isinstance(each, Trajectory) else trajectories[0] for each in read]
        states = torch.stack([each.grasp_states for each in trajectories])  # (batch, 2, state)
        displacements = self.state_regressor.displacements(
            states, localization.locations, localization.heights, localization.is_same_place
        )
        return self.replay.start(trajectories, self._unlimited_state(batch), displacements), replayed

    # Before the first step

    def fit(self, data: TrainingData) -> None:
        """Finds the locations of the training episodes, and fits feature matching to them.

        Args:
            data: The training episodes.

        Raises:
            ValueError: There are too few episodes in which the gripper closes and opens, or no task with two
                of them.
            PretrainedWeightsError: The weights that feature matching needs are missing.
        """
        self.fit_locations(data)
        if not bool(self.localizer.matching.fitted):
            self.fit_matching()

    def fit_locations(self, data: TrainingData) -> None:
        """Fits the map from robot states to image locations, and the states at locations, in seconds.

        Args:
            data: The training episodes.

        Raises:
            ValueError: There are too few episodes in which the gripper closes and opens.
        """
        super().fit(data)
        bank, robot, grasps = data.demonstrations, data.robot, data.grasps
        assert robot is not None
        assert grasps is not None
        assert self.config.gripper_command is not None
        opening = self.config.gripper_command.opening(robot.actions)
        warn_of_missing(grasps, bank.episodes.tolist(), "are not trained on")
        warn_if_inverted(opening, robot, self.config.gripper_closed)
        gripper_states = find_gripper_states(robot.states, opening, robot.spans, robot.state_names)
        gripper_states.warn()
        n_grasps = int(grasps.has_grasp.sum())
        if n_grasps < MIN_EPISODES:
            other = "high" if self.config.gripper_closed == "low" else "low"
            reverse = find_grasps(-opening, robot.spans, states=robot.states)
            n_reverse = sum(isinstance(each, Grasp) for each in reverse)
            advice = (
                f" If {other} values close it, {n_reverse} episodes have a grasp: set "
                f"--policy.gripper_closed={other}."
                if n_reverse >= MIN_EPISODES
                else ""
            )
            raise UserError(
                f"`deltaco_match` learns where grasps are in the image from at least {MIN_EPISODES} "
                f"episodes in which the gripper closes and opens. Got {n_grasps}. Collect more, or train "
                "--policy.type=deltaco with --policy.demo_encoder=attention, which needs none. The gripper "
                f"is dimension {self.config.gripper} of the action, whose {self.config.gripper_closed} "
                f"values close it; see --policy.gripper and --policy.gripper_closed.{advice}"
            )
        scale, shift = (each.to(robot.states.device) for each in self._scaling(OBS_STATE))
        carried = robot.images_at(grasps.carried.tolist()).to(bank.frames.device)
        self.training_locations = self.state_regressor.fit(
            grasps,
            bank.frames[:, 0],
            carried,
            bank.frames[:, -1],
            scale,
            shift,
            ~gripper_states.is_gripper,
            bank.tasks,
            find_positions(robot.state_names),
        )
        self._fit_replay(robot, ~gripper_states.is_gripper)
        if self.config.acting is None:
            is_replayed = n_grasps <= _MAX_REPLAYED and not self.replay.is_blind
            self.config.acting = "replay" if is_replayed else "network"
            logger.info("From %d episodes with a grasp, `acting` is %r.", n_grasps, self.config.acting)
        if self.config.acting == "replay":
            command, spans = self.config.gripper_command, [slice(a, b + 1) for a, b in robot.spans]
            self.replay.store([(robot.states[span], robot.actions[span]) for span in spans], command)

    def _fit_replay(self, robot: RobotData, is_arm: Tensor) -> None:
        """Fits how actions move the robot, in a second."""
        assert self.config.gripper_index is not None
        replay, regressor = self.replay, self.state_regressor
        scale, shift = self._scaling(ACTION)
        replay.action_scale.copy_(scale)
        replay.action_shift.copy_(shift)
        replay.state_scale.copy_(regressor.state_scale)
        replay.state_shift.copy_(regressor.state_shift)
        states = robot.states * replay.state_scale + replay.state_shift
        actions = robot.actions * replay.action_scale + replay.action_shift
        replay.fit(
            [(states[first : last + 1], actions[first : last + 1]) for first, last in robot.spans],
            is_arm,
            self.config.gripper_index,
        )
        if not replay.is_blind:
            return
        problem = (
            "No dimension of the robot's state follows its actions, so that demonstrations cannot be "
            "replayed elsewhere."
        )
        if self.config.acting == "replay":
            raise UserError(
                f"{problem} Record the state that the actions move, such as the end effector's position, or "
                "let the policy network act with --policy.acting=network."
            )
        logger.warning("%s The policy network acts.", problem)

    def fit_matching(self) -> None:
        """Fits feature matching to the first images of the training episodes, in minutes.

        Raises:
            ValueError: No task has two episodes with a grasp, or no proposal is near a grasp.
            PretrainedWeightsError: The encoder's weights are missing.
        """
        assert self.training_data is not None
        assert self.training_locations is not None
        bank, located = self.training_data.demonstrations, self.training_locations
        first_images = bank.frames[:, 0] if bank.first_images is None else bank.first_images
        sentences = self._sentences(bank.tasks)
        self._forget_words(chain.from_iterable(sentences.values()))
        held_out = fit_feature_matching(
            self.localizer.matching,
            bank.frames[:, 0],
            bank.frames[:, -1],
            first_images,
            torch.where(located.has_grasp[:, None], located.locations[:, 0], torch.nan),
            located.heights,
            bank.tasks,
            sentences,
            self.seed,
            in_bfloat16=self.config.precision == "bfloat16",
        )
        rows = located.has_grasp.nonzero().flatten().cpu()
        tasks = [bank.tasks[row] for row in rows.tolist()]
        self.localizer.measure_places(first_images[rows], located.locations[rows], tasks)
        has_few = bool(self.localizer.matching.has_few_episodes)
        self.config.trained_tasks = sorted(set(tasks)) if has_few else []
        self.config.held_out_episodes = bank.episodes[held_out].tolist()
        self.config.n_dataset_frames = None if self._meta is None else self._meta.total_frames

    def _forget_words(self, sentences: Iterable[str]) -> None:
        """Forgets words that no sentence has: those of tasks that are not trained on are unknown."""
        known = set(vocabulary_of(sentences))
        words = [word if word in known else "" for word in self.config.known_words]
        self.config.known_words[:] = self.localizer.matching.vocabulary[:] = words

    def _recorded_locations(self, episodes: Sequence[int], rows: Sequence[int]) -> TrainingLocations:
        """Returns the locations of episodes, (batch, ...); reads those that are held out."""
        meta, device, located = self._meta, self.step.device, self.training_locations
        assert located is not None
        row_of = dict(zip(episodes, rows, strict=True))
        new = [episode for episode, row in row_of.items() if row < 0 and episode not in self._held_out]
        if new:
            assert meta is not None
            dataset = open_dataset("--dataset.root", meta.repo_id, meta.root, new)
            data = TrainingData.read(DatasetEpisodes(dataset, new), self.config.demonstration_format)
            assert data.grasps is not None
            read = zip(*self.state_regressor.locate(data.grasps.to(device)), strict=True)
            self._held_out.update(zip(new, starmap(TrainingLocations, read), strict=True))
        found = [
            self._held_out[episode] if row < 0 else TrainingLocations(*(part[row] for part in located))
            for episode, row in zip(episodes, rows, strict=True)
        ]
        return TrainingLocations(*map(torch.stack, zip(*found, strict=True)))

    def _sentences(self, tasks: Iterable[str]) -> dict[str, list[str]]:
        """Returns the instructions of tasks in training; a task string is repeated by its probability."""
        sentences = {}
        for task in dict.fromkeys(tasks):
            others = [] if self.paraphrases is None else list(self.paraphrases.of(task))
            p = self.config.p_paraphrase if others else 0.0
            n_templates = 1 if p == 0 else round(len(others) * (1 - p) / p)
            sentences[task] = [task] * n_templates + (others if p else [])
        return sentences

    def _scaling(self, feature: str) -> tuple[Tensor, Tensor]:
        """Returns scale and shift of the preprocessor's normalization of states or actions, on the CPU."""
        is_state = feature == OBS_STATE
        features = {feature: self.config.robot_state_feature if is_state else self.config.action_feature}
        step = NormalizerProcessorStep(features, self.config.normalization_mapping, self._stats)
        ends = torch.tensor([[0.0], [1.0]]).expand(-1, *features[feature].shape)
        if is_state:
            ends = step(create_transition(observation={feature: ends}))[TransitionKey.OBSERVATION][feature]
            ends = ends * self.state_limits.scale.cpu()
        else:
            ends = step(create_transition(action=ends))[TransitionKey.ACTION]
        return ends[1] - ends[0], ends[0]

    def _check_demonstrations(self, data: TrainingData) -> None:
        if data.grasps is not None:
            episodes = data.demonstrations.episodes.tolist()
            consequence = "what they moved is found from their first and last image"
            warn_of_missing(data.grasps, episodes, consequence)
            assert data.robot is not None
            assert self.config.action_feature is not None
            sizes = (data.robot.states.shape[1], data.robot.actions.shape[1])
            expected = (self.config.state_dim, self.config.action_feature.shape[0])
            if sizes != expected:
                raise UserError(
                    f"The demonstrations in {self.config.demo_repo_id} are of another robot: their states "
                    f"and actions have {sizes[0]} and {sizes[1]} numbers, those of the policy "
                    f"{expected[0]} and {expected[1]}. Name a dataset of the policy's robot."
                )
