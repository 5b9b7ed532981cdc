"""Lets threads share the steps of LeRobot's processors, as `lerobot-eval` does with several tasks at a time.

A step of LeRobot 0.6 keeps what it is processing in an attribute: it sets it and reads it again. With
`--eval.max_parallel_tasks` above 1, a thread could so get the observation and the instruction of another.
Importing this module gives each thread an attribute of its own.
"""

from __future__ import annotations

import threading
from typing import Any

from lerobot.processor import ProcessorStep

_ATTRIBUTE = "_current_transition"


class _PerThread:
    """An attribute with a value for each thread, None at first. Kept in the instance, and copied with it."""

    def __get__(self, step: ProcessorStep | None, owner: type[ProcessorStep]) -> Any:
        if step is None:
            return self
        return step.__dict__.get(_ATTRIBUTE, {}).get(threading.get_ident())

    def __set__(self, step: ProcessorStep, value: Any) -> None:
        step.__dict__.setdefault(_ATTRIBUTE, {})[threading.get_ident()] = value


# A later LeRobot may do without the attribute, and so without this.
if getattr(ProcessorStep, _ATTRIBUTE, ...) is None:
    setattr(ProcessorStep, _ATTRIBUTE, _PerThread())
