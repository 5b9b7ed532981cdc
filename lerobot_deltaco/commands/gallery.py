"""`deltaco-gallery`: draws images of the benchmark, and a page that shows them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, check_scenes, select_objects
from gym_deltaco.random_objects import FIRST_INDEX
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.commands.command_errors import exit_on_error

# All kinds of tasks with various containers: six names, three colors, three shapes.
DEFAULT_TASKS = "4,64,123,179,231,258,33,234,187,90,144,296"
MAX_SCENES = 12


def main(arguments: Sequence[str] | None = None) -> None:
    """Draws the images and writes the page."""
    parser = _parser()
    options = parser.parse_args(arguments)

    def fail(message: str) -> NoReturn:
        parser.exit(2, f"{parser.prog}: error: {message}\n")

    if options.seed < 0:
        fail(f"--seed must be at least 0. Got {options.seed}.")
    try:
        task_ids = select_tasks(options.tasks)
        check_scenes(task_ids, "all", ADVERSARIAL_PROBABILITY)
    except ValueError as error:
        fail(f"--tasks: {error}")
    try:
        labels = select_objects(options.objects)
    except ValueError as error:
        fail(f"--objects: {error}")
    random_objects = [label for label in labels if label.index >= FIRST_INDEX]
    if options.out.exists() and not options.out.is_dir():
        fail(f"--out must be a folder. {options.out} is a file.")
    with exit_on_error(parser, interrupted="Interrupted."):
        from gym_deltaco.gallery import draw_gallery  # imports the simulator

        try:
            draw_gallery(options.out, options.seed, task_ids, MAX_SCENES, random_objects)
        except OSError as error:
            fail(f"cannot write to {options.out}: {error.strerror or error}.")
    sys.stdout.write(f"The images are in {options.out}. Start with {options.out / 'index.md'}.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-gallery",
        description="Draws the benchmark's objects, scenes and expert, and writes a page that shows them.",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write to; created if missing"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the scenes, at least 0 (default: %(default)s)"
    )
    parser.add_argument(
        "--tasks",
        default=DEFAULT_TASKS,
        metavar="SELECTION",
        help="tasks to show: task set, such as scenario_a_test, or indices and ranges, such as "
        f"4,50-73; {MAX_SCENES} tasks are drawn at random from a larger selection (default: %(default)s)",
    )
    parser.add_argument(
        "--objects",
        default="all",
        metavar="SET",
        help="set of objects, whose random objects are also drawn: random:N has N - 24 of them "
        "(default: %(default)s, which has none)",
    )
    return parser


if __name__ == "__main__":
    main()
