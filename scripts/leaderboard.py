"""Writes the table of docs/leaderboard.md anew, from the committed records and results/leaderboard.yaml."""

from __future__ import annotations

import sys
from pathlib import Path

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco.reporting.leaderboard import PAGE, ROWS_FILE, updated

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Writes the table into the page."""
    page = ROOT / PAGE
    write_text(page, updated(page.read_text(encoding="utf-8"), ROOT))
    sys.stdout.write(f"{PAGE} has the table of {ROWS_FILE}.\n")


if __name__ == "__main__":
    main()
