"""`deltaco-experiment`: a row of the tables, from its data to its evaluation."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_deltaco.experiments.rows import RowError, read_row
from lerobot_deltaco.experiments.run import Experiment, ExperimentError


def main(arguments: list[str] | None = None) -> None:
    """Runs what of the row is not done yet."""
    parser = argparse.ArgumentParser(
        prog="deltaco-experiment",
        description="Collects the data of a row, trains, and evaluates every checkpoint. Interrupted, it "
        "goes on when the same command is given again.",
    )
    parser.add_argument("row", help="such as scenario_a/deltaco")
    parser.add_argument("--seed", type=int, default=0, help="of the training (%(default)s)")
    parser.add_argument(
        "--experiments",
        type=Path,
        default=Path("experiments"),
        metavar="DIR",
        help="with the rows' files (%(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/experiments"), metavar="DIR", help="where to (%(default)s)"
    )
    options = parser.parse_args(arguments)
    try:
        row = read_row(options.experiments, options.row)
    except RowError as error:
        parser.error(str(error))
    try:
        Experiment(row, options.seed, options.out).do()
    except (ExperimentError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command goes on from here.\n")


if __name__ == "__main__":
    main()
