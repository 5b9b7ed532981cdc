"""Opens LeRobotDatasets, and checks that what they store twice agrees.

An error names the episode, its file, and what disagrees. Datasets that other tools converted or edited may
have a table of episodes, statistics or tasks that do not belong to the frames.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from huggingface_hub import constants
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from lerobot_deltaco.data.files import check_files
from lerobot_deltaco.errors import UserError

logger = logging.getLogger(__name__)

# Of the mean, in standard deviations, and of the standard deviation, as a factor
_MAX_MEAN_ERROR, _MAX_STD_RATIO = 0.5, 2.0
_ROUNDING = 1e-3  # of statistics, as a fraction of 1 plus the mean
_TOLERANCE = 1e-3  # of numbers beyond the range of the statistics, as a fraction of it


def check_dataset_folder(option: str, root: str | Path | None) -> None:
    """Checks that the folder named by a command-line option holds a dataset, if the Hub is offline.

    Raises:
        FileNotFoundError: It holds none.
    """
    if root is not None and constants.HF_HUB_OFFLINE and not (Path(root) / "meta/info.json").exists():
        raise FileNotFoundError(
            f"{option} is {root}, but there is no dataset: meta/info.json is missing. Check the spelling. "
            "(HF_HUB_OFFLINE is set, so nothing can be downloaded into it.)"
        )


def open_dataset(
    option: str, repo_id: str, root: str | Path | None, episodes: Sequence[int] | None = None
) -> LeRobotDataset:
    """Opens a dataset, and checks it.

    Args:
        option: Command-line option that names its folder, for the error.
        repo_id: Repository id of the dataset.
        root: Folder of the dataset; None for LeRobot's cache.
        episodes: Episodes to open; None for all.

    Raises:
        FileNotFoundError: The folder holds no dataset, or a file of it is missing.
        ValueError: The dataset is damaged, or has no such episode.
    """
    check_dataset_folder(option, root)
    with missing_files_named(repo_id, root, episodes):
        dataset = LeRobotDataset(
            repo_id, root=root, episodes=None if episodes is None else list(episodes), return_uint8=True
        )
    check_dataset(dataset)
    return dataset


def open_folder_or_hub(name: str, episodes: Sequence[int] | None = None) -> LeRobotDataset:
    """Opens and checks the dataset in a folder, or of an id on the Hugging Face Hub.

    Args:
        name: The folder or the id.
        episodes: Episodes to open; None for all.

    Raises:
        FileNotFoundError: The folder holds no dataset.
        ValueError: The dataset is damaged.
    """
    folder = Path(name)
    if not folder.exists() and len(folder.parts) == 2:
        return open_dataset("", name, None, episodes)
    if not (folder / "meta/info.json").exists():
        raise FileNotFoundError(
            f"There is no dataset in {name}: meta/info.json is missing. Check the spelling, or name one of "
            "the Hub, as USER/NAME."
        )
    return open_dataset("", folder.resolve().name, folder, episodes)


@contextmanager
def missing_files_named(
    repo_id: str, root: str | Path | None, episodes: Sequence[int] | None = None
) -> Iterator[None]:
    """Checks the files of a local dataset, and names one that is missing while it is opened, not the Hub.

    Raises:
        UserError: A file cannot be read, or contradicts another one.
        FileNotFoundError: A file is missing.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    check_files(folder, episodes)
    try:
        yield
    except Exception as error:
        if (folder / "meta/info.json").exists():
            for owner, path in _needed_files(repo_id, folder, episodes):
                if not path.exists():
                    raise FileNotFoundError(
                        f"{path} is missing. {owner} needs it, and it could not be downloaded. Copy it "
                        "there, or leave out the episode with --dataset.episodes."
                    ) from error
        raise


def _needed_files(repo_id: str, folder: Path, episodes: Sequence[int] | None) -> Iterator[tuple[str, Path]]:
    """Yields the files of a dataset that some episodes need, and who needs each."""
    for name in ("meta/tasks.parquet", "meta/episodes"):
        yield "The dataset", folder / name
    meta = LeRobotDatasetMetadata(repo_id, folder)
    chosen = range(meta.total_episodes) if episodes is None else episodes
    check_episode_numbers(repo_id, meta.total_episodes, chosen)
    for episode in chosen:
        videos = [meta.get_video_file_path(episode, name) for name in meta.video_keys]
        for path in (meta.get_data_file_path(episode), *videos):
            yield f"Episode {episode}", meta.root / path


def check_episode_numbers(repo_id: str, total: int, episodes: Sequence[int]) -> None:
    """Checks that a dataset has episodes.

    Raises:
        ValueError: It does not.
    """
    if not len(episodes) or not all(0 <= episode < total for episode in episodes):
        raise UserError(
            f"{repo_id} has the episodes 0 to {total - 1}. Got {shortened(episodes)}. Name others in "
            "--dataset.episodes or `training_episodes`."
        )


def shortened(numbers: Sequence[int], n_shown: int = 10) -> str:
    """Returns the first of some numbers as text."""
    text = ", ".join(map(str, numbers[:n_shown]))
    return f"{text}, ..." if len(numbers) > n_shown else text or "none"


# Frames


def episode_spans(dataset: LeRobotDataset) -> dict[int, tuple[int, int]]:
    """Returns the first and the last row of each episode in a dataset, by the episode's index."""
    episodes = column(dataset, "episode_index").reshape(-1)
    first = np.flatnonzero(np.diff(episodes, prepend=-1))
    last = np.append(first[1:], len(episodes)) - 1
    return dict(zip(episodes[first].tolist(), zip(first.tolist(), last.tolist(), strict=True), strict=True))


def column(dataset: LeRobotDataset, name: str) -> NDArray[Any]:
    """Returns all values of a feature, (frames, ...)."""
    table = dataset.hf_dataset.select_columns([name])
    values = table.with_format("arrow")[:][name].combine_chunks()
    array = _flat_numbers(values)
    if array is None:
        array = np.array(table.with_format("numpy")[:][name])
    elif len(array) != len(values):
        array = array.reshape(len(values), *dataset.meta.features[name]["shape"])
    elif pa.types.is_nested(values.type):
        array = array[:, None]
    # As LeRobot, which makes tensors of Python's numbers.
    if np.issubdtype(array.dtype, np.floating):
        return array.astype(np.float32)
    return array.astype(np.int64) if np.issubdtype(array.dtype, np.integer) else array.copy()


def _flat_numbers(values: pa.Array) -> NDArray[Any] | None:
    """Returns numbers and vectors of numbers as one flat array; None for anything else.

    `datasets` makes arrays row by row, and takes ten seconds for a hundred thousand.
    """
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        if values.null_count:
            return None
        values = values.flatten()
    is_number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
    if values.null_count or not (is_number or pa.types.is_boolean(values.type)):
        return None
    return values.to_numpy(zero_copy_only=False)


def frame_name(dataset: LeRobotDataset, row: int, camera: str | None = None) -> str:
    """Returns the episode, frame and file of a row, for errors."""
    episode, frame = (
        int(column(dataset, name).reshape(-1)[row]) for name in ("episode_index", "frame_index")
    )
    meta = dataset.meta
    is_video = camera in meta.video_keys
    path = meta.get_video_file_path(episode, camera) if is_video else meta.get_data_file_path(episode)
    return f"frame {frame} of episode {episode} ({meta.root / path})"


@contextmanager
def decoding(dataset: LeRobotDataset, row: int, camera: str) -> Iterator[None]:
    """Names the frame in errors while an image of a camera is decoded.

    Raises:
        ValueError: It fails; the message names the frame.
    """
    try:
        yield
    except Exception as error:
        raise UserError(
            f"The image {camera} in {frame_name(dataset, row, camera)} cannot be decoded: {error}. Record "
            "the episode again, or leave it out with --dataset.episodes."
        ) from error


def dimension_names(feature: Mapping[str, Any], name: str = ACTION) -> list[str]:
    """Returns the names of a feature's dimensions, in any of the forms that converters and robots write.

    These are a list, lists in a list or under names of groups, and a dictionary from name to index.

    Raises:
        ValueError: The names cannot be read, or are not as many as the dimensions.
    """
    names, shape = feature.get("names"), feature.get("shape", ())
    if names is None:
        return []
    found = _flat_names(names)
    if not all(isinstance(name, str) for name in found) or (len(shape) == 1 and len(found) != shape[0]):
        raise UserError(
            f"The `names` of {name!r} in meta/info.json must name each of its {shape[0] if shape else '?'} "
            f"dimensions. Got {names}. Correct them, or set them to null."
        )
    return found


def _flat_names(names: Any) -> list[Any]:
    if isinstance(names, dict):
        if all(isinstance(index, int) for index in names.values()):
            return sorted(names, key=names.__getitem__)
        names = list(names.values())
    if not isinstance(names, (list, tuple)):
        return [names]
    return [name for part in names for name in _flat_names(part)]


# Checks


def check_dataset(dataset: LeRobotDataset) -> None:
    """Checks that a dataset is not damaged, and that what it stores twice agrees.

    Raises:
        ValueError: It is, or does not; the message names the episode and the file.
    """
    _check_tasks(dataset.meta)
    _check_episodes(dataset)
    stats = dataset.meta.stats or {}
    for name in (ACTION, OBS_STATE):
        if name in dataset.meta.features and not {"min", "max", "mean", "std"} <= set(stats.get(name, ())):
            raise UserError(
                f"{dataset.meta.root / 'meta/stats.json'} has no statistics of `{name}`, which normalize it. "
                "Compute them with LeRobot's lerobot-edit-dataset, or record the dataset again."
            )
    for name, feature in dataset.meta.features.items():
        if name not in dataset.meta.camera_keys and str(feature["dtype"]).startswith("float"):
            _check_numbers(dataset, name, stats.get(name, {}))
    for name in (ACTION, OBS_STATE):
        if name in dataset.meta.features:
            _check_statistics(dataset, name, stats[name])


def _check_tasks(meta: LeRobotDatasetMetadata) -> None:
    """Checks that tasks are in the order of their indices, since LeRobot finds them by position."""
    indices = meta.tasks["task_index"].tolist()
    if indices != list(range(len(indices))):
        wrong = next(n for n, index in enumerate(indices) if index != n)
        raise UserError(
            f"In {meta.root / 'meta/tasks.parquet'}, row {wrong} has the `task_index` {indices[wrong]}, but "
            "LeRobot finds tasks by their rows. Sort the rows, and number them from 0."
        )


def _check_episodes(dataset: LeRobotDataset) -> None:
    """Checks that the table of episodes agrees with the frames, and that each episode has one task."""
    meta = dataset.meta
    table = {
        name: meta.episodes[name][:]
        for name in ("episode_index", "length", "dataset_from_index", "dataset_to_index")
    }
    # LeRobot's conversion to videos leaves them out.
    known_tasks = meta.episodes["tasks"][:] if "tasks" in meta.episodes.column_names else None
    index, frame_index, tasks = (
        column(dataset, name).reshape(-1) for name in ("index", "frame_index", "task_index")
    )
    spans, names = episode_spans(dataset), meta.tasks.index
    for episode in sorted(range(meta.total_episodes) if dataset.episodes is None else set(dataset.episodes)):
        first, last = spans.get(episode, (0, -1))
        rows = slice(first, last + 1)
        start, stop = table["dataset_from_index"][episode], table["dataset_to_index"][episode]
        present = [names[n] if 0 <= n < len(names) else f"number {n}" for n in np.unique(tasks[rows])]
        known = present if known_tasks is None else list(known_tasks[episode])
        problem = None
        if len(present) > 1:
            problem = (
                f"it has several tasks, {present}, but a demonstration shows one. Split it into one for each"
            )
        elif present != known:
            problem = f"its task is {present}, but {known} by the table"
        elif (table["episode_index"][episode], table["length"][episode]) != (episode, stop - start):
            problem = "the table contradicts itself"
        elif not (
            np.array_equal(index[rows], np.arange(start, stop))
            and np.array_equal(frame_index[rows], np.arange(stop - start))
        ):
            problem = f"its frames are not those with the indices {start} to {stop - 1}, as in the table"
        if problem is not None:
            raise UserError(
                f"Episode {episode} of {dataset.repo_id}: {problem} (frames: "
                f"{meta.root / meta.get_data_file_path(episode)}; table: {meta.root / 'meta/episodes'}). "
                "Convert or record the dataset again, or leave out the episode with --dataset.episodes."
            )


def _check_numbers(dataset: LeRobotDataset, name: str, stats: dict[str, Any]) -> None:
    """Checks that the numbers of a feature are finite, and within the range of its statistics."""
    values = column(dataset, name).reshape(len(dataset.hf_dataset), -1)
    wrong, problem = ~np.isfinite(values), "is not finite"
    if not wrong.any() and {"min", "max"} <= stats.keys():
        least, most = (np.asarray(stats[end], np.float64).reshape(-1) for end in ("min", "max"))
        if len(least) == len(most) == values.shape[1]:
            margin = _TOLERANCE * (most - least) + 1e-5 * (1 + np.maximum(abs(least), abs(most)))
            # Not finite statistics are wrong for all.
            wrong = ~((values >= least - margin) & (values <= most + margin))
            problem = f"is outside of the range in {dataset.meta.root / 'meta/stats.json'}"
    if wrong.any():
        row, dimension = np.argwhere(wrong)[0]
        raise UserError(
            f"`{name}` {problem}: dimension {dimension} is {values[row, dimension]:g} in "
            f"{frame_name(dataset, int(row))}. {int(wrong.any(axis=1).sum())} frames are such. Leave out "
            "damaged episodes with --dataset.episodes; compute wrong statistics again."
        )


def _check_statistics(dataset: LeRobotDataset, name: str, stats: Mapping[str, Any]) -> None:
    """Checks the mean and the standard deviation of a feature, by which a policy normalizes it.

    Wrong ones make it blind to the feature. Some episodes alone may differ from all of them, though not as
    much as all can.
    """
    values = column(dataset, name).reshape(len(dataset.hf_dataset), -1).astype(np.float64)
    mean, std, least, most = (
        np.asarray(stats[key], np.float64).reshape(-1) for key in ("mean", "std", "min", "max")
    )
    if len(mean) != values.shape[1] or len(std) != values.shape[1]:
        return  # LeRobot refuses these
    # Of a constant dimension, rounding leaves a small standard deviation.
    spread, rounding = most - least, _ROUNDING * (1 + np.abs(mean))
    own = values.std(axis=0)
    wrong = (mean < least - _TOLERANCE * spread - rounding) | (mean > most + _TOLERANCE * spread + rounding)
    wrong |= (std > spread + rounding) | ((std <= 0) & (own > rounding))
    if len(values) == dataset.meta.total_frames:
        wrong |= np.abs(values.mean(axis=0) - mean) > _MAX_MEAN_ERROR * own + rounding
        wrong |= (own > rounding) & ((std < own / _MAX_STD_RATIO) | (std > own * _MAX_STD_RATIO))
    if wrong.any():
        dimension = int(np.argmax(wrong))
        raise UserError(
            f"The statistics of `{name}` in {dataset.meta.root / 'meta/stats.json'} are not those of the "
            f"frames: by them, dimension {dimension} has mean {mean[dimension]:g} and standard deviation "
            f"{std[dimension]:g}; in the frames, {values[:, dimension].mean():g} and "
            f"{values[:, dimension].std():g}. Compute them again: lerobot-edit-dataset "
            "--operation.type=recompute_stats."
        )


def warn_of_equal_instructions(tasks: Sequence[str], encoded: Tensor) -> None:
    """Warns if a policy cannot tell two instructions apart.

    Args:
        tasks: Task strings.
        encoded: What the policy makes of them, (tasks, ...).
    """
    _, group, sizes = encoded.unique(dim=0, return_inverse=True, return_counts=True)
    alike = (sizes[group] > 1).nonzero().flatten().tolist()
    if alike:
        first, other = [n for n in alike if group[n] == group[alike[0]]][:2]
        logger.warning(
            "The policy cannot tell %d of %d tasks from others by their instructions, such as %r and %r. "
            "Word them differently, with English words.",
            len(alike),
            len(tasks),
            tasks[first],
            tasks[other],
        )


def compare_robots(training: LeRobotDatasetMetadata, shown: LeRobotDatasetMetadata) -> None:
    """Warns if demonstrations are of another robot than the training's, or in other units."""
    for name in {ACTION, OBS_STATE} & training.features.keys() & shown.features.keys():
        names = [meta.features[name].get("names") for meta in (training, shown)]
        least, most, means = (
            np.asarray(meta.stats[name][key]).reshape(-1)
            for meta, key in ((training, "min"), (training, "max"), (shown, "mean"))
        )
        ours, theirs = f"{training.repo_id}, which is trained on,", f"the demonstrations in {shown.repo_id}"
        if names[0] != names[1]:
            logger.warning("`%s` is %s in %s but %s in %s.", name, names[0], ours, names[1], theirs)
        elif len(least) == len(means) and (abs(means - (least + most) / 2) > most - least + 1e-6).any():
            worst = int(np.argmax(abs(means - (least + most) / 2) - (most - least)))
            logger.warning(
                "`%s` does not fit: its dimension %d is between %g and %g in %s but %g on average in %s. Are "
                "the units the same?",
                name,
                worst,
                least[worst],
                most[worst],
                ours,
                means[worst],
                theirs,
            )
