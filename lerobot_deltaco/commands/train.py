"""`deltaco-train`: `lerobot-train` with the frames in memory, and the paper's batches."""

import sys

from lerobot_deltaco.lerobot_internals import UnsupportedLeRobotError
from lerobot_deltaco.training.loop import train


def main() -> None:
    """Trains. The arguments are those of `lerobot-train`."""
    try:
        train()
    except UnsupportedLeRobotError as error:
        sys.exit(f"deltaco-train: {error}")


if __name__ == "__main__":
    main()
