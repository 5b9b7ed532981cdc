"""Values against the types that are declared for them: of a dataclass's fields, and of what JSON gives."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Hashable, Mapping
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin


def check_field_types(instance: Any) -> None:
    """Checks that the fields of a dataclass have values of their declared types; not those that it inherits.

    Numbers are finite; an integer stands for a float, but a boolean for no number.

    Args:
        instance: The dataclass's instance.

    Raises:
        ValueError: A field has a value of another type; the message names it and says what is valid.
    """
    for name, kind in type_hints(type(instance)).items():
        if not is_a(getattr(instance, name), kind):
            raise ValueError(f"`{name}` must be {in_words(kind)}. Got {getattr(instance, name)!r}.")


def check_ranges(instance: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Checks that numbers are within their ranges.

    Args:
        instance: Object with the numbers as attributes.
        ranges: Least and greatest valid value of each attribute, by name. None is always valid.

    Raises:
        ValueError: A number is not; the message names it and says what is valid.
    """
    for name, (least, greatest) in ranges.items():
        value = getattr(instance, name)
        if value is not None and not value >= least:
            raise ValueError(f"`{name}` must be at least {least}. Got {value}.")
        if value is not None and value > greatest:
            raise ValueError(f"`{name}` must be at most {greatest}. Got {value}.")


@cache
def _type_hints(kind: Hashable) -> dict[str, Any]:
    return inspect.get_annotations(cast(type[Any], kind), eval_str=True)


def type_hints(kind: type[Any]) -> dict[str, Any]:
    """The declared types of a class's own attributes, by name."""
    return _type_hints(cast(Hashable, kind))


def is_a(value: Any, kind: Any) -> bool:
    """Whether a value is of a declared type."""
    return _type_check(kind)(value)


@cache
def _type_check(kind: Any) -> Callable[[Any], bool]:
    """The check of a declared type, made once: records have hundreds of thousands of values."""
    origin, options = get_origin(kind), get_args(kind)
    if kind is Any:
        return lambda value: True
    if origin is Literal:
        return lambda value: type(value) is str and value in options
    if origin in (UnionType, Union):
        checks = [_type_check(option) for option in options]
        return lambda value: any(check(value) for check in checks)
    if origin is list:
        check_item = _type_check(options[0])
        return lambda value: isinstance(value, list) and all(map(check_item, value))
    if origin is dict:
        check_name, check_value = map(_type_check, options)
        return lambda value: (
            isinstance(value, dict) and all(map(check_name, value)) and all(map(check_value, value.values()))
        )
    if kind is NoneType:
        return lambda value: value is None
    if kind is float:
        return lambda value: type(value) in (int, float) and math.isfinite(value)
    if kind in (int, bool):
        return lambda value: type(value) is kind  # True is no integer here
    return lambda value: isinstance(value, kind)


def in_words(kind: Any) -> str:
    """A declared type as an error names it."""
    origin, options = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(options)}"
    if origin in (UnionType, Union):
        return " or ".join(in_words(option) for option in options)
    if origin is list:
        return f"a list whose items are each {in_words(options[0])}"
    if origin is dict:
        return f"a mapping from {in_words(options[0])} to {in_words(options[1])}"
    names: dict[Any, str] = {
        int: "an integer",
        float: "a finite number",
        str: "a string",
        bool: "true or false",
        NoneType: "None",
    }
    return names.get(kind) or str(getattr(kind, "__name__", kind))
