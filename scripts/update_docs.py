"""Writes the tables of docs/leaderboard.md and docs/paper.md anew from the committed records."""

from __future__ import annotations

import sys
from pathlib import Path

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco.leaderboard import (
    BEGIN,
    END,
    LEADERBOARD_PAGE,
    PAPER_PAGE,
    leaderboard,
    paper_tables,
    replace_section,
)

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Writes the tables into the pages."""
    for page, make in ((LEADERBOARD_PAGE, leaderboard), (PAPER_PAGE, paper_tables)):
        path = ROOT / page
        text = path.read_text(encoding="utf-8")
        write_text(path, replace_section(text, BEGIN, END, make(ROOT)))
        sys.stdout.write(f"{page} is up to date.\n")


if __name__ == "__main__":
    main()
