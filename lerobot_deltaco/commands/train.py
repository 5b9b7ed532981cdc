"""`deltaco-train`: `lerobot-train` with the frames in memory, and the paper's batches."""

from lerobot_deltaco.training.loop import train


def main() -> None:
    """Trains. The arguments are those of `lerobot-train`."""
    train()


if __name__ == "__main__":
    main()
