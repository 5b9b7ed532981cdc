"""`deltaco-collect`: the expert's episodes as a LeRobotDataset."""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

from gym_deltaco.layout import AMBIGUITIES
from lerobot_deltaco.data.collection import CollectionError, Summary, collect
from lerobot_deltaco.data.collection_plan import COLLECTED_SPLITS, DATA_SETS, CollectionPlan

_VERIFY_HELP = "only check every byte of a finished dataset, of which just --root is named"


def main(arguments: list[str] | None = None) -> None:
    """Collects, and shows what it came to; or verifies what was collected."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--verify" in arguments:
        _verify(arguments)
        return
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.workers < 1:
        parser.error(f"--workers must be at least 1. Got {options.workers}.")
    try:
        plan = CollectionPlan(
            tasks=options.tasks,
            episodes_per_task=options.episodes_per_task,
            seed=options.seed,
            split=options.split,
            ambiguity=options.ambiguity,
            noise=options.noise,
            image_size=options.image_size,
        )
    except ValueError as error:
        parser.error(str(error))
    _check_sharing(parser, options)
    try:
        summary = collect(options.root, plan, options.workers, options.append)
    except (CollectionError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"\n{parser.prog}: Interrupted. The same command goes on from here.\n")
    sys.stdout.write(_text(summary, options.root))
    if options.summary:
        options.summary.write_text(json.dumps(asdict(summary), indent=2) + "\n")
    _share(parser, options)


def _check_sharing(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Ends the command if it could not push what it is about to collect, perhaps for hours."""
    if options.push_to_hub and options.repo_id is None:
        parser.error("--push-to-hub needs --repo-id USER/NAME.")
    if options.repo_id is None:
        return
    # Here and below, so that the worker processes, which import this module, start quickly.
    from lerobot_deltaco.data.hub import HubError, check_credentials, check_repo_id

    try:
        check_repo_id(options.repo_id)
    except HubError as error:
        parser.error(str(error))
    try:
        if options.push_to_hub:
            check_credentials()
    except HubError as error:
        parser.exit(1, f"{parser.prog}: {error}\n")


def _share(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Writes the card of the finished dataset, and pushes it if that is wanted."""
    from lerobot_deltaco.cards.dataset_card import has_current_card, write_card
    from lerobot_deltaco.data.hub import HubError, push_dataset
    from lerobot_deltaco.data.integrity import DatasetError

    try:
        if not has_current_card(options.root):
            write_card(options.root, repo_id=options.repo_id if options.push_to_hub else None)
        if options.push_to_hub:
            sys.stdout.write(f"It is now at {push_dataset(options.root, options.repo_id)}.\n")
    except DatasetError as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    except (HubError, OSError, KeyboardInterrupt) as error:
        reason = str(error) or "Interrupted."
        parser.exit(1, f"{parser.prog}: {reason} The dataset itself is finished; `deltaco-push` shares it.\n")


def _verify(arguments: list[str]) -> None:
    """Checks every byte of a finished dataset, and says what was found."""
    from lerobot_deltaco.data.finished_dataset import verify_dataset
    from lerobot_deltaco.data.integrity import DatasetError

    parser = argparse.ArgumentParser(
        prog="deltaco-collect", description="Verifies a finished dataset: it is only read."
    )
    parser.add_argument("--verify", action="store_true", required=True, help=_VERIFY_HELP)
    parser.add_argument("--root", type=Path, required=True, help="the dataset's folder")
    options = parser.parse_args(arguments)
    try:
        found = verify_dataset(options.root)
    except (DatasetError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    how = (
        "each has the checksum that was written down when it was collected"
        if found.has_digests
        else "all of them can be read; there are no checksums to compare them with"
    )
    sys.stdout.write(
        f"{options.root}: {found.episodes} episodes in {found.n_files} files, {found.n_bytes / 1e6:.1f} MB: "
        f"{how}.\n"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-collect",
        description="Collects successful episodes of the scripted expert as a LeRobotDataset. "
        "Interrupted, it goes on when the same command is given again.",
    )
    parser.add_argument(
        "--tasks",
        required=True,
        help=f"a task set (scenario_a_train, ...), a named data set ({', '.join(DATA_SETS)}), "
        "or indices and ranges of 0 to 299, such as 4,50-73",
    )
    parser.add_argument("--episodes-per-task", type=int, required=True, metavar="N")
    parser.add_argument("--root", type=Path, required=True, help="the dataset's folder")
    parser.add_argument("--seed", type=int, default=0, help="of the whole dataset (%(default)s)")
    parser.add_argument(
        "--split",
        choices=COLLECTED_SPLITS,
        help="what the episodes are for; their scenes never coincide (that of the data set; else "
        "validation for test and validation tasks, and train)",
    )
    parser.add_argument(
        "--ambiguity",
        choices=AMBIGUITIES,
        default="container",
        help="the paper's scheme i or ii (%(default)s)",
    )
    parser.add_argument("--noise", type=float, default=0.1, help="on the expert's motions (%(default)s)")
    parser.add_argument("--image-size", type=int, default=48, metavar="PX", help="(%(default)s)")
    parser.add_argument(
        "--workers",
        type=int,
        default=os.cpu_count(),
        help="processes; the dataset does not depend on it (%(default)s)",
    )
    parser.add_argument("--repo-id", metavar="USER/NAME", help="the dataset's name on the Hugging Face Hub")
    parser.add_argument(
        "--push-to-hub",
        action="store_true",
        help="then push it there, as deltaco-push does; that needs HF_TOKEN or `hf auth login`",
    )
    parser.add_argument("--append", action="store_true", help="add to a finished dataset")
    parser.add_argument("--verify", action="store_true", help=_VERIFY_HELP)
    parser.add_argument("--summary", type=Path, metavar="FILE", help="also write the summary as JSON")
    return parser


def _text(summary: Summary, root: Path) -> str:
    speed = "nothing to do" if summary.episodes_per_s is None else f"{summary.episodes_per_s:.1f} episodes/s"
    rates = ", ".join(f"{kind} {rate:.1%}" for kind, rate in summary.success_rates.items())
    return (
        f"{root}: {summary.episodes} episodes, {summary.bytes_per_episode * summary.episodes / 1e6:.1f} MB "
        f"({summary.bytes_per_episode / 1e3:.1f} kB each); {speed}.\n"
        f"The expert succeeded in {summary.new_episodes} of {summary.attempts} attempts ({rates}).\n"
    )


if __name__ == "__main__":
    main()
