"""`deltaco-demo`: collects, trains and evaluates on a small set of tasks, and shows what came of it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.demo.page import write_page
from lerobot_deltaco.demo.steps import Demo, DemoError


def main(arguments: list[str] | None = None) -> None:
    """Does what is not done yet."""
    parser = argparse.ArgumentParser(
        prog="deltaco-demo",
        description="In a quarter of an hour on two cores: collects episodes, trains a policy on them with "
        "lerobot-train, and evaluates it with lerobot-eval. Interrupted, the same command goes on.",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/demo"), metavar="DIR", help="where to (%(default)s)"
    )
    options = parser.parse_args(arguments)
    try:
        demo = Demo(options.out)
        for step in (demo.collect, demo.train, demo.evaluate, demo.ask_otherwise):
            step()
        page = write_page(demo)
    except (DemoError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command goes on from here.\n")
    sys.stdout.write(f"\n{(options.out / 'summary.json').read_text()}\nSee {page}.\n")


if __name__ == "__main__":
    main()
