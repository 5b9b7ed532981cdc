"""Collects the episodes of a job in worker processes, and joins them into data files.

Each finished episode is stored at once, in a file of its own. When all episodes of a data file are there, a
worker joins them.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
from tqdm import tqdm

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.tasks import get_task
from lerobot_deltaco.common import file_locks
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import (
    EPISODE_LENGTH,
    FPS,
    CollectionError,
    CollectionPlan,
    collect_episode,
)
from lerobot_deltaco.data.dataset_statistics import merged_by_feature
from lerobot_deltaco.data.finished_dataset import STAGING
from lerobot_deltaco.data.integrity import (
    damaged,
    file_digest,
    read_checked,
    read_checked_json,
    write_checked,
    write_checked_json,
)

JOINED = "joined"
# Each worker holds it as long as it lives.
WORKERS_LOCK = "workers"
# What an episode's own file knows of it, in its table's metadata.
_KNOWN = b"deltaco"
# So that none waits for the main process to hear of its last one.
_JOBS_PER_WORKER = 3


@dataclass(frozen=True)
class Job:
    """Everything that a worker needs to know of a collection."""

    root: Path
    plan: CollectionPlan
    tasks: list[str]  # of the whole dataset
    task_indices: dict[int, int]  # of a task in the dataset's table of tasks
    first_numbers: dict[int, int]  # of a task's episodes
    base_episodes: int
    base_frames: int
    base_files: int
    episodes_per_file: int
    collected: range  # the episodes that are collected here; those of a shard are not all

    @property
    def staging(self) -> Path:
        """The folder of the collection under way."""
        return self.root / STAGING

    @property
    def joined(self) -> Path:
        """Where complete files wait; it looks like the dataset's folder."""
        return self.staging / JOINED

    def episode_file(self, index: int) -> Path:
        """Where an episode of this collection waits until its data file is complete."""
        return self.staging / "episodes" / f"{index:07d}.arrow"

    def part_file(self, part: int) -> Path:
        """What is known of a complete data file; it is written after the file itself."""
        return self.staging / "parts" / f"{part:05d}.json"

    def files_of_part(self, part: int) -> tuple[Path, Path]:
        """The data file and the file of its episodes, in the dataset's folder."""
        number = self.base_files + part
        return files.numbered(files.DATA_FILE, number), files.numbered(files.EPISODES_FILE, number)

    def part(self, part: int) -> range:
        """The episodes of a data file."""
        first = part * self.episodes_per_file
        return range(first, min(first + self.episodes_per_file, self.plan.n_episodes))

    @property
    def n_parts(self) -> int:
        """Number of data files of the whole plan."""
        return -(-self.plan.n_episodes // self.episodes_per_file)

    @property
    def parts(self) -> range:
        """The data files with episodes that are collected here."""
        if not self.collected:
            return range(0)
        size = self.episodes_per_file
        return range(self.collected.start // size, -(-self.collected.stop // size))

    def is_whole(self, part: int) -> bool:
        """Whether all episodes of a data file are collected here, so that they can be joined."""
        episodes = self.part(part)
        return self.collected.start <= episodes.start and episodes.stop <= self.collected.stop

    def missing_episodes(self, part: int) -> list[int]:
        """The episodes of a data file that are to be collected here, and have not been."""
        if self.part_file(part).exists():
            return []
        episodes = self.part(part)
        first, stop = (
            max(episodes.start, self.collected.start),
            min(episodes.stop, self.collected.stop),
        )
        return [index for index in range(first, stop) if not self.episode_file(index).exists()]

    def task_and_number(self, index: int) -> tuple[int, int]:
        """Task of an episode, and its number among those of the task."""
        position, number = divmod(index, self.plan.episodes_per_task)
        task_id = self.plan.task_ids[position]
        return task_id, self.first_numbers[task_id] + number


def run_job(job: Job, n_workers: int) -> int:
    """Collects what is missing. Returns the number of episodes collected."""
    parts = [part for part in job.parts if not job.part_file(part).exists()]
    missing = {part: set(job.missing_episodes(part)) for part in parts}
    n_missing = sum(map(len, missing.values()))
    n_all = len(job.collected)
    progress = tqdm(total=n_all, initial=n_all - n_missing, desc="Collecting", unit="episode")
    with progress, _executor(job, n_workers) as executor:
        waiting = ((part, index) for part in parts for index in sorted(missing[part]))
        running: dict[Future, tuple[int, int | None]] = {}
        try:
            for part in parts:
                if not missing[part] and job.is_whole(part):
                    running[_submit(executor, _join, part)] = (part, None)
            while True:
                for part, index in islice(waiting, max(0, _JOBS_PER_WORKER * n_workers - len(running))):
                    running[_submit(executor, _collect, index)] = (part, index)
                if not running:
                    return n_missing
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    part, collected = running.pop(future)
                    future.result()
                    if collected is None:
                        continue
                    progress.update()
                    missing[part].remove(collected)
                    if not missing[part] and job.is_whole(part):
                        running[_submit(executor, _join, part)] = (part, None)
        except BrokenProcessPool:
            raise CollectionError(
                "A worker process ended unexpectedly; the memory may be full. What is finished is kept: run "
                "the command again, perhaps with fewer workers."
            ) from None
        finally:
            executor.shutdown(wait=True, cancel_futures=True)


def _executor(job: Job, n_workers: int) -> Executor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(n_workers, mp_context=context, initializer=_start_worker, initargs=(job,))


def _submit(executor: Executor, function: Callable[[int], None], number: int) -> Future:
    # This may start a process. An interrupt is for the main process, which lets the episodes end that are
    # under way; a process keeps what was blocked when it was started.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return executor.submit(function, number)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@dataclass
class _Worker:
    """What a worker process keeps from one episode to the next."""

    job: Job
    env: PickPlaceEnv
    schema: pa.Schema


_worker: _Worker | None = None


def _start_worker(job: Job) -> None:
    global _worker
    _end_with_main_process(job.staging / WORKERS_LOCK)
    env = PickPlaceEnv(**job.plan.env_settings)
    _worker = _Worker(job, env, files.data_schema(job.plan.features))


def _end_with_main_process(lock_file: Path) -> None:
    """Lets this process end when the main one is killed, and the next run wait for that.

    Else it would wait for work forever, or interfere with what the next run does.
    """
    main = multiprocessing.parent_process()
    assert main is not None
    lock = os.open(lock_file, os.O_RDWR)  # closed when the process ends
    file_locks.lock(lock, shared=True)

    def watch() -> None:
        main.join()
        os._exit(1)

    # Had it ended before this process had the lock, then the next run might not have waited for it.
    if not main.is_alive():
        os._exit(1)
    threading.Thread(target=watch, daemon=True).start()


def _collect(index: int) -> None:
    """Collects an episode and stores it."""
    assert _worker is not None
    job = _worker.job
    task_id, number = job.task_and_number(index)
    episode = collect_episode(_worker.env, job.plan, task_id, number)
    columns = files.episode_columns(
        episode.frames,
        FPS,
        episode_index=job.base_episodes + index,
        first_index=job.base_frames + index * EPISODE_LENGTH,
        task_index=job.task_indices[task_id],
    )
    statistics = files.statistics_to_json(files.episode_statistics(columns))
    known = {"attempts": episode.attempts, "statistics": statistics}
    table = files.episode_table(columns, _worker.schema)
    table = table.replace_schema_metadata({**table.schema.metadata, _KNOWN: json.dumps(known)})
    buffer = io.BytesIO()
    with pa.ipc.new_file(buffer, table.schema) as writer:
        writer.write_table(table)
    write_checked(job.episode_file(index), buffer.getvalue())


def _join(part: int) -> None:
    """Joins the episodes of a data file, and removes their own files."""
    assert _worker is not None
    job, schema = _worker.job, _worker.schema
    episodes = job.part(part)
    known: list[dict[str, Any]] = []

    def tables() -> Iterator[pa.Table]:
        for index in episodes:
            table = read_episode(job.episode_file(index))
            known.append(json.loads(table.schema.metadata[_KNOWN]))
            yield table.replace_schema_metadata(schema.metadata)

    number = job.base_files + part
    data_file, episodes_file = job.files_of_part(part)
    files.write_data_file(job.joined / data_file, tables(), schema)
    statistics = [files.statistics_from_json(item["statistics"]) for item in known]
    task_ids = [job.task_and_number(index)[0] for index in episodes]
    files.write_episodes_file(
        job.joined / episodes_file,
        file_number=number,
        first_episode=job.base_episodes + episodes.start,
        first_index=job.base_frames + episodes.start * EPISODE_LENGTH,
        tasks=[get_task(task_id).instruction for task_id in task_ids],
        lengths=[EPISODE_LENGTH] * len(episodes),
        statistics=statistics,
    )
    attempts: Counter[int] = Counter()
    for task_id, item in zip(task_ids, known, strict=True):
        attempts[task_id] += item["attempts"]
    write_checked_json(
        job.part_file(part),
        {
            "attempts": attempts,
            "statistics": files.statistics_to_json(merged_by_feature(statistics)),
            "sha256": {str(file): file_digest(job.joined / file) for file in (data_file, episodes_file)},
        },
    )
    for index in episodes:
        job.episode_file(index).unlink()


def read_episode(path: Path) -> pa.Table:
    """The frames of an episode that waits for its data file, which still are as they were written.

    Raises:
        DatasetError: They are not.
    """
    remedy = "Delete it and run the command again: its episode is then collected again."
    try:
        with pa.ipc.open_file(read_checked(path, remedy)) as reader:
            return reader.read_all()
    except pa.ArrowException as error:
        raise damaged(path, error, remedy) from None


def read_part(job: Job, part: int) -> dict[str, Any]:
    """What is known of a complete data file, which still is as it was written.

    Raises:
        DatasetError: It is not.
    """
    part_file = job.part_file(part)
    remedy = f"Delete {part_file} and run the command again: its episodes are then collected again."
    known = read_checked_json(part_file, remedy)
    for name, digest in known["sha256"].items():
        path = job.joined / name
        if not path.exists() or file_digest(path) != digest:
            raise damaged(path, "its contents do not have their checksum", remedy)
    return known
