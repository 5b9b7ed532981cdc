"""Checks the files of a LeRobotDataset before LeRobot opens them.

Recordings that were cut short, and datasets that other tools converted, have files that LeRobot cannot read.
Its errors then come from another package, or name the Hub.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_deltaco.errors import UserError

_EPISODE_COLUMNS = (
    "episode_index",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
)
_AGAIN = "Convert or record the dataset again."


def check_files(folder: Path, episodes: Sequence[int] | None = None) -> None:
    """Checks what a dataset's files say of its features, tasks and episodes.

    Files that are missing are left to LeRobot, which may download them.

    Args:
        folder: Folder of the dataset; nothing is checked if it has no meta/info.json.
        episodes: Episodes that are needed; None for all.

    Raises:
        UserError: A file cannot be read, or contradicts another one; the message names it.
    """
    path = folder / "meta/info.json"
    if not path.is_file():
        return
    info = _read_info(path)
    check_tasks(folder / "meta/tasks.parquet")
    table = _read_episodes(folder / "meta/episodes")
    if table is None:
        return
    if len(table) != info["total_episodes"]:
        raise UserError(
            f"{path} counts {info['total_episodes']} episodes, but {folder / 'meta/episodes'} has "
            f"{len(table)}. Correct `total_episodes`, or finish the conversion."
        )
    needed = table if episodes is None else table[table["episode_index"].isin(list(episodes))]
    for (chunk, number), group in needed.groupby(["data/chunk_index", "data/file_index"]):
        _check_data(folder, info, int(chunk), int(number), group)


def _read_info(path: Path) -> dict[str, Any]:
    """Reads meta/info.json, and checks its numbers and features."""
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read: {error}. {_AGAIN}") from error
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not features:
        raise UserError(f"{path} does not say which `features` the dataset has. {_AGAIN}")
    fps, n_episodes = info.get("fps"), info.get("total_episodes")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < float("inf"):
        raise UserError(f"`fps` in {path} must be a positive number of frames per second. Got {fps!r}.")
    if not isinstance(n_episodes, int) or n_episodes < 0:
        raise UserError(f"`total_episodes` in {path} must be a number. Got {n_episodes!r}.")
    if not n_episodes:
        raise UserError(f"The dataset in {path.parents[1]} has no episodes. Record some.")
    for name, feature in features.items():
        if not isinstance(feature, dict) or not {"dtype", "shape"} <= feature.keys():
            raise UserError(
                f"The feature {name!r} in {path} must have a `dtype` and a `shape`. Got {feature!r}."
            )
        if feature["dtype"] in ("image", "video") and not feature.get("names"):
            raise UserError(
                f"The camera {name!r} in {path} has no `names`. Set them to the order of its shape, such as "
                '["height", "width", "channels"].'
            )
    return info


def check_tasks(path: Path) -> None:
    """Checks the form of meta/tasks.parquet: task strings are the index of the table.

    Raises:
        UserError: It has another form.
    """
    if not path.is_file():
        return
    with _reading(path):
        tasks = pd.read_parquet(path)
    if "task_index" not in tasks or not all(isinstance(task, str) for task in tasks.index):
        raise UserError(
            f"{path} must have the task strings as its index and the column `task_index`. Its columns are "
            f"{', '.join(map(str, tasks.columns))}. With pandas: "
            'table.set_index("task")[["task_index"]].to_parquet(path).'
        )
    empty = [task for task in tasks.index if not task.strip()]
    if empty:
        raise UserError(f"{path} has an empty task string. Give each task a sentence.")


def _read_episodes(folder: Path) -> pd.DataFrame | None:
    """Reads the columns of meta/episodes that are needed; None if there are no files."""
    parts = []
    for path in sorted(folder.rglob("*.parquet")):
        with _reading(path):
            names = pq.read_schema(path).names
            missing = [name for name in _EPISODE_COLUMNS if name not in names]
            if missing:
                raise UserError(f"{path} has no column {missing[0]!r}, which LeRobot v3 needs. {_AGAIN}")
            parts.append(pd.read_parquet(path, columns=list(_EPISODE_COLUMNS)))
    return pd.concat(parts) if parts else None


def _check_data(folder: Path, info: dict[str, Any], chunk: int, number: int, table: pd.DataFrame) -> None:
    """Checks that a file of frames has all frames of the episodes that the table places there."""
    pattern = info.get("data_path", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    path = folder / pattern.format(chunk_index=chunk, file_index=number)
    if not path.is_file():
        return
    with _reading(path):
        rows = pq.read_table(path, columns=["episode_index"])["episode_index"].to_numpy()
    present, counts = np.unique(rows, return_counts=True)
    n_rows = dict(zip(present.tolist(), counts.tolist(), strict=True))
    for episode, length in zip(table["episode_index"].tolist(), table["length"].tolist(), strict=True):
        if n_rows.get(episode, 0) != length:
            raise UserError(
                f"Episode {episode} has {n_rows.get(episode, 0)} frames in {path}, but {length} by "
                f"{folder / 'meta/episodes'}. Leave it out with --dataset.episodes, or record the dataset "
                "again."
            )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Names a Parquet file that cannot be read.

    Raises:
        UserError: It cannot.
    """
    try:
        yield
    except UserError:
        raise
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        raise UserError(
            f"{path} cannot be read as Parquet: {str(error).rstrip('.')}. If the recording was interrupted "
            "before `LeRobotDataset.finalize()`, the file is incomplete: record the dataset again."
        ) from error
