"""Commands of the demo, in processes that are forked from one that has imported LeRobot already.

A command is a module whose `main` reads `sys.argv`. Forked, it need not import LeRobot, which takes 6 to 15 s
of a core; the demo runs seven commands. Functions that a command registers with `atexit` are not called.
"""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.forkserver
import os
import shlex
import signal
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import Any, NamedTuple

# Nothing is fetched from the Hub: the language encoder comes with the extra `offline`.
_ENVIRONMENT = {"HF_HUB_OFFLINE": "1"}
_PRELOADED = "lerobot_deltaco.demo.preloaded"
# Elsewhere, processes that have imported PyTorch cannot be forked safely: each command imports what it needs.
_FORKS = sys.platform == "linux"
_SECONDS_TO_END = 10
# Whoever starts a process also asks whether others have ended. Only one thread may read their status.
_STATUS = threading.Lock()


class Command(NamedTuple):
    """A command line: the module that is run, and its arguments."""

    module: str
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return shlex.join(("python", "-m", self.module, *self.arguments))


def deltaco(name: str, *arguments: Any) -> Command:
    """`deltaco-NAME` with arguments."""
    return Command(f"lerobot_deltaco.commands.{name}", tuple(map(str, arguments)))


def lerobot(name: str, *arguments: Any) -> Command:
    """`lerobot-NAME` with arguments."""
    return Command(f"lerobot.scripts.lerobot_{name}", tuple(map(str, arguments)))


def start_imports() -> None:
    """Starts the process that commands are forked from, which imports LeRobot while this one goes on."""
    os.environ.update(_ENVIRONMENT)
    if not _FORKS:
        return
    multiprocessing.set_forkserver_preload([_PRELOADED])
    # It ignores Ctrl-C, or it would print a traceback; it ends after its imports once this process has ended.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        multiprocessing.forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)


def wait_for_imports() -> None:
    """Waits until that process has imported everything, after which it needs no processor time."""
    if _FORKS:
        process = _context().Process(target=_nothing)
        process.start()
        process.join()


def run(command: Command, log: Path | None = None, threads: int | None = None) -> int:
    """Runs a command to its end. Several threads may do so at a time.

    Args:
        command: What is run.
        log: File for its output; this process's own output by default.
        threads: Number of PyTorch's threads; by default, PyTorch chooses.

    Returns:
        Its exit status; minus the number of the signal that ended it, if one did.
    """
    process = _context().Process(target=_run, args=(command, log, threads))
    try:
        with _STATUS:
            process.start()
        wait([process.sentinel])
    except BaseException:
        # After Ctrl-C, which the command gets too, it has time to end by itself, until Ctrl-C comes again.
        if process.pid is not None:
            with suppress(BaseException):
                process.join(_SECONDS_TO_END)
            process.kill()
            process.join()
        raise
    with _STATUS:
        process.join()
    assert process.exitcode is not None
    return process.exitcode


def _context() -> ForkServerContext | SpawnContext:
    return multiprocessing.get_context("forkserver") if _FORKS else multiprocessing.get_context("spawn")


def _nothing() -> None:
    """A process that has nothing to do."""


def _run(command: Command, log: Path | None, threads: int | None) -> None:
    """The command's process."""
    demo = multiprocessing.parent_process()
    if demo is None or not demo.is_alive():
        return  # It was interrupted while it waited for the imports.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.update(_ENVIRONMENT)
    if log is not None:
        with log.open("wb") as file:
            for stream in (sys.stdout, sys.stderr):
                os.dup2(file.fileno(), stream.fileno())
    if threads is not None:
        # For the processes that it starts, and for itself, where PyTorch is imported already.
        os.environ["OMP_NUM_THREADS"] = str(threads)
        importlib.import_module("torch").set_num_threads(threads)
    sys.argv = [command.module, *command.arguments]
    importlib.import_module(command.module).main()
