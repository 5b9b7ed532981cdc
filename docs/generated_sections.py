"""Sections of the documentation's pages that are made from the code, so that they cannot drift from it.

They stand in the pages themselves, so that these can be read on GitHub, too. `python scripts/update_docs.py`
writes them anew, and a test compares them. Docstrings are read without importing their modules, which takes
neither PyBullet nor LeRobot.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from gym_deltaco.tasks import COLORS, OBJECTS, SCENARIOS, SHAPES, TASK_SETS, TASKS, get_task
from lerobot_deltaco.leaderboard import replace_section

ROOT = Path(__file__).parents[1]
ENVIRONMENT = "PickPlaceEnv"
ENVIRONMENT_OPTIONS = "DeltacoEnv"
POLICY_OPTIONS = "DeltacoConfig"
SOURCES = (ROOT / "envs" / "gym_deltaco", ROOT / "lerobot_deltaco")


class Documented(NamedTuple):
    """Documentation of a class, read from its source."""

    text: str  # Markdown, up to the sections
    arguments: dict[str, str]  # descriptions, in the docstring's order
    types: dict[str, str]  # of the fields of a dataclass, or of the constructor's arguments
    defaults: dict[str, ast.expr]


def updated(page: str, name: str) -> str:
    """A page with its sections made anew.

    Args:
        page: Text of the page.
        name: Its name, one of `SECTIONS`.

    Raises:
        ValueError: The page has no place for one of them.
    """
    for section, make in SECTIONS[name].items():
        page = replace_section(
            page, f"<!-- From the code: {section}. -->", f"<!-- End of {section}. -->", make()
        )
    return page


def documented(name: str) -> Documented:
    """Reads a class's docstring, fields and constructor from its source.

    Args:
        name: Name of the class, wherever it is in the packages.

    Raises:
        LookupError: There is no such class, or it has no docstring.
    """
    node = _class(name)
    docstring = ast.get_docstring(node)
    if docstring is None:
        raise LookupError(f"The class {name} has no docstring.")
    types: dict[str, str] = {}
    defaults: dict[str, ast.expr] = {}
    for statement in node.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            types[statement.target.id] = ast.unparse(statement.annotation)
            if statement.value is not None:
                defaults[statement.target.id] = statement.value
        elif isinstance(statement, ast.FunctionDef) and statement.name == "__init__":
            arguments = statement.args.args
            n_required = len(arguments) - len(statement.args.defaults)
            for k, argument in enumerate(arguments):
                types[argument.arg] = ast.unparse(argument.annotation) if argument.annotation else ""
                if k >= n_required:
                    defaults[argument.arg] = statement.args.defaults[k - n_required]
    text, *rest = re.split(r"^(?=(?:Args|Attributes|Raises|Returns):$)", docstring, flags=re.MULTILINE)
    section = next((part for part in rest if part.startswith("Args:")), "Args:")
    return Documented(text.strip(), _arguments(section), types, defaults)


def _class(name: str) -> ast.ClassDef:
    for folder in SOURCES:
        for path in sorted(folder.rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if f"class {name}" not in text:
                continue
            for node in ast.parse(text).body:
                if isinstance(node, ast.ClassDef) and node.name == name:
                    return node
    raise LookupError(f"There is no class {name} in {', '.join(folder.name for folder in SOURCES)}.")


def _arguments(section: str) -> dict[str, str]:
    """The entries of an "Args:" section, each as one line."""
    body = inspect.cleandoc("\n".join(section.splitlines()[1:]))
    entries: dict[str, str] = {}
    name = None
    for line in body.splitlines():
        entry = re.match(r"(\w+)(?: \([^)]*\))?: (.*)", line)
        if entry:
            name = entry[1]
            entries[name] = entry[2]
        elif name is not None and line.strip():
            entries[name] += f" {line.strip()}"
    return entries


def environment() -> str:
    """The specification of the environment: its docstring, a level down, with its arguments as a table."""
    spec = documented(ENVIRONMENT)
    rows = [
        (f"`{name}`", f"`{_value(spec.defaults[name])!r}`", description)
        for name, description in spec.arguments.items()
    ]
    text = f"{spec.text}\n\n## Arguments\n\n{table(('argument', 'default', 'meaning'), rows)}"
    return re.sub(r"^##", "###", text, flags=re.MULTILINE)


def options(name: str, prefix: str) -> str:
    """The options of a configuration, as a list.

    Args:
        name: Name of the dataclass.
        prefix: Prefix of an option on the command line, such as "--policy.".
    """
    spec = documented(name)
    entries = []
    for option, description in spec.arguments.items():
        kind = spec.types[option].replace(" | None", "")
        entries.append(f"- `{prefix}{option}` ({kind}, {_default(spec.defaults[option])}): {description}\n")
    return "".join(entries)


def _default(source: ast.expr) -> str:
    """A default value as the command line takes it."""
    value = _value(source)
    if value is None:
        return "not set by default"
    return f"default `{str(value).lower() if isinstance(value, bool) else value}`"


def _value(source: ast.expr) -> object:
    """The value of a default: a literal, a constant of the packages, or what a factory makes.

    Raises:
        LookupError: It is something else.
    """
    if isinstance(source, ast.Name):
        return _constant(source.id)
    if isinstance(source, ast.Call) and ast.unparse(source) == "field(default_factory=list)":
        return []
    return ast.literal_eval(source)


def _constant(name: str) -> object:
    """The value of a constant, wherever in the packages it is assigned one.

    Raises:
        LookupError: There is none.
    """
    for folder in SOURCES:
        for path in sorted(folder.rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if not re.search(rf"^{name}\b", text, re.MULTILINE):
                continue
            for node in ast.parse(text).body:
                targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
                is_it = any(isinstance(target, ast.Name) and target.id == name for target in targets)
                if is_it and isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                    return _value(node.value)
    raise LookupError(f"The constant {name} is assigned nowhere.")


# Tables


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def objects_table() -> str:
    """The 32 objects, and what scenario A does with each."""
    train_rows = SCENARIOS["a"].train_rows
    rows = [
        (
            str(label.index),
            label.name,
            label.shape,
            label.color,
            "training" if label.index in train_rows else "test",
        )
        for label in OBJECTS
    ]
    return table(("index", "name", "shape", "color", "as a named target in scenario A"), rows)


def tasks_table() -> str:
    """The rows of the task table, by kind."""
    counts: dict[str, int] = {}
    examples: dict[str, str] = {}
    for task in TASKS:
        counts[task.kind] = counts.get(task.kind, 0) + 1
        examples.setdefault(task.kind, f"{task.index}: “{task.instruction}”")
    first_color = len(OBJECTS)
    first_shape = first_color + len(COLORS)
    rows_of_kind = {
        "name": (0, first_color - 1),
        "color": (first_color, first_shape - 1),
        "shape": (first_shape, first_shape + len(SHAPES) - 1),
    }
    rows = [
        (kind, f"{first} to {last}", str(counts[kind]), examples[kind])
        for kind, (first, last) in rows_of_kind.items()
    ]
    return table(("object asked for by", "rows", "tasks", "first task"), rows)


def scenarios_table() -> str:
    """The task sets: which rows of the task table each has, and how many tasks."""
    rows_of: Mapping[str, tuple[int, ...]] = {
        name: tuple(sorted({get_task(index).row for index in indices})) for name, indices in TASK_SETS.items()
    }
    rows = [(f"`{name}`", spans(rows_of[name]), str(len(indices))) for name, indices in TASK_SETS.items()]
    return table(("task set", "rows of the task table", "tasks"), rows)


def spans(numbers: Sequence[int]) -> str:
    """Ascending numbers as ranges, such as "0 to 23, 36 to 44"."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in found)


# The sections of each page, by their names.
SECTIONS: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "benchmark.md": {
        "the environment": environment,
        "the environment's options": partial(options, ENVIRONMENT_OPTIONS, prefix="--env."),
        "the tasks": tasks_table,
        "the objects": objects_table,
        "the task sets": scenarios_table,
    },
    "policy.md": {"the policy's options": partial(options, POLICY_OPTIONS, prefix="--policy.")},
}
