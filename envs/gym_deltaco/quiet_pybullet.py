"""PyBullet, imported without the line that it prints ("pybullet build time: ...").

The environment needs it; tasks, layouts, datasets and policies do not. It is the extra `sim`, because many
systems have to compile it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from gym_deltaco.errors import SimulatorMissingError


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discards what compiled code prints to the standard error."""
    with suppress(AttributeError, OSError, ValueError):  # it is missing or closed
        sys.stderr.flush()
    try:
        saved = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


try:
    with _silent_stderr():
        import pybullet
except ImportError as error:
    if isinstance(error, ModuleNotFoundError) and error.name == "pybullet":
        raise SimulatorMissingError(
            "The environment needs PyBullet, which is not installed. Install it with "
            '`pip install "lerobot_policy_deltaco[sim]"`; it needs a C++ compiler where there is no wheel.'
        ) from error
    raise SimulatorMissingError(
        f"The environment needs PyBullet, which is installed, but does not load: {error}. Build it again "
        "with `pip install --force-reinstall --no-cache-dir --no-deps pybullet`; it needs a C++ compiler."
    ) from error

__all__ = ["pybullet"]
