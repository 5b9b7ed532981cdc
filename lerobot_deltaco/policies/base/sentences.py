"""Reads other sentences for the tasks of a dataset, as people would word them."""

from __future__ import annotations

import csv
from pathlib import Path

from lerobot_deltaco.errors import UserError

_COLUMNS = ("task", "instruction")


def read_sentences(path: str | Path) -> dict[str, tuple[str, ...]]:
    """Reads sentences by task string.

    Args:
        path: CSV file in UTF-8 with the columns `task` and `instruction`, one sentence per row.

    Raises:
        ValueError: The file cannot be read, has other columns, or no or an empty sentence; the message names
            the line.
    """
    sentences: dict[str, list[str]] = {}
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, strict=True)
            if set(reader.fieldnames or ()) != set(_COLUMNS):
                raise UserError(
                    f"{path} must have the columns {' and '.join(_COLUMNS)}. Got "
                    f"{', '.join(reader.fieldnames or ()) or 'none'}."
                )
            for row in reader:
                task, instruction = (" ".join((row[name] or "").split()) for name in _COLUMNS)
                if None in row or not (task and instruction):
                    raise UserError(
                        f"{path}, line {reader.line_num}: expected a task and a sentence. Put those with "
                        "a comma between double quotes."
                    )
                sentences.setdefault(task, []).append(instruction)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"Cannot read the paraphrases {path}: {error}.") from error
    if not sentences:
        raise UserError(f"{path} has no sentences.")
    return {task: tuple(dict.fromkeys(own)) for task, own in sentences.items()}
