"""The command `deltaco`: tyro turns the arguments of each subcommand's function into options."""

from __future__ import annotations

import importlib
import logging
import sys
import textwrap
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lerobot_deltaco.policy_options import OPTIONS, read_options

COMMANDS = {
    "collect": "Collect episodes of the scripted expert as a LeRobotDataset.",
    "check": "Show what a policy would take from a dataset, before it is trained.",
    "train": "Train a policy: `lerobot-train` over frames in memory.",
    "evaluate": "Evaluate a policy on the benchmark, and record every episode.",
    "report": "Write tables and a figure from the records of evaluations.",
    "experiment": "Run experiments: collect, train, evaluate and report.",
    "look": "Draw what a policy sees: what was moved, where it would pick and place.",
    "play": "Play with a policy in the browser.",
    "demo": "Train and evaluate the project's method in a few minutes.",
}
_FUNCTIONS = {
    "collect": "collection.hub.collect_and_push",
    "check": "pages.check.check",
    "evaluate": "evaluation.evaluate.evaluate_checkpoints",
    "report": "reports.report.write_report",
    "experiment": "experiments.run.run_experiments",
    "look": "pages.look.look",
    "play": "pages.play.play",
    "demo": "pages.demo.run_demo",
}
# Commands whose modules import torch, which help should not wait for: their functions have one argument, an
# object of a class in arguments.py.
_SLOW = ("check", "evaluate", "look", "play")
_PACKAGES = ("lerobot_deltaco", "gym_deltaco")


def main() -> None:
    """Runs the subcommand given on the command line."""
    name, arguments = (sys.argv[1:2] or ["--help"])[0], sys.argv[2:]
    if name in ("-h", "--help"):
        _print(_overview())
        return
    if name not in COMMANDS:
        sys.exit(f"deltaco: unknown command {name!r}. The commands are {', '.join(COMMANDS)}.")
    if name == "train" and {"-h", "--help"} & set(arguments):
        _print(_training_help())
        return
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    # Without FFmpeg, LeRobot decodes videos with PyAV, and warns of it with four tracebacks.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    try:
        _run(name, arguments)
    except KeyboardInterrupt:
        sys.exit("\nInterrupted. Run the same command again to continue.")
    except Exception as error:
        if _is_ours(error):
            sys.exit(f"deltaco {name}: {error}")
        # Libraries report it as errors of their own.
        if "No space left on device" in str(error):
            sys.exit(
                f"deltaco {name}: The disk of {_output_folder(arguments)} is full. Free some space, and run "
                "the command again. Training continues from its last complete checkpoint with --resume=true "
                "--config_path=RUN/checkpoints/last/pretrained_model/train_config.json."
            )
        if isinstance(error, OSError):  # a file or folder that cannot be read or written
            sys.exit(f"deltaco {name}: {error}")
        raise


def _run(name: str, arguments: Sequence[str]) -> None:
    if name == "train":
        sys.argv = ["lerobot-train", *arguments]
        import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)
        from lerobot_deltaco.training.train import train

        train()
        return
    import tyro

    kind = command_arguments(name)
    parsed = tyro.cli(kind, prog=f"deltaco {name}", description=COMMANDS[name], args=arguments)
    result = _imported(_FUNCTIONS[name])(parsed) if name in _SLOW else parsed
    if isinstance(result, Path):
        _print(f"See {result}.")
    elif result is not None:
        _print(result)


def command_arguments(name: str) -> Callable[..., Any]:
    """Returns the function, or the class of its argument, from which tyro makes the options of a command."""
    return _imported(f"arguments.{name.capitalize()}Arguments" if name in _SLOW else _FUNCTIONS[name])


def _imported(path: str) -> Any:
    module, _, attribute = path.rpartition(".")
    return getattr(importlib.import_module(f"lerobot_deltaco.{module}"), attribute)


def _is_ours(error: BaseException) -> bool:
    """Returns whether an error was raised on purpose, with a message for the user, by this project.

    Other errors are reported with their traceback. LeRobot's parser may wrap an error that was raised on
    purpose.
    """
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and any(f"/{package}/" in frames[-1].filename for package in _PACKAGES)


def _output_folder(arguments: Sequence[str]) -> Path:
    """Returns the folder that a command writes to, as its arguments say."""
    words = [part for word in arguments for part in word.split("=", 1)]
    named = [words[n + 1] for n, word in enumerate(words[:-1]) if word in ("--output_dir", "--out", "--root")]
    return Path(*named[-1:]).resolve()


# Help


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        ["usage: deltaco COMMAND ...", "", *lines, "", "deltaco COMMAND --help shows its options."]
    )


def _training_help() -> str:
    parts = [
        "usage: deltaco train --policy.type=deltaco_match --dataset.repo_id=NAME [--dataset.root=DIR] ...\n\n"
        "Takes the arguments of lerobot-train, such as --batch_size, --steps, --save_freq, --output_dir,\n"
        "--job_name, --seed, and --resume=true --config_path=RUN/checkpoints/last/pretrained_model/"
        "train_config.json."
    ]
    for policy in OPTIONS:
        parts.append("Both policies" if policy == "both" else f"--policy.type={policy}")
        lines = []
        for name, option in read_options(policy).items():
            if option.description:
                lines.append(f"  --policy.{name} (default: {option.default})")
                lines.append(textwrap.indent(textwrap.fill(option.description, 104), " " * 6))
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
