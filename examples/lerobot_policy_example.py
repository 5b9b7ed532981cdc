"""A complete policy for the benchmark, to start from: it takes a demonstration and a sentence.

What differs between the demonstration's first and last image is described by its features, and looked for in
the camera's image. The sentence is a bag of words. docs/compare.md trains and evaluates it.
"""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

import zlib
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import make_default_pre_post_processors
from torch import Tensor, nn

from lerobot_deltaco.demonstrations import open_dataset, read_demonstrations

N_WORDS, DIM = 4096, 64


@PreTrainedConfig.register_subclass("example")
@dataclass
class ExampleConfig(PreTrainedConfig):
    """Options: `--policy.optimizer_lr=3e-4`."""

    optimizer_lr: float = 1e-3
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {"STATE": NormalizationMode.MEAN_STD}  # images are in 0..1, actions in -1..1
    )
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def validate_features(self) -> None: ...

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=1e-2)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=self.optimizer_lr, decay_lr=0.0, num_warmup_steps=100, num_decay_steps=1_000_000
        )


def make_example_pre_post_processors(config, dataset_stats=None):
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)


class ExamplePolicy(PreTrainedPolicy):
    """A convolutional network that is told where the demonstrated object is."""

    config_class, name = ExampleConfig, "example"

    def __init__(self, config: ExampleConfig, dataset_stats=None, dataset_meta=None) -> None:
        super().__init__(config)
        self.meta, self.bank, self.tasks = dataset_meta, None, None
        layers = nn.Conv2d(3, 32, 5, 2, 2), nn.ReLU(), nn.Conv2d(32, DIM, 3, 2, 1), nn.ReLU()
        self.encoder = nn.Sequential(*layers, nn.Conv2d(DIM, DIM, 3, 1, 1))
        self.words = nn.EmbeddingBag(N_WORDS, 2 * DIM)
        nn.init.zeros_(self.words.weight)  # words that were never trained on say nothing
        self.trunk = nn.ModuleList(nn.Conv2d(size, DIM, 3, 1, 1) for size in (DIM + 1, DIM, DIM))
        self.head = nn.Sequential(nn.Linear(2 * DIM + 2 + 10 + 2 * DIM, 256), nn.ReLU(), nn.Linear(256, 4))

    def act(self, images: Tensor, states: Tensor, sentences: list[str], ends: Tensor) -> Tensor:
        """Returns actions (batch, 4): a motion, and the logit of an open gripper.

        Args:
            images: (batch, 3, H, W) in 0..1.
            states: (batch, 10), normalized.
            sentences: Instruction of each sample.
            ends: First and last image of each demonstration, (batch, 2, 3, H, W) in 0..1.
        """
        scene, first, last = self.encoder(torch.cat([images, ends[:, 0], ends[:, 1]])).chunk(3)
        moved = (first - last).square().sum(1, keepdim=True)  # (batch, 1, h, w)
        attention = (moved / moved.amax((2, 3), keepdim=True).clamp_min(1e-6) * 8).flatten(2).softmax(2)
        descriptor = torch.einsum("bns,bcs->bc", attention, first.flatten(2))
        similar = torch.einsum("bc,bchw->bhw", F.normalize(descriptor, dim=1), F.normalize(scene, dim=1))
        found = soft_argmax(8 * similar[:, None])
        words = [[zlib.crc32(word.encode()) % N_WORDS for word in f"{text} .".split()] for text in sentences]
        starts = torch.tensor([0, *map(len, words[:-1])], device=images.device).cumsum(0)
        said = self.words(torch.tensor(sum(words, []), device=images.device), starts)
        scale, shift = said[..., None, None].chunk(2, dim=1)
        hidden = F.relu(self.trunk[0](torch.cat([scene, similar[:, None]], 1)))
        hidden = F.relu(self.trunk[1](hidden) * (1 + scale) + shift)
        points = soft_argmax(self.trunk[2](hidden))
        return self.head(torch.cat([points, found, states, said], 1))

    def forward(self, batch):
        if (
            self.bank is None
        ):  # once: the training episodes, of which others than the sample's are demonstrations
            dataset = open_dataset("--dataset.root", self.meta.repo_id, self.meta.root)
            self.bank = read_demonstrations(dataset, "observation.image", 48, 2).to(self.config.device)
        generator = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
        rows = self.bank.draw_other_episodes(batch["episode_index"], batch["task"], generator)
        ends = self.bank.frames[rows] / 255
        predicted = self.act(batch["observation.image"], batch["observation.state"], batch["task"], ends)
        motion = F.smooth_l1_loss(predicted[:, :3], batch["action"][:, :3], beta=0.1)
        gripper = F.binary_cross_entropy_with_logits(predicted[:, 3], (batch["action"][:, 3] > 0).float())
        return motion + 0.1 * gripper, {"motion": motion.item(), "gripper": gripper.item()}

    def set_tasks(self, instructions, demonstrations) -> None:
        """Called by `deltaco evaluate` after each reset, with a list of demonstrations of each sample."""
        ends = torch.stack([own[0].frames[[0, -1]] for own in demonstrations])
        self.tasks = instructions, ends.to(self.config.device)

    @torch.no_grad()
    def select_action(self, batch):
        # With `lerobot-eval --env.demonstrations=true`, the demonstration is part of the observation.
        sentences, ends = self.tasks or (batch["task"], batch["observation.demonstration_image"][:, [0, -1]])
        action = self.act(batch["observation.image"], batch["observation.state"], sentences, ends / 255)
        return torch.cat([action[:, :3], action[:, 3:].sign()], 1)

    def predict_action_chunk(self, batch):
        return self.select_action(batch)[:, None]

    def reset(self) -> None:
        self.tasks = None

    def get_optim_params(self):
        return self.parameters()


def soft_argmax(maps: Tensor) -> Tensor:
    """Returns the mean location in each channel of maps, (batch, channels, h, w), as (batch, 2 channels)."""
    weights = maps.flatten(2).softmax(2).view_as(maps)
    y, x = (torch.linspace(-1, 1, size, device=maps.device) for size in maps.shape[2:])
    return torch.cat([(weights.sum(2) * x).sum(2), (weights.sum(3) * y).sum(2)], 1)
