"""A thread in which everything that is slow happens, one thing after the other, whoever asked for it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TypeVar

T = TypeVar("T")


class _End:
    """The last item of a stream."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


class Worker:
    """Runs functions and generators in one thread.

    A policy keeps the task of a running episode by thread, and a generator of Gradio's may be resumed in
    another thread at every step. Here, an episode stays in one thread from its first step to its last, and no
    other begins before it ends.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="deltaco-play")

    def call(self, function: Callable[[], T]) -> T:
        """The result of a function, once its turn has come."""
        return self._executor.submit(function).result()

    def stream(self, make: Callable[[], Generator[T]]) -> Iterator[T]:
        """Yields what a generator yields. If the caller stops early, the generator is closed."""
        items: queue.SimpleQueue[T | _End] = queue.SimpleQueue()
        is_cancelled = threading.Event()

        def work() -> None:
            error = None
            try:
                if not is_cancelled.is_set():
                    with closing(make()) as generator:
                        for item in generator:
                            items.put(item)
                            if is_cancelled.is_set():
                                break
            except BaseException as raised:  # it is raised again where the items are read
                error = raised
            items.put(_End(error))

        self._executor.submit(work)
        try:
            while not isinstance(item := items.get(), _End):
                yield item
            if item.error is not None:
                raise item.error
        finally:
            is_cancelled.set()
