"""`deltaco-match`: adds matching by pretrained features to a trained policy, or fits it anew."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_deltaco.commands.command_errors import exit_on_error


def main(arguments: list[str] | None = None) -> None:
    """Fits the matching to a dataset, and saves the policy with it."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.out.exists():
        parser.error(f"{options.out} exists. Name a new folder with --out.")
    # Only here, since they take seconds to import.
    from lerobot_deltaco.policy.task_file import TaskFileError
    from lerobot_deltaco.policy.vision import VisionEncoderError
    from lerobot_deltaco.training.added_matching import add_matching

    with exit_on_error(
        parser,
        ValueError,
        OSError,
        TaskFileError,
        VisionEncoderError,
        interrupted="Interrupted. Nothing was saved.",
    ):
        n_episodes = add_matching(
            options.policy, options.dataset_repo_id, options.dataset_root, options.out, options.seed
        )
    sys.stdout.write(
        f"{options.out}: the policy of {options.policy}, with matching fitted to {n_episodes:,} episodes. "
        f"Evaluate it with --policy.path={options.out}.\n"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-match",
        description="Adds matching by pretrained features (pretrained_matching) to a policy that was trained "
        "without it, or fits it anew: the policy then also looks for what a demonstration moved by the "
        "features of EfficientNet-Lite0. The policy's other weights stay as they are. It takes minutes and "
        "needs the extra `offline`.",
    )
    parser.add_argument(
        "policy",
        type=Path,
        metavar="CHECKPOINT",
        help="folder of a checkpoint with demo_encoder=correspondence",
    )
    parser.add_argument(
        "--dataset.root",
        dest="dataset_root",
        type=Path,
        metavar="DIR",
        help="folder of the training dataset (default: LeRobot's cache)",
    )
    parser.add_argument(
        "--dataset.repo_id",
        dest="dataset_repo_id",
        default="deltaco/training",
        metavar="USER/NAME",
        help="name of the training dataset (default: %(default)s). If it is the one that the policy was "
        "trained on, by its name or its folder, episodes that the training held back are left out",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder of the checkpoint")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draws (default: %(default)s)")
    return parser


if __name__ == "__main__":
    main()
