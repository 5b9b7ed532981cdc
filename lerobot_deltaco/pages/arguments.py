"""Arguments of `deltaco check`, `look` and `play`, apart from the pages: help does not import torch."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lerobot_deltaco.errors import UserError

# Under the name that errors advise, as in `deltaco train`
DatasetEpisodesOption = Annotated[str | None, tyro.conf.arg(name="dataset.episodes")]


def list_of_numbers(text: str | None) -> list[int] | None:
    """Returns the episodes or the coordinates that an option lists, such as "[10,20]"; None for none.

    Raises:
        UserError: It is not a list of whole numbers.
    """
    if text is None:
        return None
    try:
        numbers = json.loads(text)
    except ValueError:
        numbers = None
    if not isinstance(numbers, list) or not all(type(number) is int for number in numbers):
        raise UserError(f"Episodes and points are lists of whole numbers, such as [10,20]. Got {text!r}.")
    return numbers


@dataclass(frozen=True)
class PolicyOptions:
    """Options of `deltaco train` on which it depends what is taken from a dataset.

    Args:
        demo_camera: Name of the camera of demonstrations. By default, the first.
        gripper: Gripper's dimension of the action: an index, or "auto" for the one whose name contains
            "gripper"; of several, the one that moves most.
        gripper_closed: Whether low or high values of the gripper's dimension mean closed.
        image_size: Height and width to which images are scaled, px.
        chunk_size: Number of steps that the policy predicts at once, on which the time depends; None, as in
            training, chooses it by the length of the episodes.
    """

    demo_camera: str | None = None
    gripper: str = "auto"
    gripper_closed: str = "low"
    image_size: int = 48
    chunk_size: int | None = None


@dataclass(frozen=True)
class CheckArguments:
    """Arguments of `deltaco check`.

    Args:
        dataset: Folder of a LeRobotDataset, or its id on the Hugging Face Hub.
        policy: Options as for `deltaco train`.
        batch_size: Batch size that the time of training is estimated for.
        steps: Number of training steps that it is estimated for.
        episodes: Number of episodes to show; those that are left out come first.
        out: Folder for the page.
        dataset_episodes: Episodes to check, as for `deltaco train`, such as [0,1,2]; None for all.
    """

    dataset: tyro.conf.Positional[str]
    policy: PolicyOptions = PolicyOptions()
    batch_size: int = 64
    steps: int = 8000
    episodes: int = 48
    out: Path = Path("outputs/check")
    dataset_episodes: DatasetEpisodesOption = None

    def __post_init__(self) -> None:
        list_of_numbers(self.dataset_episodes)


@dataclass(frozen=True)
class PromptOptions:
    """Options of `lerobot-rollout` that show the object to pick, in place of a demonstration.

    Args:
        demo_point: Point [x, y] or box [left, top, right, bottom] on the object, px: in the first image of
            each episode, or in `demo_photo`.
        demo_photo: Image file that shows the object.
    """

    demo_point: str | None = None
    demo_photo: Path | None = None

    def __post_init__(self) -> None:
        list_of_numbers(self.demo_point)


@dataclass(frozen=True)
class LookArguments:
    """Arguments of `deltaco look`.

    Args:
        checkpoint: Folder of a policy of the type deltaco_match, or of its training run; or id of a
            repository on the Hugging Face Hub.
        dataset: Folder of a LeRobotDataset, or its id on the Hub. Without one, episodes of the benchmark's
            test tasks are run.
        episodes: Number of episodes, evenly spread.
        out: Folder for the page.
        dataset_episodes: Episodes to choose from, as for `deltaco train`, such as [0,1,2]. By default, those
            that were held out of the fit, if it is the training dataset, or else all.
        policy: What shows the object in place of other episodes.
    """

    checkpoint: tyro.conf.Positional[str]
    dataset: str | None = None
    episodes: int = 12
    out: Path = Path("outputs/look")
    dataset_episodes: DatasetEpisodesOption = None
    policy: PromptOptions = PromptOptions()

    def __post_init__(self) -> None:
        list_of_numbers(self.dataset_episodes)
        if self.dataset is None and self.policy != PromptOptions():
            raise ValueError("--policy.demo_point and --policy.demo_photo need the episodes of a --dataset.")


@dataclass(frozen=True)
class PlayArguments:
    """Arguments of `deltaco play`.

    Args:
        checkpoint: Folder of a policy or of a training run, or id of a repository on the Hugging Face Hub. By
            default, it is the one that comes with the project.
        port: Port to serve at.
    """

    checkpoint: tyro.conf.Positional[str | None] = None
    port: int = 7860
