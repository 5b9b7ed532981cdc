"""The files of a LeRobotDataset v3, written directly.

LeRobot's own writer spends most of its time on turning images from one form into another, and cannot be
shared by processes. Here, each process writes files of its own, whose indices are known beforehand. This
module knows the format, and neither LeRobot nor torch, whose import takes 10 s in each process; the tests
hold it against LeRobot's reader, statistics and editing tools.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco.atomic_files import atomic_write
from lerobot_deltaco.data.dataset_statistics import STATISTICS, Statistics, feature_statistics

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
INFO_FILE = Path("meta/info.json")
STATS_FILE = Path("meta/stats.json")
TASKS_FILE = Path("meta/tasks.parquet")
DATA_FILE = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_FILE = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_PNG_COMPRESSION = 6

Features = Mapping[str, Mapping[str, Any]]  # as in LeRobot's info.json


def numbered(file: str, number: int) -> Path:
    """`DATA_FILE` or `EPISODES_FILE` of a number, counted over all chunks."""
    chunk_index, file_index = divmod(number, FILES_PER_CHUNK)
    return Path(file.format(chunk_index=chunk_index, file_index=file_index))


# Frames


def data_schema(features: Features) -> pa.Schema:
    """Columns of the frames, with what Hugging Face's `datasets` needs to read them as features."""
    fields: list[pa.Field] = []
    hugging_face: dict[str, dict[str, Any]] = {}
    for name, feature in features.items():
        dtype, (size, *_) = feature["dtype"], feature["shape"]
        if dtype == "image":
            kind: pa.DataType = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            hugging_face[name] = {"_type": "Image"}
        else:
            kind = pa.type_for_alias({"float32": "float", "bool": "bool"}.get(dtype, dtype))
            hugging_face[name] = {"dtype": dtype, "_type": "Value"}
            if size > 1:
                kind = pa.list_(kind, size)
                hugging_face[name] = {"feature": hugging_face[name], "length": size, "_type": "List"}
        fields.append(pa.field(name, kind))
    metadata = {"huggingface": json.dumps({"info": {"features": hugging_face}})}
    return pa.schema(fields, metadata=metadata)


def episode_columns(
    frames: Mapping[str, NDArray], fps: int, episode_index: int, first_index: int, task_index: int
) -> dict[str, NDArray]:
    """The frames of an episode, with the columns that every dataset has.

    Args:
        frames: The recorded features, (N, ...) each.
        fps: Frames per second.
        episode_index: Index of the episode in the dataset.
        first_index: Index of its first frame in the dataset.
        task_index: Row of its task in the dataset's table of tasks.
    """
    number = np.arange(len(next(iter(frames.values()))))
    return {
        **frames,
        "timestamp": (number / fps).astype(np.float32),
        "frame_index": number,
        "episode_index": np.full_like(number, episode_index),
        "index": first_index + number,
        "task_index": np.full_like(number, task_index),
    }


def episode_table(columns: Mapping[str, NDArray], schema: pa.Schema) -> pa.Table:
    """An episode's frames as a table; images, (N, H, W, 3) uint8, as PNG."""
    arrays = []
    for field in schema:
        values = columns[field.name]
        if pa.types.is_struct(field.type):
            cells = [{"bytes": _png(image), "path": f"frame-{i:06d}.png"} for i, image in enumerate(values)]
            arrays.append(pa.array(cells, field.type))
        elif pa.types.is_fixed_size_list(field.type):
            flat = pa.array(values.ravel(), field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, field.type.list_size))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "png", compress_level=_PNG_COMPRESSION)
    return buffer.getvalue()


def episode_statistics(columns: Mapping[str, NDArray]) -> dict[str, Statistics]:
    """Statistics of each feature of an episode."""
    return {name: feature_statistics(values) for name, values in columns.items()}


def write_data_file(path: Path, tables: Iterable[pa.Table], schema: pa.Schema) -> None:
    """Writes episodes, one row group each, so that a reader may fetch a single one."""
    with atomic_write(path) as temporary, pq.ParquetWriter(temporary, schema, compression="snappy") as writer:
        for table in tables:
            writer.write_table(table)


# Metadata


def write_episodes_file(
    path: Path,
    file_number: int,
    first_episode: int,
    first_index: int,
    tasks: Sequence[str],
    lengths: Sequence[int],
    statistics: Sequence[Mapping[str, Statistics]],
) -> None:
    """Writes the metadata of the consecutive episodes of one data file.

    Args:
        path: The file.
        file_number: Number of the data file, and of this file, over all chunks.
        first_episode: Index of the first of them in the dataset.
        first_index: Index of its first frame in the dataset.
        tasks: Task of each episode.
        lengths: Number of frames of each.
        statistics: Statistics of the features of each.
    """
    n_episodes = len(tasks)
    chunk_index, file_index = divmod(file_number, FILES_PER_CHUNK)
    ends = first_index + np.cumsum(lengths)
    columns: dict[str, Any] = {
        "episode_index": np.arange(first_episode, first_episode + n_episodes),
        "tasks": [[task] for task in tasks],
        "length": np.array(lengths),
        "data/chunk_index": np.full(n_episodes, chunk_index),
        "data/file_index": np.full(n_episodes, file_index),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
    for feature in statistics[0]:
        for name in STATISTICS:
            columns[f"stats/{feature}/{name}"] = [item[feature][name].tolist() for item in statistics]
    columns["meta/episodes/chunk_index"] = np.full(n_episodes, chunk_index)
    columns["meta/episodes/file_index"] = np.full(n_episodes, file_index)
    with atomic_write(path) as temporary:
        pq.write_table(pa.table(columns), temporary, compression="snappy")


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Writes the table of tasks; their order is their index."""
    frame = pd.DataFrame({"task_index": np.arange(len(tasks))}, index=pd.Index(tasks, name="task"))
    with atomic_write(path) as temporary:
        frame.to_parquet(temporary)


def dataset_info(
    features: Features, fps: int, robot_type: str, n_episodes: int, n_frames: int, n_tasks: int
) -> dict[str, Any]:
    """Contents of info.json."""
    return {
        "codebase_version": CODEBASE_VERSION,
        "fps": fps,
        "features": features,
        "total_episodes": n_episodes,
        "total_frames": n_frames,
        "total_tasks": n_tasks,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": DATA_FILE,
        "video_path": None,
        "robot_type": robot_type,
        "splits": {"train": f"0:{n_episodes}"},
    }


def statistics_to_json(statistics: Mapping[str, Statistics]) -> dict[str, dict[str, Any]]:
    """Contents of stats.json."""
    return {
        feature: {name: value.tolist() for name, value in of.items()} for feature, of in statistics.items()
    }


def statistics_from_json(contents: Mapping[str, Mapping[str, Any]]) -> dict[str, Statistics]:
    """The inverse of `statistics_to_json`."""
    return {
        feature: {name: np.array(value) for name, value in of.items()} for feature, of in contents.items()
    }
