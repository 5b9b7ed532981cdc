"""Error handling of all commands: they end with one line and an exit status."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from gym_deltaco.errors import SimulatorMissingError
from lerobot_deltaco.common.errors import UnsupportedSystemError


@contextmanager
def exit_on_error(
    parser: argparse.ArgumentParser,
    *errors: type[Exception],
    interrupted: str = "Interrupted. Run the same command again to continue.",
) -> Iterator[None]:
    """Ends the command with status 1 and the error's message, or with status 130 if it is interrupted.

    Args:
        parser: Parser of the command.
        errors: Errors whose messages a user can act on. Others are bugs, and show a traceback.
        interrupted: Message after an interrupt.
    """
    actionable: tuple[type[Exception], ...] = (SimulatorMissingError, UnsupportedSystemError, *errors)
    try:
        yield
    except actionable as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: {interrupted}\n")
