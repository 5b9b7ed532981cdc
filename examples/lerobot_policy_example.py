"""A complete policy for the benchmark, to start from: it takes a demonstration and a sentence.

What the demonstration moved is looked for in the scene, and the place that the sentence names. Both are found
once, as positions of the hand; a small network then moves it there. docs/compare.md trains and evaluates it.
"""

# No `from __future__ import annotations`: LeRobot expects the annotation of `config` to be a class.

import zlib
from dataclasses import dataclass, field
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import make_default_pre_post_processors
from torch import Tensor, nn

from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.data.training_data import DatasetEpisodes, DemonstrationFormat, TrainingData

N_WORDS, DIM = 4096, 32
N_SCENES = 32  # of a batch's samples, on which finding is trained
HAND = slice(6, 9)  # the end effector's x, y, z in the state


@PreTrainedConfig.register_subclass("example")
@dataclass
class ExampleConfig(PreTrainedConfig):
    """Options: `--policy.optimizer_lr=3e-4`."""

    optimizer_lr: float = 2e-3
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=dict  # images are in 0..1, actions in -1..1, and states in m and rad
    )
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def validate_features(self) -> None: ...

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=1e-2)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=self.optimizer_lr, decay_lr=0.0, num_warmup_steps=0, num_decay_steps=1_000_000
        )


def make_example_pre_post_processors(config, dataset_stats=None):
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)


class ExamplePolicy(PreTrainedPolicy):
    """A network that finds two locations, and one that acts on them."""

    config_class, name = ExampleConfig, "example"

    def __init__(self, config: ExampleConfig, dataset_stats=None, dataset_meta=None) -> None:
        super().__init__(config)
        self.meta, self.bank, self.tasks, self.found = dataset_meta, None, None, None
        layers = (
            nn.Conv2d(3, DIM, 5, 2, 2),
            nn.ReLU(),
            nn.BatchNorm2d(DIM),
            nn.Conv2d(DIM, DIM, 3, 1, 1),
            nn.ReLU(),
        )
        self.encoder = nn.Sequential(*layers, nn.Conv2d(DIM, DIM, 3, 1, 1))
        self.attention = nn.Sequential(nn.Conv2d(6, DIM, 5, 2, 2), nn.ReLU(), nn.Conv2d(DIM, 1, 3, 1, 1))
        self.words = nn.EmbeddingBag(N_WORDS, DIM, mode="sum")
        nn.init.zeros_(self.words.weight)  # words that were never trained on say nothing
        self.places = nn.Conv2d(DIM, DIM, 3, 1, 1)
        self.locate = nn.ModuleList(nn.Linear(2 + DIM, 3) for _ in range(2))
        self.controller = nn.Sequential(
            *(nn.Linear(10 + 6, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 4))
        )

    def find(self, scenes: Tensor, sentences: list[str], ends: Tensor) -> Tensor:
        """Returns where the hand should grasp and release, and where it grasped, (batch, 3, 3) in m.

        Args:
            scenes: First image of each episode, (batch, 3, H, W) in 0..1.
            sentences: Instruction of each.
            ends: First and last image of each demonstration, (batch, 2, 3, H, W) in 0..1.
        """
        scene, first = self.encoder(torch.cat([scenes, ends[:, 0]])).chunk(2)
        moved = 20 * self.attention(torch.cat([ends[:, 0], ends[:, 0] - ends[:, 1]], 1))[:, 0]
        descriptor = F.normalize(pool(first, moved)[:, 2:], dim=1)
        picks = 20 * torch.einsum("bc,bchw->bhw", descriptor, F.normalize(scene, dim=1))
        words = [f". {text.lower()} .".split() for text in sentences]
        pairs = [[zlib.crc32("".join(pair).encode()) % N_WORDS for pair in pairwise(own)] for own in words]
        flat, starts = sum(pairs, []), torch.tensor([0, *map(len, pairs[:-1])]).cumsum(0)
        said = 10 * self.words(torch.tensor(flat, device=scene.device), starts.to(scene.device))
        places = torch.einsum("bc,bchw->bhw", said, self.places(scene))
        pick, place = self.locate
        return torch.stack(
            [pick(pool(scene, picks)), place(pool(scene, places)), pick(pool(first, moved))], 1
        )

    def act(self, states: Tensor, targets: Tensor) -> Tensor:
        """Returns actions (batch, 4): a motion, and the logit of an open gripper."""
        offsets = 10 * (targets - states[:, None, HAND]).flatten(1)
        return self.controller(torch.cat([states, offsets], 1))

    def forward(self, batch):
        if self.bank is None:  # once: of the training episodes, others than the sample's are demonstrations
            dataset = LeRobotDataset(self.meta.repo_id, root=self.meta.root)
            form = DemonstrationFormat("observation.image", 48, gripper=Gripper(3))
            data = TrainingData.read(DatasetEpisodes(dataset), form).to(self.config.device)
            self.bank, self.targets = data.demonstrations, data.grasps.states[..., HAND]
        generator = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
        own, tasks = batch["episode_index"][:N_SCENES], batch["task"][:N_SCENES]
        others = self.bank.draw_other_episodes(own, tasks, generator)
        found = self.find(self.bank.frames[own, 0] / 255, tasks, self.bank.frames[others] / 255)
        wanted = torch.cat([self.targets[own], self.targets[others, :1]], 1)
        finding = F.smooth_l1_loss(found, wanted, beta=0.005)
        targets = self.targets[batch["episode_index"]]
        noisy = targets + 0.005 * torch.randn_like(targets)
        predicted = self.act(batch["observation.state"], noisy)
        motion = F.smooth_l1_loss(predicted[:, :3], batch["action"][:, :3], beta=0.1)
        gripper = F.binary_cross_entropy_with_logits(predicted[:, 3], (batch["action"][:, 3] > 0).float())
        losses = {"finding": 10 * finding, "motion": motion, "gripper": 0.1 * gripper}
        return sum(losses.values()), {name: loss.item() for name, loss in losses.items()}

    def set_tasks(self, instructions, demonstrations) -> None:
        """Called by `deltaco evaluate` after each reset, with a list of demonstrations of each sample."""
        if not all(demonstrations):
            raise ValueError("This example needs a demonstration: evaluate it with an instruction and one.")
        ends = torch.stack([own[0].frames[[0, -1]] for own in demonstrations])
        self.tasks = instructions, ends.to(self.config.device)

    @torch.no_grad()
    def select_action(self, batch):
        if self.found is None:
            # With `lerobot-eval --env.demonstrations=true`, the demonstration is part of the observation.
            sentences, ends = self.tasks or (batch["task"], batch["observation.demonstration"])
            self.found = self.find(batch["observation.image"], sentences, ends / 255)[:, :2]
        action = self.act(batch["observation.state"], self.found)
        return torch.cat([action[:, :3], action[:, 3:].sign()], 1)

    def predict_action_chunk(self, batch):
        return self.select_action(batch)[:, None]

    def reset(self) -> None:
        self.tasks = self.found = None

    def get_optim_params(self):
        return self.parameters()


def pool(features: Tensor, maps: Tensor) -> Tensor:
    """Returns the mean location and features where maps (batch, h, w) are great, (batch, 2 + channels)."""
    weights = maps.flatten(1).softmax(1).view_as(maps)
    y, x = (torch.linspace(-1, 1, size, device=maps.device) for size in maps.shape[1:])
    location = torch.stack([(weights.sum(1) * x).sum(1), (weights.sum(2) * y).sum(1)], 1)
    return torch.cat([location, torch.einsum("bhw,bchw->bc", weights, features)], 1)
