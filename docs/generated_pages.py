"""Pages that are made from the code when the site is built, so that they cannot drift from it.

Docstrings are read without importing their modules, which takes neither PyBullet nor LeRobot.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from gym_deltaco.tasks import COLORS, OBJECTS, SCENARIOS, SHAPES, TASK_SETS, TASKS, get_task

ROOT = Path(__file__).parents[1]
ENVIRONMENT = "PickPlaceEnv"
ENVIRONMENT_OPTIONS = "DeltacoEnv"
POLICY_OPTIONS = "DeltacoConfig"
PACKAGES = {
    "gym_deltaco": ROOT / "envs" / "gym_deltaco",
    "lerobot_deltaco": ROOT / "lerobot_deltaco",
}
# The command line and the demo are described by their own pages and `--help`.
WITHOUT_API = ("lerobot_deltaco.commands", "lerobot_deltaco.demo")


class Documented(NamedTuple):
    """Documentation of a class, read from its source."""

    text: str  # Markdown, up to the sections
    arguments: dict[str, str]  # descriptions, in the docstring's order
    types: dict[str, str]  # of the fields of a dataclass, or of the constructor's arguments
    defaults: dict[str, str]


def write(docs: Path) -> list[Path]:
    """Writes all generated files into the documentation's folder, and removes those of an earlier build.

    Args:
        docs: The folder of the documentation.

    Returns:
        The files.
    """
    texts = {
        "generated/environment.md": environment(),
        "generated/environment_options.md": options(ENVIRONMENT_OPTIONS, prefix="--env."),
        "generated/policy_options.md": options(POLICY_OPTIONS, prefix="--policy."),
        "generated/objects.md": objects_table(),
        "generated/tasks.md": tasks_table(),
        "generated/scenarios.md": scenarios_table(),
        **{f"api/generated/{name}.md": text for name, text in api_pages().items()},
    }
    for folder in ("generated", "api/generated"):
        (docs / folder).mkdir(parents=True, exist_ok=True)
        for path in (docs / folder).glob("*.md"):
            if path.relative_to(docs).as_posix() not in texts:
                path.unlink()
    for name, text in texts.items():
        path = docs / name
        # An unchanged file keeps its date, so that Sphinx does not read it again.
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return [docs / name for name in texts]


# Docstrings


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
    defaults: dict[str, str] = {}
    for statement in node.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            types[statement.target.id] = ast.unparse(statement.annotation)
            if statement.value is not None:
                defaults[statement.target.id] = ast.unparse(statement.value)
        elif isinstance(statement, ast.FunctionDef) and statement.name == "__init__":
            arguments = statement.args.args
            n_required = len(arguments) - len(statement.args.defaults)
            for k, argument in enumerate(arguments):
                types[argument.arg] = ast.unparse(argument.annotation) if argument.annotation else ""
                if k >= n_required:
                    defaults[argument.arg] = ast.unparse(statement.args.defaults[k - n_required])
    text, *rest = re.split(r"^(?=(?:Args|Attributes|Raises|Returns):$)", docstring, flags=re.MULTILINE)
    section = next((part for part in rest if part.startswith("Args:")), "Args:")
    return Documented(text.strip(), _arguments(section), types, defaults)


def _class(name: str) -> ast.ClassDef:
    for folder in PACKAGES.values():
        for path in sorted(folder.rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if f"class {name}" not in text:
                continue
            for node in ast.parse(text).body:
                if isinstance(node, ast.ClassDef) and node.name == name:
                    return node
    raise LookupError(f"There is no class {name} in {', '.join(PACKAGES)}.")


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
    """The specification of the environment: its docstring, with its arguments as a table."""
    spec = documented(ENVIRONMENT)
    rows = [
        (f"`{name}`", f"`{spec.defaults[name]}`", description) for name, description in spec.arguments.items()
    ]
    return f"{spec.text}\n\n## Arguments\n\n{table(('argument', 'default', 'meaning'), rows)}"


def options(name: str, prefix: str) -> str:
    """The options of a configuration, as a definition list.

    Args:
        name: Name of the dataclass.
        prefix: Prefix of an option on the command line, such as "--policy.".
    """
    spec = documented(name)
    entries = []
    for option, description in spec.arguments.items():
        kind = spec.types[option].replace(" | None", "")
        entries.append(f"`{prefix}{option}` ({kind}, {_default(spec.defaults[option])})\n: {description}\n")
    return "\n".join(entries)


def _default(source: str) -> str:
    """A default value as the command line takes it."""
    if source == "None":
        return "not set by default"
    try:
        value = ast.literal_eval(source)
    except ValueError:
        value = _constant(source)
    return f"default `{str(value).lower() if isinstance(value, bool) else value}`"


def _constant(name: str) -> str:
    """The value of a constant that is assigned a literal anywhere in the packages; else its name."""
    for folder in PACKAGES.values():
        for path in sorted(folder.rglob("*.py")):
            found = re.search(rf"^{name} = ([\w.'\"-]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
            if found:
                return found[1].strip("'\"")
    return name


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
    spans = {
        "name": (0, first_color - 1),
        "color": (first_color, first_shape - 1),
        "shape": (first_shape, first_shape + len(SHAPES) - 1),
    }
    rows = [
        (kind, f"{first} to {last}", str(counts[kind]), examples[kind])
        for kind, (first, last) in spans.items()
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


# API reference


def api_pages() -> dict[str, str]:
    """A page for each package, with all of its public modules."""
    pages: dict[str, str] = {}
    for package, folder in PACKAGES.items():
        for init in sorted(folder.rglob("__init__.py")):
            name = ".".join([package, *init.parent.relative_to(folder).parts])
            if name.startswith(WITHOUT_API):
                continue
            files = [init, *sorted(path for path in init.parent.glob("*.py") if path.name[0] != "_")]
            modules = [name if path == init else f"{name}.{path.stem}" for path in files]
            pages[name] = _api_page(name, modules)
    return pages


def _api_page(package: str, modules: Sequence[str]) -> str:
    parts = [f"# `{package}`"]
    for module in modules:
        if module != package:
            parts.append(f"## `{module.removeprefix(package + '.')}`")
        parts.append(f"```{{eval-rst}}\n.. automodule:: {module}\n```")
    return "\n\n".join(parts) + "\n"
