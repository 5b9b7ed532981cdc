"""`deltaco-collect`: collects episodes of the scripted expert as a LeRobotDataset, and verifies datasets."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gym_deltaco import EXPERT_NOISE, MIN_IMAGE_SIZE
from gym_deltaco.atomic_files import write_json
from gym_deltaco.layout import AMBIGUITIES
from gym_deltaco.object_sets import ADVERSARIAL_DRAWS, ADVERSARIAL_PROBABILITY
from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.data.collection_plan import COLLECTED_SPLITS, DATA_SETS, CollectionPlan

# What takes long to import is imported where it is used, so that --help and worker processes start quickly.
if TYPE_CHECKING:
    from lerobot_deltaco.data.collection import Summary

_VERIFY_HELP = "only check every byte of a finished dataset; takes no other argument than --root"


def main(arguments: list[str] | None = None) -> None:
    """Collects a dataset, or verifies one."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--verify" in arguments:
        _verify(arguments)
        return
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.workers < 1:
        parser.error(f"--workers must be at least 1. Got {options.workers}.")
    with exit_on_error(parser):
        from lerobot_deltaco.data.collection import CollectionError, collect
    try:
        plan = CollectionPlan(
            tasks=options.tasks,
            episodes_per_task=options.episodes_per_task,
            seed=options.seed,
            split=options.split,
            ambiguity=options.ambiguity,
            noise=options.noise,
            image_size=options.image_size,
            objects=options.objects,
            adversarial_probability=options.adversarial_probability,
            adversarial_draw=options.adversarial_draw,
        )
    except ValueError as error:
        parser.error(str(error))
    _check_summary(parser, options)
    if options.append and (options.join or options.shard):
        parser.error("--append adds to a finished dataset. It cannot be combined with --shard and --join.")
    if options.shard is not None:
        _collect_shard(parser, options, plan)
        return
    _check_sharing(parser, options)
    with exit_on_error(parser, CollectionError, OSError):
        if options.join:
            from lerobot_deltaco.data.shards import join_shards

            summary = join_shards(options.root, plan, options.workers)
        else:
            summary = collect(options.root, plan, options.workers, options.append)
    sys.stdout.write(_text(summary, options.root))
    _write_summary(parser, options.summary, asdict(summary))
    _share(parser, options)


def _check_summary(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Ends the command before it collects, if it could not write the summary."""
    file: Path | None = options.summary
    if file is None:
        return
    if not file.parent.is_dir() and file.parent.resolve() != options.root.resolve():
        parser.error(f"--summary is {file}, but there is no folder {file.parent}. Make it first.")
    if file.is_dir():
        parser.error(f"--summary is {file}, which is a folder. Name a file in it.")


def _write_summary(parser: argparse.ArgumentParser, file: Path | None, contents: dict[str, Any]) -> None:
    if file is None:
        return
    with exit_on_error(parser, OSError):
        write_json(file, contents, indent=2)


def _collect_shard(
    parser: argparse.ArgumentParser, options: argparse.Namespace, plan: CollectionPlan
) -> None:
    """Collects a part of the dataset, into a folder beside it."""
    from lerobot_deltaco.data.collection import CollectionError
    from lerobot_deltaco.data.shards import Shard, collect_shard

    if options.push_to_hub:
        parser.error("A shard is no dataset yet: push with --join.")
    try:
        shard = Shard.parse(options.shard)
    except ValueError as error:
        parser.error(str(error))
    with exit_on_error(parser, CollectionError, OSError):
        summary = collect_shard(options.root, plan, shard, options.workers)
    speed = "nothing to do" if summary.episodes_per_s is None else f"{summary.episodes_per_s:.1f} episodes/s"
    sys.stdout.write(
        f"{summary.folder}: {summary.episodes} of {summary.all_episodes} episodes; {speed}.\n"
        "When all shards are there, join them: the same command with --join instead of --shard.\n"
    )
    _write_summary(parser, options.summary, {**asdict(summary), "folder": str(summary.folder)})


def _check_sharing(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Ends the command before it collects, perhaps for hours, what it could not push."""
    if options.push_to_hub and options.repo_id is None:
        parser.error("--push-to-hub needs --repo-id USER/NAME.")
    if options.repo_id is None:
        return
    from lerobot_deltaco.data.hub import HubError, check_credentials, check_repo_id

    try:
        check_repo_id(options.repo_id)
    except HubError as error:
        parser.error(str(error))
    if options.push_to_hub:
        with exit_on_error(parser, HubError):
            check_credentials()


def _share(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Writes the card of the finished dataset, and pushes both if `--push-to-hub` is given."""
    from lerobot_deltaco.cards.dataset_card import has_current_card, write_card
    from lerobot_deltaco.data.hub import HubError, push_dataset
    from lerobot_deltaco.data.integrity import DatasetError

    rest = "The dataset itself is complete; `deltaco-push` pushes it."
    with exit_on_error(parser, DatasetError, interrupted=f"Interrupted. {rest}"):
        try:
            if not has_current_card(options.root):
                write_card(options.root, repo_id=options.repo_id if options.push_to_hub else None)
            if options.push_to_hub:
                url = push_dataset(options.root, options.repo_id)
                sys.stdout.write(f"The dataset is at {url}.\n")
        except (HubError, OSError) as error:
            parser.exit(1, f"{parser.prog}: {error} {rest}\n")


def _verify(arguments: list[str]) -> None:
    """Checks every byte of a finished dataset."""
    parser = argparse.ArgumentParser(
        prog="deltaco-collect", description="Verifies a finished dataset, without changing it."
    )
    parser.add_argument("--verify", action="store_true", required=True, help=_VERIFY_HELP)
    parser.add_argument("--root", type=Path, required=True, help="folder of the dataset")
    options = parser.parse_args(arguments)
    from lerobot_deltaco.data.finished_dataset import verify_dataset
    from lerobot_deltaco.data.integrity import DatasetError

    with exit_on_error(parser, DatasetError, OSError, interrupted="Interrupted."):
        found = verify_dataset(options.root)
    how = (
        "all have the checksums that were recorded when they were collected"
        if found.has_digests
        else "all can be read; there are no checksums to compare them with"
    )
    sys.stdout.write(
        f"{options.root}: {found.episodes} episodes in {found.n_files} files, {found.n_bytes / 1e6:.1f} MB: "
        f"{how}.\n"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-collect",
        description="Collects successful episodes of the scripted expert as a LeRobotDataset. After an "
        "interruption, the same command continues.",
    )
    parser.add_argument(
        "--tasks",
        required=True,
        help=f"task set (scenario_a_train, ...), named data set ({', '.join(DATA_SETS)}), or indices and "
        "ranges, such as 4,50-73",
    )
    parser.add_argument(
        "--episodes-per-task", type=int, required=True, metavar="N", help="number of episodes of each task"
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the dataset")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the whole dataset (default: %(default)s)"
    )
    parser.add_argument(
        "--split",
        choices=COLLECTED_SPLITS,
        help="purpose of the episodes; scenes of different splits never coincide (default: the split of the "
        "named data set, validation for test and validation tasks, and train otherwise)",
    )
    parser.add_argument(
        "--ambiguity",
        choices=AMBIGUITIES,
        default="container",
        help="ambiguity scheme of the scenes: container (the paper's scheme i) or object (scheme ii) "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=EXPERT_NOISE,
        help="standard deviation of the noise on the expert's motions (default: %(default)s)",
    )
    parser.add_argument(
        "--image-size",
        type=int,
        default=48,
        metavar="PX",
        help=f"height and width of the images, at least {MIN_IMAGE_SIZE} (default: %(default)s)",
    )
    parser.add_argument(
        "--objects",
        metavar="SET",
        help="objects that scenes are made of: all; scenario_a_train, without test objects; or random:N, the "
        "24 training objects and N - 24 random ones (default: scenario_a_train for scenario_a_clean_train, "
        "all otherwise)",
    )
    parser.add_argument(
        "--adversarial-probability",
        type=float,
        default=ADVERSARIAL_PROBABILITY,
        metavar="P",
        help="probability that a distractor is drawn from the objects that share the target's color or shape "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--adversarial-draw",
        choices=ADVERSARIAL_DRAWS,
        default="each",
        help="scope of a draw with that probability: each, one distractor; or scene, both distractors of a "
        "scene, as in the authors' code (default: %(default)s)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=available_cores(),
        help="number of processes; the dataset is the same with any number (default: %(default)s)",
    )
    shards = parser.add_mutually_exclusive_group()
    shards.add_argument(
        "--shard",
        metavar="I/N",
        help="collect only the I-th of N equal parts, into ROOT.shards/I-of-N, for collecting on N machines",
    )
    shards.add_argument(
        "--join",
        action="store_true",
        help="join the shards in ROOT.shards into the dataset that one machine would have collected",
    )
    parser.add_argument("--repo-id", metavar="USER/NAME", help="name of the dataset on the Hugging Face Hub")
    parser.add_argument(
        "--push-to-hub",
        action="store_true",
        help="push the dataset as deltaco-push does; needs HF_TOKEN or `hf auth login`",
    )
    parser.add_argument("--append", action="store_true", help="add the episodes to a finished dataset")
    parser.add_argument("--verify", action="store_true", help=_VERIFY_HELP)
    parser.add_argument("--summary", type=Path, metavar="FILE", help="file to write the summary to, as JSON")
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
