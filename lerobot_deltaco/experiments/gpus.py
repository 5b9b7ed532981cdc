"""The GPUs of this machine, and their distribution among runs."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from itertools import takewhile

VISIBLE_DEVICES = "CUDA_VISIBLE_DEVICES"


def visible_gpus() -> list[str]:
    """Names of the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` takes them."""
    listed = os.environ.get(VISIBLE_DEVICES)
    if listed is not None:
        names = (name.strip() for name in listed.split(","))
        # As CUDA, which ignores what follows the first that is none.
        return list(takewhile(lambda name: name not in ("", "-1"), names))
    import torch  # takes seconds

    return [str(number) for number in range(torch.cuda.device_count())]


def gpu_of_its_own(gpus: Sequence[str], used: Collection[str | None]) -> str | None:
    """The GPU for one more run: the one with the fewest runs, and the first of these.

    Args:
        gpus: Names of all GPUs.
        used: GPU of each run that is under way; None for one that uses no GPU, or all.

    Returns:
        Its name; None where there are not several to choose from.
    """
    if len(gpus) < 2:
        return None
    return min(gpus, key=list(used).count)
