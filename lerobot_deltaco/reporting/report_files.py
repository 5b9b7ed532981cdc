"""The files of a report: CSV, tables in Markdown, and a folder in which all of them are replaced together."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gym_deltaco.atomic_files import atomic_write


def csv_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """A CSV file. Floats are rounded to six digits.

    Args:
        rows: At least one; all have the columns of the first.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {name: round(value, 6) if isinstance(value, float) else value for name, value in row.items()}
        )
    return text.getvalue().encode()


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, which ends with a line break."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def write_files(out: Path, contents: Mapping[str, bytes], all_names: Iterable[str]) -> None:
    """Puts all files in place once all of them are written.

    Args:
        out: Folder; it is created.
        contents: Content of each file, by its name.
        all_names: Names of the files that such a report may have. Those that this one does not have are
            removed.

    Raises:
        OSError: A file cannot be written; then none is replaced.
    """
    with ExitStack() as stack:
        for name, content in contents.items():
            stack.enter_context(atomic_write(out / name)).write_bytes(content)
    for name in set(all_names) - set(contents):
        (out / name).unlink(missing_ok=True)
