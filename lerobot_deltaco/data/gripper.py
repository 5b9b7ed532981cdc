"""The gripper among the dimensions of an action."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Gripper:
    """Where the gripper's command is in an action, and how to read it.

    Attributes:
        index: Dimension of the action.
        closed: "low" or "high": which values close the gripper.
        usual_range: Range of its commands in a usual episode, in the dataset's unit; None if it is to be
            estimated from the episodes at hand.
    """

    index: int
    closed: str = "low"
    usual_range: float | None = None

    def opening(self, actions: Tensor) -> Tensor:
        """Returns the commands in actions (frames, action), larger for more open, (frames,)."""
        command = actions[:, self.index]
        return command if self.closed == "low" else -command
