"""Where checkpoints and datasets may come from: folders that are allowed, and the Hugging Face Hub."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import httpx
from huggingface_hub import HfApi, constants, snapshot_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
from huggingface_hub.utils import filter_repo_objects

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco.play.errors import PlayError

logger = logging.getLogger(__name__)

MAX_HUB_BYTES = 1_000_000_000
MIN_FREE_BYTES = 5_000_000_000  # that a download leaves on the disk


class Kind(NamedTuple):
    """What is looked for.

    Attributes:
        word: The word for it, for messages.
        repo_type: Type of its repositories on the Hub.
        patterns: Files that are fetched of a repository, all of them data.
    """

    word: str
    repo_type: str
    patterns: tuple[str, ...]


CHECKPOINT = Kind("checkpoint", "model", ("*.json", "*.safetensors"))
DATASET = Kind(
    "dataset", "dataset", ("meta/*.json", "meta/*.jsonl", "meta/*.parquet", "data/*.parquet", "videos/*.mp4")
)


def find_folder(name: str, kind: Kind, roots: Sequence[Path], is_hub_allowed: bool) -> Path:
    """The folder of a checkpoint or a dataset, whose files are not checked yet.

    Args:
        name: Folder, or the repository's id on the Hugging Face Hub.
        kind: What is looked for.
        roots: Folders in which it may lie, at any depth.
        is_hub_allowed: Whether it may be downloaded.

    Raises:
        PlayError: There is none, or it may not be loaded.
    """
    name = name.strip()
    if not name:
        valid = _valid_names(kind, roots, is_hub_allowed)
        raise PlayError(f"The name of the {kind.word} is empty. Enter {valid}.")
    folder = _allowed_folder(name, roots)
    if folder is not None:
        return folder
    is_repo_id = re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", name, re.ASCII) is not None
    if not is_repo_id or not is_hub_allowed:
        valid = _valid_names(kind, roots, is_hub_allowed)
        raise PlayError(f"There is no {kind.word} {name!r} that this page may load. Enter {valid}.")
    return _downloaded(name, kind)


def read_json(path: Path, name: str) -> dict[str, Any]:
    """The object in a file of what the user named.

    Raises:
        PlayError: The file cannot be read, or holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise PlayError(f"{name!r} is damaged: {path.name} cannot be read.") from error
    if not isinstance(content, dict):
        raise PlayError(f"{name!r} is damaged: {path.name} holds no object.")
    return content


def _allowed_folder(name: str, roots: Sequence[Path]) -> Path | None:
    """The folder that a name stands for; None if there is none that lies in one of the roots."""
    try:
        folder = Path(name).expanduser().resolve()
        is_allowed = any(folder.is_relative_to(root.resolve()) for root in roots)
        return folder if is_allowed and folder.is_dir() else None
    except (OSError, ValueError, RuntimeError):  # too long, a null character, no such user
        return None


def _downloaded(repo_id: str, kind: Kind) -> Path:
    """The folder of a public repository's files, of which only data are fetched.

    The host's token is not used: visitors are not to see what only the host may.
    """
    revision = None
    try:
        if not constants.HF_HUB_OFFLINE:
            info = HfApi(token=False).repo_info(repo_id, repo_type=kind.repo_type, files_metadata=True)
            revision = info.sha  # what is checked, even if the repository changes meanwhile
            files = filter_repo_objects(
                getattr(info, "siblings", None) or (),
                allow_patterns=list(kind.patterns),
                key=lambda file: file.rfilename,
            )
            sizes = {file.rfilename: file.size or 0 for file in files}
            if not _is_cached(repo_id, kind, revision, sizes):
                _check_size(sum(sizes.values()), repo_id)
        folder = snapshot_download(
            repo_id,
            repo_type=kind.repo_type,
            revision=revision,
            allow_patterns=list(kind.patterns),
            token=False,
        )
        if revision is not None:
            # As the head of the branch, so that it is found again without the Hub.
            write_text(Path(folder).parents[1] / "refs" / constants.DEFAULT_REVISION, revision)
        return Path(folder)
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError) as error:
        reason = " ".join(str(error).split())[:200]
        raise PlayError(
            f"The {kind.word} {repo_id!r} cannot be fetched from the Hugging Face Hub: {reason}"
        ) from error
    except (httpx.HTTPError, OSError) as error:
        # The details may name files of this machine. They are for the terminal.
        logger.warning("The %s %r cannot be fetched.", kind.word, repo_id, exc_info=error)
        raise PlayError(
            f"The {kind.word} {repo_id!r} cannot be fetched: the Hugging Face Hub cannot be reached, or the "
            "files cannot be written. The terminal of the page has the details."
        ) from error


def _is_cached(repo_id: str, kind: Kind, revision: str | None, files: Iterable[str]) -> bool:
    """Whether files of a repository need not be downloaded."""
    try:
        folder = snapshot_download(
            repo_id, repo_type=kind.repo_type, revision=revision, local_files_only=True, token=False
        )
    except LocalEntryNotFoundError:
        return False
    return all((Path(folder) / name).exists() for name in files)


def _check_size(n_bytes: int, repo_id: str) -> None:
    """Checks that a repository is not too large.

    Raises:
        PlayError: It is, or the disk has too little space for it.
    """
    if n_bytes > MAX_HUB_BYTES:
        raise PlayError(
            f"{repo_id!r} has {n_bytes / 1e9:.1f} GB; at most {MAX_HUB_BYTES / 1e9:g} are loaded."
        )
    cache = Path(constants.HF_HUB_CACHE)
    folder = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if shutil.disk_usage(folder).free - n_bytes < MIN_FREE_BYTES:
        raise PlayError(
            f"{repo_id!r} cannot be fetched: the disk of this page would be too full, with less than "
            f"{MIN_FREE_BYTES / 1e9:g} GB free. Whoever serves the page has to make room."
        )


def _valid_names(kind: Kind, roots: Sequence[Path], is_hub_allowed: bool) -> str:
    folders = " or ".join(str(root) for root in roots)
    hub = "the id USER/NAME of one on the Hugging Face Hub"
    local = f"the folder of a {kind.word} in {folders}"
    return " or ".join([*([local] if roots else []), *([hub] if is_hub_allowed else [])])
