"""The one place that depends on LeRobot's version.

Elsewhere, only LeRobot's public names are used, and of its methods with an underscore only `_save_pretrained`
is overridden, which huggingface_hub documents for that purpose.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from lerobot.utils import constants

TRIED_WITH = ("0.6.1", "0.6.2")

# The key under which `select_action` may return what a policy has found, beside the action. LeRobot draws it
# on the live picture; None for versions before 0.7, which expect a tensor.
PREDICTION: str | None = getattr(constants, "PREDICTION", None)


def action_of(output: Any) -> Any:
    """Returns the action in what a policy's `select_action` gives."""
    return output[constants.ACTION] if isinstance(output, dict) else output


@contextmanager
def replaced(make_card: Callable[..., Any], **replacements: Callable[..., Any]) -> Iterator[None]:
    """Replaces functions by their names in LeRobot's training script, in a context.

    The loop of `lerobot-train` makes its dataset, sampler and policy itself, so the functions that make them
    are replaced while it runs.

    Args:
        make_card: Replaces `generate_model_card`, and gets LeRobot's as its first argument. Before 0.6.2, it
            was a method, and the policy's own is called.
        replacements: Functions by the names of those that they replace.

    Raises:
        ImportError: LeRobot's training script has no function of a name.
    """
    from lerobot.common import train_utils
    from lerobot.scripts import lerobot_train

    missing = [name for name in replacements if not callable(getattr(lerobot_train, name, None))]
    if missing:
        raise ImportError(
            f"`deltaco train` was tried with LeRobot {', '.join(TRIED_WITH)}. The training script of LeRobot "
            f"{version('lerobot')} has no {', '.join(missing)}. Install a version that was tried, or train "
            "with `lerobot-train`, which reads frames from the disk and draws them one by one."
        )
    changes: list[tuple[Any, str, Callable[..., Any]]]
    changes = [(lerobot_train, name, function) for name, function in replacements.items()]
    if hasattr(train_utils, "generate_model_card"):
        card = functools.partial(make_card, train_utils.generate_model_card)
        changes.append((train_utils, "generate_model_card", card))
    own = [getattr(module, name) for module, name, _ in changes]
    try:
        for module, name, function in changes:
            setattr(module, name, function)
        yield
    finally:
        for (module, name, _), function in zip(changes, own, strict=True):
            setattr(module, name, function)
