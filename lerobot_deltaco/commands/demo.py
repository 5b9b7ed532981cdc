"""`deltaco-demo`: collects, trains and evaluates on a small set of tasks, and shows the result on a page."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.demo.commands import start_imports, wait_for_imports


def main(arguments: list[str] | None = None) -> None:
    """Runs the steps that are not finished yet."""
    parser = argparse.ArgumentParser(
        prog="deltaco-demo",
        description="Collects episodes, trains a policy on them with deltaco-train and evaluates it with "
        "lerobot-eval, in about 5 minutes on two idle cores. After an interruption, the same command "
        "continues.",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/demo"),
        metavar="DIR",
        help="folder for all outputs (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    start_imports()
    with exit_on_error(parser):
        # Only here, since they take seconds to import.
        from lerobot_deltaco.demo.page import write_page
        from lerobot_deltaco.demo.steps import Demo, DemoError

        wait_for_imports()  # or the demo's measurements of this machine would be disturbed
    with exit_on_error(parser, DemoError, OSError):
        demo = Demo(options.out)
        for step in (demo.collect, demo.train, demo.evaluate):
            step()
        page = write_page(demo)
    sys.stdout.write(f"\n{(options.out / 'summary.json').read_text()}\nSee {page}.\n")


if __name__ == "__main__":
    main()
