"""Files that are either complete or as they were before: written under another name, then renamed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Gives a temporary file to write to, which replaces `path` if the block ends without an error.

    The temporary name is always the same, so that what a killed process leaves is overwritten by the next
    write to `path`. Missing folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def json_text(content: Any, indent: int = 4) -> str:
    """The text of a JSON file. Characters beyond ASCII stay as they are."""
    return json.dumps(content, indent=indent, ensure_ascii=False) + "\n"


def write_json(path: Path, content: Any, indent: int = 4) -> None:
    """Writes a JSON file, atomically, as `json_text` formats it."""
    write_text(path, json_text(content, indent))
