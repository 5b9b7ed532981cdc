"""`deltaco-gallery`: draws images of the benchmark, and a page that shows them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from gym_deltaco.gallery import DEFAULT_TASKS, MAX_SCENES, draw_gallery
from gym_deltaco.tasks import select_tasks


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command.

    Args:
        arguments: Of the command line; None takes the process's own.
    """
    parser = argparse.ArgumentParser(
        prog="deltaco-gallery",
        description="Draws the benchmark's objects, scenes and expert, and writes a page that shows them.",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write to; made if missing"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the scenes, at least 0; default: %(default)s")
    parser.add_argument(
        "--tasks",
        default=DEFAULT_TASKS,
        metavar="SELECTION",
        help="tasks to show: indices and ranges of 0 to 299, such as 4,50-73, or a set, such as "
        f"scenario_a_test. Of more than {MAX_SCENES}, so many are drawn at random. Default: %(default)s",
    )
    options = parser.parse_args(arguments)

    def fail(message: str) -> NoReturn:
        parser.exit(2, f"{parser.prog}: error: {message}\n")

    if options.seed < 0:
        fail(f"--seed must be at least 0. Got {options.seed}.")
    try:
        task_ids = select_tasks(options.tasks)
    except ValueError as error:
        fail(f"--tasks: {error}")
    if options.out.exists() and not options.out.is_dir():
        fail(f"--out must be a folder. {options.out} is a file.")
    try:
        draw_gallery(options.out, options.seed, task_ids)
    except OSError as error:
        fail(f"cannot write to {options.out}: {error.strerror or error}.")
    sys.stdout.write(f"The images are in {options.out}. Start with {options.out / 'index.md'}.\n")


if __name__ == "__main__":
    main()
