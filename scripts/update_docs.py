"""Writes the tables of docs/leaderboard.md and docs/paper.md anew from the committed records."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco.reporting.leaderboard import PAGE, updated
from lerobot_deltaco.reporting.paper_table import PAPER_PAGE, updated_paper_page

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Writes the tables into the pages."""
    updates = {
        ROOT / PAGE: partial(updated, root=ROOT),
        ROOT / PAPER_PAGE: partial(updated_paper_page, root=ROOT),
    }
    for path, update in updates.items():
        write_text(path, update(path.read_text(encoding="utf-8")))
        sys.stdout.write(f"{path.relative_to(ROOT)} is up to date.\n")


if __name__ == "__main__":
    main()
