"""Turns the project's docstrings, Google sections around Markdown, into what Sphinx reads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

_SECTION = re.compile(r"(Args|Attributes|Example|Examples|Note|Raises|Returns|Yields):$")
_CODE = re.compile(r"(`+[^`]+`+)")


def to_restructured_text(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Converts a docstring in place: code spans, headings, tables and indented diagrams.

    Args:
        app: The Sphinx application.
        what: Kind of the object, such as "class".
        name: Full name of the object.
        obj: The object.
        options: Options of the directive.
        lines: Lines of the docstring.
    """
    lines[:] = list(_converted(lines))


def skip_named_tuple_fields(
    app: Any, what: str, name: str, obj: Any, skip: bool, options: Any
) -> bool | None:
    """Leaves out the fields of named tuples, of which Python only says "Alias for field number 0"."""
    return True if str(getattr(obj, "__doc__", "")).startswith("Alias for field number") else None


def _converted(lines: list[str]) -> Iterator[str]:
    n = 0
    in_section = False
    while n < len(lines):
        line = lines[n]
        in_section = (in_section and (not line or line.startswith(" "))) or bool(_SECTION.match(line))
        if line.startswith("|"):
            end = n
            while end < len(lines) and lines[end].startswith("|"):
                end += 1
            yield from _table(lines[n:end])
            n = end
        elif line.startswith(" ") and not in_section and (n == 0 or not lines[n - 1].strip()):
            end = n
            while end < len(lines) and (not lines[end].strip() or lines[end].startswith(" ")):
                end += 1
            yield from [".. code-block:: text", "", *lines[n:end], ""]
            n = end
        elif heading := re.match(r"#+ (.+)", line):
            yield from [f"**{heading[1]}**", ""]
            n += 1
        elif line.startswith("```"):
            end = next(k for k in range(n + 1, len(lines)) if lines[k].startswith("```"))
            yield from ["::", "", *(f"    {code}" for code in lines[n + 1 : end]), ""]
            n = end + 1
        else:
            yield _inline(line)
            n += 1


def _inline(text: str) -> str:
    """Escapes what only reStructuredText reads as markup, outside of code spans."""
    parts = _CODE.split(text)
    for k, part in enumerate(parts):
        if k % 2:
            parts[k] = f"``{part.strip('`').strip()}``"
            # A code span that touches a word or another mark needs a separator.
            if k + 1 < len(parts) and re.match(r"[\w(]", parts[k + 1]):
                parts[k] += r"\ "
            if re.search(r"\w$", parts[k - 1]):
                parts[k] = r"\ " + parts[k]
        else:
            parts[k] = re.sub(r"([*|]|(?<=\w)_(?!\w))", r"\\\1", part)
    return "".join(parts)


def _table(rows: list[str]) -> Iterator[str]:
    cells = [[cell.strip() for cell in row.strip().strip("|").split("|")] for row in rows]
    cells = [row for row in cells if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    yield from [".. list-table::", "   :header-rows: 1", ""]
    for row in cells:
        for k, cell in enumerate(row):
            yield f"   {'* -' if k == 0 else '  -'} {_inline(cell)}"
    yield ""
