"""Writes what the documentation's pages have from the records and from the code anew.

These are the tables of docs/leaderboard.md and docs/paper.md, from the committed records, and the
specification, options and tables of docs/benchmark.md and docs/policy.md, from the code.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco import leaderboard

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))

import generated_sections  # noqa: E402


def main() -> None:
    """Writes the tables and sections into the pages."""
    updates = {
        ROOT / leaderboard.LEADERBOARD_PAGE: partial(_with_records, make=leaderboard.leaderboard),
        ROOT / leaderboard.PAPER_PAGE: partial(_with_records, make=leaderboard.paper_tables),
        **{
            DOCS / name: partial(generated_sections.updated, name=name)
            for name in generated_sections.SECTIONS
        },
    }
    for path, update in updates.items():
        write_text(path, update(path.read_text(encoding="utf-8")))
        sys.stdout.write(f"{path.relative_to(ROOT)} is up to date.\n")


def _with_records(page: str, make: Callable[[Path], str]) -> str:
    return leaderboard.replace_section(page, leaderboard.BEGIN, leaderboard.END, make(ROOT))


if __name__ == "__main__":
    main()
