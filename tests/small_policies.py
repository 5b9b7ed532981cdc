"""Small datasets unlike the benchmark's, small policies, and fake encoders of sentences and images."""

import hashlib

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from torch.utils.data import default_collate

import lerobot_policy_deltaco  # noqa: F401  (registers the policies)
from lerobot_deltaco import language
from lerobot_deltaco.deltaco import modeling_deltaco
from lerobot_deltaco.deltaco_match import feature_matching
from lerobot_deltaco.deltaco_match.crops import FEATURE_DIM, cut_crops
from lerobot_deltaco.vision import VISION_ENCODERS

# A dataset with two cameras and a gripper in the middle of the action.
REPO_ID = "test/foreign"
TASKS = ["stack the cups", "pour the tea", "wave"]
EPISODES_PER_TASK = {"stack the cups": 3, "pour the tea": 2, "wave": 1}
EPISODES = [task for task in TASKS for _ in range(EPISODES_PER_TASK[task])]
LENGTH = 5
ACTION_NAMES = ["left.pos", "left_gripper.pos", "right.pos"]

# A dataset of a table with two objects, of which one is moved.
TABLE_ID = "test/table"
TABLE_SIZE, TABLE_LENGTH = 24, 7
TABLE_TASKS = ["move the red object left", "move the blue object right"]
COLORS = {TABLE_TASKS[0]: (230, 40, 30), TABLE_TASKS[1]: (30, 60, 220)}
GRIPPER = (1, 1, -1, -1, -1, 1, 1)  # in the frames of an episode; -1 is closed

_SMALL = {
    "deltaco": {"image_size": 16, "backbone": "strided"},
    "deltaco_match": {"image_size": TABLE_SIZE, "num_mixture_components": 2, "dtype": "float32"},
}


def fake_encoder(name):
    """Makes a sentence encoder whose unit vectors depend on nothing but the sentence."""
    dim = language.LANGUAGE_ENCODERS[name].embedding_dim

    def encode(sentences):
        fake_encoder.calls.append(list(sentences))
        seeds = [int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) for text in sentences]
        vectors = np.stack([np.random.default_rng(seed).normal(size=dim) for seed in seeds])
        return torch.nn.functional.normalize(torch.tensor(vectors, dtype=torch.float32), dim=-1)

    return encode


def use_fake_encoder(monkeypatch):
    """Replaces all language encoders by the fake one."""
    fake_encoder.calls = []
    monkeypatch.setattr(language, "load_language_encoder", fake_encoder)
    torch.manual_seed(0)


class FakeVisionEncoder:
    """Features that are linear in the means of an image's colors, as many as those of the real encoder."""

    def __init__(self, name, *_):
        self.feature_dim = VISION_ENCODERS[name].feature_dim
        self.weights = torch.randn(3, self.feature_dim, generator=torch.Generator().manual_seed(0))

    def __call__(self, images):
        return images.mean(dim=(2, 3)) @ self.weights


def use_fake_vision_encoder(monkeypatch):
    """Replaces all frozen image encoders by the fake one."""
    monkeypatch.setattr(modeling_deltaco, "load_vision_encoder", FakeVisionEncoder)


def use_short_fit(monkeypatch, steps=2):
    """Fits feature matching in a few steps, to colors instead of a pretrained encoder's features."""

    def colors(images, locations, sizes):
        crops = cut_crops(images, locations, sizes, resolution=8).flatten(2)
        return torch.nn.functional.pad(crops, (0, FEATURE_DIM - crops.shape[2]))

    monkeypatch.setattr(feature_matching, "crop_features", colors)
    monkeypatch.setattr(feature_matching, "_MAX_DISTANCE", 9.0)  # any proposal will do
    monkeypatch.setattr(feature_matching.FeatureMatching.fit, "__defaults__", (steps,))


def write_dataset(root, episodes=EPISODES):
    """Writes an episode for each task named; its frames have its number as a shade of gray."""
    features = {
        "observation.images.top": _image_feature((20, 28, 3)),
        "observation.images.wrist": _image_feature((24, 24, 3)),
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "action": {"dtype": "float32", "shape": (3,), "names": ACTION_NAMES},
    }
    rng = np.random.default_rng(0)
    dataset = LeRobotDataset.create(REPO_ID, 10, features, root=root, use_videos=False)
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


def random_moves(n_episodes, tasks=TABLE_TASKS):
    """Draws episodes: the task, where its object is, where the other one is, and where the first is put."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < n_episodes:
        start, other = rng.uniform(-0.7, 0.7, (2, 2))
        if np.abs(start - other).max() > 0.5:
            task = tasks[len(found) % 2]
            found.append((task, start, other, np.array([-0.8 if "left" in task else 0.8, start[1]])))
    return found


def draw_table(task, moved, other):
    """Draws squares of 4 x 4 px: the task's object at one location, and the other object at another."""
    image = np.full((TABLE_SIZE, TABLE_SIZE, 3), 120, np.uint8)
    other_color = next(color for name, color in COLORS.items() if name != task)
    for color, location in ((COLORS[task], moved), (other_color, other)):
        column, row = (round((c + 1) * TABLE_SIZE / 2) for c in location)
        image[max(0, row - 2) : row + 2, max(0, column - 2) : column + 2] = color
    return image


def state_at(location):
    """Returns the robot's state at a location: other units, and a number that never changes."""
    x, y = location
    return np.array([3 + 0.4 * x + 0.1 * y, -1 - 0.1 * x + 0.5 * y, 7.0], np.float32)


def write_table(root, episodes, n_joints=3):
    """Writes episodes of `random_moves`: grasped in frame 3, released in frame 5."""
    features = {
        "observation.image": _image_feature((TABLE_SIZE, TABLE_SIZE, 3)),
        "observation.state": {"dtype": "float32", "shape": (n_joints,), "names": list("abcde"[:n_joints])},
        "action": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "gripper"]},
    }
    dataset = LeRobotDataset.create(TABLE_ID, 10, features, root=root, use_videos=False)
    home = np.zeros(2)
    for task, start, other, end in episodes:
        for step in range(TABLE_LENGTH):
            location = (home, start, start, start, end, end, home)[step]
            dataset.add_frame(
                {
                    "observation.image": draw_table(task, start if step < 4 else end, other),
                    "observation.state": np.resize(state_at(location), n_joints),
                    "action": np.array([*(location - home), GRIPPER[step]], np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(TABLE_ID, root=root)


def _image_feature(shape):
    return {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}


def small_policy(dataset, policy_type="deltaco", **options):
    """Makes a small policy and its processors, as LeRobot's training does."""
    config = make_policy_config(policy_type, **{"device": "cpu", **_SMALL[policy_type], **options})
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    return policy.train(), before, after


def demos_of(dataset):
    """Options that name a dataset as that of the demonstrations for evaluation."""
    return {"demo_repo_id": dataset.repo_id, "demo_root": str(dataset.root)}


def with_chunks(dataset, config):
    """Returns a dataset whose frames have the actions of a chunk, as a policy's training needs them."""
    windows = resolve_delta_timestamps(config, dataset.meta)
    return LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps=windows)


def batch_of(dataset, indices):
    """Returns frames of a dataset as a batch."""
    return default_collate([dataset[index] for index in indices])


def observation(dataset, tasks):
    """Returns the first observation of a dataset, once for each task."""
    batch = batch_of(dataset, [0] * len(tasks))
    kept = {key: value for key, value in batch.items() if key.startswith("observation.")}
    return {**kept, "task": list(tasks)}
