"""The processor's cores."""

from __future__ import annotations

import os


def available_cores() -> int:
    """How many of the processor's cores this process may use; on a cluster, those of its job."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
