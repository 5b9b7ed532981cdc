"""Shares datasets, and the files of other repositories, on the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, constants, get_token
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, RevisionNotFoundError
from huggingface_hub.utils import validate_repo_id

from lerobot_deltaco.cards.dataset_card import CARD_FILES, write_card
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.finished_dataset import verify_dataset
from lerobot_deltaco.data.integrity import DIGESTS_FILE, DatasetError

# What belongs to a dataset: nothing of a collection under way, nothing that only lies in the folder.
DATASET_PATTERNS = ("data/*/*.parquet", "meta/**/*.parquet", "meta/*.json", str(DIGESTS_FILE))
_TOKENS_PAGE = "https://huggingface.co/settings/tokens"


class HubError(RuntimeError):
    """Something cannot be shared; the message says why, and what to do."""


def push_dataset(root: Path, repo_id: str, private: bool = False, branch: str | None = None) -> str:
    """Uploads a dataset and its card, and tags them with the version of their format.

    All files arrive in one commit. LeRobot fetches a dataset by the tag, which is set last; a push that was
    interrupted can simply be done again.

    Args:
        root: The dataset's folder; it is only read.
        repo_id: "USER/NAME" on the Hub. It is made if there is none; what it has of an earlier dataset is
            replaced.
        private: Whether a new repository is private. False leaves it to the owner's settings.
        branch: Branch to upload to, created if missing, without a tag; None for the main branch.

    Returns:
        The dataset's address.

    Raises:
        HubError: The name is not valid, the dataset is not finished or damaged, credentials are missing or do
            not suffice, or the Hub cannot be reached. The message says what has arrived.
    """
    check_repo_id(repo_id)
    check_dataset(root)
    check_credentials()
    api = HfApi()
    tag = files.CODEBASE_VERSION
    with TemporaryDirectory(prefix="deltaco_card_") as folder:
        card = Path(folder)
        write_card(root, card, repo_id)
        with _one_line_errors(repo_id, "Nothing has arrived."):
            api.create_repo(repo_id, repo_type="dataset", private=private or None, exist_ok=True)
            if branch is not None:
                api.create_branch(repo_id, branch=branch, repo_type="dataset", exist_ok=True)
            remote = api.list_repo_files(repo_id, repo_type="dataset", revision=branch)
        local = {
            str(path.relative_to(root)): path
            for pattern in DATASET_PATTERNS
            for path in root.glob(pattern)
            if path.is_file() and not path.name.startswith(".")
        }
        operations: list[CommitOperationAdd | CommitOperationDelete] = [
            *(CommitOperationAdd(name, path) for name, path in sorted(local.items())),
            *(CommitOperationAdd(str(file), card / file) for file in CARD_FILES),
            # LeRobot reads every file in these folders, so those of an earlier, larger dataset must go.
            *(
                CommitOperationDelete(path)
                for path in remote
                if path.startswith(("data/", "meta/")) and path not in local
            ),
        ]
        _commit(api, repo_id, operations, "Dataset", repo_type="dataset", revision=branch)
    if branch is None:
        arrived = f"All files have arrived, but the tag {tag!r}, by which LeRobot fetches them, is not set."
        with _one_line_errors(repo_id, arrived):
            with suppress(RevisionNotFoundError):
                api.delete_tag(repo_id, tag=tag, repo_type="dataset")
            api.create_tag(repo_id, tag=tag, repo_type="dataset")
    return f"{constants.ENDPOINT}/datasets/{repo_id}"


def push_files(files: Mapping[str, bytes], repo_id: str, message: str) -> str:
    """Uploads files to a model repository in one commit, in place of those that it has.

    Args:
        files: Contents of the files, by name.
        repo_id: "USER/NAME" on the Hub. It is made if there is none.
        message: Title of the commit.

    Returns:
        The repository's address.

    Raises:
        HubError: Credentials are missing or do not suffice, or the Hub cannot be reached.
    """
    api = HfApi()
    with _one_line_errors(repo_id, "Nothing has arrived."):
        api.create_repo(repo_id, exist_ok=True)
        remote = api.list_repo_files(repo_id)
    operations: list[CommitOperationAdd | CommitOperationDelete] = [
        *(CommitOperationAdd(name, content) for name, content in files.items()),
        *(CommitOperationDelete(name) for name in remote if name not in files and name != ".gitattributes"),
    ]
    _commit(api, repo_id, operations, message)
    return f"{constants.ENDPOINT}/{repo_id}"


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
    try:
        verify_dataset(root)
    except DatasetError as error:
        raise HubError(str(error)) from None


def _commit(
    api: HfApi,
    repo_id: str,
    operations: list[CommitOperationAdd | CommitOperationDelete],
    message: str,
    repo_type: str = "model",
    revision: str | None = None,
) -> None:
    """Changes files of a repository in one commit."""
    with _one_line_errors(repo_id, f"{repo_id} has either all of the new files or none of them."):
        try:
            api.create_commit(
                repo_id, operations, commit_message=message, repo_type=repo_type, revision=revision
            )
        except ValueError as error:  # before anything is uploaded
            if isinstance(error, HfHubHTTPError):
                raise
            raise HubError(
                f"The Hub at {constants.ENDPOINT} cannot check the card of {repo_id} ({error}). Nothing has "
                "arrived. Push again when it can."
            ) from None


@contextmanager
def _one_line_errors(repo_id: str | None = None, arrived: str = "") -> Iterator[None]:
    """Turns what can go wrong with a network into a sentence.

    Args:
        repo_id: Name of the repository that is written to.
        arrived: Sentence that says what has arrived in the repository so far.
    """
    arrived = f" {arrived}" if arrived else ""
    try:
        yield
    except HfHubHTTPError as error:
        reason = " ".join(str(error).split())
        if error.response.status_code in (401, 403):
            owner = f" of {repo_id.split('/')[0]!r}" if repo_id else ""
            raise HubError(
                f"The Hub does not accept the credentials ({reason}).{arrived} Set HF_TOKEN to a token that "
                f"may write to the repositories{owner} ({_TOKENS_PAGE})."
            ) from None
        raise HubError(f"The Hub refused ({reason}).{arrived} The push can be repeated.") from None
    except (httpx.HTTPError, ConnectionError) as error:
        raise HubError(
            f"The Hub at {constants.ENDPOINT} cannot be reached ({error}).{arrived} Push again when it can."
        ) from None
