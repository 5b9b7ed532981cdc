"""Processes that end with the one that started them."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from lerobot_deltaco.errors import UserError


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
