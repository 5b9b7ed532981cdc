"""What is written directly is what LeRobot's own writer, reader, statistics and editing tools expect."""

import io
import json
from pathlib import Path

import datasets
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import LeRobotDataset, dataset_metadata
from lerobot.datasets import utils as lerobot_files
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.utils.constants import DEFAULT_FEATURES
from PIL import Image

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.data import collection, feature_names
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import FPS, ROBOT_TYPE, CollectionPlan
from lerobot_deltaco.data.dataset_statistics import STATISTICS, feature_statistics, merged_statistics
from lerobot_deltaco.data.finished_dataset import read_tasks

REPO_ID = "user/deltaco"
TASK_IDS = (90, 4)  # not in the order of the benchmark
EPISODES_PER_TASK = 3
PLAN = CollectionPlan("90,4", EPISODES_PER_TASK)
N_EPISODES = len(TASK_IDS) * EPISODES_PER_TASK
# So that tasks and files end at different episodes, and the last file is not full.
EPISODES_PER_FILE = 4
LENGTH = 30


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Keeps the tables that `datasets` makes out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path_factory.mktemp("cache"))
        yield


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A dataset of two tasks in two data files, as collected."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collection, "EPISODES_PER_FILE", EPISODES_PER_FILE)
        root = tmp_path_factory.mktemp("collected") / "dataset"
        collect(root, PLAN)
    return root


@pytest.fixture(scope="module")
def dataset(root):
    return LeRobotDataset(REPO_ID, root=root)


@pytest.fixture(scope="module")
def frames(root):
    """All frames, decoded without LeRobot: each feature's values, (N, ...)."""
    table = pd.concat([pd.read_parquet(path) for path in data_files(root)])
    images = [np.asarray(Image.open(io.BytesIO(cell["bytes"]))) for cell in table["observation.image"]]
    return {
        name: np.stack(images if name == "observation.image" else list(column.to_numpy()))
        for name, column in table.items()
    }


@pytest.fixture(scope="module")
def reference(tmp_path_factory, frames):
    """The same frames in a dataset by LeRobot's own writer."""
    features = {
        name: {key: tuple(value) if key == "shape" else value for key, value in feature.items()}
        for name, feature in PLAN.features.items()
        if name not in DEFAULT_FEATURES
    }
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    writer = LeRobotDataset.create(REPO_ID, FPS, features, root=root, robot_type=ROBOT_TYPE, use_videos=False)
    for episode in range(N_EPISODES):
        for i in range(episode * LENGTH, (episode + 1) * LENGTH):
            writer.add_frame(
                {
                    "task": TASKS[TASK_IDS[episode // EPISODES_PER_TASK]].instruction,
                    **{name: np.atleast_1d(frames[name][i]) for name in features},
                }
            )
        writer.save_episode()
    writer.finalize()
    return root


def data_files(root):
    return sorted((root / "data").glob("*/*.parquet"))


def all_rows(root, folder):
    """The tables of a folder, one after the other, their schemas included."""
    tables = [pq.read_table(path) for path in sorted((root / folder).glob("*/*.parquet"))]
    assert all(table.schema.equals(tables[0].schema, check_metadata=True) for table in tables)
    return tables[0].schema, pd.concat([table.to_pandas() for table in tables], ignore_index=True)


def hugging_face(schema):
    """What the metadata of a schema tell `datasets`."""
    return json.loads((schema.metadata or {}).get(b"huggingface", "{}")).get("info")


def episode_statistics(root):
    """Statistics of each episode as its metadata have them, in LeRobot's nesting."""
    _, rows = all_rows(root, "meta/episodes")
    return [
        {
            feature: {name: np.array(nested(row[f"stats/{feature}/{name}"])) for name in STATISTICS}
            for feature in PLAN.features
        }
        for _, row in rows.iterrows()
    ]


def nested(values):
    """Arrays of arrays, as pandas has them, as lists."""
    return [nested(value) for value in values] if isinstance(values, list | np.ndarray) else values


# The format


def test_constants_are_those_of_lerobot():
    assert files.CODEBASE_VERSION == dataset_metadata.CODEBASE_VERSION
    assert files.FILES_PER_CHUNK == lerobot_files.DEFAULT_CHUNK_SIZE
    assert files.DATA_FILE == lerobot_files.DEFAULT_DATA_PATH
    assert files.EPISODES_FILE == lerobot_files.DEFAULT_EPISODES_PATH
    assert str(files.INFO_FILE) == lerobot_files.INFO_PATH
    assert str(files.STATS_FILE) == lerobot_files.STATS_PATH
    assert str(files.TASKS_FILE) == lerobot_files.DEFAULT_TASKS_PATH
    as_lerobot_has_them = json.loads(json.dumps(DEFAULT_FEATURES))
    assert as_lerobot_has_them == feature_names.DEFAULT_FEATURES


def test_the_last_file_of_a_chunk_is_followed_by_the_first_of_the_next():
    numbers = [0, 999, 1000, 1001, 12345]
    expected = ["000/file-000", "000/file-999", "001/file-000", "001/file-001", "012/file-345"]
    assert [files.numbered(files.DATA_FILE, n) for n in numbers] == [
        Path(f"data/chunk-{name}.parquet") for name in expected
    ]
    chunk_index, file_index = 0, 0
    for number in range(2002):
        path = files.EPISODES_FILE.format(chunk_index=chunk_index, file_index=file_index)
        assert files.numbered(files.EPISODES_FILE, number) == Path(path)
        chunk_index, file_index = lerobot_files.update_chunk_file_indices(
            chunk_index, file_index, files.FILES_PER_CHUNK
        )


def test_columns_of_hugging_face_are_those_that_lerobot_expects(root):
    lerobot_features = {
        name: {**feature, "shape": tuple(feature["shape"])} for name, feature in PLAN.features.items()
    }
    expected = get_hf_features_from_features(lerobot_features)
    assert datasets.Features.from_arrow_schema(files.data_schema(PLAN.features)) == expected
    for path in data_files(root):
        assert datasets.Features.from_arrow_schema(pq.read_schema(path)) == expected


def test_info_is_what_lerobot_writes(root, reference):
    ours, theirs = (json.loads((folder / files.INFO_FILE).read_text()) for folder in (root, reference))
    # There are no videos to be found there.
    assert ours.pop("video_path") is None
    theirs.pop("video_path")
    assert ours == theirs


@pytest.mark.parametrize("folder", ["data", "meta/episodes"])
def test_tables_have_the_columns_types_and_values_that_lerobot_writes(root, reference, folder):
    (our_schema, ours), (their_schema, theirs) = (all_rows(path, folder) for path in (root, reference))
    assert our_schema.equals(their_schema)
    assert hugging_face(our_schema) == hugging_face(their_schema)
    assert len(ours) == len(theirs)
    # Which file has an episode is up to the writer, and statistics and images are compared elsewhere.
    elsewhere = ("data/", "meta/", "stats/", "observation.image")
    for name in our_schema.names:
        if not name.startswith(elsewhere):
            assert nested(ours[name].to_list()) == nested(theirs[name].to_list()), name


def test_images_have_the_names_and_pixels_that_lerobot_writes(root, reference):
    ours, theirs = (all_rows(path, "data")[1]["observation.image"] for path in (root, reference))
    for our_cell, their_cell in zip(ours, theirs, strict=True):
        assert our_cell["path"] == their_cell["path"]
        our_image, their_image = (Image.open(io.BytesIO(c["bytes"])) for c in (our_cell, their_cell))
        assert our_image.mode == their_image.mode == "RGB"
        np.testing.assert_array_equal(our_image, their_image)


def test_tasks_are_what_lerobot_writes(root, reference):
    ours, theirs = (pd.read_parquet(folder / files.TASKS_FILE) for folder in (root, reference))
    pd.testing.assert_frame_equal(ours, theirs)
    assert read_tasks(root, len(TASK_IDS)) == [TASKS[i].instruction for i in TASK_IDS]


def test_each_episode_is_a_row_group_in_the_file_that_its_metadata_name(root):
    _, rows = all_rows(root, "meta/episodes")
    assert rows["episode_index"].to_list() == list(range(N_EPISODES))
    assert rows["data/file_index"].to_list() == [i // EPISODES_PER_FILE for i in range(N_EPISODES)]
    for index, row in rows.iterrows():
        path = files.DATA_FILE.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        table = pq.ParquetFile(root / path).read_row_group(index % EPISODES_PER_FILE)
        assert table["episode_index"].unique().to_pylist() == [index]
        assert table["index"].to_pylist() == list(range(row["dataset_from_index"], row["dataset_to_index"]))
        assert row["dataset_to_index"] - row["dataset_from_index"] == row["length"] == len(table)


# Reading


def test_the_dataset_is_what_was_planned(dataset):
    assert dataset.fps == FPS
    assert dataset.meta.robot_type == ROBOT_TYPE
    assert dataset.num_episodes == N_EPISODES
    assert dataset.num_frames == len(dataset) == N_EPISODES * LENGTH
    assert list(dataset.features) == list(PLAN.features)
    assert dataset.features["observation.image"]["shape"] == (48, 48, 3)
    assert dataset.meta.tasks.index.to_list() == [TASKS[i].instruction for i in TASK_IDS]


def test_every_frame_reads_like_one_that_lerobot_wrote(dataset, reference):
    expected = LeRobotDataset(REPO_ID, root=reference)
    assert len(dataset) == len(expected)
    for ours, theirs in zip(dataset, expected, strict=True):
        assert ours.keys() == theirs.keys()
        for name in ours:
            if isinstance(ours[name], torch.Tensor):
                assert ours[name].dtype == theirs[name].dtype
                assert torch.equal(ours[name], theirs[name]), name
            else:
                assert ours[name] == theirs[name]


def test_a_subset_of_the_episodes_can_be_read(root, frames):
    wanted = [1, 3, 5]  # in both files
    subset = LeRobotDataset(REPO_ID, root=root, episodes=wanted)
    assert len(subset) == len(wanted) * LENGTH
    for position, episode in enumerate(wanted):
        for step in (0, LENGTH - 1):
            frame = subset[position * LENGTH + step]
            assert frame["index"] == episode * LENGTH + step
            assert frame["episode_index"] == episode
            np.testing.assert_array_equal(frame["action"], frames["action"][episode * LENGTH + step])
            assert frame["task"] == TASKS[TASK_IDS[episode // EPISODES_PER_TASK]].instruction


def test_neighboring_frames_do_not_cross_the_ends_of_episodes(root, frames):
    offsets = [-1, 0, 1]
    deltas = [offset / FPS for offset in offsets]
    dataset = LeRobotDataset(
        REPO_ID, root=root, delta_timestamps={"action": deltas, "observation.image": deltas}
    )
    for index in (0, 1, LENGTH - 1, LENGTH, EPISODES_PER_FILE * LENGTH - 1, EPISODES_PER_FILE * LENGTH):
        frame = dataset[index]
        first, last = index // LENGTH * LENGTH, index // LENGTH * LENGTH + LENGTH - 1
        np.testing.assert_array_equal(
            frame["action"], [frames["action"][np.clip(index + i, first, last)] for i in offsets]
        )
        assert frame["action_is_pad"].tolist() == [not first <= index + i <= last for i in offsets]
        assert frame["observation.image"].shape == (3, 3, 48, 48)


def test_a_loader_makes_batches(dataset):
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)))
    assert batch["observation.image"].shape == (4, 3, 48, 48)
    assert batch["observation.image"].dtype == torch.float32
    assert 0 <= batch["observation.image"].min() < batch["observation.image"].max() <= 1
    assert batch["observation.state"].shape == (4, 10)
    assert batch["action"].shape == (4, 4)
    assert set(batch["task"]) <= {TASKS[i].instruction for i in TASK_IDS}


# Statistics


def recomputed(values):
    """What the statistics mean, from all frames of a feature."""
    axis = (0, 1, 2) if values.ndim == 4 else 0
    numbers = values / 255 if values.ndim == 4 else values.astype(np.float64)
    shape = (3, 1, 1) if values.ndim == 4 else (-1,)
    return {
        **{name: getattr(numbers, name)(axis=axis).reshape(shape) for name in ("min", "max", "mean", "std")},
        "count": np.array([len(values)]),
    }


@pytest.mark.parametrize("feature", PLAN.features)
def test_statistics_are_those_of_all_frames(dataset, frames, feature):
    expected = recomputed(frames[feature])
    stored = dataset.meta.stats[feature]
    assert set(stored) == set(STATISTICS)
    for name, value in expected.items():
        assert stored[name].shape == value.shape
        np.testing.assert_allclose(stored[name], value, rtol=1e-9, atol=1e-9)


def test_statistics_of_the_dataset_are_what_lerobot_makes_of_those_of_its_episodes(dataset, root):
    expected = aggregate_stats(episode_statistics(root))
    assert expected.keys() == dataset.meta.stats.keys()
    for feature, statistics in expected.items():
        for name, value in statistics.items():
            stored = dataset.meta.stats[feature][name]
            assert stored.shape == value.shape
            np.testing.assert_allclose(stored, value, rtol=1e-9, atol=1e-12)


def test_statistics_of_an_episode_are_what_lerobot_computes(root, frames, tmp_path):
    for episode, ours in enumerate(episode_statistics(root)):
        of_episode = slice(episode * LENGTH, (episode + 1) * LENGTH)
        columns = {name: values[of_episode] for name, values in frames.items()}
        paths = []
        for i, image in enumerate(columns["observation.image"]):
            paths.append(str(tmp_path / f"{i}.png"))
            Image.fromarray(image).save(paths[-1])
        theirs = compute_episode_stats({**columns, "observation.image": paths}, PLAN.features)
        for feature, statistics in theirs.items():
            values = columns[feature].astype(np.float64) / (255 if feature == "observation.image" else 1)
            for name, value in statistics.items():
                assert ours[feature][name].shape == value.shape, (feature, name)
                # LeRobot computes in single precision, and sorts values into 5000 bins for the quantiles.
                atol = np.ptp(values) / 2000 + 1e-3 * np.abs(values).max() * (name == "std") + 1e-6
                np.testing.assert_allclose(
                    ours[feature][name], value, rtol=1e-5, atol=atol, err_msg=f"{feature} {name}"
                )


@pytest.mark.parametrize("shape", [(7,), (7, 3), (7, 8, 8, 3)], ids=["numbers", "vectors", "images"])
def test_merged_statistics_are_those_of_everything(shape):
    rng = np.random.default_rng(0)
    values = rng.integers(0, 256, shape, dtype=np.uint8)
    whole = feature_statistics(values)
    # Of parts of different lengths, merged in two steps.
    a, b, c = (feature_statistics(part) for part in (values[:1], values[1:3], values[3:]))
    for merged in (merged_statistics([a, b, c]), merged_statistics([merged_statistics([a, b]), c])):
        for name in ("min", "max", "mean", "std", "count"):
            np.testing.assert_allclose(merged[name], whole[name], rtol=1e-12)
        for name in ("q01", "q50", "q99"):
            mean = (1 * a[name] + 2 * b[name] + 4 * c[name]) / 7
            np.testing.assert_allclose(merged[name], mean, rtol=1e-12)


def test_statistics_survive_json(root):
    contents = json.loads((root / files.STATS_FILE).read_text())
    assert files.statistics_to_json(files.statistics_from_json(contents)) == contents


# Writing


def test_a_file_whose_writing_fails_is_not_there_and_the_old_one_stays(tmp_path):
    def tables():
        yield table
        raise OSError("The disk is full.")

    table = pa.table({"number": [1, 2]})
    path = tmp_path / "new" / "file.parquet"
    with pytest.raises(OSError, match="full"):
        files.write_data_file(path, tables(), table.schema)
    assert list(path.parent.iterdir()) == []
    files.write_data_file(path, [table], table.schema)
    with pytest.raises(OSError, match="full"):
        files.write_data_file(path, tables(), table.schema)
    assert list(path.parent.iterdir()) == [path]
    assert pq.read_table(path).equals(table)


# LeRobot's editing tools


def edited_frames(dataset, wanted, frames):
    """Checks that a dataset has the wanted episodes, renumbered, and can be read."""
    assert dataset.num_episodes == len(wanted)
    assert len(dataset) == len(wanted) * LENGTH
    for position, episode in enumerate(wanted):
        for step in (0, LENGTH - 1):
            frame, source = dataset[position * LENGTH + step], episode * LENGTH + step
            assert frame["episode_index"] == position
            assert frame["index"] == position * LENGTH + step
            assert frame["benchmark.seed"] == frames["benchmark.seed"][source]
            np.testing.assert_array_equal(frame["observation.state"], frames["observation.state"][source])
            image = frame["observation.image"].permute(1, 2, 0).numpy() * 255
            np.testing.assert_array_equal(image.round(), frames["observation.image"][source])
            assert frame["task"] == TASKS[frame["benchmark.task_id"].item()].instruction


def test_lerobot_splits_it(dataset, frames, tmp_path):
    splits = {"early": [0, 1, 4], "late": [2, 3, 5]}
    parts = split_dataset(dataset, splits, output_dir=tmp_path)
    for name, wanted in splits.items():
        edited_frames(parts[name], wanted, frames)
        np.testing.assert_allclose(parts[name].meta.stats["action"]["count"], len(wanted) * LENGTH)


def test_lerobot_deletes_episodes(dataset, frames, tmp_path):
    kept = delete_episodes(dataset, [0, 4], output_dir=tmp_path / "kept", repo_id="user/kept")
    edited_frames(kept, [1, 2, 3, 5], frames)


def test_lerobot_merges_it_with_a_dataset_of_other_tasks(dataset, frames, tmp_path):
    collect(tmp_path / "other", CollectionPlan("32", 1))
    other = LeRobotDataset("user/other", root=tmp_path / "other")
    merged = merge_datasets([dataset, other], "user/merged", output_dir=tmp_path / "merged")
    assert merged.num_episodes == N_EPISODES + 1
    assert merged.meta.tasks.index.to_list() == [TASKS[i].instruction for i in (*TASK_IDS, 32)]
    last, original = merged[-1 + len(merged)], other[len(other) - 1]
    assert last["task"] == original["task"] == TASKS[32].instruction
    assert torch.equal(last["observation.image"], original["observation.image"])
    assert torch.equal(merged[0]["action"], torch.from_numpy(frames["action"][0]))
    expected = aggregate_stats([dataset.meta.stats, other.meta.stats])
    np.testing.assert_allclose(merged.meta.stats["action"]["std"], expected["action"]["std"])


def test_lerobot_goes_on_recording_in_it(root, tmp_path, frames):
    """LeRobot's own way to add episodes: its writer takes our metadata for its own."""
    import shutil

    copy = shutil.copytree(root, tmp_path / "copy")
    dataset = LeRobotDataset.resume(REPO_ID, root=copy)
    names = [name for name in PLAN.features if name not in DEFAULT_FEATURES]
    for i in range(LENGTH):
        dataset.add_frame({"task": "Wave.", **{name: np.atleast_1d(frames[name][i]) for name in names}})
    dataset.save_episode()
    dataset.finalize()
    longer = LeRobotDataset(REPO_ID, root=copy)
    assert longer.num_episodes == N_EPISODES + 1
    assert longer[len(longer) - 1]["task"] == "Wave."
    assert longer[len(longer) - 1]["index"] == len(longer) - 1
