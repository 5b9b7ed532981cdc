"""Publishes what `make release` has checked: the package, the policy, the environment and datasets.

    UV_PUBLISH_TOKEN=... HF_TOKEN=... make release HUB_USER=you DATASETS="data/train data/test"

Everything that can be refused beforehand is refused before the first part is published. The command can be
repeated after an interruption: on the Hub, a part replaces what was published of it before, and the package
index accepts the same files again. It accepts no other files of a version that it has.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from check_release import DISTRIBUTION, ROOT, ReleaseError, find_wheel, uv

from lerobot_deltaco.data.hub import (
    HubError,
    check_credentials,
    check_dataset,
    check_repo_id,
    push_dataset,
    push_files,
)

CHECKPOINT = ROOT / "checkpoints" / "pick_place"
ENVIRONMENT = ROOT / "envhub"
CARD = "README.md"
PARTS = ("package", "policy", "environment", "datasets")


@dataclass(frozen=True)
class Release:
    """What is published, and where.

    Attributes:
        user: User or organization on the Hub that the repositories belong to.
        datasets: Folders of the datasets.
        dist: Folder of the wheel and of the source distribution.
    """

    user: str
    datasets: Sequence[Path]
    dist: Path

    @property
    def policy_id(self) -> str:
        """Repository of the trained policy on the Hub."""
        return f"{self.user}/deltaco_{CHECKPOINT.name}"

    @property
    def environment_id(self) -> str:
        """Repository of the environment on the Hub, for LeRobot's `make_env`."""
        return f"{self.user}/deltaco"

    @cached_property
    def policy_files(self) -> dict[str, bytes]:
        """Files of the trained policy's repository, by name.

        Raises:
            ReleaseError: They cannot be read, or the card does not name the policy.
        """
        return _folder(CHECKPOINT, {CHECKPOINT.relative_to(ROOT).as_posix(): self.policy_id})

    @cached_property
    def environment_files(self) -> dict[str, bytes]:
        """Files of the environment's repository, by name.

        Raises:
            ReleaseError: They cannot be read, or the card does not name the environment.
        """
        return _folder(ENVIRONMENT, {"USER/NAME": self.environment_id})

    def dataset_id(self, root: Path) -> str:
        """Repository of a dataset on the Hub, named after the dataset's folder."""
        return f"{self.user}/deltaco_{root.resolve().name}"

    def check(self, parts: Sequence[str]) -> None:
        """Checks everything that can be checked before the first part is published.

        Raises:
            ReleaseError: A distribution, a card, a name or credentials are missing or not valid.
            HubError: A dataset, a repository's name or credentials are missing or not valid.
        """
        if "package" in parts:
            self._distributions()
            if shutil.which(uv()) is None:
                raise ReleaseError("uv is missing, which uploads the package. Install it: pip install uv.")
            if "UV_PUBLISH_TOKEN" not in os.environ:
                raise ReleaseError("Set UV_PUBLISH_TOKEN to a token of the package index.")
        if parts == ("package",):
            return
        check_repo_id(self.policy_id)
        if "policy" in parts:
            _ = self.policy_files
        if "environment" in parts:
            _ = self.environment_files
        if "datasets" in parts:
            ids = [self.dataset_id(root) for root in self.datasets]
            if len(set(ids)) < len(ids):
                raise ReleaseError(
                    f"Datasets are published under their folders' names, which must differ: {ids}."
                )
            for root, repo_id in zip(self.datasets, ids, strict=True):
                check_repo_id(repo_id)
                check_dataset(root)
        check_credentials()

    def publish_package(self) -> list[str]:
        """Uploads the wheel and the source distribution to the package index of uv's settings.

        Raises:
            ReleaseError: The index refuses them.
        """
        files = [str(path) for path in self._distributions()]
        result = subprocess.run([uv(), "publish", *files], capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise ReleaseError(f"`uv publish` failed:\n{result.stderr[-3000:]}")
        return [f"package {DISTRIBUTION}"]

    def publish_policy(self) -> list[str]:
        """Pushes the trained policy that the project comes with."""
        return [push_files(self.policy_files, self.policy_id, "Policy")]

    def publish_environment(self) -> list[str]:
        """Pushes the files by which LeRobot makes the environment from the Hub."""
        return [push_files(self.environment_files, self.environment_id, "Environment")]

    def publish_datasets(self) -> list[str]:
        """Pushes the datasets with their cards."""
        return [push_dataset(root, self.dataset_id(root)) for root in self.datasets]

    def _distributions(self) -> list[Path]:
        wheel = find_wheel(self.dist)
        sources = list(self.dist.glob(f"{DISTRIBUTION}-*.tar.gz"))
        if len(sources) != 1:
            raise ReleaseError(f"{self.dist} must have one source distribution. It has {len(sources)}.")
        return [wheel, *sources]


def main(arguments: Sequence[str] | None = None) -> None:
    """Publishes the parts in order, and stops at the first that fails."""
    parser = _parser()
    options = parser.parse_args(arguments)
    release = Release(options.user, options.datasets, options.dist)
    parts = tuple(part for part in PARTS if part in options.parts)
    publish: dict[str, Callable[[], list[str]]] = {
        "package": release.publish_package,
        "policy": release.publish_policy,
        "environment": release.publish_environment,
        "datasets": release.publish_datasets,
    }
    try:
        release.check(parts)
    except (ReleaseError, HubError) as error:
        parser.exit(1, f"Nothing was published: {error}\n")
    for index, part in enumerate(parts):
        try:
            for published in publish[part]():
                sys.stdout.write(f"Published {published}\n")
                sys.stdout.flush()
        except (ReleaseError, HubError, OSError, KeyboardInterrupt) as error:
            left = " ".join(parts[index:])
            reason = str(error) or "interrupted."
            parser.exit(1, f"{part}: {reason}\nGo on with --parts {left}.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "user", metavar="USER", help="user or organization on the Hub that the repositories belong to"
    )
    parser.add_argument(
        "--datasets",
        nargs="*",
        type=Path,
        default=[],
        metavar="ROOT",
        help="folders of datasets, published as USER/deltaco_FOLDER",
    )
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=PARTS, help="what to publish (default: everything)"
    )
    parser.add_argument(
        "--dist", type=Path, default=ROOT / "dist", metavar="DIR", help="folder of the wheel (%(default)s)"
    )
    return parser


def _folder(root: Path, names: Mapping[str, str]) -> dict[str, bytes]:
    """Files of a folder without subfolders, by name. In its card, names are replaced by repositories.

    Raises:
        ReleaseError: The files cannot be read, there is no card, or a name does not occur in it.
    """
    try:
        files = {path.name: path.read_bytes() for path in sorted(root.iterdir()) if path.is_file()}
    except OSError as error:
        raise ReleaseError(f"{root} cannot be read: {error}.") from error
    if CARD not in files:
        raise ReleaseError(f"{root} has no {CARD}, which is the card of the repository.")
    for name, repo_id in names.items():
        if name.encode() not in files[CARD]:
            raise ReleaseError(f"{root / CARD} does not say {name!r}, which is replaced by {repo_id!r}.")
        files[CARD] = files[CARD].replace(name.encode(), repo_id.encode())
    return files


if __name__ == "__main__":
    main()
