"""Speed of the collection of datasets: `python benchmarks/collect.py [--json FILE]` prints a table.

Times are of one machine; compare figures of one run. Run it while nothing else uses the processor.
The peak of the memory is known on Linux alone.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.tasks import N_TASKS
from lerobot_deltaco.data import collection, collection_workers
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import CollectionPlan

# Of all kinds.
TASKS = range(0, N_TASKS, 15)
# The small dataset has 1/4 of the episodes. The difference of the two times leaves out the start of the
# processes.
SMALL_SHARE = 4


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--episodes-per-task",
        type=int,
        default=16,
        metavar="N",
        help=f"of {len(TASKS)} tasks, for each number of workers (%(default)s)",
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="at the most (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.episodes_per_task < SMALL_SHARE or options.workers < 1:
        parser.error(f"--episodes-per-task must be at least {SMALL_SHARE}, and --workers at least 1.")

    results = measure_parts(max(1, options.episodes_per_task // SMALL_SHARE))
    # 1, 2, 4, ... and all of them.
    for n_workers in sorted({*(2**i for i in range(options.workers.bit_length())), options.workers}):
        results |= measure_collection(options.episodes_per_task, n_workers)
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:10.3f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def make_plan(episodes_per_task: int) -> CollectionPlan:
    """A collection of the benchmark's tasks."""
    return CollectionPlan(",".join(map(str, TASKS)), episodes_per_task)


def measure_parts(episodes_per_task: int) -> dict[str, float]:
    """Milliseconds of one process for each episode that is stored."""
    plan = make_plan(episodes_per_task)
    seconds: Counter[str] = Counter()
    env = PickPlaceEnv()
    env.reset(seed=0)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        job = collection.make_job(Path(folder), plan)
        worker = collection_workers._Worker(job, env, files.data_schema(plan.features))
        stack.enter_context(mock.patch.object(collection_workers, "_worker", worker))
        for owner, name in (
            (collection_workers, "collect_episode"),
            (files, "_png"),
            (files, "episode_statistics"),
        ):
            function = _timed(getattr(owner, name), seconds)
            stack.enter_context(mock.patch.object(owner, name, function))
        collect, join = (
            _timed(collection_workers._collect, seconds),
            _timed(collection_workers._join, seconds),
        )
        for index in range(plan.n_episodes):
            collect(index)
        for part in range(job.n_parts):
            join(part)
    env.close()
    per_episode = {name: value / plan.n_episodes * 1e3 for name, value in seconds.items()}
    parts = {
        "simulate_ms": per_episode["collect_episode"],
        "png_ms": per_episode["_png"],
        "statistics_ms": per_episode["episode_statistics"],
        "join_ms": per_episode["_join"],
    }
    parts["table_and_file_ms"] = per_episode["_collect"] + parts["join_ms"] - sum(parts.values())
    writing = sum(parts.values()) - parts["simulate_ms"]
    return {**parts, "writing_ms": writing, "writing_of_simulation": writing / parts["simulate_ms"]}


def _timed(function: Callable[..., Any], seconds: Counter[str]) -> Callable[..., Any]:
    """The function, adding the time of each call to the seconds of its name."""

    def timed(*arguments: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments)
        seconds[function.__name__] += time.perf_counter() - start
        return result

    return timed


def measure_collection(episodes_per_task: int, n_workers: int) -> dict[str, float]:
    """Episodes per second from the simulation to the finished dataset, and what does not depend on them."""
    small = make_plan(episodes_per_task // SMALL_SHARE)
    large = make_plan(episodes_per_task)
    (small_seconds, small_memory), (seconds, memory) = (
        _run_alone(plan, n_workers) for plan in (small, large)
    )
    rate = (large.n_episodes - small.n_episodes) / (seconds - small_seconds)
    suffix = f"{n_workers}_worker{'s' * (n_workers > 1)}"
    return {
        f"episodes_per_s_{suffix}": rate,
        f"episodes_per_s_and_worker_{suffix}": rate / n_workers,
        f"start_and_end_s_{suffix}": seconds - large.n_episodes / rate,
        f"main_process_mb_{small.n_episodes}_episodes_{suffix}": small_memory,
        f"main_process_mb_{large.n_episodes}_episodes_{suffix}": memory,
    }


def _run_alone(plan: CollectionPlan, n_workers: int) -> tuple[float, float]:
    """Seconds of a collection, and megabytes of its main process at the most."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        return executor.submit(_collect, plan, n_workers).result()


def _collect(plan: CollectionPlan, n_workers: int) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        collection.collect(Path(folder), plan, n_workers)
        seconds = time.perf_counter() - start
    # Not `getrusage`: its figure may be that of the process which started this one.
    peak = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return seconds, int(peak[1]) * 1024 / 1e6 if peak else float("nan")


if __name__ == "__main__":
    main()
