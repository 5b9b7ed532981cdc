"""Shares datasets on the Hugging Face Hub."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import pyarrow.parquet as pq
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, constants, get_token
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, RevisionNotFoundError
from huggingface_hub.utils import validate_repo_id

from lerobot_deltaco.cards.dataset_card import CARD_FILES, write_card
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection import STAGING, UNFINISHED

# What belongs to a dataset: nothing of a collection under way, nothing that only lies in the folder.
DATASET_PATTERNS = ("data/*.parquet", "meta/*.parquet", "meta/*.json")
_MAIN = "main"
_TOKENS_PAGE = "https://huggingface.co/settings/tokens"


class HubError(RuntimeError):
    """A dataset cannot be shared; the message says why, and what to do."""


def push_dataset(root: Path, repo_id: str, private: bool = False, branch: str | None = None) -> str:
    """Uploads a dataset and its card, and tags them with the version of their format.

    LeRobot fetches a dataset by that tag. It is set last, so a push that was interrupted shows nobody half a
    dataset; it can simply be done again.

    Args:
        root: The dataset's folder; it is only read.
        repo_id: "USER/NAME" on the Hub. It is made if there is none; what it has of an earlier dataset is
            replaced.
        private: Whether a new repository is for its owner only. False leaves it to the owner's settings.
        branch: Where to upload to, made if missing, without a tag. None is the main one.

    Returns:
        The dataset's address.

    Raises:
        HubError: The name is not valid, the dataset is not finished or damaged, credentials are missing or do
            not suffice, or the Hub cannot be reached.
    """
    check_repo_id(repo_id)
    check_dataset(root)
    check_credentials()
    # It takes 10 s to import.
    from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION, LeRobotDataset

    api = HfApi()
    with _one_line_errors(repo_id), TemporaryDirectory(prefix="deltaco_card_") as folder:
        card = Path(folder)
        write_card(root, card, repo_id)
        # The files are uploaded: one episode spares LeRobot a copy of all of them in its cache, and a named
        # video backend the search for one. A branch begins at the revision; the default is the tag, which a
        # new repository does not have.
        dataset = LeRobotDataset(repo_id, root=root, episodes=[0], revision=_MAIN, video_backend="pyav")
        dataset.push_to_hub(
            branch=branch,
            private=private or None,
            tag_version=False,
            allow_patterns=list(DATASET_PATTERNS),
            license="apache-2.0",
        )
        local = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
        remote = api.list_repo_files(repo_id, repo_type="dataset", revision=branch)
        operations = [
            *(CommitOperationAdd(str(file), card / file) for file in CARD_FILES),
            # LeRobot reads every file in these folders, so those of an earlier, larger dataset must go.
            *(
                CommitOperationDelete(path)
                for path in remote
                if path.startswith(("data/", "meta/")) and path not in local
            ),
        ]
        api.create_commit(
            repo_id, operations, commit_message="Dataset card", repo_type="dataset", revision=branch
        )
        if branch is None:
            with suppress(RevisionNotFoundError):
                api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
            api.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
    return f"{constants.ENDPOINT}/datasets/{repo_id}"


def check_repo_id(repo_id: str) -> None:
    """Checks the form of a name on the Hub.

    Raises:
        HubError: It is not "USER/NAME".
    """
    if repo_id.count("/") != 1:
        raise HubError(f"The repository id must be USER/NAME. Got {repo_id!r}.")
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise HubError(f"The repository id must be USER/NAME. {error}") from None


def check_credentials() -> None:
    """Checks that the Hub can be reached, and knows the user.

    Raises:
        HubError: It cannot, or does not.
    """
    if constants.HF_HUB_OFFLINE:
        raise HubError("HF_HUB_OFFLINE or TRANSFORMERS_OFFLINE is set. Unset it to use the Hub.")
    if get_token() is None:
        raise HubError(
            "There are no credentials for the Hugging Face Hub. Set HF_TOKEN to a token that may write "
            f"({_TOKENS_PAGE}), or log in with `hf auth login`."
        )
    with _one_line_errors():
        HfApi().whoami()


def check_dataset(root: Path) -> None:
    """Checks that a folder has a finished dataset of the benchmark, whose files are whole.

    Raises:
        HubError: It has not.
    """
    if not (root / files.INFO_FILE).exists():
        raise HubError(f"{root} holds no dataset: {files.INFO_FILE} is missing. `deltaco-collect` makes one.")
    info = _read(root / files.INFO_FILE)
    if info["codebase_version"] == UNFINISHED or (root / STAGING / "plan.json").exists():
        raise HubError(f"The collection in {root} is unfinished. Run its `deltaco-collect` command first.")
    features = info["features"]
    if "benchmark.task_id" not in features or "info" not in features.get("observation.image", {}):
        raise HubError(f"{root} holds a dataset that `deltaco-collect` did not make.")
    for file in (files.STATS_FILE, files.TASKS_FILE):
        _read(root / file)
    for folder, expected in (("data", info["total_frames"]), ("meta/episodes", info["total_episodes"])):
        n_rows = sum(_read(path).num_rows for path in sorted((root / folder).glob("*/*.parquet")))
        if n_rows != expected:
            raise HubError(
                f"The files in {root / folder} have {n_rows} rows, and {files.INFO_FILE} says {expected}: "
                "some are missing, or too many. Collect the dataset again, in a new folder."
            )


def _read(path: Path) -> Any:
    """Contents of a JSON file, or a Parquet file's own description of them."""
    try:
        return pq.read_metadata(path) if path.suffix == ".parquet" else json.loads(path.read_text())
    except (ValueError, OSError) as error:  # PyArrow's errors are ValueErrors
        raise HubError(
            f"The file {path} is damaged or missing ({error}). Collect the dataset again, in a new folder."
        ) from None


@contextmanager
def _one_line_errors(repo_id: str | None = None) -> Iterator[None]:
    """Turns what can go wrong with a network into a sentence."""
    try:
        yield
    except HfHubHTTPError as error:
        reason = " ".join(str(error).split())
        if error.response.status_code in (401, 403):
            owner = f" of {repo_id.split('/')[0]!r}" if repo_id else ""
            raise HubError(
                f"The Hub does not accept the credentials ({reason}). Set HF_TOKEN to a token that may write "
                f"to the repositories{owner} ({_TOKENS_PAGE})."
            ) from None
        raise HubError(f"The Hub refused ({reason}). The push can be repeated.") from None
    except (httpx.HTTPError, ConnectionError) as error:
        raise HubError(
            f"The Hub at {constants.ENDPOINT} cannot be reached ({error}). Push again when it can."
        ) from None
