"""`deltaco-push`: pushes a dataset to the Hugging Face Hub."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.commands.command_errors import exit_on_error


def main(arguments: list[str] | None = None) -> None:
    """Pushes a dataset, or only writes its card."""
    parser = _parser()
    options = parser.parse_args(arguments)
    with exit_on_error(parser):
        # Only here, since they take seconds to import.
        from lerobot_deltaco.cards.dataset_card import CARD_FILE, write_card
        from lerobot_deltaco.data.hub import HubError, check_dataset, check_repo_id, push_dataset
        from lerobot_deltaco.data.integrity import DatasetError
    try:
        check_repo_id(options.repo_id)
    except HubError as error:
        parser.error(str(error))
    interrupted = "Interrupted. Run the same command again to push."
    with exit_on_error(parser, HubError, DatasetError, OSError, interrupted=interrupted):
        if options.card_only:
            check_dataset(options.root)
            write_card(options.root, repo_id=options.repo_id)
            sys.stdout.write(f"The card is {options.root / CARD_FILE}.\n")
        else:
            url = push_dataset(options.root, options.repo_id, options.private, options.branch)
            sys.stdout.write(f"{options.root} is now at {url}.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-push",
        description="Pushes a finished dataset of deltaco-collect, with its card, to the Hugging Face Hub. "
        "Credentials are taken from HF_TOKEN or `hf auth login`.",
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the dataset")
    parser.add_argument(
        "--repo-id", required=True, metavar="USER/NAME", help="name of the dataset on the Hub"
    )
    parser.add_argument("--private", action="store_true", help="create a new repository as private")
    parser.add_argument(
        "--branch",
        help="branch to push to, without tagging the format's version (default: main, tagged)",
    )
    parser.add_argument(
        "--card-only",
        action="store_true",
        help="push nothing; only write README.md and its images into the folder",
    )
    return parser


if __name__ == "__main__":
    main()
