"""Locks of open files. They end with the process that holds them, however it ends, on POSIX systems."""

from __future__ import annotations

from typing import IO

from lerobot_deltaco.common.errors import UnsupportedSystemError

try:
    import fcntl
except ModuleNotFoundError:
    raise UnsupportedSystemError(
        "Collecting datasets needs file locks of POSIX systems, which Windows does not have. Use Linux."
    ) from None


def lock(file: IO[str] | int, *, shared: bool = False, wait: bool = True) -> None:
    """Locks an open file until it is closed or unlocked.

    Args:
        file: The file, or its descriptor.
        shared: Whether other processes may hold a shared lock at the same time.
        wait: Whether to wait until other processes have released their locks.

    Raises:
        BlockingIOError: Another process holds a lock, and `wait` is False.
    """
    fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))


def unlock(file: IO[str] | int) -> None:
    """Releases the lock of an open file."""
    fcntl.flock(file, fcntl.LOCK_UN)
