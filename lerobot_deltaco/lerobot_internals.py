"""Everything that relies on LeRobot's internals, which another version of LeRobot may have changed.

- LeRobot's training loop has no hook for datasets, samplers and evaluation. `deltaco-train` therefore
  replaces some of the functions that the loop calls, while it runs.
- A dataset gives windows of frames or single ones, as it was made.
- Neither the policy nor its card learns which episodes of a dataset are trained on; they are read from the
  command line or the configuration file, as LeRobot reads it.
- A processor step keeps the transition that it processes in an attribute, which several threads overwrite.
- Some of LeRobot's log messages are pages long: a traceback for each version of FFmpeg that torchcodec does
  not find, and the paths of all videos of an evaluation.
- The parser of LeRobot's commands does not say why a configuration refuses a value.
- LeRobot's rollout has a progress bar of its own, which several processes would write over one another.

What is replaced is checked first: with an unsupported version of LeRobot, an error names those that are
supported.
"""

from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from importlib.metadata import version
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import yaml
from draccus.utils import ParsingError
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import (
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    RemoteEntryNotFoundError,
)

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset
    from lerobot.processor import ProcessorStep

logger = logging.getLogger(__name__)

SUPPORTED_LEROBOT = ">=0.6.1,<0.6.2"

# Functions and classes that the training loop of a supported LeRobot looks up by these names.
LOOP_FUNCTIONS = (
    "make_train_eval_datasets",
    "make_policy",
    "EpisodeAwareSampler",
    "cycle",
    "_make_eval_envs",
    "eval_policy_all",
    "submit_to_hf",
)


class UnsupportedLeRobotError(RuntimeError):
    """This version of LeRobot lacks something that is relied on; the message says which versions have it."""


# The training loop


def training_loop() -> ModuleType:
    """The module of LeRobot's training loop.

    Raises:
        UnsupportedLeRobotError: The loop does not call the functions that are to be replaced.
    """
    from lerobot.scripts import lerobot_train

    called = _names_in(inspect.unwrap(lerobot_train.train).__code__)
    missing = [name for name in LOOP_FUNCTIONS if name not in called or not hasattr(lerobot_train, name)]
    if missing:
        raise UnsupportedLeRobotError(
            f"`deltaco-train` supports lerobot{SUPPORTED_LEROBOT}. The training loop of the installed "
            f"version {version('lerobot')} does not call {', '.join(missing)}. Install a supported version, "
            "or train with `lerobot-train`, which takes the same arguments."
        )
    return lerobot_train


@contextmanager
def replaced_in_training_loop(functions: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Lets LeRobot's training loop call other functions while the context is open.

    Args:
        functions: Replacements, by their names in `LOOP_FUNCTIONS`.

    Raises:
        UnsupportedLeRobotError: The loop does not call the functions that are to be replaced.
    """
    loop = training_loop()
    with ExitStack() as stack:
        for name, function in functions.items():
            stack.enter_context(patch.object(loop, name, function))
        yield


def run_training_loop() -> None:
    """Trains with the arguments of the command line."""
    training_loop().main()


@contextmanager
def remote_command(command: str) -> Iterator[None]:
    """Lets jobs that LeRobot submits while the context is open run another command than `lerobot-train`.

    Args:
        command: Name of the command in the job's image.

    Raises:
        UnsupportedLeRobotError: LeRobot submits otherwise.
    """
    from lerobot.jobs import hf

    submit = getattr(hf, "run_job", None)
    if submit is None or "run_job" not in _names_in(hf.submit_to_hf.__code__):
        raise UnsupportedLeRobotError(
            f"--job.target is supported with lerobot{SUPPORTED_LEROBOT}. The installed version "
            f"{version('lerobot')} submits jobs in another way. Install a supported version."
        )

    def run_job(**arguments: Any) -> Any:
        words = ["lerobot-train", *arguments["command"][1:]]
        if arguments["command"] != words:
            raise UnsupportedLeRobotError(f"LeRobot's job would run {arguments['command']}.")
        return submit(**{**arguments, "command": [command, *words[1:]]})

    with patch.object(hf, "run_job", run_job):
        yield


def step_of_videos(videos_dir: Path) -> int:
    """The training step of an evaluation in the loop, which only the name of the folder for its videos has.

    Raises:
        UnsupportedLeRobotError: The folder is named otherwise.
    """
    step = videos_dir.name.rpartition("_")[2]
    if not step.isdecimal():
        raise UnsupportedLeRobotError(
            f"`deltaco-train` supports lerobot{SUPPORTED_LEROBOT}, which evaluates into folders named "
            f"videos_step_STEP. Got {videos_dir.name!r} from version {version('lerobot')}."
        )
    return int(step)


def _names_in(code: CodeType) -> set[str]:
    """Global names that a function uses, those of the functions inside it included."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names_in, inner))


# Datasets


@contextmanager
def single_frames(dataset: LeRobotDataset) -> Iterator[None]:
    """Lets a dataset give single frames, whatever its `delta_timestamps` are, while the context is open."""
    reader = dataset.reader
    windows, reader.delta_indices = reader.delta_indices, None
    try:
        yield
    finally:
        reader.delta_indices = windows


# Arguments of `lerobot-train`


def dataset_option(name: str) -> Any:
    """The value of `--dataset.<name>` for the running `lerobot-train`; None if it is not given.

    It is taken from the command line, or else from the file of `--config_path`, as YAML, which JSON is as
    well. `--config_path` may also be a folder, or the id of a repository on the Hub.

    Raises:
        ValueError: `--config_path` is none of these, or the Hub cannot be reached.
    """
    from lerobot.configs import parser
    from lerobot.configs.train import TRAIN_CONFIG_NAME

    text = parser.parse_arg(f"dataset.{name}")
    if text is not None:
        return yaml.safe_load(text)
    config_path = parser.parse_arg("config_path")
    if config_path is None:
        return None
    path = Path(config_path)
    file = path / TRAIN_CONFIG_NAME if path.is_dir() else path
    if not path.exists():
        try:
            file = _config_on_hub(config_path)
        except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError) as error:
            raise ValueError(
                f"--config_path is {config_path}, whose {TRAIN_CONFIG_NAME} cannot be read: {error}. So it "
                "is not known which episodes are held back from the demonstrations. Download it and name its "
                "folder."
            ) from error
    if not file.is_file():
        return None
    content = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    return (content.get("dataset") or {}).get(name)


def _config_on_hub(repo_id: str) -> Path:
    """The configuration file of a repository: at its root, or else of its last checkpoint.

    LeRobot has just read it, so that it is in the cache.
    """
    from lerobot.configs.train import PRETRAINED_MODEL_DIR, TRAIN_CONFIG_NAME, find_latest_hub_checkpoint

    try:
        return Path(hf_hub_download(repo_id, TRAIN_CONFIG_NAME))
    except RemoteEntryNotFoundError:
        latest = find_latest_hub_checkpoint(repo_id)
        if latest is None:
            raise
        return Path(hf_hub_download(repo_id, f"{latest}/{PRETRAINED_MODEL_DIR}/{TRAIN_CONFIG_NAME}"))


# Processor steps

_TRANSITION = "_current_transition"


class _PerThread:
    """An attribute with a value for each thread, None at first. It is copied with its instance."""

    def __get__(self, step: ProcessorStep | None, owner: type[ProcessorStep]) -> Any:
        if step is None:
            return self
        return step.__dict__.get(_TRANSITION, {}).get(threading.get_ident())

    def __set__(self, step: ProcessorStep, value: Any) -> None:
        step.__dict__.setdefault(_TRANSITION, {})[threading.get_ident()] = value


def make_processor_steps_thread_safe() -> None:
    """Gives each thread its own copy of the transition that a processor step works on.

    LeRobot 0.6 shares the steps between the threads of `--env.max_parallel_tasks`, so that a policy could get
    another task's observation and instruction. A version without the attribute needs no workaround.
    """
    from lerobot.processor import ProcessorStep

    if getattr(ProcessorStep, _TRANSITION, ...) is None:
        setattr(ProcessorStep, _TRANSITION, _PerThread())


# Rollouts


@contextmanager
def without_rollout_progress() -> Iterator[None]:
    """Hides the progress bar of each of LeRobot's rollouts, while the context is open.

    A version without the attribute needs no workaround.
    """
    from lerobot.scripts import lerobot_eval

    bar = getattr(lerobot_eval, "trange", None)
    if bar is None:
        yield
        return
    with patch.object(lerobot_eval, "trange", partial(bar, disable=True)):
        yield


# Log messages

_LONG_LOGS = ("lerobot.utils.import_utils", "lerobot.scripts.lerobot_eval", "__main__")
_NO_TORCHCODEC = "'torchcodec' is installed but cannot be loaded"
_VIDEO_PATHS = ("video_paths", "predicted_video_paths")


class _ShortMessages(logging.Filter):
    """Shortens messages, and lets the one about torchcodec through once."""

    def __init__(self) -> None:
        super().__init__()
        self._has_said_no_torchcodec = False

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.msg, dict):
            record.msg = _without_video_paths(record.msg)
        elif isinstance(record.msg, str) and _NO_TORCHCODEC in record.msg:
            if self._has_said_no_torchcodec:
                return False
            self._has_said_no_torchcodec = True
            record.msg = "Videos are decoded by PyAV, since torchcodec finds no FFmpeg that it supports."
        return True


_SHORT_MESSAGES = _ShortMessages()


def shorten_logs() -> None:
    """Keeps pages of library errors and of video paths out of LeRobot's logs."""
    for name in _LONG_LOGS:
        logging.getLogger(name).addFilter(_SHORT_MESSAGES)


def _without_video_paths(content: Any) -> Any:
    if isinstance(content, dict):
        return {
            name: _without_video_paths(value) for name, value in content.items() if name not in _VIDEO_PATHS
        }
    return content


# The command line


def log_refusals[**P](check: Callable[P, None]) -> Callable[P, None]:
    """Makes a configuration that LeRobot's parser makes log why it refuses values.

    The parser ends the command with "Couldn't instantiate class DeltacoConfig", and does not say why.

    Args:
        check: Method `__post_init__` of the configuration.
    """

    @wraps(check)
    def logged(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            check(*args, **kwargs)
        except ValueError as error:
            if _is_parsing():
                logger.error("%s", error)
            raise

    return logged


def reason_of(error: BaseException) -> str:
    """What is wrong, where LeRobot's parser says only which class cannot be made."""
    cause: BaseException | None = error
    while isinstance(cause, ParsingError):
        if type(cause) is ParsingError and cause.__cause__ is not None:
            return reason_of(cause.__cause__)
        cause = cause.__cause__
    return str(error)


def _is_parsing() -> bool:
    """Whether draccus, the parser of LeRobot's commands, is among the callers."""
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "draccus.parsers.decoding":
            return True
        frame = frame.f_back
    return False
