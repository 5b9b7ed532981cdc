"""How the process manages memory."""

from __future__ import annotations

import ctypes
import functools
import platform

# Options of glibc's mallopt, and its largest value.
_TRIM_THRESHOLD, _MMAP_MAX, _GREATEST = -1, -4, 2**31 - 1


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
