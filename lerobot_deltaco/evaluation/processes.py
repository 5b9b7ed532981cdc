"""Runs the batches of an evaluation set in several processes; the outcomes are those of a single one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from tqdm import tqdm

from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.evaluation.evaluate import EpisodeOutcome, Evaluation
from lerobot_deltaco.lerobot_internals import without_rollout_progress


class EvaluationError(ValueError):
    """An evaluation could not be completed; the message says why."""


def default_processes(device: str) -> int:
    """Number of processes for a policy on a device: one for each core; one if it is not on the CPU.

    OMP_NUM_THREADS, by which `deltaco-experiment --jobs` shares the cores between runs, takes precedence.
    """
    if device != "cpu":
        return 1
    n_threads = os.environ.get("OMP_NUM_THREADS", "")
    if n_threads.isdecimal() and int(n_threads) > 0:
        return int(n_threads)
    return available_cores()


def check_processes(processes: int, device: str) -> None:
    """Checks a number of processes.

    Raises:
        ValueError: It is less than 1, or there are several for a policy that is not on the CPU.
    """
    if processes < 1:
        raise ValueError(f"`processes` must be at least 1. Got {processes}.")
    if processes > 1 and device != "cpu":
        raise ValueError(
            f"Only a policy on the CPU is evaluated by several processes. This one is on {device!r}: leave "
            "out --processes, or add --device cpu."
        )


def run_batches(evaluation: Evaluation, processes: int) -> list[EpisodeOutcome]:
    """Runs all batches of an evaluation set.

    Args:
        evaluation: The set.
        processes: Number of processes; with 1, all is run in this one.

    Returns:
        The episodes, task after task, which do not depend on the number of processes.

    Raises:
        EvaluationError: A process ended unexpectedly.
        ValueError: A task has no demonstration, or the number of processes is invalid.
    """
    check_processes(processes, str(evaluation.policy.config.device))
    processes = min(processes, len(evaluation.batches))
    outcomes: list[EpisodeOutcome] = []
    progress = tqdm(
        total=sum(len(batch) for batch in evaluation.batches),
        desc=f"Evaluating step {evaluation.set_number}",
        unit="episode",
    )
    with progress, without_rollout_progress():
        for found in _run_all(evaluation, processes):
            outcomes += found
            progress.update(len(found))
    return evaluation.in_task_order(outcomes)


def _run_all(evaluation: Evaluation, processes: int) -> Iterator[list[EpisodeOutcome]]:
    """The episodes of the batches, in the order in which these are completed."""
    numbers = range(len(evaluation.batches))
    if processes == 1:
        for number in numbers:
            yield evaluation.run(number)
        return
    # Processes are forked, which shares the policy and takes no time: importing LeRobot takes 10 s.
    context = multiprocessing.get_context("fork")
    executor = ProcessPoolExecutor(processes, mp_context=context, initializer=_start, initargs=(evaluation,))
    try:
        with warnings.catch_warnings():
            # Of threads that hold locks: there are none but idle ones, and each process computes with one.
            warnings.filterwarnings("ignore", category=DeprecationWarning, message=".*fork")
            running = [executor.submit(_run, number) for number in numbers]
        for future in as_completed(running):
            yield future.result()
    except BrokenProcessPool:
        raise EvaluationError(
            "A process of the evaluation ended unexpectedly; the memory may be full. Run the command again "
            "with fewer --processes."
        ) from None
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


_evaluation: Evaluation | None = None  # of this process, if it was forked for one


def _start(evaluation: Evaluation) -> None:
    global _evaluation
    # An interrupt is for the main process, which lets the running batches end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _evaluation = evaluation


def _run(number: int) -> list[EpisodeOutcome]:
    assert _evaluation is not None
    return _evaluation.run(number)
