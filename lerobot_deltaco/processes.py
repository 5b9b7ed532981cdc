"""Processes that end with the one that started them, and memory that a process keeps."""

from __future__ import annotations

import ctypes
import functools
import logging
import multiprocessing
import os
import platform
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from lerobot_deltaco.errors import UserError

# Options of glibc's mallopt, and its largest value.
_TRIM_THRESHOLD, _MMAP_MAX, _GREATEST = -1, -4, 2**31 - 1


def call_in_new_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function in a process of its own, and returns its result or raises its error.

    LeRobot's training is made for one run in a process, whose memory and settings of precision stay.

    Args:
        function: Function of a module, which the process imports.
        arguments: Its arguments.

    Raises:
        UserError: The process was killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, _start) as executor:
        try:
            return executor.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise UserError(
                "The process was killed; the memory may be full. The same command continues."
            ) from None


def _start() -> None:
    # Without FFmpeg, LeRobot decodes videos with PyAV, and warns of it with four tracebacks.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    end_with_parent()


def end_with_parent() -> None:
    """Lets this process end when its parent does, also if that is killed; otherwise it would go on alone."""
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@functools.cache
def disable_malloc_trim() -> None:
    """Prevents glibc from returning freed memory to the operating system, for the rest of the process.

    Otherwise, it returns the memory of large tensors at each step and requests it again, and the system
    clears it page by page. Without that, training steps of a small network on a CPU are 5 to 25 % faster.
    """
    if platform.libc_ver()[0] == "glibc":
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_MAX, 0)
        mallopt(_TRIM_THRESHOLD, _GREATEST)
