"""Small datasets, policies and trainings in this process, with fake encoders of sentences and images."""

import functools
import hashlib
import sys

import numpy as np
import pytest
import torch
from draccus import argparsing
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset, dataset_metadata, load_episodes
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from lerobot.scripts import lerobot_train
from torch.utils.data import default_collate

import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)
from gym_deltaco.tasks import TASKS as BENCHMARK_TASKS
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.evaluation.video import load_conditioned
from lerobot_deltaco.policies.base import language
from lerobot_deltaco.policies.deltaco_match import feature_matching, fit, modeling_deltaco_match
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import (
    DeltacoMatchConfig,
    MatchingSettings,
)
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.policies.deltaco_match.words import vocabulary_of
from lerobot_deltaco.policies.scene.crops import CropEncoder
from lerobot_deltaco.training.train import train

# Most of a small training is spent on making parsers of options and on opening datasets: do both once.


_parsers = functools.cache(argparsing.ArgumentParser)
_episodes = functools.cache(lambda root, *times: load_episodes(root))


def parser_once(config_class, config_path=None, **options):
    parser = _parsers(config_class, **options)
    parser.config_path = config_path
    return parser


def load_episodes_once(root):
    files = sorted((root / "meta" / "episodes").rglob("*.parquet"))
    return _episodes(root, *((path, path.stat().st_mtime_ns) for path in files))


argparsing.ArgumentParser = parser_once
dataset_metadata.load_episodes = load_episodes_once

# Fake encoders


def fake_encoder(name):
    """Makes a sentence encoder whose unit vectors depend on nothing but the sentence."""
    dim = language.LANGUAGE_ENCODERS[name].embedding_dim

    def encode(sentences):
        fake_encoder.calls.append(list(sentences))
        seeds = [int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) for text in sentences]
        vectors = np.stack([np.random.default_rng(seed).normal(size=dim) for seed in seeds])
        return torch.nn.functional.normalize(torch.tensor(vectors, dtype=torch.float32), dim=-1)

    return encode


fake_encoder.calls = []


def use_fake_encoder(monkeypatch):
    """Replaces all language encoders by the fake one."""
    fake_encoder.calls = []
    monkeypatch.setattr(language, "load_language_encoder", fake_encoder)
    torch.manual_seed(0)


_fits = {}


def fit_once(matching, *data, **options):
    """Fits feature matching, or takes the result of an earlier fit to the same data."""
    digest = hashlib.sha256()
    arguments = [matching.vocabulary, matching.settings, type(matching.encoder), options]
    for part in data:
        if isinstance(part, torch.Tensor):
            digest.update(part.cpu().contiguous().numpy())
        arguments.append(part.shape if isinstance(part, torch.Tensor) else part)
    key = digest.digest(), repr(arguments)
    if key not in _fits:
        held_out = fit.fit_feature_matching(matching, *data, **options)
        state = {name: value.cpu().clone() for name, value in matching.state_dict().items()}
        _fits[key] = state, held_out
    matching.load_state_dict(_fits[key][0])
    return _fits[key][1]


class ColorEncoder(CropEncoder):
    """Describes crops by colors alone."""

    feature_dim, color_dim, resolution = 192, 0, 8

    def encode(self, crops):
        return crops.flatten(1)


def use_short_fit(monkeypatch, steps=2, **settings):
    """Fits feature matching in a few steps, to colors instead of a pretrained encoder's features."""
    short = {
        "refinement_steps": steps,
        "grasp_error": 9.0,  # any proposal will do
        "min_matching_steps": steps,
        "max_matching_steps": steps,
        "place_reaches": (0.0,),
        **settings,
    }
    monkeypatch.setattr(modeling_deltaco_match, "fit_feature_matching", fit_once)
    monkeypatch.setattr(feature_matching, "EfficientNetCropEncoder", ColorEncoder)
    monkeypatch.setattr(feature_matching, "MatchingSettings", functools.partial(MatchingSettings, **short))


# Datasets


def write_episodes(root, repo_id, episodes, fps=10, video=False, **names):
    """Writes a dataset of episodes (task, frames), with names of a feature's dimensions, and opens it.

    The values of the first frame tell the features.
    """

    def feature(name, value):
        if isinstance(value, str):
            return {"dtype": "string", "shape": (1,), "names": None}
        if value.ndim == 3:
            kind, axes = "video" if video else "image", ["height", "width", "channels"]
            return {"dtype": kind, "shape": value.shape, "names": axes}
        return {"dtype": str(value.dtype), "shape": value.shape, "names": names.get(name)}

    features = {name: feature(name, value) for name, value in episodes[0][1][0].items()}
    encoder = RGBEncoderConfig(vcodec="h264") if video else None
    dataset = LeRobotDataset.create(repo_id, fps, features, root=root, use_videos=video, rgb_encoder=encoder)
    for task, frames in episodes:
        for frame in frames:
            dataset.add_frame({**frame, "task": task})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(repo_id, root=root)


# A dataset with two cameras and a gripper in the middle of the action.
REPO_ID = "test/foreign"
TASKS = ["stack the cups", "pour the tea", "wave"]
EPISODES = ["stack the cups"] * 3 + ["pour the tea"] * 2 + ["wave"]
LENGTH = 5


def write_dataset(root, episodes=EPISODES, cameras=("top", "wrist"), **options):
    """Writes an episode for each task named; the first camera shows its number as a shade of gray."""
    rng = np.random.default_rng(0)
    first, second = (f"observation.images.{camera}" for camera in cameras)

    def frame(number, step):
        return {
            first: np.full((20, 28, 3), (10 * number + step) % 256, np.uint8),
            second: rng.integers(0, 255, (24, 24, 3), dtype=np.uint8),
            "observation.state": rng.normal(size=2).astype(np.float32),
            "action": np.array([rng.uniform(-5, 5), step % 2, rng.uniform(100, 200)], np.float32),
        }

    frames = [(task, [frame(number, step) for step in range(LENGTH)]) for number, task in enumerate(episodes)]
    names = {"observation.state": ["a", "b"], "action": ["left.pos", "left_gripper.pos", "right.pos"]}
    return write_episodes(root, REPO_ID, frames, **names, **options)


# A dataset of a table with two objects, of which one is moved.
TABLE_SIZE, TABLE_LENGTH = 24, 7
TABLE_TASKS = ["move the red object left", "move the blue object right"]
COLORS = {TABLE_TASKS[0]: (230, 40, 30), TABLE_TASKS[1]: (30, 60, 220)}
GRIPPER = (1, 1, -1, -1, -1, 1, 1)  # in the frames of an episode; -1 is closed


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


def write_table(root, episodes, n_joints=3, grippers=("gripper",)):
    """Writes episodes of `random_moves`: grasped in frame 3, released in frame 5; the last gripper moves."""
    home = np.zeros(2)

    def frame(step, task, start, other, end):
        location = (home, start, start, start, end, end, home)[step]
        return {
            "observation.image": draw_table(task, start if step < 4 else end, other),
            "observation.state": np.resize(state_at(location), n_joints),
            "action": np.array([*(location - home), *resting, GRIPPER[step]], np.float32),
        }

    resting = np.ones(len(grippers) - 1)
    frames = [(move[0], [frame(step, *move) for step in range(TABLE_LENGTH)]) for move in episodes]
    names = {"observation.state": list("abcde"[:n_joints]), "action": ["a", "b", *grippers]}
    return write_episodes(root, "test/table", frames, **names)


# A dataset of the benchmark: tasks by name, color and shape. `deltaco_match` needs 24 episodes.
TASK_IDS = (4, 14, 55, 90)


def collect_benchmark(root):
    """Collects six episodes of each of the tasks `TASK_IDS`."""
    collect(root, CollectionPlan(",".join(map(str, TASK_IDS)), 6))
    return root


class SharedFrames(FramesInMemory):
    """Frames that copies of a policy share."""

    def __deepcopy__(self, _):
        return self


def hold_in_memory(dataset, **options):
    """Lets policies that are made for a dataset get their training data from memory, which saves a second."""
    dataset.frames = SharedFrames(LeRobotDataset(dataset.repo_id, root=dataset.root, **options))
    return dataset


# Policies

_SMALL = {
    "deltaco": {"image_size": 16, "backbone": "strided"},
    "deltaco_match": {"image_size": TABLE_SIZE, "num_mixture_components": 2, "precision": "float32"},
}


def small_policy(dataset, policy_type="deltaco", prepare=True, **options):
    """Makes a small policy and its processors, as LeRobot's training does."""
    config = make_policy_config(policy_type, **{"device": "cpu", **_SMALL[policy_type], **options})
    policy = make_policy(config, ds_meta=dataset.meta)
    if prepare and hasattr(dataset, "frames") and config.uses_demonstrations and not config.training_episodes:
        policy.prepare_training(dataset.frames)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    return policy.train(), before, after


def demos_of(dataset):
    """Options that name a dataset as that of the demonstrations for evaluation."""
    return {"demo_repo_id": dataset.repo_id, "demo_root": str(dataset.root)}


def with_chunks(dataset, config):
    """Returns a dataset whose frames have the actions of a chunk, as a policy's training needs them."""
    windows = resolve_delta_timestamps(config, dataset.meta)
    if windows is None:
        return dataset
    return LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps=windows)


def batch_of(dataset, indices):
    """Returns the batch that LeRobot's data loader makes of some frames."""
    return default_collate([dataset[index] for index in indices])


def observation(dataset, tasks):
    """Returns the first observation of a dataset, once for each task."""
    batch = batch_of(dataset, [0] * len(tasks))
    kept = {key: value for key, value in batch.items() if key.startswith("observation.")}
    return {**kept, "task": list(tasks)}


# Benchmark tasks of which the untrained policy has a demonstration, and sentences whose words it knows.
DEMONSTRATED = (4, 26)
SENTENCES = [task.instruction for task in BENCHMARK_TASKS]
SENTENCES += ["Put it in the red bin.", "wave at me", "put the blue goblet into the red one"]


def save_tiny_policy(folder, **options):
    """Saves an untrained `deltaco_match` for the benchmark with its processors, and returns the folder."""
    torch.manual_seed(0)
    config = DeltacoMatchConfig(
        device="cpu",
        known_words=vocabulary_of(SENTENCES),
        gripper="3",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        **options,
    )
    stats = {"observation.state": {"mean": torch.zeros(10), "std": torch.ones(10)}}
    policy = DeltacoMatchPolicy(config, stats).eval()
    frames = torch.randint(0, 256, (len(DEMONSTRATED), 2, 3, 48, 48), dtype=torch.uint8)
    tasks = [BENCHMARK_TASKS[task_id].instruction for task_id in DEMONSTRATED]
    policy.demonstrations = DemonstrationBank(frames, tasks, range(len(tasks)), DEMONSTRATED)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


def load_tiny_policy(folder, **options):
    return load_conditioned(save_tiny_policy(folder / "tiny", **options))


# Trainings

DELTACO = {"policy.type": "deltaco", "policy.backbone": "strided", "policy.tasks_per_batch": 2}
MATCH = {"policy.type": "deltaco_match", "policy.tasks_per_batch": 2, "policy.precision": "float32"}
_SMALL_ACT = {
    **{"type": "act", "pretrained_backbone_weights": "null", "push_to_hub": False},
    **{"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "chunk_size": 5, "n_action_steps": 5},
    **{"n_encoder_layers": 1, "n_vae_encoder_layers": 1},
}
ACT = {f"policy.{name}": value for name, value in _SMALL_ACT.items()}
POLICIES = {"deltaco": DELTACO, "deltaco_match": MATCH, "act": ACT}


def run_training(root, folder, options, in_memory=True, **more):
    """Trains as `deltaco train` or `lerobot-train` do, in this process; returns the folder of checkpoints."""
    arguments = {
        **{"policy.device": "cpu", "dataset.repo_id": "test/small", "dataset.root": root},
        **{"batch_size": 6, "steps": 4, "save_freq": 2, "log_freq": 1, "num_workers": 0},
        "output_dir": folder,
        **options,
        **more,
    }
    if "resume" in more:
        arguments = {"output_dir": folder, **more}
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        use_short_fit(patch)
        patch.setattr(sys, "argv", ["train", *as_options(arguments)])
        train() if in_memory else lerobot_train.main()
    return folder / "checkpoints"


def as_options(values):
    """Returns options of a command of LeRobot, by their names without dashes."""
    return [f"--{k}={str(v).lower() if isinstance(v, bool) else v}" for k, v in values.items()]
