"""`deltaco-push`: shares a dataset on the Hugging Face Hub."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.cards.dataset_card import CARD_FILE, write_card
from lerobot_deltaco.data.hub import HubError, check_dataset, check_repo_id, push_dataset
from lerobot_deltaco.data.integrity import DatasetError


def main(arguments: list[str] | None = None) -> None:
    """Pushes a dataset, or only writes its card."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        check_repo_id(options.repo_id)
    except HubError as error:
        parser.error(str(error))
    try:
        if options.card_only:
            check_dataset(options.root)
            write_card(options.root, repo_id=options.repo_id)
            sys.stdout.write(f"The card is {options.root / CARD_FILE}.\n")
        else:
            url = push_dataset(options.root, options.repo_id, options.private, options.branch)
            sys.stdout.write(f"{options.root} is now at {url}.\n")
    except (HubError, DatasetError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command pushes again.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-push",
        description="Pushes a finished dataset of deltaco-collect, with its card, to the Hugging Face Hub. "
        "The Hub's credentials are taken from HF_TOKEN or `hf auth login`.",
    )
    parser.add_argument("--root", type=Path, required=True, help="the dataset's folder")
    parser.add_argument("--repo-id", required=True, metavar="USER/NAME", help="its name on the Hub")
    parser.add_argument("--private", action="store_true", help="make a new repository for its owner only")
    parser.add_argument(
        "--branch", help="push to this branch, and leave the version's tag alone (main, tagged)"
    )
    parser.add_argument(
        "--card-only",
        action="store_true",
        help="push nothing: only write README.md and its images into the folder",
    )
    return parser


if __name__ == "__main__":
    main()
