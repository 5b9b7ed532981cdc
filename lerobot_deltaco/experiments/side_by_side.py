"""Runs several experiments at the same time.

A small network does not keep several processor cores busy: two trainings with a core each get further in an
hour than one after the other with both cores. (Measured with `small_a` on two cores: 1.4 times as far.)
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from tqdm import tqdm

from lerobot_deltaco.experiments.run import Experiment, run_folder

SECONDS_BETWEEN_LOOKS = 1.0
_LAST_CHARACTERS = 2000
# A progress bar of tqdm, without the bar itself.
_PROGRESS = re.compile(r"(\d+)%\|[^|]*\| *([^\]\r\n]*\])")


def run_side_by_side(experiments: Sequence[Experiment], jobs: int, report: Callable[[Path], None]) -> None:
    """Collects what is missing, one dataset after the other; trains and evaluates several runs at a time.

    Each run prints to its log. A row that starts from another of these waits for it.

    Args:
        experiments: What to run.
        jobs: How many at a time; they share the processor's cores evenly.
        report: Called with the folder of each run that is complete.

    Raises:
        ExperimentError: A step failed. Those that had begun were completed, no other was begun.
    """
    for experiment in experiments:
        experiment.check_settings()
    collected = []
    for experiment in experiments:
        plans = (experiment.row.data, experiment.row.demonstrations)
        if plans not in collected:
            experiment.collect()
            collected.append(plans)

    n_threads = max(1, (os.cpu_count() or 1) // jobs)
    waiting = list(experiments)
    running: dict[Future[None], Experiment] = {}
    failure: BaseException | None = None
    with ThreadPoolExecutor(jobs) as pool, tqdm(total=len(experiments), desc="Runs", unit="run") as progress:
        while running or (waiting and failure is None):
            while failure is None and len(running) < jobs and (ready := _next(waiting, running)):
                waiting.remove(ready)
                running[pool.submit(ready.train_and_evaluate, n_threads)] = ready
                tqdm.write(f"{_label(ready)}: see {ready.log}")
            done, _ = wait(running, SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED)
            for future in done:
                experiment = running.pop(future)
                failure = failure or future.exception()
                if future.exception() is None:
                    progress.update()
                    report(experiment.run)
            states = [f"{_label(now)} {last_progress(now.log)}" for now in running.values()]
            progress.set_postfix_str("; ".join(states))
    if failure is not None:
        raise failure


def last_progress(log: Path) -> str:
    """The last progress bar in a file, such as "70% 7/10 [00:20<00:08, 2.8step/s]", or nothing."""
    if not log.exists():
        return ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _LAST_CHARACTERS))
        found = _PROGRESS.findall(file.read().decode(errors="replace"))
    return f"{found[-1][0]}% {found[-1][1]}" if found else ""


def _next(waiting: Sequence[Experiment], running: dict[Future[None], Experiment]) -> Experiment | None:
    """The first that does not start from one that is still to be completed."""
    incomplete = {experiment.run for experiment in (*waiting, *running.values())}
    for experiment in waiting:
        start = experiment.row.start_from
        if start is None or run_folder(experiment.outputs, start, experiment.seed) not in incomplete:
            return experiment
    return waiting[0] if waiting and not running else None  # one that says what it lacks


def _label(experiment: Experiment) -> str:
    return f"{experiment.row.name} {experiment.seed}"
