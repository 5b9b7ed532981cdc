"""`deltaco-instructions`: downloads the instructions that people wrote, and checks files of instructions."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gym_deltaco.instructions import (
    INSTRUCTION_SPLITS,
    InstructionsError,
    bare_name_instructions,
    read_instructions,
    split_instructions,
    write_instructions,
)
from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.data.authors_instructions import AUTHORS_URL, fetch_instructions


def main(arguments: list[str] | None = None) -> None:
    """Downloads instructions, or checks a file of them, and says how many there are."""
    parser = _parser()
    options = parser.parse_args(arguments)
    with exit_on_error(parser, InstructionsError, OSError):
        if options.check is None:
            if options.out.exists():
                parser.error(f"{options.out} already exists. Check it with --check {options.out}.")
            if options.bare_names:
                write_instructions(options.out, bare_name_instructions())
            else:
                fetch_instructions(options.out, options.url)
        path = options.check or options.out
        instructions = read_instructions(path)
    lines = [f"{path}: distinct instructions of {len(instructions)} tasks"]
    for split in INSTRUCTION_SPLITS:
        chosen = split_instructions(instructions, split)
        lines.append(f"  {split}: {sum(map(len, chosen.values()))} of {len(chosen)} tasks")
    sys.stdout.write("\n".join(lines) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-instructions",
        description="Downloads the 1,500 instructions that the paper's authors collected from people, five "
        "for each task, and checks them; or checks a file of your own: CSV with the columns task_id and "
        "instruction. Use the file with deltaco-evaluate --instructions, --env.instructions and "
        "--policy.instructions.",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("human_instructions.csv"),
        metavar="FILE",
        help="file to write (default: %(default)s)",
    )
    parser.add_argument("--url", default=AUTHORS_URL, help="address to download from (default: %(default)s)")
    parser.add_argument(
        "--bare-names",
        action="store_true",
        help="instead of downloading, write instructions that name objects without color and shape, as the "
        "authors' code does in ambiguity scheme (ii); use them with the split all",
    )
    parser.add_argument("--check", type=Path, metavar="FILE", help="only check this file")
    return parser


if __name__ == "__main__":
    main()
