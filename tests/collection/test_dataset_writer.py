"""The files are those that LeRobot's own writer makes, and LeRobot reads and edits them."""

import io
import json

import datasets
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata, dataset_metadata
from lerobot.datasets import utils as lerobot_files
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.utils.constants import DEFAULT_FEATURES
from PIL import Image

from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.collection import writer
from lerobot_deltaco.collection.collect import ROBOT_TYPE, dataset_features

REPO_ID = "user/deltaco"
FPS = 24
FEATURES = dataset_features(SceneConfig(image_size=16))
FEATURES_OF_LEROBOT = {name: {**own, "shape": tuple(own["shape"])} for name, own in FEATURES.items()}
TASKS = ["Put the cup in the left bin.", "Put the vase in the red bin."]
LENGTHS = [5, 4, 6, 5, 3]
TASK_INDICES = [0, 0, 1, 1, 0]
SHARDS = [range(0, 2), range(2, 4), range(4, 5)]


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Keeps the tables that `datasets` makes out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path_factory.mktemp("cache"))
        yield


@pytest.fixture(scope="module")
def episodes():
    """Random episodes of different lengths."""
    rng = np.random.default_rng(0)
    made = []
    for length, task_index in zip(LENGTHS, TASK_INDICES, strict=True):
        frames = {
            "observation.image": rng.integers(0, 256, (length, 16, 16, 3), dtype=np.uint8),
            "observation.state": rng.normal(size=(length, 10)).astype(np.float32),
            "action": rng.uniform(-1, 1, (length, 4)).astype(np.float32),
            "next.reward": rng.integers(0, 2, length).astype(np.float32),
            "next.done": np.arange(length) == length - 1,
            "next.success": rng.integers(0, 2, length).astype(bool),
        }
        for name in FEATURES:
            if name.startswith("benchmark."):
                frames[name] = np.full(length, rng.integers(2**62))
        made.append(writer.RecordedEpisode(frames, TASKS[task_index], task_index))
    return made


@pytest.fixture(scope="module")
def root(tmp_path_factory, episodes):
    """The episodes in three shards, which are written in another order, and numbered afterwards."""
    root = tmp_path_factory.mktemp("ours") / "dataset"
    for shard in (2, 0, 1):
        first = SHARDS[shard].start
        parts = [episodes[i] for i in SHARDS[shard]]
        assert not writer.is_written(root, shard)
        writer.write_shard(root, shard, iter(parts), FEATURES, FPS, first, 6 * first)
        assert writer.is_written(root, shard)
    writer.number_frames(root, len(SHARDS))
    writer.write_metadata(root, FEATURES, FPS, ROBOT_TYPE, TASKS)
    return root


@pytest.fixture(scope="module")
def dataset(root):
    return LeRobotDataset(REPO_ID, root=root)


@pytest.fixture(scope="module")
def reference(tmp_path_factory, episodes):
    """The same episodes, written by LeRobot."""
    features = {
        name: feature for name, feature in FEATURES_OF_LEROBOT.items() if name not in DEFAULT_FEATURES
    }
    root = tmp_path_factory.mktemp("theirs") / "dataset"
    options = {"root": root, "robot_type": ROBOT_TYPE, "use_videos": False}
    recorder = LeRobotDataset.create(REPO_ID, FPS, features, **options)
    for episode in episodes:
        for i in range(len(episode.frames["action"])):
            frame = {name: np.atleast_1d(values[i]) for name, values in episode.frames.items()}
            recorder.add_frame({"task": episode.task, **frame})
        recorder.save_episode()
    recorder.finalize()
    return root


def read_table(root, folder):
    files = sorted((root / folder).glob("*/*.parquet"))
    schemas = [pq.read_schema(path) for path in files]
    assert all(schema.equals(schemas[0], check_metadata=True) for schema in schemas)
    return schemas[0], pd.concat([pd.read_parquet(path) for path in files], ignore_index=True)


def nested(values):
    """Returns arrays of arrays, as pandas has them, as lists."""
    return [nested(value) for value in values] if isinstance(values, list | np.ndarray) else values


def episode_statistics(root):
    _, rows = read_table(root, "meta/episodes")
    return [
        {
            feature: {name: np.array(nested(row[f"stats/{feature}/{name}"])) for name in writer.STATISTICS}
            for feature in FEATURES
        }
        for _, row in rows.iterrows()
    ]


def test_files_are_named_and_numbered_as_lerobots():
    assert writer.CODEBASE_VERSION == dataset_metadata.CODEBASE_VERSION
    assert writer.FILES_PER_CHUNK == lerobot_files.DEFAULT_CHUNK_SIZE
    assert writer.DATA_FILE == lerobot_files.DEFAULT_DATA_PATH
    assert writer.EPISODES_FILE == lerobot_files.DEFAULT_EPISODES_PATH
    files = writer.INFO_FILE, writer.STATS_FILE, writer.TASKS_FILE
    assert files == (lerobot_files.INFO_PATH, lerobot_files.STATS_PATH, lerobot_files.DEFAULT_TASKS_PATH)
    assert json.loads(json.dumps(DEFAULT_FEATURES)) == writer.DEFAULT_FEATURES
    names = [writer._numbered(writer.DATA_FILE, number) for number in (0, 999, 1000, 12345)]
    expected = ["000/file-000", "000/file-999", "001/file-000", "012/file-345"]
    assert names == [f"data/chunk-{name}.parquet" for name in expected]


def test_info_and_tasks_are_lerobots(root, reference):
    ours, theirs = (json.loads((folder / writer.INFO_FILE).read_text()) for folder in (root, reference))
    # LeRobot names a path of videos even if there are none.
    assert ours.pop("video_path") is None
    theirs.pop("video_path")
    assert ours == theirs
    ours, theirs = (pd.read_parquet(folder / writer.TASKS_FILE) for folder in (root, reference))
    pd.testing.assert_frame_equal(ours, theirs)


@pytest.mark.parametrize("folder", ["data", "meta/episodes"])
def test_tables_have_the_columns_types_and_values_of_lerobots(root, reference, folder):
    (our_schema, ours), (their_schema, theirs) = (read_table(path, folder) for path in (root, reference))
    assert our_schema.equals(their_schema)
    if folder == "data":
        expected = get_hf_features_from_features(FEATURES_OF_LEROBOT)
        assert datasets.Features.from_arrow_schema(our_schema) == expected
    assert len(ours) == len(theirs)
    # Files are numbered in another way; statistics and images are compared elsewhere.
    elsewhere = ("data/", "meta/", "stats/", "observation.image")
    for name in our_schema.names:
        if not name.startswith(elsewhere):
            assert nested(ours[name].to_list()) == nested(theirs[name].to_list()), name


def test_each_episode_is_a_row_group_of_the_file_that_its_metadata_name(root):
    _, rows = read_table(root, "meta/episodes")
    for index, row in rows.iterrows():
        path = writer.DATA_FILE.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        table = pq.ParquetFile(root / path).read_row_group(index % 2)
        assert table["episode_index"].unique().to_pylist() == [index]
        assert table["index"].to_pylist() == list(range(row["dataset_from_index"], row["dataset_to_index"]))
        assert len(table) == row["length"] == LENGTHS[index]


def test_shard_whose_writing_fails_is_absent(tmp_path, episodes):
    def failing():
        yield episodes[0]
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        writer.write_shard(tmp_path, 0, failing(), FEATURES, FPS, 0, 0)
    assert not writer.is_written(tmp_path, 0)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_every_frame_reads_like_one_that_lerobot_wrote(dataset, reference):
    expected = LeRobotDataset(REPO_ID, root=reference)
    assert len(dataset) == len(expected) == sum(LENGTHS)
    for ours, theirs in zip(dataset, expected, strict=True):
        assert ours.keys() == theirs.keys()
        for name in ours:
            if isinstance(ours[name], torch.Tensor):
                assert ours[name].dtype == theirs[name].dtype
                assert torch.equal(ours[name], theirs[name]), name
            else:
                assert ours[name] == theirs[name]


def test_lerobot_deletes_and_merges_episodes(dataset, episodes, tmp_path):
    kept = delete_episodes(dataset, [0, 3], output_dir=tmp_path / "kept", repo_id="user/kept")
    merged = merge_datasets([dataset, kept], "user/merged", output_dir=tmp_path / "merged")
    expected = [*range(5), 1, 2, 4]
    assert merged.num_episodes == len(expected)
    start = 0
    for position, episode in enumerate(expected):
        frame = merged[start]
        assert frame["episode_index"] == position
        assert frame["task"] == episodes[episode].task
        np.testing.assert_array_equal(frame["action"], episodes[episode].frames["action"][0])
        image = (frame["observation.image"].permute(1, 2, 0) * 255).round()
        np.testing.assert_array_equal(image, episodes[episode].frames["observation.image"][0])
        start += LENGTHS[episode]


def test_statistics_are_those_of_all_frames(dataset, root):
    _, table = read_table(root, "data")
    for feature, statistics in dataset.meta.stats.items():
        if feature == "observation.image":
            images = [np.asarray(Image.open(io.BytesIO(cell["bytes"]))) for cell in table[feature]]
            values, axis, shape = np.stack(images) / 255, (0, 1, 2), (3, 1, 1)
        else:
            values, axis, shape = np.stack(table[feature].to_list()).astype(np.float64), 0, (-1,)
        assert set(statistics) == set(writer.STATISTICS)
        assert statistics["count"] == [sum(LENGTHS)]
        for name in ("min", "max", "mean", "std"):
            expected = getattr(values, name)(axis=axis).reshape(shape)
            assert statistics[name].shape == expected.shape
            np.testing.assert_allclose(statistics[name], expected, rtol=1e-9, atol=1e-9)


def test_statistics_agree_with_lerobots(dataset, root, reference):
    ours, theirs = episode_statistics(root), episode_statistics(reference)
    ours.append(dataset.meta.stats)
    theirs.append(LeRobotDatasetMetadata(REPO_ID, root=reference).stats)
    for found, expected in zip(ours, theirs, strict=True):
        assert found.keys() == expected.keys()
        for feature, statistics in expected.items():
            spread = np.ptp([statistics["min"], statistics["max"]])
            for name, value in statistics.items():
                assert found[feature][name].shape == value.shape, (feature, name)
                # LeRobot computes in single precision, and estimates quantiles from 5000 bins.
                atol = spread / 2000 + 1e-3 * np.abs(statistics["max"]).max() * (name == "std") + 1e-6
                message = f"{feature} {name}"
                np.testing.assert_allclose(found[feature][name], value, rtol=1e-5, atol=atol, err_msg=message)
