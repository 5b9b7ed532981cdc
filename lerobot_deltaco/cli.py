"""The command `deltaco`: tyro turns the arguments of each subcommand's function into options."""

from __future__ import annotations

import functools
import importlib
import logging
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from lerobot_deltaco.errors import UserError


class Command(NamedTuple):
    """A subcommand.

    Attributes:
        description: What it does, in a line.
        function: Function that runs it. What it returns is printed.
        arguments: Class of the function's only argument, whose module is quick to import; None if tyro reads
            the arguments of the function itself.
    """

    description: str
    function: str
    arguments: str | None = None


COMMANDS = {
    "collect": Command(
        "Collect episodes of the scripted expert as a LeRobotDataset.", "collection.hub.collect_and_push"
    ),
    "check": Command(
        "Show what a policy would take from a dataset, before it is trained.",
        "pages.check.check",
        "pages.arguments.CheckArguments",
    ),
    "train": Command("Train a policy: `lerobot-train` over frames in memory.", "training.train.train"),
    "evaluate": Command(
        "Evaluate a policy on the benchmark, and record every episode.",
        "evaluation.command.evaluate_checkpoints",
        "evaluation.command.EvaluateArguments",
    ),
    "report": Command(
        "Write tables and a figure from the records of evaluations.", "reports.report.write_report"
    ),
    "compare": Command(
        "Compare two evaluations in the same scenes, and say whether it is decided.",
        "reports.compare.compare_records",
    ),
    "experiment": Command(
        "Run experiments: collect, train, evaluate and report.", "experiments.run.run_experiments"
    ),
    "look": Command(
        "Draw what a policy sees: what was moved, where it would pick and place.",
        "pages.look.look",
        "pages.arguments.LookArguments",
    ),
    "play": Command("Play with a policy in the browser.", "pages.play.play", "pages.arguments.PlayArguments"),
    "demo": Command("Train and evaluate the project's method in a few minutes.", "pages.demo.run_demo"),
}
_CONTINUE_TRAINING = (
    "To continue a training from its last checkpoint: deltaco train --resume=true "
    "--config_path=RUN/checkpoints/last/pretrained_model/train_config.json. Before the first checkpoint, "
    "delete the folder RUN and start again."
)


def main() -> None:
    """Runs the subcommand given on the command line."""
    # Idle threads of a training would spin on the cores that other processes need, which would make each of
    # its steps wait. The OpenMP library reads it when PyTorch is imported; worker processes inherit it.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    name, arguments = (sys.argv[1:2] or ["--help"])[0], sys.argv[2:]
    if name in ("-h", "--help"):
        _print(_overview())
        return
    if name == "--version":
        _print(_installation())
        return
    if name not in COMMANDS:
        sys.exit(f"deltaco: unknown command {name!r}. The commands are {', '.join(COMMANDS)}.")
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    # Without FFmpeg, LeRobot decodes videos with PyAV, and warns of it with four tracebacks.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    next_step = _CONTINUE_TRAINING if name == "train" else "Run the same command again to continue."
    try:
        result = _train(arguments) if name == "train" else parse_arguments(name, arguments)()
    except KeyboardInterrupt:
        sys.exit(f"\nInterrupted. {next_step}")
    except Exception as error:
        # Libraries report it as errors of their own.
        if "No space left on device" in str(error):
            sys.exit(f"deltaco {name}: The disk is full ({error}). Free some space. {next_step}")
        if _is_for_users(error):
            sys.exit(f"deltaco {name}: {error}")
        raise
    if isinstance(result, Path):
        _print(f"See {result}.")
    elif result is not None:
        _print(result)


def parse_arguments(name: str, arguments: Sequence[str]) -> Callable[[], Any]:
    """Parses the arguments of a subcommand other than `train`, and returns the call that runs it.

    Raises:
        UserError: An argument is invalid; the message says what is valid.
        SystemExit: An argument is unknown or missing, or help was asked for; tyro has printed which.
    """
    import tyro

    command = COMMANDS[name]
    deferred: Callable[..., Any]
    if command.arguments is None:
        function = _imported(command.function)
        deferred = functools.wraps(function)(functools.partial(functools.partial, function))
    else:

        def call_later(arguments: Any) -> Callable[[], Any]:
            return lambda: _imported(command.function)(arguments)

        kind = _imported(command.arguments)
        call_later.__annotations__["arguments"] = Annotated[kind, tyro.conf.arg(name="")]
        deferred = call_later
    try:
        return tyro.cli(deferred, prog=f"deltaco {name}", description=command.description, args=arguments)
    except ValueError as error:  # of a class of arguments
        raise UserError(str(error)) from error


def _train(arguments: Sequence[str]) -> str | None:
    """Trains with LeRobot's command line; help without other arguments is the project's own."""
    if arguments in (["-h"], ["--help"]):
        return _imported("training.options.training_help")()
    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

    # LeRobot finds the checkpoints to start from in the command line alone.
    sys.argv = ["lerobot-train", *arguments]
    return _imported(COMMANDS["train"].function)()


def _imported(path: str) -> Any:
    module, _, attribute = path.rpartition(".")
    return getattr(importlib.import_module(f"lerobot_deltaco.{module}"), attribute)


def _is_for_users(error: Exception) -> bool:
    """Returns whether an error says what a user can change: it was raised for that, or the system refused."""
    is_without_simulator = isinstance(error, ImportError) and error.name == "pybullet"
    return isinstance(error, UserError | OSError | MemoryError) or is_without_simulator


def _installation() -> str:
    """Returns the versions, and which types of this project LeRobot has found, as its commands do."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import EnvConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    found = [
        f"--{option}.type={choice}"
        for option, config in (("policy", PreTrainedConfig), ("env", EnvConfig))
        for choice, kind in config.get_known_choices().items()
        if kind.__module__.startswith("lerobot_deltaco.")
    ]
    return (
        f"lerobot_policy_deltaco {version('lerobot_policy_deltaco')}. LeRobot {version('lerobot')} finds "
        f"{', '.join(found) or 'nothing of it: install the project again, as its README says'}."
    )


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {command.description}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: deltaco COMMAND ...",
            "",
            *lines,
            "",
            "deltaco COMMAND --help shows its options;",
            "deltaco --version what LeRobot has found.",
        ]
    )


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
