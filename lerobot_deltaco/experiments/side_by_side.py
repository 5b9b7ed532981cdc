"""Runs several experiments at the same time.

A small network does not keep several processor cores busy: two trainings with a core each have a higher
throughput than one after the other with both cores. (Measured with `small_a` on two cores: 1.4x.) Where
there are several GPUs, each run sees one of them.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.experiments.command_runner import CommandRunner
from lerobot_deltaco.experiments.gpus import gpu_of_its_own, visible_gpus
from lerobot_deltaco.experiments.run import ExperimentRun, Step

SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_LINES = 60.0  # where what is printed goes to a file
_LAST_CHARACTERS = 2000
# A progress bar of tqdm: the percentage and the time that is left.
_PROGRESS = re.compile(r"(\d+)%\|[^|]*\|[^\]\r\n]*<([\d:?]+)[^\]\r\n]*\]")


class _Running(NamedTuple):
    experiment: ExperimentRun
    commands: CommandRunner


def run_side_by_side(
    experiments: Sequence[ExperimentRun],
    jobs: int,
    report: Callable[[Path], None],
    step: Step | None = None,
) -> None:
    """Collects what is missing, one dataset after the other; trains and evaluates several runs at a time.

    Each run prints to its log. An experiment that starts from another one of these waits for it.

    Args:
        experiments: Experiments to run, each a run of its own.
        jobs: Number of runs at a time. Each has the same share of the cores, also when some are done.
        report: Called with the folder of each run that is complete.
        step: The only step to run, "train" or "evaluate"; None for all.

    Raises:
        ExperimentError: A step failed. Those that had begun were completed, no other was begun.
    """
    for experiment in experiments:
        experiment.check_settings()
    if step is None:
        collect_once(experiments)

    jobs = min(jobs, len(experiments))
    n_threads = max(1, available_cores() // jobs)
    gpus = visible_gpus() if jobs > 1 else []
    waiting = list(experiments)
    running: dict[Future[None], _Running] = {}
    failure: Exception | None = None
    with ThreadPoolExecutor(jobs) as pool, _Progress(len(experiments)) as progress:
        try:
            while running or (waiting and failure is None):
                while failure is None and len(running) < jobs and (ready := _next(waiting, running.values())):
                    waiting.remove(ready)
                    gpu = None
                    if ready.uses_any_gpu:
                        gpu = gpu_of_its_own(gpus, [now.commands.gpu for now in running.values()])
                    commands = CommandRunner(ready.log, n_threads, gpu)
                    future = pool.submit(ready.train_and_evaluate, commands, step)
                    running[future] = _Running(ready, commands)
                    place = "" if gpu is None else f" runs on GPU {gpu} and"
                    progress.write(f"{_label(ready)}{place} prints to {ready.log}")
                done, _ = wait(running, SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED)
                for future in done:
                    experiment = running.pop(future).experiment
                    try:
                        future.result()
                        progress.update()
                        report(experiment.folder)
                    except Exception as error:
                        progress.write(f"{_label(experiment)}: {error}")
                        failure = failure or error
                progress.show([now.experiment for now in running.values()])
        except BaseException:
            for now in running.values():
                now.commands.stop()
            raise
    if failure is not None:
        raise failure


def collect_once(experiments: Sequence[ExperimentRun], options: Sequence[str] = ()) -> None:
    """Collects what is missing, one dataset after the other, and each once.

    Args:
        experiments: Those whose data are collected.
        options: More options of `deltaco-collect`, such as "--join".
    """
    collected = []
    for experiment in experiments:
        plans = (experiment.config.data, experiment.config.demonstrations)
        if plans not in collected:
            experiment.collect(options)
            collected.append(plans)


def last_progress(log: Path) -> str:
    """What the last progress bar in a file says, such as "70%, 00:08 left", or nothing."""
    if not log.exists():
        return ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _LAST_CHARACTERS))
        found = _PROGRESS.findall(file.read().decode(errors="replace"))
    return "{}%, {} left".format(*found[-1]) if found else ""


class _Progress(tqdm):
    """How many runs are done, and how far the others have come."""

    def __init__(self, n_runs: int) -> None:
        form = "Runs: {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
        super().__init__(total=n_runs, bar_format=form, dynamic_ncols=True)
        self._shown_at = -SECONDS_BETWEEN_LINES

    def show(self, running: Sequence[ExperimentRun]) -> None:
        """Says how far those that run have come."""
        states = (f"{_label(experiment)} {last_progress(experiment.log)}" for experiment in running)
        self.set_postfix_str("; ".join(states), refresh=False)
        seconds = 0.0 if sys.stderr.isatty() else SECONDS_BETWEEN_LINES
        if time.monotonic() >= self._shown_at + seconds:
            self._shown_at = time.monotonic()
            self.refresh()


def _next(waiting: Sequence[ExperimentRun], running: Collection[_Running]) -> ExperimentRun | None:
    """The first that does not start from one that is still to be completed."""
    incomplete = {experiment.folder for experiment in (*waiting, *(now.experiment for now in running))}
    for experiment in waiting:
        if not any(experiment.may_start_from(folder) for folder in incomplete - {experiment.folder}):
            return experiment
    return waiting[0] if waiting and not running else None  # one that says what it lacks


def _label(experiment: ExperimentRun) -> str:
    return f"{experiment.config.name} {experiment.seed}"
