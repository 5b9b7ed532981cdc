"""Sealed scenes: the test of a release, which nobody can look at while the release is made.

Their seed is drawn once, and only the SHA-256 of its file is known. The release puts the file into `FOLDER`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from lerobot_deltaco.errors import UserError

SEALED = "sealed"
FOLDER = Path(__file__).parent  # of the files of seeds
# SHA-256 of the file of each release's seed, the latest one last. docs/evaluation.md says how to draw one.
DIGESTS = ["be1aa1e1bf40729e92f51bcf7bae9aed8aa804bd07b2a9eeceb1f0efe9c22fc8"]


def sealed_splits() -> list[str]:
    """Returns the names of the sealed scene splits, the latest one last."""
    return [f"{SEALED}-{digest[:8]}" for digest in DIGESTS]


def sealed_seed(split: str) -> int:
    """Returns the seed of a sealed scene split.

    Raises:
        UserError: The file with the seed is missing, or is another one.
    """
    expected, path = DIGESTS[sealed_splits().index(split)], FOLDER / f"{split}.txt"
    if not path.is_file():
        raise UserError(
            f"The sealed scenes are closed until the release, which adds the file of their seed, {path} "
            f"(SHA-256 {expected})."
        )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != expected:
        raise UserError(
            f"{path} is not the file of the seed: its SHA-256 is {digest}, and must be {expected}. Take the "
            "file from the release."
        )
    return int(path.read_text(encoding="utf-8"), base=16)
