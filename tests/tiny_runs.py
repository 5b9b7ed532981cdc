"""Small datasets, and trainings in this process: a new one takes seconds to import LeRobot."""

import hashlib
import sys

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train
from small_policies import use_short_fit
from torch.utils.data import default_collate

import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)
from lerobot_deltaco import language
from lerobot_deltaco.collect import CollectionPlan, collect
from lerobot_deltaco.train import train

# Tasks of the small dataset of the benchmark, by name, color and shape.
TASK_IDS = (4, 14, 55, 90)
EPISODES_PER_TASK = 6  # `deltaco_match` needs 24 episodes

DELTACO = {"policy.type": "deltaco", "policy.backbone": "strided", "policy.tasks_per_batch": 2}
MATCH = {
    "policy.type": "deltaco_match",
    "policy.tasks_per_batch": 2,
    # accelerate keeps its precision for the whole process.
    "policy.dtype": "float32",
}
ACT = {
    "policy.type": "act",
    "policy.dim_model": 16,
    "policy.n_heads": 2,
    "policy.dim_feedforward": 16,
    "policy.n_encoder_layers": 1,
    "policy.n_vae_encoder_layers": 1,
    "policy.chunk_size": 5,
    "policy.n_action_steps": 5,
    "policy.pretrained_backbone_weights": "null",
    "policy.push_to_hub": False,
}
POLICIES = {"deltaco": DELTACO, "deltaco_match": MATCH, "act": ACT}


def fake_language_encoder(name):
    """Returns an encoder whose unit vectors depend on nothing but the sentence."""
    dim = language.LANGUAGE_ENCODERS[name].embedding_dim

    def encode(sentences):
        seeds = [int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) for text in sentences]
        vectors = np.stack([np.random.default_rng(seed).normal(size=dim) for seed in seeds])
        return torch.nn.functional.normalize(torch.tensor(vectors, dtype=torch.float32), dim=-1)

    return encode


def collect_benchmark(root):
    """Collects a small dataset of the benchmark."""
    collect(root, CollectionPlan(",".join(map(str, TASK_IDS)), EPISODES_PER_TASK))
    return root


def write_dataset(root, tasks, length, camera_shapes, video=False, **features):
    """Writes a dataset of random numbers, with an episode for each of the tasks.

    Args:
        root: Its folder.
        tasks: Task string of each episode.
        length: Frames of an episode.
        camera_shapes: (height, width) of each camera's images.
        video: Whether images are stored as videos, in which they are smooth.
        features: More features, by name: a function that makes the value of a frame.
    """
    names = ["x", "y", "gripper"]
    declared = {
        **{
            f"observation.images.{name}": {
                "dtype": "video" if video else "image",
                "shape": (*shape, 3),
                "names": ["height", "width", "channels"],
            }
            for name, shape in camera_shapes.items()
        },
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "action": {"dtype": "float32", "shape": (3,), "names": names},
    }
    rng = np.random.default_rng(0)
    made = {name: make(rng) for name, make in features.items()}
    for name, value in made.items():
        is_text = isinstance(value, str)
        dtype, shape = ("string", (1,)) if is_text else (str(value.dtype), value.shape)
        declared[name] = {"dtype": dtype, "shape": shape, "names": None}
    dataset = LeRobotDataset.create("test/small", 10, declared, root=root, use_videos=video)
    for episode, task in enumerate(tasks):
        for step in range(length):
            frame = {
                "observation.state": rng.normal(size=2).astype(np.float32),
                "action": np.array([*rng.uniform(-5, 5, 2), step % 2], np.float32),
                "task": task,
                **{name: make(rng) for name, make in features.items()},
            }
            for name, shape in camera_shapes.items():
                image = rng.integers(0, 255, (*shape, 3), dtype=np.uint8)
                if video:
                    image = np.full_like(image, 40 * episode + 10 * step)
                frame[f"observation.images.{name}"] = image
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def batch_of(dataset, indices):
    """Returns the batch that LeRobot's data loader makes of some frames."""
    return default_collate([dataset[index] for index in indices])


def run_training(root, folder, options, in_memory=True, **more):
    """Trains in this process, and returns the folder of the checkpoints.

    Args:
        root: Folder of the dataset.
        folder: Output folder.
        options: Options of the policy.
        in_memory: Whether as `deltaco train`, or as `lerobot-train`.
        more: More options, with two underscores for a dot.
    """
    arguments = {
        "policy.device": "cpu",
        "dataset.repo_id": "test/small",
        "dataset.root": root,
        "batch_size": 6,
        "steps": 4,
        "save_freq": 2,
        "log_freq": 1,
        "num_workers": 0,
        "output_dir": folder,
        **options,
        **{name.replace("__", "."): value for name, value in more.items()},
    }
    if "resume" in arguments:
        arguments = {"output_dir": folder, **more}
    words = [f"--{name}={_as_word(value)}" for name, value in arguments.items()]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(language, "load_language_encoder", fake_language_encoder)
        use_short_fit(patch)
        patch.setattr(sys, "argv", ["train", *words])
        train() if in_memory else lerobot_train.main()
    return folder / "checkpoints"


def _as_word(value):
    return str(value).lower() if isinstance(value, bool) else value
