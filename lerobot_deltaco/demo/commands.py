"""Commands of the demo, in processes that are forked from one that has imported LeRobot already.

A command is a module with a function `main`, which reads `sys.argv`. It does what `python -m` would do with
it, but need not import LeRobot, which takes 6 to 15 s of a core. The demo runs seven commands.
"""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.forkserver
import os
import shlex
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

# Nothing is fetched from the Hub: the language encoder comes with the extra `offline`.
_ENVIRONMENT = {"HF_HUB_OFFLINE": "1"}
# What takes long to import; the modules of the commands import these where they need them.
_IMPORTED = (
    "lerobot.scripts.lerobot_eval",
    "lerobot.scripts.lerobot_train",
    "lerobot_deltaco.data.collection",
    "lerobot_deltaco.evaluation.sets",
    "lerobot_deltaco.training.loop",
    "lerobot_policy_deltaco",
)
# Elsewhere, processes that have imported PyTorch cannot be forked safely: each command imports what it needs.
_FORKS = sys.platform == "linux"
_SECONDS_TO_END = 10


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
    if _FORKS:
        multiprocessing.set_forkserver_preload(list(_IMPORTED))
        # It ends when this process ends; after Ctrl-C, it need not say where in its imports it was.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        multiprocessing.forkserver.ensure_running()
        signal.signal(signal.SIGINT, before)


def run(command: Command, log: Path | None = None, threads: int | None = None) -> int:
    """Runs a command to its end.

    Args:
        command: What is run.
        log: File for its output; this process's own output by default.
        threads: Number of PyTorch's threads; by default, PyTorch chooses.

    Returns:
        Its exit status; minus the number of the signal that ended it, if one did.
    """
    context = multiprocessing.get_context("forkserver") if _FORKS else multiprocessing.get_context("spawn")
    process = context.Process(target=_run, args=(command, log, threads))
    process.start()
    try:
        process.join()
    except BaseException:
        # After Ctrl-C, which the command gets too, it has time to end by itself, until Ctrl-C comes again.
        with suppress(BaseException):
            process.join(_SECONDS_TO_END)
        process.kill()
        process.join()
        raise
    assert process.exitcode is not None
    return process.exitcode


def _run(command: Command, log: Path | None, threads: int | None) -> None:
    """The command's process."""
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
