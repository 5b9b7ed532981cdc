"""PyBullet, which is imported when it is first used, without its message ("pybullet build time: ...").

PyBullet is the optional dependency `sim`, because many systems have to compile it. Only the environment needs
it; tasks, layouts, datasets and policies do not.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def _discarded_stderr() -> Iterator[None]:
    """Discards output of compiled code to the standard error."""
    saved = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def load() -> None:
    """Imports PyBullet, whose functions are then attributes of this module.

    Raises:
        ImportError: PyBullet is missing or does not load; the message says what to install.
    """
    try:
        with _discarded_stderr():
            import pybullet
    except ModuleNotFoundError as error:
        raise ImportError(
            "The environment needs PyBullet, which is not installed. Install it with "
            '`pip install "lerobot_policy_deltaco[sim]"`; it needs a C++ compiler where there is no wheel.',
            name="pybullet",
        ) from error
    except ImportError as error:
        raise ImportError(
            f"PyBullet is installed, but does not load: {error}. Build it again with `pip install "
            "--force-reinstall --no-cache-dir --no-deps pybullet`; it needs a C++ compiler.",
            name="pybullet",
        ) from error
    globals().update({name: value for name, value in vars(pybullet).items() if not name.startswith("_")})


def __getattr__(name: str) -> Any:
    if name.startswith("_") or "stepSimulation" in globals():
        raise AttributeError(name)
    load()
    return globals()[name]
