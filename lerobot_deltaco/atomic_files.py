"""Writes files whole or not at all: under another name first, then renamed. Reads JSON. Locks folders."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_deltaco.errors import UserError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path that replaces `path` once the block has ended without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Prevents other processes from writing to a folder until the block, or this process, has ended.

    Processes that are forked meanwhile keep the lock, too, until they end.

    Args:
        folder: The folder, which is made if it does not exist. No file is added.

    Raises:
        UserError: Another process writes to it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(
                f"Another process is writing to {folder}. Wait until it has ended, or name another folder."
            ) from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any, indent: int = 4) -> None:
    """Writes a JSON file."""
    write_text(path, json.dumps(content, indent=indent, ensure_ascii=False) + "\n")


def parse_json(text: str | bytes, source: object) -> Any:
    """Returns the content of a text of JSON.

    Args:
        text: The text, in UTF-8.
        source: Origin of the text, for the error message.

    Raises:
        ValueError: The text is not JSON, or nested too deeply.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{source} is not valid JSON: {error}.") from None


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is not JSON.
    """
    return parse_json(path.read_bytes(), path)
