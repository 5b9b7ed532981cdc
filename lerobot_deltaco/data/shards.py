"""Collection in shards: several machines collect parts of one plan, and one of them joins the parts.

A shard is a range of the plan's episodes. It is a collection under way in a folder of its own beside the
dataset's: its complete data files, and single episodes where it begins or ends within a data file. To join,
complete data files are linked or copied as they are, and the others are put together from their episodes,
whose images stay encoded. So the dataset equals that of one machine, byte for byte.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from tqdm import tqdm

from gym_deltaco.atomic_files import atomic_write
from lerobot_deltaco.data import collection
from lerobot_deltaco.data.collection import Summary, collect_into, make_job, versions
from lerobot_deltaco.data.collection_plan import CollectionError, CollectionPlan
from lerobot_deltaco.data.collection_workers import WORKERS_LOCK, Job, read_part, run_job
from lerobot_deltaco.data.finished_dataset import is_finished
from lerobot_deltaco.data.integrity import DatasetError, read_checked, read_checked_json, write_checked_json

_PLAN_REMEDY = "Delete the shard's folder, and collect the shard again."
_EPISODE_REMEDY = "Delete it and collect its shard again: only this episode is missing then."


@dataclass(frozen=True)
class Shard:
    """A range of a plan's episodes: one of several that are equal, give or take an episode.

    Args:
        number: Number of this shard, 1..count.
        count: Number of shards.
    """

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Reads "3/8".

        Raises:
            ValueError: It is something else.
        """
        found = re.fullmatch(r"(\d+)/(\d+)", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise ValueError(f"A shard is I/N, from 1/N to N/N, such as 3/8. Got {text!r}.")
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def episodes(self, n_episodes: int) -> range:
        """Its episodes of a plan with so many."""
        return range(
            (self.number - 1) * n_episodes // self.count,
            self.number * n_episodes // self.count,
        )

    def folder(self, root: Path) -> Path:
        """Its folder, given that of the dataset."""
        return shards_folder(root) / f"{self.number}-of-{self.count}"


@dataclass(frozen=True)
class ShardSummary:
    """What the collection of a shard came to.

    Attributes:
        folder: Folder of the shard.
        episodes: Number of its episodes.
        all_episodes: Number of episodes of the whole dataset.
        episodes_per_s: Speed of this run, which may have collected a part; None if there was nothing to do.
    """

    folder: Path
    episodes: int
    all_episodes: int
    episodes_per_s: float | None


def shards_folder(root: Path) -> Path:
    """The folder of a dataset's shards, beside its own."""
    return root.with_name(f"{root.name}.shards")


def collect_shard(root: Path, plan: CollectionPlan, shard: Shard, n_workers: int = 1) -> ShardSummary:
    """Collects a shard of a dataset, or continues an interrupted one.

    Args:
        root: The folder of the dataset that the shards are joined into. It is not touched.
        plan: Plan of the whole dataset.
        shard: Share of its episodes that is collected.
        n_workers: Number of processes.

    Returns:
        What it came to. If the dataset is finished, or the shard, there is nothing to do.

    Raises:
        CollectionError: The shard's folder is in use, or has something else in it; the expert cannot do a
            task; a process ended, or a file is damaged.
        OSError: The folder cannot be written to, or is full. What is finished is kept.
    """
    job = _job(root, plan, shard)
    n_collected = seconds = 0.0
    if not is_finished(root):
        job.root.mkdir(parents=True, exist_ok=True)
        try:
            _check_arguments(job, shard)
            with collection.locked(job.staging):
                _check_arguments(job, shard)
                write_checked_json(_plan_file(job), _identity(plan, shard))
                start = time.perf_counter()
                n_collected = run_job(job, n_workers)
                seconds = time.perf_counter() - start
        except DatasetError as error:
            raise CollectionError(str(error)) from None
    return ShardSummary(
        job.root, len(job.collected), plan.n_episodes, n_collected / seconds if n_collected else None
    )


def join_shards(root: Path, plan: CollectionPlan, n_workers: int = 1) -> Summary:
    """Joins the shards of a dataset, or continues where that was interrupted.

    Args:
        root: The dataset's folder: new, empty, or that of an interrupted collection with the same plan.
        plan: Plan of the whole dataset.
        n_workers: Number of processes.

    Returns:
        What the collection came to. If the dataset is finished, and of this plan, there is nothing to do.

    Raises:
        CollectionError: Shards are missing, unfinished or of other arguments; or as with `collect`.
        OSError: The folder cannot be written to, or is full. What is finished is kept.
    """
    try:
        shards = [] if is_finished(root) else _finished_shards(root, plan)
        return collect_into(root, plan, n_workers, bring=lambda job: _bring(job, shards))
    except DatasetError as error:
        raise CollectionError(str(error)) from None


def _job(root: Path, plan: CollectionPlan, shard: Shard) -> Job:
    return make_job(shard.folder(root), plan, collected=shard.episodes(plan.n_episodes))


def _plan_file(job: Job) -> Path:
    return job.staging / "plan.json"


def _identity(plan: CollectionPlan, shard: Shard) -> dict[str, Any]:
    """What has to be the same for a shard to be continued or joined."""
    # Unlike a collection, a shard keeps its versions, since the dataset has only one entry for all shards.
    return {**collection.identity(plan), "shard": str(shard), "versions": versions()}


def _check_arguments(job: Job, shard: Shard) -> None:
    """Checks that the folder of a shard, if there is something in it, is of the same arguments."""
    if not _plan_file(job).exists():
        others = {path.name for path in (*job.root.iterdir(), *job.staging.glob("*"))}
        if others - {job.staging.name, collection.LOCK, WORKERS_LOCK}:
            raise CollectionError(
                f"{job.root} holds something else than shard {shard}. Delete it, or name another --root."
            )
        return
    begun, wanted = read_checked_json(_plan_file(job), _PLAN_REMEDY), _identity(job.plan, shard)
    if differing := collection.differences(begun, wanted):
        raise CollectionError(
            f"{job.root} holds shard {shard} of other arguments ({'; '.join(differing)}). Use the same "
            "arguments and versions for all shards, or delete the folder and collect the shard again."
        )


def _finished_shards(root: Path, plan: CollectionPlan) -> list[Job]:
    """The shards of a dataset, all of which are there and complete."""
    folder = shards_folder(root)
    found = {path.name for path in folder.glob("*") if re.fullmatch(r"\d+-of-\d+", path.name)}
    counts = sorted({int(name.split("-")[-1]) for name in found})
    if not counts:
        raise CollectionError(
            f"There are no shards in {folder}. Collect them first: the same command with --shard 1/N to "
            "--shard N/N instead of --join. Those of machines without a common disk are copied there."
        )
    if len(counts) > 1:
        raise CollectionError(
            f"{folder} holds shards of {' and of '.join(map(str, counts))}, which do not belong together. "
            "Delete those that are not wanted."
        )
    jobs, problems = [], []
    for number in range(1, counts[0] + 1):
        shard = Shard(number, counts[0])
        job = _job(root, plan, shard)
        if not _plan_file(job).exists():
            problems.append(f"{shard} is missing")
            continue
        _check_arguments(job, shard)
        n_missing = sum(len(job.missing_episodes(part)) for part in job.parts)
        if n_missing:
            problems.append(f"{shard} lacks {n_missing} of {len(job.collected)} episodes")
        elif any(job.is_whole(part) and not job.part_file(part).exists() for part in job.parts):
            problems.append(f"{shard} was interrupted at its end")
        jobs.append(job)
    if problems:
        raise CollectionError(
            f"The shards in {folder} are not complete: {', '.join(problems)}. Collect these with the same "
            "command and --shard instead of --join."
        )
    return jobs


def _bring(job: Job, shards: Sequence[Job]) -> None:
    """Puts what shards have collected where the collection of the whole dataset looks for it."""
    wanted = [(shard, part) for shard in shards for part in shard.parts if not job.part_file(part).exists()]
    for shard, part in tqdm(wanted, desc="Joining", unit="file"):
        if shard.is_whole(part):
            read_part(shard, part)  # checks it
            for file in shard.files_of_part(part):
                _link_or_copy(shard.joined / file, job.joined / file)
            # Last, since it says that the others are there.
            _link_or_copy(shard.part_file(part), job.part_file(part))
        else:
            episodes = shard.part(part)
            for index in shard.collected:
                if index in episodes:
                    read_checked(shard.episode_file(index), _EPISODE_REMEDY)
                    _link_or_copy(shard.episode_file(index), job.episode_file(index))


def _link_or_copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(target) as temporary:
        temporary.unlink(missing_ok=True)
        try:
            os.link(source, temporary)
        except OSError:  # on another disk, or one without links
            shutil.copyfile(source, temporary)
