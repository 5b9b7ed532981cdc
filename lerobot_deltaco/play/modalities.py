"""What a run uses: the demonstration, the instruction, or both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from lerobot_deltaco.configuration_deltaco import DeltacoConfig

BOTH, INSTRUCTION_ALONE, DEMONSTRATION_ALONE = "both", "instruction alone", "demonstration alone"
# What the policy's option `leave_out` is for each of them.
LEFT_OUT = MappingProxyType({BOTH: None, INSTRUCTION_ALONE: "demo", DEMONSTRATION_ALONE: "instruction"})
_WORDS = MappingProxyType({"demo": "demonstration", "instruction": "instruction"})


class Uses(NamedTuple):
    """What a checkpoint can do with and without.

    Attributes:
        choices: Those of `LEFT_OUT` that it has learned, `BOTH` among them.
        reason: Why it has not learned the others; empty if it has learned all of them.
    """

    choices: tuple[str, ...] = (BOTH,)
    reason: str = ""


def learned_uses(config: DeltacoConfig) -> Uses:
    """What a policy has learned to do without."""
    if not config.uses_demo:
        return Uses(reason=f"This checkpoint never takes a demonstration: its method is {config.method}.")
    if not config.uses_language:
        return Uses(reason=f"This checkpoint never takes an instruction: its method is {config.method}.")
    dropouts = {"demo": config.demo_dropout, "instruction": config.instruction_dropout}
    choices = tuple(use for use, part in LEFT_OUT.items() if part is None or dropouts[part] > 0)
    missing = [part for part, dropout in dropouts.items() if not dropout]
    if not missing:
        return Uses(choices)
    lacking = "either" if len(missing) == 2 else f"the {_WORDS[missing[0]]}"
    options = " and ".join(f"`{part}_dropout`" for part in missing)
    return Uses(
        choices, f"This checkpoint has not learned to do without {lacking}: it was trained with {options} 0."
    )


@contextmanager
def using(config: DeltacoConfig, use: str) -> Iterator[None]:
    """Lets a policy use the demonstration, the instruction, or both, while the context is open.

    Args:
        config: The policy's, whose own `leave_out` is restored.
        use: One of `LEFT_OUT`.
    """
    own, config.leave_out = config.leave_out, LEFT_OUT[use]
    try:
        yield
    finally:
        config.leave_out = own
