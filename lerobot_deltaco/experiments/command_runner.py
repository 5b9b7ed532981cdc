"""Runs this project's commands, each in a process of its own that another thread can stop."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

SECONDS_BETWEEN_PROGRESS = 10  # in a log, which keeps every state of a progress bar
SECONDS_TO_END = 3.0  # for a command that is stopped, before it is made to


class ExperimentError(RuntimeError):
    """A step of an experiment failed; the message says which."""


class CommandRunner:
    """Runs commands one after the other.

    Args:
        log: File to which the commands' output is appended; None for this terminal.
        n_threads: Number of the processor's cores that they may use; None for all.
        gpu: The only GPU that they see, as `CUDA_VISIBLE_DEVICES` names it; None for all.
    """

    def __init__(self, log: Path | None = None, n_threads: int | None = None, gpu: str | None = None) -> None:
        self.log = log
        self.n_threads = n_threads
        self.gpu = gpu
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False
        self._lock = threading.Lock()

    def run(self, command: str, arguments: list[str]) -> None:
        """Runs "collect", "train", ... with this Python.

        Raises:
            ExperimentError: It failed, or was stopped.
        """
        words = [sys.executable, "-m", f"lerobot_deltaco.commands.{command}", *arguments]
        with self.log.open("a", encoding="utf-8") if self.log else nullcontext(sys.stdout) as output:
            output.write(f"\ndeltaco-{command} {shlex.join(arguments)}\n")
            output.flush()
            streams: dict[str, Any] = {"stdout": output, "stderr": subprocess.STDOUT} if self.log else {}
            with self._lock:
                if self._stopped:
                    raise ExperimentError(f"deltaco-{command} was not begun: its runner was stopped.")
                self._process = subprocess.Popen(words, env=os.environ | self._environment(), **streams)
            try:
                code = self._process.wait()
            except BaseException:
                self.stop()
                raise
        if code != 0:
            raise ExperimentError(
                f"deltaco-{command} failed (exit status {code}); see {self.log or 'above'} for why. Run "
                "the same command again to continue."
            )

    def stop(self) -> None:
        """Ends the command that runs, and lets no other begin. From any thread."""
        with self._lock:
            self._stopped = True
            process = self._process
        if process is None:
            return
        # The interrupt of a terminal reaches the process as well: it may be ending by itself.
        for end in (lambda: None, lambda: process.send_signal(signal.SIGINT), process.kill):
            end()
            with suppress(subprocess.TimeoutExpired):
                process.wait(SECONDS_TO_END)
                return

    def _environment(self) -> dict[str, str]:
        environment = {}
        if self.n_threads is not None:
            environment["OMP_NUM_THREADS"] = str(self.n_threads)
        if self.gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = self.gpu
        if self.log is not None:
            environment["TQDM_MININTERVAL"] = str(SECONDS_BETWEEN_PROGRESS)
        return environment
