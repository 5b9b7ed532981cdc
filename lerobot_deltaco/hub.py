"""Publishes datasets on the Hugging Face Hub."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import httpx
from huggingface_hub import DatasetCard, HfApi, constants, get_token
from huggingface_hub.errors import HFValidationError, RevisionNotFoundError
from huggingface_hub.utils import validate_repo_id

from lerobot_deltaco.collect import is_finished
from lerobot_deltaco.dataset_card import CARD_FILE, write_dataset_card
from lerobot_deltaco.dataset_writer import CODEBASE_VERSION


class HubError(RuntimeError):
    """Raised when something cannot be published; the message says why, and what to do."""


def check_push(repo_id: str) -> None:
    """Checks the requirements of a push, so that a collection that ends with one fails early.

    Raises:
        HubError: The repository id is invalid, or there is no token.
    """
    try:
        if repo_id.count("/") != 1:
            raise HFValidationError("It must have one slash.")
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise HubError(f"The repository id must be USER/NAME. Got {repo_id!r}. {error}") from None
    if get_token() is None:
        raise HubError(
            "There is no token for the Hugging Face Hub. Set HF_TOKEN to a token with write access "
            "(https://huggingface.co/settings/tokens), or log in with `hf auth login`."
        )


def push(root: Path, repo_id: str, private: bool = False, branch: str | None = None) -> str:
    """Uploads a finished dataset with its card.

    Args:
        root: Folder of the dataset. The card is written into it.
        repo_id: "USER/NAME" on the Hub. The repository is created if it does not exist; its files from an
            earlier dataset are deleted.
        private: Whether to create a new repository as private.
        branch: Branch to upload to, created if it does not exist. None: the main branch, tagged with the
            version of the format, which LeRobot looks for.

    Returns:
        Address of the dataset.

    Raises:
        HubError: The dataset is not finished, the repository id is invalid, there is no token, or the Hub
            refuses or cannot be reached.
    """
    check_push(repo_id)
    if not is_finished(root):
        raise HubError(f"{root} holds no finished dataset of `deltaco collect`. Run `deltaco collect` first.")
    write_dataset_card(root, repo_id)
    # Imported here, since it takes 10 s.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    api = HfApi()
    try:
        dataset = LeRobotDataset(repo_id, root=root, revision="main")
        # The tag is set below, on the commit with our card.
        dataset.push_to_hub(branch=branch, private=private or None, tag_version=False)
        remote = api.list_repo_files(repo_id, repo_type="dataset", revision=branch)
        # LeRobot reads every file in these folders.
        stale = [
            name for name in remote if name.startswith(("data/", "meta/")) and not (root / name).exists()
        ]
        if stale:
            api.delete_files(repo_id, stale, repo_type="dataset", revision=branch)
        card = DatasetCard.load(root / CARD_FILE)
        card.push_to_hub(repo_id, repo_type="dataset", revision=branch)
        if branch is None:
            with suppress(RevisionNotFoundError):
                api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
            api.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
    except (httpx.HTTPError, OSError) as error:
        reason = " ".join(str(error).split())
        raise HubError(f"Cannot push to {repo_id}: {reason} A push can be repeated.") from None
    return f"{constants.ENDPOINT}/datasets/{repo_id}"
