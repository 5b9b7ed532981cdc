"""Writes the tables of docs/leaderboard.md and docs/paper.md anew, from the committed records."""

from __future__ import annotations

import sys
from pathlib import Path

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco.reporting.leaderboard import PAGE, updated
from lerobot_deltaco.reporting.paper_table import PAPER_PAGE, updated_paper_page

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Writes the tables into the pages."""
    for page, update in ((PAGE, updated), (PAPER_PAGE, updated_paper_page)):
        path = ROOT / page
        write_text(path, update(path.read_text(encoding="utf-8"), ROOT))
        sys.stdout.write(f"{page} has the tables of the records.\n")


if __name__ == "__main__":
    main()
