"""The policy of DeL-TaCo (Yu & Mooney, ICLR 2023), and the baselines and ablations of the paper."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from huggingface_hub import ModelCard, hf_hub_download
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lerobot_deltaco.cards.policy_card import policy_card
from lerobot_deltaco.configuration_deltaco import BACKBONES, DeltacoConfig
from lerobot_deltaco.policy.demo_encoders import ArrayEncoder, AttentionEncoder
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, load_demonstrations
from lerobot_deltaco.policy.inference import FoldedPolicy
from lerobot_deltaco.policy.language import InstructionTable
from lerobot_deltaco.policy.losses import (
    contrastive_logits,
    contrastive_loss,
    cosine_loss,
    gripper_loss,
    mixture_negative_log_likelihood,
)
from lerobot_deltaco.policy.memory import keep_freed_memory
from lerobot_deltaco.policy.networks import ConditionedPolicy, random_crop
from lerobot_deltaco.policy.scalars import LoggedScalars
from lerobot_deltaco.policy.training_episodes import training_episodes

logger = logging.getLogger(__name__)

# Beside the weights: embeddings of instructions, and the demonstrations for evaluation.
TASKS_FILE = "tasks.safetensors"
# Of the names that the weights of `DeltacoPolicy.model` had before version 0.2.
OLD_MODEL_PREFIX = "policy."


class TaskConditioning(NamedTuple):
    """What the networks receive about the tasks of a batch, computed once per episode."""

    tasks: tuple[str, ...]
    film: Tensor  # (batch, film_dim)
    concat: Tensor | None  # (batch, concatenated embeddings)
    model: nn.Module  # the network that acts


class DeltacoPolicy(PreTrainedPolicy):
    """A policy that is told its task by a demonstration, an instruction, or both.

    In training, each sample's demonstration is another episode of its task, from the training dataset. At
    evaluation, demonstrations come from the dataset that the configuration names, or from the checkpoint.
    The instruction is the batch's `task`.

    Args:
        config: The configuration. Features that it lacks are filled in by LeRobot beforehand.
        dataset_stats: Unused; normalization is the processors' business.
        dataset_meta: Of the training dataset; None at evaluation.
    """

    config_class = DeltacoConfig
    name = "deltaco"

    def __init__(
        self,
        config: DeltacoConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        self.config: DeltacoConfig = config
        self._meta = dataset_meta
        config.resolve(dataset_meta.features if dataset_meta else None)
        self.instructions = InstructionTable(config.language_encoder)
        if config.instruction_embeddings is not None:
            self.instructions.read(Path(config.instruction_embeddings))
        self.eval_demonstrations: DemonstrationSet | None = None
        self.train_demonstrations: DemonstrationSet | None = None  # read with the first training batch
        self._train_demonstrations_are_complete = False  # whether they surely include every training episode
        self._demonstrated_as: Mapping[str, str] = {}
        if config.demo_repo_id is not None:
            self.eval_demonstrations = self._load_demonstrations(config.demo_repo_id, config.demo_root, None)
        if config.method == "one_hot" and not config.one_hot_tasks:
            config.one_hot_tasks = self._one_hot_vocabulary()

        film, concat, encoder_loss = config.conditioning
        dims = {
            "none": 0,
            "demo": config.embedding_dim,
            "language": config.embedding_dim,
            "demo+language": 2 * config.embedding_dim,
            "language_or_demo": config.embedding_dim,
            "one_hot": len(config.one_hot_tasks),
        }
        backbone = BACKBONES[config.backbone]
        state = config.robot_state_feature
        action_dim = config.action_feature.shape[0]
        self.model = ConditionedPolicy(
            n_cameras=len(config.image_features),
            film_dim=dims[film],
            concat_dim=dims[concat] + (state.shape[0] if state else 0),
            motion_dim=action_dim - (config.gripper_index is not None),
            has_gripper=config.gripper_index is not None,
            channels=backbone.channels,
            stem_stride=backbone.stem_stride,
            motion_modes=config.motion_modes,
        )
        self.demo_encoder = self._make_demo_encoder() if config.uses_demo else None
        # MCIL brings both modalities into one space.
        self.project_language = (
            nn.Linear(config.embedding_dim, config.embedding_dim) if config.method == "mcil" else None
        )
        # Draws are a function of the seed and the step, so that a resumed run repeats an uninterrupted one.
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        if config.compile:
            for network in (self.model, self.demo_encoder):
                if network is not None:
                    network.compile()
        self._folded = FoldedPolicy(self.model)
        self._conditioning: dict[int, TaskConditioning] = {}
        self._n_episodes: dict[str, int] = {}  # of each task
        self.reset()

    def _make_demo_encoder(self) -> nn.Module:
        config = self.config
        if config.demo_encoder == "attention":
            return AttentionEncoder(config.n_demo_frames, config.embedding_dim)
        size, stride = config.image_size, BACKBONES[config.backbone].demo_stride
        return ArrayEncoder(size, size, config.demo_rows, config.demo_columns, config.embedding_dim, stride)

    def get_optim_params(self) -> list[nn.Parameter]:
        """All weights; the language encoder is not among them."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    # Training

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, LoggedScalars]:
        """The loss of a batch: L = L_pi + lambda L_demo (the paper's equation 4).

        Args:
            batch: Of the preprocessor; it is left as it is.
                `observation.image`, or any cameras: (batch, 3, H, W) float in 0..1.
                `observation.state`: (batch, state), normalized, if there is one.
                `action`: (batch, action), -1..1.
                `task`: list of instructions, (batch,).
                `episode_index`: (batch,) int64, if demonstrations are used.
            reduction: "mean", or "none" for the loss of each sample.

        Returns:
            The loss, () or (batch,), and what is logged.
        """
        tasks = list(batch["task"])
        device = batch[ACTION].device
        if self.training and device.type == "cpu":
            keep_freed_memory()
        generator = self._generator()
        images = self._images(batch)
        if self.training and self.config.crop_padding:
            images = random_crop(images, self.config.crop_padding, generator)
        demo = language = None
        distinct = {task: n for n, task in enumerate(dict.fromkeys(tasks))}
        column = torch.tensor([distinct[task] for task in tasks], device=device)
        if self.config.uses_demo:
            demo = self._train_demo_embeddings(batch["episode_index"], tasks, column, generator)
        if self.config.uses_language:
            known = self.instructions(list(distinct), device)  # (distinct, embedding)
            language = known[column]  # (batch, embedding)

        if self.config.method == "mcil":
            parts = [
                self._imitation_loss(batch, images, film, None)
                for film in (self.project_language(language), demo)
            ]
            loss = torch.stack([part[0] for part in parts]).mean(dim=0)
            logged = {name: torch.stack([part[1][name] for part in parts]).mean() for name in parts[0][1]}
        else:
            film, concat = self.conditioning_inputs(tasks, demo, language)
            loss, logged = self._imitation_loss(batch, images, film, concat)

        if self.config.conditioning.encoder_loss != "none":
            logits = contrastive_logits(demo.float(), known, self.config.temperature)  # (batch, distinct)
            if self.config.conditioning.encoder_loss == "contrastive":
                encoder_loss = contrastive_loss(logits, column)
            else:
                encoder_loss = cosine_loss(demo.float(), language)
            loss = loss + self.config.encoder_loss_weight * encoder_loss
            logged["encoder_loss"] = encoder_loss.mean()
            logged["demo_accuracy"] = (logits.argmax(dim=1) == column).float().mean()
        if self.training:
            self.step += 1
        return loss.mean() if reduction == "mean" else loss, LoggedScalars(logged)

    def _imitation_loss(
        self, batch: dict[str, Any], images: Tensor, film: Tensor, concat: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """L_pi of each sample, (batch,), and its parts."""
        predicted, gripper = self.model(images, film, self._concatenated(batch, concat))
        action = batch[ACTION].float()
        motion, target = self._split_action(action)
        likelihood = mixture_negative_log_likelihood(
            predicted.means.float(), predicted.logits.float(), self.model.log_std.float(), motion
        )
        error = (predicted.mean.float() - motion).square()
        logged = {"motion_nll": likelihood.mean(), "motion_mse": error.mean()}
        if gripper is None:
            return likelihood, logged
        error = gripper_loss(gripper.float(), target, self.config.gripper_loss)
        logged["gripper_loss"] = error.mean()
        logged["gripper_accuracy"] = ((gripper > 0) == (target > 0.5)).float().mean()
        return likelihood + self.config.gripper_weight * error, logged

    def set_train_demonstrations(self, demonstrations: DemonstrationSet) -> None:
        """Gives demonstrations for training, instead of those that the first batch would read from the disk.

        Args:
            demonstrations: Among them is every episode that is trained on.
        """
        self.train_demonstrations = demonstrations
        self._train_demonstrations_are_complete = True

    def _train_demo_embeddings(
        self, episodes: Tensor, tasks: Sequence[str], column: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Embeddings of demonstrations for samples, (batch, embedding); `column` numbers their tasks."""
        demonstrations = self._training_demonstrations(episodes.device)
        if not self.training:
            rows = demonstrations.sample_other_episodes(episodes, generator, tasks=tasks)
            return self._encode_demo(demonstrations, rows, generator)
        check = not self._train_demonstrations_are_complete
        if not self.config.demos_per_task:
            rows = demonstrations.sample_other_episodes(episodes, generator, check)
            return self._encode_demo(demonstrations, rows, generator)
        rows, which = demonstrations.sample_shared_episodes(
            episodes, column, len(set(tasks)), self.config.demos_per_task, generator, check
        )
        return self._encode_demo(demonstrations, rows, generator)[which]

    def _training_demonstrations(self, device: torch.device) -> DemonstrationSet:
        if self.train_demonstrations is None:
            if self._meta is None:
                raise ValueError("Only a policy that was made with a dataset's metadata can be trained.")
            if self.config.tasks_per_batch:
                logger.warning(
                    "`tasks_per_batch` has no effect here: this loop draws samples of any tasks. Train with "
                    "`deltaco-train`, which takes the same arguments."
                )
            chosen = self.config.demo_episodes or training_episodes(self._meta)
            loaded = self._load_demonstrations(self._meta.repo_id, self._meta.root, chosen)
            self.train_demonstrations = loaded.to(device)
        return self.train_demonstrations

    def _generator(self) -> torch.Generator:
        rank = torch.distributed.get_rank() if torch.distributed.is_initialized() else 0
        step = int(self.step) if self.training else 0
        seed = torch.tensor([self.config.seed, step, rank], dtype=torch.int64)
        # A hash, so that neighboring seeds and steps have nothing in common.
        mixed = 0
        for value in seed.tolist():
            mixed = (mixed * 6364136223846793005 + value + 1442695040888963407) % 2**63
        return torch.Generator().manual_seed(mixed)

    # Evaluation

    def reset(self) -> None:
        """Begins an episode (of this thread, if several evaluate tasks at the same time)."""
        self._conditioning.pop(threading.get_ident(), None)

    def begin_evaluation(self) -> None:
        """Forgets how many episodes each task has had: its demonstrations begin with the first again."""
        self._n_episodes.clear()

    @contextmanager
    def demonstrated_as(self, tasks: Mapping[str, str]) -> Iterator[None]:
        """Demonstrates instructions by other tasks' demonstrations while the context is open.

        For a sentence of one's own: `with policy.demonstrated_as({"fetch the jar": task.instruction}): ...`

        Args:
            tasks: Maps an instruction to the task string whose demonstrations are used with it. It is read at
                the start of each episode; instructions that are not in it have their own demonstrations.
        """
        previous, self._demonstrated_as = self._demonstrated_as, tasks
        try:
            yield
        finally:
            self._demonstrated_as = previous

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """The mean action, of the likeliest mode if there are several.

        Args:
            batch: As in `forward`, without actions and indices.

        Returns:
            (batch, action), as the preprocessor would have normalized it.

        Raises:
            ValueError: A task has no demonstration.
        """
        tasks = tuple(batch["task"])
        images = self._images(batch)
        with self._autocast(images.device):
            conditioning = self._conditioning.get(threading.get_ident())
            if conditioning is None or conditioning.tasks != tasks:
                conditioning = self.encode_task(tasks, images.device)
                self._conditioning[threading.get_ident()] = conditioning
            concatenated = self._concatenated(batch, conditioning.concat)
            motion, gripper = conditioning.model(images, conditioning.film, concatenated)
        if gripper is not None:
            gripper = torch.sigmoid(gripper.float())
        return self._join_action(motion.mean.float(), gripper)

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """The action as a chunk of one, (batch, 1, action)."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def encode_task(self, tasks: tuple[str, ...], device: torch.device) -> TaskConditioning:
        """Encodes the demonstrations and instructions of tasks, once an episode."""
        trials = self._count_trials(tasks)
        demo = language = None
        if self.config.uses_demo:
            demonstrations, rows = self._eval_demonstrations_of(tasks, trials)
            generator = torch.Generator().manual_seed(self.config.seed)
            demo = self._encode_demo(demonstrations, rows, generator)
        if self.config.uses_language:
            language = self.instructions(tasks, device)
        if self.config.method == "mcil":
            # The trials of a task use the language and the demonstration in turn.
            by_language = torch.tensor(trials, device=device) % 2 == 0
            film = torch.where(by_language[:, None], self.project_language(language), demo)
            return TaskConditioning(tasks, film, None, self._acting_model())
        return TaskConditioning(tasks, *self.conditioning_inputs(tasks, demo, language), self._acting_model())

    def _acting_model(self) -> nn.Module:
        """The network that acts: a copy that is quicker for small batches, unless in training mode."""
        return self.model if self.training else self._folded.network()

    def _count_trials(self, tasks: tuple[str, ...]) -> list[int]:
        """The number of each sample's episode among those of its task, from 0, whichever thread runs them."""
        trials = []
        for task in tasks:
            trials.append(self._n_episodes.get(task, 0))
            self._n_episodes[task] = trials[-1] + 1
        return trials

    def _eval_demonstrations_of(
        self, tasks: tuple[str, ...], trials: Sequence[int]
    ) -> tuple[DemonstrationSet, Tensor]:
        """The demonstrations for evaluation, and the row of each task's; those of a task take turns."""
        candidates = [
            demonstrations
            for demonstrations in (self.eval_demonstrations, self.train_demonstrations)
            if demonstrations is not None
        ]
        if self.config.demo_episode is not None and self.eval_demonstrations is not None:
            found = (self.eval_demonstrations.episodes == self.config.demo_episode).nonzero().flatten()
            if not len(found):
                raise ValueError(
                    f"`demo_episode` is {self.config.demo_episode}, but the demonstrations are the episodes "
                    f"{self.eval_demonstrations.episodes.tolist()[:10]} ..."
                )
            return self.eval_demonstrations, found[:1].expand(len(tasks))
        tasks = tuple(self._demonstrated_as.get(task, task) for task in tasks)
        for demonstrations in candidates:
            if all(task in demonstrations.rows for task in tasks):
                rows = [
                    demonstrations.rows[task][trial % len(demonstrations.rows[task])]
                    for task, trial in zip(tasks, trials, strict=True)
                ]
                return demonstrations, torch.tensor(rows, device=demonstrations.frames.device)
        there = sorted({task for demonstrations in candidates for task in demonstrations.rows})
        missing = next(task for task in tasks if task not in there) if there else tasks[0]
        raise ValueError(
            f"There is no demonstration of the task {missing!r}. There are {len(there)} tasks"
            f"{f', such as {there[0]!r}' if there else ''}. Name a dataset that has it with "
            "--policy.demo_repo_id and --policy.demo_root, and, if its words are other ones, the episode "
            "with --policy.demo_episode."
        )

    def _autocast(self, device: torch.device) -> Any:
        if self.config.dtype == "float32":
            return nullcontext()
        return torch.autocast(device.type, torch.bfloat16)

    # Both

    def _images(self, batch: dict[str, Any]) -> Tensor:
        """Images of all cameras, (batch, cameras, 3, size, size)."""
        size = self.config.image_size
        images = []
        for name in self.config.image_features:
            image = batch[name]  # (batch, 3, H, W)
            if image.shape[-2:] != (size, size):
                image = F.interpolate(image, (size, size), mode="bilinear", antialias=True)
            images.append(image)
        return torch.stack(images, dim=1)

    def _concatenated(self, batch: dict[str, Any], embedding: Tensor | None) -> Tensor | None:
        parts = [embedding] if embedding is not None else []
        if self.config.robot_state_feature:
            parts.append(batch[OBS_STATE])
        return torch.cat(parts, dim=-1) if parts else None

    def conditioning_inputs(
        self, tasks: Sequence[str], demo: Tensor | None, language: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        """What goes through FiLM and what is concatenated."""

        def source(name: str) -> Tensor | None:
            if name == "none":
                return None
            if name == "one_hot":
                return self._one_hot(tasks)
            embeddings = {"demo": demo, "language": language}
            return torch.cat([embeddings[part] for part in name.split("+")], dim=-1)

        film, concat, _ = self.config.conditioning
        return source(film), source(concat)

    def _one_hot(self, tasks: Sequence[str]) -> Tensor:
        unknown = next((task for task in tasks if task not in self.config.one_hot_tasks), None)
        if unknown is not None:
            raise ValueError(
                f"The task {unknown!r} is not among the {len(self.config.one_hot_tasks)} that this one-hot "
                "policy knows: those of its training and demonstration datasets."
            )
        places = {task: n for n, task in enumerate(self.config.one_hot_tasks)}
        indices = torch.tensor([places[task] for task in tasks], device=self.step.device)
        return F.one_hot(indices, len(places)).float()

    def _encode_demo(
        self, demonstrations: DemonstrationSet, rows: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Unit embeddings of demonstrations, (batch, embedding)."""
        frames = demonstrations.sample_frames(rows, self.config.n_demo_frames, generator)
        if self.training and self.config.demo_crop_padding:
            frames = random_crop(frames, self.config.demo_crop_padding, generator)
        return self.demo_encoder(frames)

    def _split_action(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        """An action's motion, and its gripper in 0..1."""
        index = self.config.gripper_index
        if index is None:
            return action, None
        motion = torch.cat([action[:, :index], action[:, index + 1 :]], dim=1)
        return motion, (action[:, index] + 1) / 2

    def _join_action(self, motion: Tensor, gripper: Tensor | None) -> Tensor:
        """The inverse of `_split_action`."""
        index = self.config.gripper_index
        if index is None:
            return motion
        return torch.cat([motion[:, :index], 2 * gripper[:, None] - 1, motion[:, index:]], dim=1)

    # Datasets and checkpoints

    def _load_demonstrations(
        self, repo_id: str, root: str | Path | None, episodes: Sequence[int] | None
    ) -> DemonstrationSet:
        camera = next(iter(self.config.image_features))
        size, n_frames = self.config.image_size, self.config.n_demo_frames
        return load_demonstrations(repo_id, root, episodes, camera, size, n_frames)

    def _one_hot_vocabulary(self) -> list[str]:
        """Tasks of the training and demonstration datasets."""
        if self._meta is None:
            raise ValueError("A one-hot policy is made with a dataset, whose tasks it will know.")
        return list(
            dict.fromkeys(
                [
                    *self._meta.tasks.index,
                    *(self.eval_demonstrations.rows if self.eval_demonstrations else ()),
                ]
            )
        )

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        # What was read from the datasets is saved; the next user may name others.
        sources = ("demo_repo_id", "demo_root", "instruction_embeddings")
        given = {name: getattr(self.config, name) for name in sources}
        try:
            for name in sources:
                setattr(self.config, name, None)
            super()._save_pretrained(save_directory, state_dict)
        finally:
            for name, value in given.items():
                setattr(self.config, name, value)
        tensors, known = self.instructions.state()
        if self.eval_demonstrations is not None and self.config.uses_demo:
            tensors |= {
                "frames": self.eval_demonstrations.frames.cpu(),
                "episodes": self.eval_demonstrations.episodes.cpu(),
            }
            known["tasks"] = json.dumps(self.eval_demonstrations.tasks)
        save_file(tensors, save_directory / TASKS_FILE, metadata=known)

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> DeltacoPolicy:
        """Loads a policy with what it knows of tasks. See `PreTrainedPolicy.from_pretrained`."""
        folder = Path(pretrained_name_or_path)
        if folder.is_dir():
            path = folder / TASKS_FILE
        else:
            names = ("revision", "cache_dir", "token", "local_files_only", "force_download")
            options = {name: kwargs[name] for name in names if name in kwargs}
            path = Path(hf_hub_download(str(pretrained_name_or_path), TASKS_FILE, **options))
        config = kwargs.get("config")
        if config is not None:
            # Before its weights turn out not to fit.
            InstructionTable(config.language_encoder).read(path)
        policy = super().from_pretrained(pretrained_name_or_path, **kwargs)
        policy._read_tasks(path)
        return policy

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Loads weights. See `torch.nn.Module.load_state_dict`.

        Raises:
            ValueError: The weights were saved by a version that named them otherwise.
        """
        if any(name.startswith(OLD_MODEL_PREFIX) for name in state_dict):
            raise ValueError(
                "An earlier version of lerobot_policy_deltaco saved these weights: those of the policy's "
                f"network are named `{OLD_MODEL_PREFIX}*`. Train the policy again, or rename them in "
                f"model.safetensors: replace the prefix `{OLD_MODEL_PREFIX}` by `model.`."
            )
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card that goes to the Hub with the policy. LeRobot's arguments."""
        demonstrations = list(self.eval_demonstrations.rows) if self.eval_demonstrations is not None else []
        n_known = len(self.instructions.rows)
        return policy_card(
            self.config, demonstrations, n_known, dataset_repo_id, license, tags, cfg, dataset_meta
        )

    def _read_tasks(self, path: Path) -> None:
        self.instructions.read(path)
        with safe_open(path, framework="pt") as file:
            known = file.metadata()
            names = set(file.keys())
            # Demonstrations named on the command line come before those of the checkpoint.
            if self.eval_demonstrations is None and "frames" in names:
                self.eval_demonstrations = DemonstrationSet(
                    file.get_tensor("frames"), json.loads(known["tasks"]), file.get_tensor("episodes")
                ).to(self.config.device)
