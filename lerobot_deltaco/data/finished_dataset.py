"""What a dataset's own files say of it, checked before it is believed; and the check of all its files."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from PIL import Image
from tqdm import tqdm

from gym_deltaco.tasks import N_TASKS, get_task, is_task
from lerobot_deltaco.common.typed_fields import in_words, is_a
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.data.dataset_statistics import STATISTICS, Statistics
from lerobot_deltaco.data.integrity import DIGESTS_FILE, DatasetError, damaged, file_digest, read_digests

HISTORY_FILE = Path("meta/deltaco.json")
# Where a collection under way keeps its files, in the dataset's folder.
STAGING = ".collecting"
# LeRobot reads this as a version number, and names it in the error: that is what a user then reads.
UNFINISHED = "this dataset is unfinished; run its `deltaco-collect` command again to go on"
_REMEDY = "Copy the dataset again, or collect it again in a new folder."
_CHANGED = f"{_REMEDY} If LeRobot's tools have changed it since it was collected, delete {DIGESTS_FILE}."

_INFO_FIELDS = {
    "codebase_version": str,
    "fps": int,
    "features": dict[str, dict[str, Any]],
    "total_episodes": int,
    "total_frames": int,
    "total_tasks": int,
    "data_path": str,
}
_FEATURE_FIELDS = {"dtype": str, "shape": list[int]}
_ENTRY_FIELDS = {
    "plan": dict[str, Any],
    "benchmark": str,
    "renderer": str,
    "versions": dict[str, str],
    "attempts": dict[str, int],
}


def is_finished(root: Path) -> bool:
    """Whether a folder holds a dataset that no collection is adding to. Only its info.json is read."""
    try:
        info = json.loads((root / files.INFO_FILE).read_text(encoding="utf-8"))
        is_unfinished = info["codebase_version"] == UNFINISHED
    except (OSError, ValueError, TypeError, KeyError):
        return False
    return not is_unfinished and not (root / STAGING / "plan.json").exists()


def read_json(path: Path, kind: Any) -> Any:
    """Contents of a JSON file.

    Args:
        path: The file.
        kind: Type of its contents, such as `dict[str, Any]`.

    Raises:
        DatasetError: It is missing, no JSON, or of another type.
    """
    try:
        contents = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise damaged(path, error, _REMEDY) from None
    if not is_a(contents, kind):
        raise damaged(path, f"its contents must be {in_words(kind)}", _REMEDY)
    return contents


def read_info(root: Path) -> dict[str, Any]:
    """Contents of a dataset's info.json.

    Raises:
        DatasetError: It is missing or not that of a LeRobotDataset.
    """
    path = root / files.INFO_FILE
    info = read_json(path, dict[str, Any])
    _check_fields(path, info, _INFO_FIELDS)
    for name, feature in info["features"].items():
        _check_fields(path, feature, _FEATURE_FIELDS, f"features.{name}.")
    if not 0 < info["total_episodes"] <= info["total_frames"] and info["codebase_version"] != UNFINISHED:
        reason = f"{info['total_episodes']} episodes with {info['total_frames']} frames"
        raise damaged(path, reason, _REMEDY)
    return info


def read_history(root: Path) -> list[dict[str, Any]]:
    """History of a dataset, one entry for each collection.

    Raises:
        DatasetError: The file is missing, or no such list.
    """
    path = root / HISTORY_FILE
    history = read_json(path, list[dict[str, Any]])
    if not history:
        raise damaged(path, "it lists no collection", _REMEDY)
    known = {field.name for field in fields(CollectionPlan)}
    for number, entry in enumerate(history):
        where = f"[{number}]."
        _check_fields(path, entry, _ENTRY_FIELDS, where)
        if unknown := sorted(set(entry["plan"]) - known):
            reason = f"{where}plan has the unknown {unknown}; it may be of a later version"
            raise damaged(path, reason, _REMEDY)
        try:
            plan = CollectionPlan(**entry["plan"])
        except (TypeError, ValueError) as error:
            raise damaged(path, f"{where}plan: {error}", _REMEDY) from None
        if set(entry["attempts"]) != {str(task_id) for task_id in plan.task_ids}:
            reason = f"{where}attempts must be those of the plan's tasks"
            raise damaged(path, reason, _REMEDY)
        if any(n_attempts < plan.episodes_per_task for n_attempts in entry["attempts"].values()):
            reason = f"{where}attempts must be at least {plan.episodes_per_task} for each task"
            raise damaged(path, reason, _REMEDY)
    return history


class Tries(NamedTuple):
    """How often the expert tried tasks, and succeeded."""

    attempts: int
    successes: int


def tries_by_kind(history: Iterable[Mapping[str, Any]]) -> dict[str, Tries]:
    """How often the expert tried each kind of task in collections.

    Args:
        history: Their entries in the history of a dataset.
    """
    found: dict[str, Tries] = {}
    for entry in history:
        for task_id, n_attempts in entry["attempts"].items():
            kind = get_task(int(task_id)).kind
            attempts, successes = found.get(kind, (0, 0))
            found[kind] = Tries(attempts + n_attempts, successes + entry["plan"]["episodes_per_task"])
    return found


def read_statistics(root: Path, features: Mapping[str, Any]) -> dict[str, Statistics]:
    """The statistics of a dataset's features.

    Raises:
        DatasetError: The file is missing, or has not a number for each statistic of each feature.
    """
    path = root / files.STATS_FILE
    contents = read_json(path, dict[str, dict[str, Any]])
    if missing := sorted(set(features) - set(contents)):
        raise damaged(path, f"it lacks {missing}", _REMEDY)
    for feature, statistics in contents.items():
        if missing := sorted(set(STATISTICS) - set(statistics)):
            raise damaged(path, f"{feature} lacks {missing}", _REMEDY)
        for name, value in statistics.items():
            try:
                is_finite = bool(np.isfinite(np.array(value, dtype=np.float64)).all())
            except (TypeError, ValueError):
                is_finite = False
            if not is_finite:
                raise damaged(path, f"{feature}.{name} must be finite numbers", _REMEDY)
    return files.statistics_from_json(contents)


def read_tasks(root: Path, n_tasks: int) -> list[str]:
    """The tasks of a dataset in the order of their index.

    Raises:
        DatasetError: The file is missing, or no table of so many tasks.
    """
    path = root / files.TASKS_FILE
    try:
        table = pd.read_parquet(path).sort_values("task_index")
        tasks, indices = table.index.tolist(), table["task_index"].tolist()
    except (OSError, ValueError, KeyError) as error:  # PyArrow's errors are ValueErrors or OSErrors
        raise damaged(path, error, _REMEDY) from None
    if indices != list(range(n_tasks)) or not is_a(tasks, list[str]):
        raise damaged(path, f"it must number {n_tasks} instructions from 0", _REMEDY)
    return tasks


def check_counts(root: Path, info: Mapping[str, Any]) -> None:
    """Checks that the files of a dataset have as many frames and episodes as it says.

    Raises:
        DatasetError: A file cannot be read, or some are missing or too many.
    """
    for folder, expected in (("data", info["total_frames"]), ("meta/episodes", info["total_episodes"])):
        n_rows = sum(_n_rows(path) for path in sorted((root / folder).glob("*/*.parquet")))
        if n_rows != expected:
            what = "frames" if folder == "data" else "episodes"
            raise DatasetError(
                f"The files in {root / folder} have {n_rows} {what} instead of {expected}: some are missing, "
                f"or too many. {_REMEDY}"
            )


def check_metadata_digests(root: Path) -> None:
    """Compares the small files of a dataset with their checksums, if it has some.

    Raises:
        DatasetError: A file is not the one that was written.
    """
    digests = read_digests(root) or {}
    for file in (files.INFO_FILE, files.STATS_FILE, files.TASKS_FILE, HISTORY_FILE):
        if str(file) in digests and file_digest(root / file) != digests[str(file)]:
            raise damaged(root / file, f"its SHA-256 is not that in {DIGESTS_FILE}", _CHANGED)


def _n_rows(path: Path) -> int:
    try:
        return pq.read_metadata(path).num_rows
    except (OSError, ValueError) as error:
        raise damaged(path, error, _REMEDY) from None


def _check_fields(
    path: Path, contents: Mapping[str, Any], expected: Mapping[str, Any], where: str = ""
) -> None:
    for name, kind in expected.items():
        if name not in contents or not is_a(contents[name], kind):
            reason = f"`{where}{name}` must be {in_words(kind)}; there is {contents.get(name)!r}"
            raise damaged(path, reason, _REMEDY)


# The check of all files


@dataclass(frozen=True)
class Verification:
    """Result of a verification.

    Attributes:
        episodes: Number of episodes.
        n_files: Number of files.
        n_bytes: Size of the files.
        has_digests: Whether the files were compared with checksums; else they were read and decoded.
    """

    episodes: int
    n_files: int
    n_bytes: int
    has_digests: bool


def check_description(root: Path) -> dict[str, Any]:
    """Checks what a finished dataset of the benchmark says of itself. It is quick: no frame is read.

    Returns:
        Contents of info.json.

    Raises:
        DatasetError: The dataset is another one, or not finished; a file is missing, or not what it must be.
    """
    if not (root / files.INFO_FILE).exists():
        raise DatasetError(
            f"{root} holds no dataset: {files.INFO_FILE} is missing. `deltaco-collect` makes one."
        )
    info = read_info(root)
    if info["codebase_version"] == UNFINISHED or (root / STAGING / "plan.json").exists():
        raise DatasetError(
            f"The collection in {root} is unfinished. Run its `deltaco-collect` command first."
        )
    features = info["features"]
    if "benchmark.task_id" not in features or "info" not in features.get("observation.image", {}):
        raise DatasetError(f"{root} holds a dataset that `deltaco-collect` did not make.")
    read_statistics(root, features)
    read_tasks(root, info["total_tasks"])
    if (root / HISTORY_FILE).exists():  # LeRobot's editing tools drop it
        read_history(root)
    check_counts(root, info)
    return info


def verify_dataset(root: Path) -> Verification:
    """Checks every byte of a finished dataset.

    Args:
        root: The dataset's folder; it is only read.

    Raises:
        DatasetError: A file is missing, is not the one that was written, or is one too many.
    """
    info = check_description(root)
    digests = read_digests(root)
    paths = sorted(path for folder in ("data", "meta") for path in (root / folder).rglob("*"))
    paths = [path for path in paths if path.is_file() and not path.name.startswith(".")]
    if digests is not None:
        _compare(root, paths, digests)
    else:
        _read_all(root, info)
    return Verification(
        episodes=info["total_episodes"],
        n_files=len(paths),
        n_bytes=sum(path.stat().st_size for path in paths),
        has_digests=digests is not None,
    )


def _compare(root: Path, paths: list[Path], digests: Mapping[str, str]) -> None:
    names = {str(path.relative_to(root)): path for path in paths if path != root / DIGESTS_FILE}
    for name in digests:
        if name not in names:
            raise damaged(root / name, f"{DIGESTS_FILE} lists it", _REMEDY)
    for name, path in tqdm(names.items(), desc="Verifying", unit="file", leave=False):
        if name not in digests:
            # LeRobot reads every Parquet file of these folders.
            if path.suffix in (".parquet", ".json"):
                raise DatasetError(
                    f"The file {path} does not belong to the dataset: {DIGESTS_FILE} does not list it. If "
                    "LeRobot's tools have added to the dataset since, delete that list; else delete the file."
                )
        elif file_digest(path) != digests[name]:
            raise damaged(path, f"its SHA-256 is not that in {DIGESTS_FILE}", _CHANGED)


def _read_all(root: Path, info: Mapping[str, Any]) -> None:
    """Reads all columns, decodes all images, and checks the numbers of the frames."""
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] == "image"]
    first = 0
    for path in tqdm(sorted((root / "data").glob("*/*.parquet")), desc="Verifying", unit="file", leave=False):
        try:
            table = pq.read_table(path)
            indices = table["index"].to_numpy()
            task_ids = table["benchmark.task_id"].to_numpy()
            for camera in cameras:
                for cell in table[camera]:
                    with Image.open(io.BytesIO(cell["bytes"].as_py())) as image:
                        image.verify()
        except (OSError, ValueError, KeyError, TypeError, SyntaxError) as error:  # Pillow's are SyntaxErrors
            raise damaged(path, error, _REMEDY) from None
        if not np.array_equal(indices, np.arange(first, first + len(table))):
            raise damaged(path, f"its frames must be numbered from {first}", _REMEDY)
        if not all(map(is_task, np.unique(task_ids).tolist())):
            raise damaged(path, f"`benchmark.task_id` must be in 0..{N_TASKS - 1}", _REMEDY)
        first += len(table)
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        try:
            pq.read_table(path)
        except (OSError, ValueError) as error:
            raise damaged(path, error, _REMEDY) from None
