"""A thread in which everything that is slow happens, one thing after the other, whoever asked for it."""

from __future__ import annotations

import queue
import threading
import weakref
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from contextlib import closing
from typing import Any, TypeVar

T = TypeVar("T")
_Job = tuple[Future[Any], Callable[[], Any]]


class _End:
    """The last item of a stream."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


class Worker:
    """Runs functions and generators in one thread.

    A policy keeps the task of a running episode by thread, and a generator of Gradio's may be resumed in
    another thread at every step. Here, an episode stays in one thread from its first step to its last, and no
    other begins before it ends. The end of the program does not wait for the thread.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._is_closing = threading.Event()
        # The threads of a `ThreadPoolExecutor` would be waited for.
        self._thread = threading.Thread(target=_work, args=(self._jobs,), name="deltaco-play", daemon=True)
        self._thread.start()
        weakref.finalize(self, self._jobs.put, None)

    def close(self, seconds: float) -> bool:
        """Ends the thread after the present function, or the present step of a generator.

        Args:
            seconds: How long to wait for it.

        Returns:
            Whether it has ended.
        """
        self._is_closing.set()
        self._jobs.put(None)
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def call(self, function: Callable[[], T]) -> T:
        """The result of a function, once its turn has come."""
        return self._submit(function).result()

    def stream(self, make: Callable[[], Generator[T]]) -> Iterator[T]:
        """Yields what a generator yields. If the caller stops early, the generator is closed."""
        items: queue.SimpleQueue[T | _End] = queue.SimpleQueue()
        is_cancelled, is_closing = threading.Event(), self._is_closing

        def work() -> None:
            error = None
            try:
                if not is_cancelled.is_set():
                    with closing(make()) as generator:
                        for item in generator:
                            items.put(item)
                            if is_cancelled.is_set() or is_closing.is_set():
                                break
            except BaseException as raised:  # it is raised again where the items are read
                error = raised
            items.put(_End(error))

        self._submit(work)
        try:
            while not isinstance(item := items.get(), _End):
                yield item
            if item.error is not None:
                raise item.error
        finally:
            is_cancelled.set()

    def _submit(self, function: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        self._jobs.put((future, function))
        return future


def _work(jobs: queue.SimpleQueue[_Job | None]) -> None:
    """Runs one job after the other, until there is None."""
    while (job := jobs.get()) is not None:
        _run(*job)
        del job  # or what it uses would be kept until the next one comes


def _run[T](future: Future[T], function: Callable[[], T]) -> None:
    try:
        future.set_result(function())
    except BaseException as error:  # it is raised again where the result is read
        future.set_exception(error)
        del future  # which the error refers to by its traceback, and which refers to the error
