"""Publishes datasets on the Hugging Face Hub."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import httpx
import tyro
from huggingface_hub import HfApi
from huggingface_hub.errors import HFValidationError, RevisionNotFoundError

from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.collection.dataset_card import write_dataset_card
from lerobot_deltaco.collection.writer import CODEBASE_VERSION
from lerobot_deltaco.errors import UserError


class HubError(UserError):
    """Raised when something cannot be published; the message says why, and what to do."""


def collect_and_push(
    root: Path,
    plan: Annotated[CollectionPlan, tyro.conf.arg(name="")],
    workers: int = len(os.sched_getaffinity(0)),
    push_to_hub: str | None = None,
    private: bool = False,
) -> str:
    """Collects successful episodes of the expert, or continues an interrupted collection.

    Args:
        root: Folder of the dataset.
        plan: Episodes to collect.
        workers: Number of processes; the dataset is the same with any number.
        push_to_hub: Repository on the Hugging Face Hub, USER/NAME, where the finished dataset is published
            with its card; needs HF_TOKEN.
        private: Whether a new repository on the Hub is private.
    """
    if push_to_hub is not None:
        create_repository(push_to_hub, private)  # fails before a long collection
    summary = collect(root, plan, workers)
    return summary if push_to_hub is None else f"{summary}\nThe dataset is at {push(root, push_to_hub)}."


@contextmanager
def _publishing(repo_id: str) -> Iterator[None]:
    """Reports in one line what the Hub refuses."""
    try:
        yield
    except (httpx.HTTPError, HFValidationError, OSError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise HubError(
            f"Cannot push to {repo_id!r}: {reason}. The repository id is USER/NAME, and HF_TOKEN a token "
            "with write access. A push can be repeated."
        ) from None


def create_repository(repo_id: str, private: bool = False) -> None:
    """Creates the repository of a dataset unless it exists.

    Raises:
        HubError: The id is invalid, there is no token that may write, or the Hub cannot be reached.
    """
    with _publishing(repo_id):
        HfApi().create_repo(repo_id, private=private or None, repo_type="dataset", exist_ok=True)


def push(root: Path, repo_id: str) -> str:
    """Uploads a finished dataset with its card, tagged with the version that LeRobot looks for.

    It replaces an earlier dataset in the repository, of which LeRobot's own `push_to_hub` would keep files.

    Returns:
        Address of the dataset.

    Raises:
        HubError: The Hub refuses, or cannot be reached.
    """
    write_dataset_card(root, repo_id)
    api, patterns = HfApi(), ["data/*", "meta/*"]
    with _publishing(repo_id):
        api.upload_folder(repo_id=repo_id, folder_path=root, repo_type="dataset", delete_patterns=patterns)
        with suppress(RevisionNotFoundError):
            api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
        api.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
    return f"{api.endpoint}/datasets/{repo_id}"
