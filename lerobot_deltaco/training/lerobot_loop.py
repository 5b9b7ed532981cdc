"""The one place where LeRobot's training loop is changed.

The loop of `lerobot-train` makes its dataset, sampler and policy itself, so the functions that make them are
replaced while it runs. This was tried with the versions in `TRIED_WITH`. In a version that lacks one of them,
training refuses to start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from lerobot.scripts import lerobot_train

TRIED_WITH = ("0.6.1",)


@contextmanager
def replaced(**replacements: Callable[..., Any]) -> Iterator[dict[str, Callable[..., Any]]]:
    """Replaces functions by their names in LeRobot's training script, and yields LeRobot's own.

    Raises:
        ImportError: LeRobot's training script has no function of a name.
    """
    missing = [name for name in replacements if not callable(getattr(lerobot_train, name, None))]
    if missing:
        raise ImportError(
            f"`deltaco train` was tried with LeRobot {', '.join(TRIED_WITH)}. The training script of LeRobot "
            f"{version('lerobot')} has no {', '.join(missing)}. Install a version that was tried, or train "
            "with `lerobot-train`, which reads frames from the disk and draws them one by one."
        )
    own = {name: getattr(lerobot_train, name) for name in replacements}
    try:
        for name, function in replacements.items():
            setattr(lerobot_train, name, function)
        yield own
    finally:
        for name, function in own.items():
            setattr(lerobot_train, name, function)
