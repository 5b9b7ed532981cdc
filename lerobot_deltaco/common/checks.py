"""Checks of the arguments of configurations."""

from __future__ import annotations

from collections.abc import Collection


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
