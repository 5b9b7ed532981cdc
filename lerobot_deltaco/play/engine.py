"""Loads LeRobot and checkpoints in the background, so that the page stands before they are ready."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from lerobot_deltaco.play.checkpoints import find_checkpoint
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.worker import Worker

if TYPE_CHECKING:
    from lerobot_deltaco.play.datasets import EpisodeDataset
    from lerobot_deltaco.play.demonstrations import Demonstration
    from lerobot_deltaco.play.episodes import Player

logger = logging.getLogger(__name__)

T = TypeVar("T")
MAX_LOADED = 3  # checkpoints, and datasets, at a time


class Status(NamedTuple):
    """Progress of the engine's start.

    Attributes:
        text: Description of the present step, or of the error that ended the start.
        is_done: Whether the start has ended, well or not.
        is_ready: Whether the first checkpoint is loaded.
    """

    text: str
    is_done: bool = False
    is_ready: bool = False


class Engine:
    """Checkpoints that act, and datasets, for any number of users. One thing runs at a time; others wait.

    Args:
        checkpoint: Name of the checkpoint to begin with, as `find_checkpoint` takes it.
        roots: Folders from which checkpoints and datasets may be loaded.
        is_hub_allowed: Whether they may be downloaded from the Hugging Face Hub.
    """

    def __init__(self, checkpoint: str, roots: Sequence[Path], is_hub_allowed: bool = True) -> None:
        self.default_checkpoint = checkpoint
        self._roots, self._is_hub_allowed = tuple(roots), is_hub_allowed
        self._worker = Worker()
        self._players: OrderedDict[str, Player] = OrderedDict()
        self._datasets: OrderedDict[str, EpisodeDataset] = OrderedDict()
        self._status = Status("Starting.")

    @property
    def status(self) -> Status:
        """Progress of the start."""
        return self._status

    def start(self) -> None:
        """Begins to load LeRobot and the first checkpoint, and returns at once."""
        threading.Thread(target=self._start, name="deltaco-play-start", daemon=True).start()

    def close(self, seconds: float = 5) -> bool:
        """Ends what runs, at its next step.

        Args:
            seconds: How long to wait for it.

        Returns:
            Whether it has ended.
        """
        return self._worker.close(seconds)

    def _start(self) -> None:
        try:
            self._status = Status("Loading LeRobot and PyTorch, which takes 10 seconds or more.")
            self._worker.call(_import_episodes)
            self._status = Status(f"Loading the checkpoint {self.default_checkpoint}.")
            self.load(self.default_checkpoint)
            self._status = Status("Ready.", is_done=True, is_ready=True)
        except PlayError as error:
            self._status = Status(str(error), is_done=True)
        # Whatever it is, the page has to say that it will not become ready.
        except Exception:
            logger.exception("The page cannot become ready.")
            self._status = Status(
                "LeRobot cannot be loaded. The terminal of the page has the details.", is_done=True
            )

    def load(self, name: str) -> None:
        """Loads a checkpoint, unless it is loaded.

        Raises:
            PlayError: It may not or cannot be loaded.
        """
        self._worker.call(lambda: self._player(name))

    def call(self, name: str, function: Callable[[Player], T]) -> T:
        """The result of a function of a checkpoint, once its turn has come."""
        return self._worker.call(lambda: function(self._player(name)))

    def stream(self, name: str, function: Callable[[Player], Generator[T]]) -> Iterator[T]:
        """Yields what a generator yields that uses a checkpoint, once its turn has come."""
        return self._worker.stream(lambda: function(self._player(name)))

    def demonstrated_tasks(self, checkpoint: str, dataset: str | None) -> dict[str, int]:
        """Number of demonstrations by task string.

        Args:
            checkpoint: Name of the checkpoint.
            dataset: Name of the dataset whose episodes are the demonstrations; None for the checkpoint's own.

        Raises:
            PlayError: One of the two may not or cannot be loaded, or the dataset does not fit the checkpoint.
        """

        def count() -> dict[str, int]:
            player = self._player(checkpoint)
            if dataset is None:
                return player.demonstrated_tasks
            opened = self._dataset(dataset)
            opened.check_fits(player.policy.config)
            return opened.counts

        return self._worker.call(count)

    def demonstration(self, checkpoint: str, dataset: str | None, task: str, number: int) -> Demonstration:
        """A demonstration for a checkpoint.

        Args:
            checkpoint: Name of the checkpoint.
            dataset: Name of the dataset that it is of; None for the checkpoint's own.
            task: Task string.
            number: Number of the demonstration among those of the task, from 1.

        Raises:
            PlayError: There is none.
        """

        def choose() -> Demonstration:
            player = self._player(checkpoint)
            if dataset is None:
                return player.demonstration(task, number)
            return self._dataset(dataset).demonstration(task, number, player.policy.config)

        return self._worker.call(choose)

    def _player(self, name: str) -> Player:
        """A checkpoint, in the worker's thread."""
        from lerobot_deltaco.play.episodes import Player

        return _kept(
            self._players,
            name,
            lambda: Player(find_checkpoint(name, self._roots, self._is_hub_allowed)),
        )

    def _dataset(self, name: str) -> EpisodeDataset:
        """A dataset, in the worker's thread."""
        from lerobot_deltaco.play.datasets import EpisodeDataset

        return _kept(self._datasets, name, lambda: EpisodeDataset(name, self._roots, self._is_hub_allowed))


def _kept[T](loaded: OrderedDict[str, T], name: str, load: Callable[[], T]) -> T:
    """What is loaded under a name; else it is loaded, and what was not used for longest is forgotten."""
    if name not in loaded:
        loaded[name] = load()
    loaded.move_to_end(name)
    while len(loaded) > MAX_LOADED:
        loaded.popitem(last=False)
    return loaded[name]


def _import_episodes() -> None:
    import torch

    import lerobot_deltaco.play.datasets
    import lerobot_deltaco.play.episodes  # noqa: F401  (takes 10 s and more)

    # An episode is a batch of one, which several threads make no faster. On a busy machine, where they wait
    # for one another, they make it many times slower.
    torch.set_num_threads(1)
