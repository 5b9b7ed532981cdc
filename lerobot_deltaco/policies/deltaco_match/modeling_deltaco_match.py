r"""`deltaco_match`: describes what a demonstration moved, finds it in the scene, and acts.

    demonstration ----- describe ----> descriptor, height of the grasp
                                           |
    first image of the episode -------- find ----> pick and place locations, grasp height
                                           |                    |
    instruction ---------------------------+                    |
                                                                v
    image, robot state -------------------------------------- act ----> action

Describing and finding happen once, at the start of an episode (`_find`). Feature matching chooses what to
pick among proposals, by the demonstration and by the instruction's words; the place network finds where to
place it, by the instruction, or by the demonstration if there is none. The policy network is given the two
locations, and how far the robot's state is from where it would be at each of them
(`predict_action_chunk`).

In training, feature matching is fitted first. The policy network is given the locations of each sample's own
episode, with noise; they follow from the robot's states when the gripper closed and opened. So it does not
have to wait for the place network, which learns beside it.
"""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, starmap
from typing import Any, NamedTuple

import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.processor import NormalizerProcessorStep, TransitionKey, create_transition
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_deltaco.data.demonstrations import Demonstration, DemonstrationBank, RobotData, read_robot_data
from lerobot_deltaco.data.grasps import (
    Keyframes,
    find_keyframes,
    follows_gripper,
    warn_of_missing,
)
from lerobot_deltaco.data.gripper_direction import warn_if_inverted
from lerobot_deltaco.data.reading import open_dataset, warn_of_equal_instructions
from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.modeling import DemonstrationsOfTasks, TaskConditionedPolicy
from lerobot_deltaco.policies.base.networks import (
    BACKBONES,
    PolicyNetwork,
    random_shifts,
    shift_images,
)
from lerobot_deltaco.policies.deltaco_match.calibration import MIN_EPISODES
from lerobot_deltaco.policies.deltaco_match.color_jitter import change_colors, random_color_changes
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.policies.deltaco_match.localization import FeatureMatching
from lerobot_deltaco.policies.deltaco_match.place import (
    TARGET_DIM,
    DemonstrationAttention,
    PlaceNetwork,
    peak_locations,
)
from lerobot_deltaco.policies.deltaco_match.states import N_LOCATIONS, RobotStates, TrainingLocations
from lerobot_deltaco.policies.deltaco_match.words import (
    INSTRUCTION_DIM,
    InstructionEncoder,
    encode_words,
    vocabulary_of,
)

_GRIPPER_LOSS = "cross_entropy"
_LOCATED_FRACTION = 0.25  # of a batch's samples, on which the locations are learned to be found
_HEIGHT_NOISE = 0.1  # in standard deviations of heights
_SHIFT_PADDING = 4  # px, of scenes and demonstrations when locations are learned to be found
_P_PLACE_BY_DEMONSTRATION = 0.25  # in these samples; in the others, the instruction says where
_MIN_ATTENTION = 1e-9


class Found(NamedTuple):
    """Locations found in the first images of episodes, and why.

    Attributes:
        locations: Pick and place, (batch, 2, 2) in -1..1.
        heights: Height offset of each grasp, (batch,).
        maps: Pick and place maps over the scenes, as logits (batch, 2, h, w).
        attention: Maps of what the (first) demonstration moved and where it was put, (batch, 2, h, w); None
            without demonstrations.
        by_demonstration: Whether the pick and the place location were found by the demonstration. Otherwise,
            the attention is meaningless.
        p_pick: Probability of the pick location among the proposals, (batch,).
    """

    locations: Tensor
    heights: Tensor
    maps: Tensor
    attention: Tensor | None
    by_demonstration: tuple[bool, bool]
    p_pick: Tensor


class Episode(NamedTuple):
    """The running episode: its instructions, what was found, and the network that acts."""

    instructions: tuple[str, ...]
    found: Found
    network: PolicyNetwork


class StackedDemonstrations(NamedTuple):
    """Demonstrations of a batch of tasks.

    Attributes:
        ends: First and last images, (batch, demonstrations, 2, 3, H, W) in 0..1.
        first_images: First images at the camera's own resolution, (batch, demonstrations, 3, H', W') uint8.
        pick_states: The robot's states at the grasps, as in the dataset, (batch, demonstrations, state); NaN
            where they are not known.
    """

    ends: Tensor
    first_images: Tensor
    pick_states: Tensor


class DeltacoMatchPolicy(TaskConditionedPolicy):
    """The project's own policy. See `TaskConditionedPolicy` for its arguments.

    Attributes:
        robot_states: The robot's states at locations.
        feature_matching: Finds what to pick, and how high.
        attention: Finds what a demonstration moved, and where it was put.
        place: Finds where to place it.
        instruction_encoder: Embeds instructions for `place`.
    """

    config_class = DeltacoMatchConfig
    name = "deltaco_match"

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
        self.model = PolicyNetwork(
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
        self.robot_states = RobotStates(config.state_dim)
        self.feature_matching = FeatureMatching(config.known_words, config.crop_size)
        self.attention = DemonstrationAttention()
        self.place = PlaceNetwork(INSTRUCTION_DIM)
        self.instruction_encoder = InstructionEncoder(len(config.known_words))
        self.training_locations: TrainingLocations | None = None
        self._held_out: dict[int, TrainingLocations] = {}

    # The loss

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Returns the loss of a batch: of the actions, and of finding the locations.

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
        self._prepare_training()
        generator, tasks = self._step_generator(), list(batch["task"])
        with self._autocast(batch[ACTION].device):
            if self.training:
                loss, logged = self._training_loss(batch, tasks, generator)
            else:
                loss, logged = self._validation_loss(batch)
        return self._finish_step(batch, loss, logged, reduction)

    def _training_loss(
        self, batch: dict[str, Any], tasks: list[str], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the loss of each sample, (batch,), and its parts to log."""
        config, located = self.config, self.training_locations
        assert located is not None
        assert self.training_bank is not None
        images, rows = self._images(batch), self.training_bank.episode_rows(batch["episode_index"])
        instructions = self._draw_instructions(tasks, generator)
        changes = random_color_changes(len(rows), config.p_hue_augmentation, generator)
        # Some samples, evenly spaced in the batch, train the finding of places.
        n_some = max(1, round(_LOCATED_FRACTION * len(rows)))
        some = torch.arange(n_some) * len(rows) // n_some
        finding = self._place_losses(
            batch["episode_index"][some.to(rows.device)],
            [tasks[sample] for sample in some.tolist()],
            [instructions[sample] for sample in some.tolist()],
            changes[some],
            generator,
        )  # (some, 2)
        noise = torch.randn(located.locations[rows].shape, generator=generator).to(rows.device)
        locations = located.locations[rows] + config.location_noise * noise
        noise = torch.randn(len(rows), generator=generator).to(rows.device)
        heights = located.heights[rows] + _HEIGHT_NOISE * noise
        images = change_colors(images, changes)
        loss, logged = self._acting_loss(batch, images, locations, heights, generator)
        # An episode without a grasp has no locations, and teaches nothing.
        loss = torch.where((rows >= 0) & located.has_grasp[rows], loss, 0.0)
        loss = loss.index_add(0, some.to(rows.device), len(rows) / n_some * finding.sum(dim=1))
        names = ("place_loss", "attention_loss")
        return loss, logged | dict(zip(names, finding.mean(dim=0), strict=True))

    def _place_losses(
        self,
        episodes: Tensor,
        tasks: Sequence[str],
        instructions: Sequence[str],
        changes: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Computes the losses of finding the places in the first images of episodes.

        Args:
            episodes: Episodes of the samples, (batch,), as indices of the dataset.
            tasks: Task string of each sample.
            instructions: Instruction of each sample.
            changes: Change of the colors of each sample's demonstration, (batch, 3, 3), on the CPU.
            generator: Source of the draws, on the CPU.

        Returns:
            Losses of the place and of the attention, (batch, 2); 0 for an episode without a grasp.
        """
        bank, located = self.training_bank, self.training_locations
        assert bank is not None
        assert located is not None
        rows, device = bank.episode_rows(episodes), episodes.device
        others = bank.draw_other_episodes(episodes, tasks, generator)
        both_grasp = (rows >= 0) & located.has_grasp[rows] & located.has_grasp[others]
        scenes, locations = _shifted(
            bank.frames[rows, 0].float() / 255, located.locations[rows, 1:], generator
        )  # (batch, 3, H, W)
        ends, demonstrated = _shifted(
            bank.frames[others][:, [0, -1]].float() / 255, located.locations[others], generator
        )  # (batch, 2, 3, H, W)
        attention = self.attention(change_colors(ends, changes))
        by_instruction = (torch.rand(len(rows), generator=generator) >= _P_PLACE_BY_DEMONSTRATION).to(device)
        maps = self._place_maps(scenes, by_instruction, instructions, ends[:, 1], attention[:, 1], generator)
        # Without a loss of its own, the attention would take thousands of steps.
        log_attention = attention.clamp_min(_MIN_ATTENTION).log()
        attention_losses = location_loss(log_attention, demonstrated).sum(dim=1, keepdim=True)
        losses = torch.cat([location_loss(maps[:, None], locations), attention_losses], dim=1)
        return torch.where(both_grasp[:, None], losses, 0.0)

    def _place_maps(
        self,
        scenes: Tensor,
        by_instruction: Tensor,
        instructions: Sequence[str],
        last: Tensor | None,
        attention: Tensor | None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Returns maps of where to place the object, as logits (batch, h, w).

        Args:
            scenes: First images of episodes, (batch, 3, H, W) in 0..1.
            by_instruction: Whether the instruction says where, and not the demonstration, (batch,) bool.
            instructions: Instruction of each sample.
            last: Last images of the demonstrations, (batch, 3, H, W); None without demonstrations.
            attention: Maps of where the demonstrations put the object, (batch, h, w).
            generator: In training, source of the draws of words that are left out, on the CPU.
        """
        words = encode_words(instructions, self.config.known_words).to(scenes.device)
        instruction = torch.where(by_instruction[:, None], self.instruction_encoder(words, generator), 0.0)
        target = torch.zeros(len(scenes), TARGET_DIM, device=scenes.device)
        if last is not None and attention is not None:
            target = torch.where(by_instruction[:, None], target, self.place.target(last, attention))
        return self.place(scenes, instruction, target)

    def _validation_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the imitation loss at the recorded locations; 0 for an episode without a grasp."""
        recorded = self._recorded_locations(batch["episode_index"].tolist())
        images = self._images(batch)
        loss, logged = self._acting_loss(batch, images, recorded.locations, recorded.heights)
        return torch.where(recorded.has_grasp, loss, 0.0), logged

    def _recorded_locations(self, episodes: Sequence[int]) -> TrainingLocations:
        """Returns the locations of episodes of the training dataset, (batch, ...); reads held-out ones."""
        located, bank = self.training_locations, self.training_bank
        meta, device = self._meta, self.step.device
        assert located is not None
        assert bank is not None
        bank_rows = bank.episode_rows(torch.tensor(episodes, device=device))
        rows = dict(zip(episodes, bank_rows.tolist(), strict=True))
        new = [episode for episode, row in rows.items() if row < 0 and episode not in self._held_out]
        if new:
            assert meta is not None
            data = read_robot_data(open_dataset("--dataset.root", meta.repo_id, meta.root, new), new)
            keyframes = self.keyframes_of(data._replace(states=data.states.to(device)))
            read = zip(*self.robot_states.locate(keyframes), strict=True)
            self._held_out.update(zip(new, starmap(TrainingLocations, read), strict=True))
        each = [
            self._held_out[episode] if rows[episode] < 0 else [part[rows[episode]] for part in located]
            for episode in episodes
        ]
        return TrainingLocations(*map(torch.stack, zip(*each, strict=True)))

    def _acting_loss(
        self,
        batch: dict[str, Any],
        images: Tensor,
        locations: Tensor,
        heights: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the imitation loss of each sample, (batch,), and its parts to log."""
        concat = self._concatenated(batch, locations, heights, generator)
        predicted, gripper = self.model(images, None, concat, locations)
        return self._imitation_loss(batch, predicted, gripper, _GRIPPER_LOSS)

    # Acting

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Returns the actions of a chunk, (batch, steps, action). See `select_action`."""
        if self._begins_episode(batch):
            instructions, demonstrations = self._tasks_of(batch)
            if demonstrations is None:
                demonstrations = self.banked_demonstrations(instructions, self.config.n_demonstrations)
            found = self._find(batch, instructions, demonstrations)
            self._start(Episode(instructions, found, self._acting_network()))
        episode: Episode = self._episode
        locations, heights = episode.found.locations, episode.found.heights
        concat = self._concatenated(batch, locations, heights)
        return self._chosen(batch, *episode.network(self._images(batch), None, concat, locations))

    @property
    def found(self) -> Found | None:
        """What was found at the start of the running episode; None before its first action."""
        return None if self._episode is None else self._episode.found

    @property
    def p_pick(self) -> Tensor | None:
        """Probability of the pick location among the proposals, (batch,); None before the first action."""
        return None if self._episode is None else self._episode.found.p_pick

    def keyframes_of(self, data: RobotData) -> Keyframes:
        """Returns the keyframes of episodes that the policy was not trained on."""
        gripper, usual = self.config.gripper_opening(data.actions), self.config.gripper_range
        return find_keyframes(data.states, gripper, data.spans, usual)

    @torch.no_grad()
    def _find(
        self,
        batch: dict[str, Any],
        instructions: Sequence[str],
        demonstrations: DemonstrationsOfTasks,
    ) -> Found:
        """Finds the locations of tasks in the first images of episodes.

        Args:
            batch: As in `select_action`, at the start of the episodes.
            instructions: Instruction of each sample; an empty string leaves it out.
            demonstrations: Demonstrations of each sample, the same number for each; an empty list leaves them
                out.
        """
        camera = self.config.cameras[0]
        scenes = self._camera_image(batch, camera)  # (batch, 3, H, W)
        by_instruction = torch.tensor([bool(text) for text in instructions], device=scenes.device)
        stacked = self._stacked(demonstrations, scenes.device)
        attention = last = described = heights = None
        if stacked is None:
            if not bool(by_instruction.all()):
                raise ValueError("Neither a demonstration nor an instruction is given. Pass one of them.")
        else:
            n_each = stacked.ends.shape[1]
            ends, states = stacked.ends.flatten(0, 1), stacked.pick_states.flatten(0, 1)
            every = self.attention(ends)
            attended = peak_locations(every.clamp_min(_MIN_ATTENTION).log())[:, 0]
            picks, native = self.robot_states.pick_locations(states), stacked.first_images.flatten(0, 1)
            described = self.feature_matching.describe(ends[:, 0], native, picks, attended)
            described = described.unflatten(0, (-1, n_each)).mean(dim=1)
            heights = self.robot_states.heights(states).unflatten(0, (-1, n_each)).nanmean(dim=1)
            attention, last = every[::n_each], ends[::n_each, 1]
        candidates = self.feature_matching.find(scenes, batch[camera], instructions, described, heights)
        pick, p_pick, height = candidates.best
        place_maps = self._place_maps(
            scenes, by_instruction, instructions, last, None if attention is None else attention[:, 1]
        )
        locations = torch.stack([pick, peak_locations(place_maps[:, None])[:, 0]], dim=1)
        maps = torch.stack([candidates.map(place_maps.shape[1:]), place_maps], dim=1)
        by_demonstration = (stacked is not None, stacked is not None and not bool(by_instruction.all()))
        bias = self.config.grasp_height_bias
        return Found(locations, height + bias, maps, attention, by_demonstration, p_pick)

    # Inputs

    def _stacked(
        self, demonstrations: DemonstrationsOfTasks, device: torch.device
    ) -> StackedDemonstrations | None:
        """Stacks the demonstrations of a batch; None if they are left out."""
        counts = {len(own) for own in demonstrations}
        if len(counts) != 1:
            raise ValueError(
                f"The samples of a batch must have as many demonstrations each. Got {sorted(counts)}."
            )
        if counts == {0}:
            return None
        unknown = torch.full((self.config.state_dim,), torch.nan)

        def stacked(part: Callable[[Demonstration], Tensor]) -> Tensor:
            rows = [torch.stack([part(each) for each in own]) for own in demonstrations]
            return torch.stack(rows).to(device)

        return StackedDemonstrations(
            stacked(lambda each: each.frames[[0, -1]]).float() / 255,
            stacked(lambda each: each.frames[0] if each.first_image is None else each.first_image),
            stacked(lambda each: unknown if each.pick_state is None else each.pick_state.cpu()),
        )

    def _concatenated(
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
        offsets = self.robot_states(locations, heights) - state.float()[:, None]
        return torch.cat([state, offsets.flatten(1)], dim=-1)

    # Training data

    def set_training_data(self, bank: DemonstrationBank, robot_data: RobotData | None) -> None:
        """Finds the locations of the training episodes, and fits everything that depends only on them.

        Args:
            bank: The training episodes.
            robot_data: States and actions of the robot in them.

        Raises:
            ValueError: There are too few episodes in which the gripper closes and opens, or no task with two
                of them.
            PretrainedWeightsError: The weights that feature matching needs are missing.
        """
        super().set_training_data(bank, robot_data)
        assert robot_data is not None
        assert self.training_bank is not None
        config, device, frames = self.config, self.step.device, self.training_bank.frames
        states = robot_data.states.to(device)
        gripper = config.gripper_opening(robot_data.actions).to(device)
        keyframes = find_keyframes(states, gripper, robot_data.spans)
        warn_of_missing(keyframes, bank.episodes.tolist(), "are not trained on")
        warn_if_inverted(gripper, robot_data, config.gripper_closed)
        zero_and_one = torch.stack([torch.zeros(states.shape[1]), torch.ones(states.shape[1])])
        shift, end = self._normalized(zero_and_one).to(device)
        is_arm = ~follows_gripper(states, gripper, robot_data.spans)
        n_grasps = int(keyframes.has_grasp.sum())
        if n_grasps < MIN_EPISODES:
            assert self._meta is not None
            raise ValueError(
                f"`deltaco_match` learns where grasps are in the image from at least {MIN_EPISODES} episodes "
                f"in which the gripper closes and opens. Got {n_grasps}. Collect more, or train "
                "--policy.type=deltaco with --policy.demo_encoder=attention, which needs none. The gripper "
                f"is {config.name_gripper(self._meta.features)}, whose {config.gripper_closed} values close "
                "it; see --policy.gripper and --policy.gripper_closed."
            )
        carried = robot_data.images_at(keyframes.carried.tolist(), config.image_size).to(device)
        images = (frames[:, 0], carried, frames[:, -1])
        located = self.robot_states.fit(keyframes, *images, end - shift, shift, is_arm)
        self.training_locations = located
        self.training_bank.pick_states = keyframes.pick_states
        if not bool(self.feature_matching.fitted):
            picks = torch.where(located.has_grasp[:, None], located.locations[:, 0], torch.nan)
            native = self.training_bank.first_images
            tasks = self.training_bank.tasks
            self.feature_matching.fit(
                frames[:, 0],
                frames[:, -1],
                frames[:, 0] if native is None else native,
                picks,
                located.heights,
                tasks,
                self._sentences(tasks),
                config.seed,
                in_bfloat16=config.dtype == "bfloat16",
            )

    def _sentences(self, tasks: Iterable[str]) -> dict[str, list[str]]:
        """Returns the instructions of tasks in training; a task string is repeated by its probability."""
        sentences = {}
        for task in dict.fromkeys(tasks):
            own = [] if self.paraphrases is None else list(self.paraphrases.of(task))
            p = self.config.p_paraphrase if own else 0.0
            n_templates = 1 if p == 0 else round(len(own) * (1 - p) / p)
            sentences[task] = [task] * n_templates + (own if p else [])
        return sentences

    def _normalized(self, states: Tensor) -> Tensor:
        """Normalizes robot states (n, state) as the network gets them, without clipping, on the CPU."""
        step = NormalizerProcessorStep(
            {OBS_STATE: self.config.robot_state_feature}, self.config.normalization_mapping, self._stats
        )
        normalized = step(create_transition(observation={OBS_STATE: states}))
        return normalized[TransitionKey.OBSERVATION][OBS_STATE] * self.state_limits.scale.cpu()

    def _complete_bank(self, bank: DemonstrationBank, dataset: LeRobotDataset) -> None:
        data = read_robot_data(dataset, bank.episodes.tolist())
        assert self.config.action_feature is not None
        sizes = (data.states.shape[1], data.actions.shape[1])
        expected = (self.config.state_dim, self.config.action_feature.shape[0])
        if sizes != expected:
            raise ValueError(
                f"The demonstrations in {self.config.demo_repo_id} are of another robot: their states and "
                f"actions have {sizes[0]} and {sizes[1]} numbers, those of the policy {expected[0]} and "
                f"{expected[1]}. Name a dataset of the policy's robot."
            )
        keyframes = self.keyframes_of(data)
        warn_of_missing(
            keyframes, bank.episodes.tolist(), "what they moved is found from their first and last image"
        )
        bank.pick_states = keyframes.pick_states


def _shifted(images: Tensor, locations: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Shifts images (batch, ..., H, W) and locations in them (batch, n, 2) at random."""
    shifts = random_shifts(len(images), _SHIFT_PADDING, generator)
    height, width = images.shape[-2:]
    moved = (shifts * 2 / torch.tensor([width, height])).to(locations.device)  # (batch, 2)
    return shift_images(images, shifts, _SHIFT_PADDING), locations + moved[:, None]
