"""Collects a dataset in several processes, so that it can be interrupted at any moment and continued.

Workers (`collection_workers.py`) store episodes and complete data files in the folder `.collecting`. The
dataset's own files change only at the end: all changes are first written down, then made; each may be
repeated. So whatever happens, the next run with the same arguments goes on, and the result is a function of
the arguments alone.

All files of that folder are written with their checksums, and read only if they still have them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gym_deltaco import ENV_ID
from gym_deltaco.atomic_files import json_text, write_json
from gym_deltaco.tasks import get_task
from lerobot_deltaco.common import file_locks
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import (
    EPISODE_LENGTH,
    EPISODES_PER_FILE,
    FPS,
    ROBOT_TYPE,
    CollectionError,
    CollectionPlan,
    first_numbers,
    renderer,
)
from lerobot_deltaco.data.collection_workers import (
    JOINED,
    WORKERS_LOCK,
    Job,
    read_part,
    run_job,
)
from lerobot_deltaco.data.dataset_statistics import merged_by_feature
from lerobot_deltaco.data.finished_dataset import (
    HISTORY_FILE,
    STAGING,
    UNFINISHED,
    check_counts,
    check_metadata_digests,
    read_history,
    read_info,
    read_json,
    read_statistics,
    read_tasks,
    tries_by_kind,
)
from lerobot_deltaco.data.integrity import (
    DatasetError,
    file_digest,
    read_checked_json,
    read_digests,
    write_checked_json,
    write_digests,
)

# The same folder once all is done; it is renamed before it is removed, so that it never counts half-removed.
FINISHED_STAGING = ".collecting.finished"
LOCK = "lock"
# What a collection under way has in its folder, once its plan is written down.
_STAGED = ("episodes", "parts", JOINED, "commit.json")
# Arguments that collections of earlier versions were begun without, and what was so in all of them.
_ADDED_ARGUMENTS = MappingProxyType({"adversarial_draw": "each"})


@dataclass(frozen=True)
class Summary:
    """What a collection came to.

    Attributes:
        episodes: Number of episodes in the dataset.
        new_episodes: Number of those that this plan collected.
        attempts: Number of episodes that were run for them.
        success_rates: Success rate of the expert over those attempts, for each kind of task.
        episodes_per_s: Speed of this run, which may have collected a part; None if there was nothing to do.
        bytes_per_episode: Size of the dataset on disk, for each episode.
    """

    episodes: int
    new_episodes: int
    attempts: int
    success_rates: dict[str, float]
    episodes_per_s: float | None
    bytes_per_episode: float


@dataclass(frozen=True)
class _Base:
    """The dataset that a collection adds to."""

    tasks: list[str]
    n_episodes: int
    n_frames: int
    n_files: int
    features: dict[str, Any]
    history: list[dict[str, Any]]
    digests: dict[str, str]

    @property
    def plans(self) -> list[CollectionPlan]:
        return [CollectionPlan(**entry["plan"]) for entry in self.history]


def collect(root: Path, plan: CollectionPlan, n_workers: int = 1, append: bool = False) -> Summary:
    """Collects a dataset, or continues an interrupted collection.

    Args:
        root: The dataset's folder: new, empty, or that of an interrupted collection with the same plan.
        plan: Tasks, episodes and settings of the dataset.
        n_workers: Number of processes; the dataset does not depend on it.
        append: Whether to add to a finished dataset.

    Returns:
        What it came to. If the dataset is finished, and of this plan alone, there is nothing to do.

    Raises:
        CollectionError: The folder is in use, or has something else in it; the expert cannot do a task; a
            process ended, or a file is damaged.
        OSError: The folder cannot be written to, or is full. What is finished is kept.
    """
    try:
        return collect_into(root, plan, n_workers, append)
    except DatasetError as error:
        raise CollectionError(str(error)) from None


def collect_into(
    root: Path,
    plan: CollectionPlan,
    n_workers: int,
    append: bool = False,
    bring: Callable[[Job], None] | None = None,
) -> Summary:
    """As `collect`; what was collected elsewhere is brought first.

    Args:
        root: As in `collect`.
        plan: As in `collect`.
        n_workers: As in `collect`.
        append: As in `collect`.
        bring: Puts files of episodes and parts where the job looks for them. What it does may be repeated.

    Raises:
        DatasetError: A file is damaged.
        CollectionError: As in `collect`.
        OSError: As in `collect`.
    """
    root.mkdir(parents=True, exist_ok=True)
    base = _read_base(root)
    staging = root / STAGING
    if base is not None:
        shutil.rmtree(root / FINISHED_STAGING, ignore_errors=True)
        if not append and base.plans == [plan] and not (staging / "plan.json").exists():
            return _summary(root, episodes_per_s=None)
    _check_may_begin(root, base, plan, append)
    with locked(staging):
        # Both again: only now can no other process come between.
        if _read_base(root) != base:
            raise CollectionError(
                f"Another process has just finished collecting into {root}. Look at it first."
            )
        _check_may_begin(root, base, plan, append)
        write_checked_json(staging / "plan.json", identity(plan, append))
        seconds = n_collected = 0.0
        if not (staging / "commit.json").exists():
            if base is None:
                _mark_unfinished(root, plan)
            job = make_job(root, plan, base)
            if bring is not None:
                bring(job)
            start = time.perf_counter()
            n_collected = run_job(job, n_workers)
            seconds = time.perf_counter() - start
            _prepare_commit(job, base)
        _commit(root)
    return _summary(root, n_collected / seconds if n_collected else None)


# Before


def _read_base(root: Path) -> _Base | None:
    """The finished dataset in a folder, if there is one."""
    info_file, history_file = root / files.INFO_FILE, root / HISTORY_FILE
    if not info_file.exists():
        return None
    codebase_version = read_json(info_file, dict[str, Any]).get("codebase_version")
    if codebase_version == UNFINISHED:
        return None
    if codebase_version is not None and (
        codebase_version != files.CODEBASE_VERSION or not history_file.exists()
    ):
        raise CollectionError(
            f"{root} holds a dataset that `deltaco-collect` did not make. Name a new folder."
        )
    info = read_info(root)
    check_counts(root, info)
    read_statistics(root, info["features"])
    base = _Base(
        tasks=read_tasks(root, info["total_tasks"]),
        n_episodes=info["total_episodes"],
        n_frames=info["total_frames"],
        n_files=len(list((root / "data").glob("*/*.parquet"))),
        features=info["features"],
        history=read_history(root),
        digests=read_digests(root) or {},
    )
    check_metadata_digests(root)
    return base


def _check_may_begin(root: Path, base: _Base | None, plan: CollectionPlan, append: bool) -> None:
    """Refuses to mix the plan with what the folder has in it.

    Raises:
        CollectionError: Something else is there.
    """
    plan_file = root / STAGING / "plan.json"
    if plan_file.exists():
        remedy = f"The arguments of the collection are lost: delete {root}, and collect again."
        begun, wanted = read_checked_json(plan_file, remedy), identity(plan, append)
        if differing := differences(begun, wanted):
            raise CollectionError(
                f"{root} holds an unfinished collection of other arguments ({'; '.join(differing)}). Go "
                "on with its own arguments, or name a new folder."
            )
        if append and base is None and not (root / STAGING / "commit.json").exists():
            raise CollectionError(
                f"The addition to {root} was interrupted while its files were put into place, and "
                f"{STAGING}/commit.json, which says how, is missing. Put the file back, or restore the "
                "dataset from a copy."
            )
        return
    if any((root / STAGING / name).exists() for name in _STAGED) or (base is None and _is_begun(root)):
        raise CollectionError(
            f"{root} holds an unfinished collection whose arguments are lost: {plan_file} is missing. Put "
            f"the file back, or delete {root if base is None else root / STAGING}, and collect again."
        )
    if base is None:
        if append:
            raise CollectionError(f"{root} holds no finished dataset to add to. Run without --append first.")
        others = sorted(path.name for path in root.iterdir() if path.name != STAGING)
        if others:
            raise CollectionError(f"{root} is not empty ({', '.join(others[:3])}). Name a new folder.")
    elif not append:
        raise CollectionError(
            f"{root} holds a finished dataset of other arguments. Add to it with --append, or name a new "
            "folder."
        )
    elif json.loads(json.dumps(plan.features)) != base.features:
        raise CollectionError(
            f"{root} holds a dataset whose images differ in size, ambiguity, renderer, objects, probability "
            "or draw of adversarial distractors, or version of the benchmark. Name a new folder."
        )


def _is_begun(root: Path) -> bool:
    """Whether a folder is marked as that of an unfinished collection."""
    info_file = root / files.INFO_FILE
    return info_file.exists() and read_json(info_file, dict[str, Any]).get("codebase_version") == UNFINISHED


def identity(plan: CollectionPlan, append: bool = False) -> dict[str, Any]:
    """What has to be the same for a collection to be continued."""
    return {
        **asdict(plan),
        "append": append,
        "benchmark": ENV_ID,
        "renderer": renderer(),
        "episodes_per_file": EPISODES_PER_FILE,
    }


def differences(begun: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What keeps a collection from being continued, in words.

    Args:
        begun: Identity of the collection, as read from its folder.
        wanted: Identity of the collection that is to continue it.
    """
    begun = {**_ADDED_ARGUMENTS, **begun}
    return [
        f"{name}: {begun.get(name)} there, {value} now"
        for name, value in wanted.items()
        if begun.get(name) != value
    ]


def versions() -> dict[str, str]:
    """Versions of what an episode depends on."""
    return {name: version(name) for name in ("lerobot_policy_deltaco", "pybullet", "numpy")}


def _mark_unfinished(root: Path, plan: CollectionPlan) -> None:
    info = files.dataset_info(plan.features, FPS, ROBOT_TYPE, 0, 0, 0)
    write_json(root / files.INFO_FILE, {**info, "codebase_version": UNFINISHED})


@contextmanager
def locked(staging: Path) -> Iterator[None]:
    """Keeps a second collection out; the lock ends with the process, however it ends."""
    staging.mkdir(exist_ok=True)
    with (staging / LOCK).open("w") as lock, (staging / WORKERS_LOCK).open("w") as workers_lock:
        try:
            file_locks.lock(lock, wait=False)
        except BlockingIOError:
            raise CollectionError(
                f"Another process is collecting into {staging.parent}. Wait for it, or end it."
            ) from None
        # If a former main process was killed, its workers end by themselves, but may need a moment.
        file_locks.lock(workers_lock)
        file_locks.unlock(workers_lock)
        yield


def make_job(
    root: Path, plan: CollectionPlan, base: _Base | None = None, collected: range | None = None
) -> Job:
    """What workers need to know of a collection.

    Args:
        root: The dataset's folder.
        plan: Plan of the episodes that the dataset gets.
        base: Dataset that is added to, if any.
        collected: The episodes of the plan that are collected in this folder; all by default.
    """
    base = base or _Base([], 0, 0, 0, {}, [], {})
    instructions = dict.fromkeys([*base.tasks, *(get_task(task_id).instruction for task_id in plan.task_ids)])
    order = {instruction: index for index, instruction in enumerate(instructions)}
    taken = first_numbers(plan, base.plans)
    return Job(
        root=root,
        plan=plan,
        tasks=list(instructions),
        task_indices={task_id: order[get_task(task_id).instruction] for task_id in plan.task_ids},
        first_numbers={task_id: taken[task_id] for task_id in plan.task_ids},
        base_episodes=base.n_episodes,
        base_frames=base.n_frames,
        base_files=base.n_files,
        episodes_per_file=EPISODES_PER_FILE,
        collected=range(plan.n_episodes) if collected is None else collected,
    )


# After


def _prepare_commit(job: Job, base: _Base | None) -> None:
    """Writes down the dataset's metadata as they shall be."""
    known = [read_part(job, part) for part in range(job.n_parts)]
    statistics = [files.statistics_from_json(item["statistics"]) for item in known]
    digests: dict[str, str] = {}
    if base is not None:
        statistics.insert(0, read_statistics(job.root, base.features))
        # Datasets of earlier versions have no checksums; theirs are taken as their files are now.
        for number in range(base.n_files):
            for file in (files.DATA_FILE, files.EPISODES_FILE):
                name = str(files.numbered(file, number))
                digests[name] = base.digests.get(name) or file_digest(job.root / name)
    for item in known:
        digests |= item["sha256"]
    attempts: Counter[str] = Counter()
    for item in known:
        attempts.update(item["attempts"])
    entry = {
        "plan": asdict(job.plan),
        "benchmark": ENV_ID,
        "renderer": renderer(),
        "versions": versions(),
        "attempts": attempts,
    }
    n_episodes = job.base_episodes + job.plan.n_episodes
    n_frames = job.base_frames + job.plan.n_episodes * EPISODE_LENGTH
    contents = {
        "info": files.dataset_info(job.plan.features, FPS, ROBOT_TYPE, n_episodes, n_frames, len(job.tasks)),
        "stats": files.statistics_to_json(merged_by_feature(statistics)),
        "tasks": job.tasks,
        "history": [*(base.history if base else []), entry],
        "sha256": digests,
    }
    write_checked_json(job.staging / "commit.json", contents)


def _commit(root: Path) -> None:
    """Makes the dataset what was written down. Interrupted, it is simply done again."""
    staging = root / STAGING
    remedy = f"Put it back from a copy, or delete {root}, and collect again."
    contents = read_checked_json(staging / "commit.json", remedy)
    info, digests = contents["info"], contents["sha256"]
    write_json(root / files.INFO_FILE, {**info, "codebase_version": UNFINISHED})
    for path in sorted((staging / JOINED).rglob("*.parquet")):
        target = root / path.relative_to(staging / JOINED)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    files.write_tasks(root / files.TASKS_FILE, contents["tasks"])
    write_json(root / files.STATS_FILE, contents["stats"])
    write_json(root / HISTORY_FILE, contents["history"])
    metadata = (files.TASKS_FILE, files.STATS_FILE, HISTORY_FILE)
    digests |= {str(file): file_digest(root / file) for file in metadata}
    digests[str(files.INFO_FILE)] = hashlib.sha256(json_text(info).encode()).hexdigest()
    write_digests(root, digests)
    write_json(root / files.INFO_FILE, info)
    os.replace(staging, root / FINISHED_STAGING)
    shutil.rmtree(root / FINISHED_STAGING)


def _summary(root: Path, episodes_per_s: float | None) -> Summary:
    info = json.loads((root / files.INFO_FILE).read_text())
    last = json.loads((root / HISTORY_FILE).read_text())[-1]
    tries = tries_by_kind([last])
    files_of_it = (path for folder in ("data", "meta") for path in (root / folder).rglob("*"))
    size = sum(path.stat().st_size for path in files_of_it if path.is_file())
    return Summary(
        episodes=info["total_episodes"],
        new_episodes=sum(each.successes for each in tries.values()),
        attempts=sum(each.attempts for each in tries.values()),
        success_rates={kind: each.successes / each.attempts for kind, each in tries.items()},
        episodes_per_s=episodes_per_s,
        bytes_per_episode=size / info["total_episodes"],
    )
