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
    from lerobot_deltaco.play.episodes import Player

logger = logging.getLogger(__name__)

T = TypeVar("T")
MAX_LOADED = 3  # checkpoints at a time


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
    """Checkpoints that act, for any number of users. Only one thing runs at a time; the others wait.

    Args:
        checkpoint: Name of the checkpoint to begin with, as `find_checkpoint` takes it.
        roots: Folders from which checkpoints may be loaded.
        is_hub_allowed: Whether checkpoints may be downloaded from the Hugging Face Hub.
    """

    def __init__(self, checkpoint: str, roots: Sequence[Path], is_hub_allowed: bool = True) -> None:
        self.default_checkpoint = checkpoint
        self._roots, self._is_hub_allowed = tuple(roots), is_hub_allowed
        self._worker = Worker()
        self._players: OrderedDict[str, Player] = OrderedDict()
        self._status = Status("Starting.")

    @property
    def status(self) -> Status:
        """Progress of the start."""
        return self._status

    def start(self) -> None:
        """Begins to load LeRobot and the first checkpoint, and returns at once."""
        threading.Thread(target=self._start, name="deltaco-play-start", daemon=True).start()

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
        except Exception as error:
            logger.exception("The page cannot become ready.")
            self._status = Status(f"LeRobot cannot be loaded ({type(error).__name__}): {error}", is_done=True)

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

    def _player(self, name: str) -> Player:
        """A checkpoint, in the worker's thread."""
        if name in self._players:
            self._players.move_to_end(name)
            return self._players[name]
        from lerobot_deltaco.play.episodes import Player

        player = Player(find_checkpoint(name, self._roots, self._is_hub_allowed))
        self._players[name] = player
        while len(self._players) > MAX_LOADED:
            self._players.popitem(last=False)
        return player


def _import_episodes() -> None:
    import torch

    import lerobot_deltaco.play.episodes  # noqa: F401  (takes 10 s and more)

    # An episode is a batch of one, which several threads make no faster. On a busy machine, where they wait
    # for one another, they make it many times slower.
    torch.set_num_threads(1)
