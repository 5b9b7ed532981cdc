"""Checksums of files: damage is found where a file is read, not where its contents are used.

Files of a collection under way carry the SHA-256 of their own contents. Those of a finished dataset are
listed in `meta/SHA256SUMS`, in the format of the command `sha256sum`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gym_deltaco.atomic_files import atomic_write

DIGESTS_FILE = Path("meta/SHA256SUMS")
_DIGEST_BYTES = hashlib.sha256().digest_size
_HEX_DIGITS = set("0123456789abcdef")


class DatasetError(ValueError):
    """A dataset, or a file of it, is not what it must be; the message says what is wrong, and what to do."""


def damaged(path: Path, reason: object, remedy: str) -> DatasetError:
    """The error that names a damaged file.

    Args:
        path: The file.
        reason: The reason, such as an exception.
        remedy: Advice to the user, as a sentence.
    """
    return DatasetError(f"The file {path} is damaged or missing ({reason}). {remedy}")


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# Files that carry the checksum of their contents


def write_checked(path: Path, contents: bytes) -> None:
    """Writes contents, followed by their SHA-256."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(contents)
        file.write(hashlib.sha256(contents).digest())


def read_checked(path: Path, remedy: str) -> bytes:
    """Contents of a file that `write_checked` wrote.

    Args:
        path: The file.
        remedy: Advice to the user if it is damaged, as a sentence.

    Raises:
        DatasetError: The file is missing, or its contents do not have their checksum.
    """
    try:
        stored = path.read_bytes()
    except OSError as error:
        raise damaged(path, error, remedy) from None
    contents, digest = stored[:-_DIGEST_BYTES], stored[-_DIGEST_BYTES:]
    if hashlib.sha256(contents).digest() != digest:
        raise damaged(path, "its contents do not have their checksum", remedy)
    return contents


def write_checked_json(path: Path, contents: Any) -> None:
    """Writes a JSON file that carries the SHA-256 of its contents."""
    text = json.dumps(contents)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({"sha256": _text_digest(text), "contents": text}) + "\n")


def read_checked_json(path: Path, remedy: str) -> Any:
    """Contents of a file that `write_checked_json` wrote.

    Args:
        path: The file.
        remedy: Advice to the user if it is damaged, as a sentence.

    Raises:
        DatasetError: The file is missing, or its contents do not have their checksum.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        text = stored["contents"]
        is_whole = stored["sha256"] == _text_digest(text)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise damaged(path, error, remedy) from None
    if not is_whole:
        raise damaged(path, "its contents do not have their checksum", remedy)
    return json.loads(text)


def _text_digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# The list of a finished dataset's checksums


def write_digests(root: Path, digests: Mapping[str, str]) -> None:
    """Writes the list of a dataset's checksums.

    Args:
        root: The dataset's folder.
        digests: SHA-256 of each file in hexadecimal digits, by the file's path in the folder.
    """
    with atomic_write(root / DIGESTS_FILE) as temporary:
        temporary.write_text("".join(f"{digests[name]}  {name}\n" for name in sorted(digests)))


def read_digests(root: Path) -> dict[str, str] | None:
    """The list of a dataset's checksums, by path; None if the dataset has none.

    Raises:
        DatasetError: The list is not one of checksums.
    """
    path = root / DIGESTS_FILE
    if not path.exists():
        return None
    digests: dict[str, str] = {}
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            digest, name = line.split("  ", maxsplit=1)
            parts = Path(name).parts
            if len(digest) != 2 * _DIGEST_BYTES or not set(digest) <= _HEX_DIGITS:
                raise ValueError(f"no checksum: {digest!r}")
            if not parts or parts[0] not in ("data", "meta") or ".." in parts or name in digests:
                raise ValueError(f"no file of a dataset, or named twice: {name!r}")
            digests[name] = digest
    except (OSError, ValueError) as error:
        remedy = "Copy the dataset again, or collect it again in a new folder."
        raise damaged(path, error, remedy) from None
    return digests
