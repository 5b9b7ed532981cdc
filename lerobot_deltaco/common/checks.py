"""Checks of the arguments of configurations."""

from __future__ import annotations

from collections.abc import Collection


def check_minimums(configuration: object, **minimums: float) -> None:
    """Checks that numbers of a configuration are not too small.

    Args:
        configuration: Object whose attributes are checked.
        minimums: Smallest valid value of each attribute, by its name.

    Raises:
        ValueError: A number is smaller, or not a number.
    """
    for name, minimum in minimums.items():
        value = getattr(configuration, name)
        if not value >= minimum:
            raise ValueError(f"`{name}` must be at least {minimum}. Got {value}.")


def check_choices(configuration: object, **choices: Collection[str]) -> None:
    """Checks that words of a configuration are valid.

    Args:
        configuration: Object whose attributes are checked.
        choices: Valid values of each attribute, by its name.

    Raises:
        ValueError: A word is none of the valid ones.
    """
    for name, valid in choices.items():
        value = getattr(configuration, name)
        if value not in valid:
            raise ValueError(f"`{name}` must be one of {', '.join(valid)}. Got {value!r}.")
