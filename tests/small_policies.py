"""A small dataset unlike the benchmark's (two cameras, a gripper in the middle); a fake sentence encoder."""

import hashlib

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from torch.utils.data import default_collate

from lerobot_deltaco.modeling import network_factory
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS

REPO_ID = "test/foreign"
TASKS = ["stack the cups", "pour the tea", "wave"]
EPISODES_PER_TASK = {"stack the cups": 3, "pour the tea": 2, "wave": 1}
LENGTH = 5
ACTION_NAMES = ["left.pos", "left_gripper.pos", "right.pos"]


def fake_encoder(name):
    """Unit vectors that depend on nothing but the sentence."""
    dim = instruction_table.LANGUAGE_ENCODERS[name].embedding_dim

    def encode(sentences):
        fake_encoder.calls.append(list(sentences))
        seeds = [int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) for text in sentences]
        vectors = np.stack([np.random.default_rng(seed).normal(size=dim) for seed in seeds])
        return torch.nn.functional.normalize(torch.tensor(vectors, dtype=torch.float32), dim=-1)

    return encode


def use_fake_encoder(monkeypatch):
    """Puts it in the place of all language encoders."""
    fake_encoder.calls = []
    monkeypatch.setattr(instruction_table, "load_language_encoder", fake_encoder)
    torch.manual_seed(0)


class FakeVisionEncoder:
    """As many features as the image encoder has, which are weights of the means of an image's colors."""

    def __init__(self, name, *_):
        self.feature_dim = VISION_ENCODERS[name].feature_dim
        self.weights = torch.randn(3, self.feature_dim, generator=torch.Generator().manual_seed(0))

    def __call__(self, images):
        return images.mean(dim=(2, 3)) @ self.weights


def use_fake_vision_encoder(monkeypatch):
    """Puts it in the place of all frozen image encoders."""
    monkeypatch.setattr(network_factory, "load_vision_encoder", FakeVisionEncoder)


def write_dataset(root, episodes):
    """A dataset with an episode for each task named; frames of an episode share its number as a shade."""
    features = {
        "observation.images.top": {
            "dtype": "image",
            "shape": (20, 28, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.images.wrist": {
            "dtype": "image",
            "shape": (24, 24, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "action": {"dtype": "float32", "shape": (3,), "names": ACTION_NAMES},
    }
    dataset = LeRobotDataset.create(REPO_ID, 10, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for number, task in enumerate(episodes):
        for step in range(LENGTH):
            dataset.add_frame(
                {
                    "observation.images.top": np.full((20, 28, 3), (10 * number + step) % 256, np.uint8),
                    "observation.images.wrist": rng.integers(0, 255, (24, 24, 3), dtype=np.uint8),
                    "observation.state": rng.normal(size=2).astype(np.float32),
                    "action": np.array([rng.uniform(-5, 5), step % 2, rng.uniform(100, 200)], np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(REPO_ID, root=root)


def small_policy(dataset, **options):
    """A small policy and its processors, made as LeRobot's training does."""
    config = make_policy_config(
        "deltaco", **{"device": "cpu", "image_size": 16, "backbone": "strided", **options}
    )
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    return policy.train(), before, after


def batch_of(dataset, indices):
    return default_collate([dataset[index] for index in indices])


def observation(dataset, tasks):
    batch = batch_of(dataset, [0] * len(tasks))
    kept = {key: value for key, value in batch.items() if key.startswith("observation.")}
    return {**kept, "task": list(tasks)}
