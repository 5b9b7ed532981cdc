"""Checks everything that a release needs, and publishes it: `make release`, `make release HUB_USER=you`.

The wheel is built, installed in an empty environment, and used there from an empty folder. Publishing needs
UV_PUBLISH_TOKEN and HF_TOKEN. It can be repeated: on the Hub, a part replaces an earlier one, and the package
index accepts the same files again.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from huggingface_hub import HfApi

from lerobot_deltaco.collect import is_finished
from lerobot_deltaco.hub import HubError, check_push, push

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
CHECKPOINT = ROOT / "checkpoints" / "pick_place"
CARD = "README.md"

TRIAL = """
import gymnasium
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
assert {"deltaco", "deltaco_match"} <= set(PreTrainedConfig.get_known_choices())
assert "deltaco" in EnvConfig.get_known_choices()
env = gymnasium.make("gym_deltaco:gym_deltaco/PickPlace-v0", task_id=4)
observation, info = env.reset(seed=0)
assert observation["pixels"].shape == (48, 48, 3)
env.close()
"""


class ReleaseError(Exception):
    """Raised when something that a release needs is missing; the message says what."""


def main() -> None:
    """Runs the command line."""
    import tyro

    tyro.cli(release, description=(__doc__ or "").partition("\n")[0])


def release(user: str | None = None, datasets: tuple[Path, ...] = (), rehearse: bool = False) -> None:
    """Checks, and publishes if a user is named; stops at the first problem.

    Args:
        user: User or organization on the Hub that gets the policy and the datasets. By default, nothing
            is published.
        datasets: Folders of datasets, published as USER/deltaco_FOLDER.
        rehearse: Whether to skip the checks of version, change log and working tree.
    """
    try:
        if not rehearse:
            check_version(ROOT)
            check_working_tree(ROOT)
        elif user is not None:
            raise ReleaseError("A rehearsal publishes nothing: leave out --user.")
        if user is not None:
            check_publishing(user, datasets)
        try_wheel(build_wheel(DIST))
        _run(
            [sys.executable, "-m", "sphinx", "-b", "html", "-W", "-E", "-q", "docs", "docs/_build/html"], ROOT
        )
        sys.stdout.write(f"Everything is ready for a release. The packages are in {DIST}.\n")
        if user is not None:
            publish(user, datasets)
    except (ReleaseError, HubError) as error:
        sys.exit(f"release: {error}")


# Checks


def check_version(root: Path) -> str:
    """Checks that one version is named everywhere, and that the change log has a dated section of it.

    Args:
        root: Folder of the repository.

    Returns:
        The version.

    Raises:
        ReleaseError: Versions differ, or the change log is not ready.
    """
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    if f"\nversion: {version}\n" not in (root / "CITATION.cff").read_text(encoding="utf-8"):
        raise ReleaseError(f"pyproject.toml has version {version}, CITATION.cff has another one.")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    heading, _, text = changes.partition("\n## ")[2].partition("\n")
    if not re.fullmatch(rf"{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", heading):
        raise ReleaseError(
            f'The first section of CHANGELOG.md must be "## {version} (YEAR-MONTH-DAY)". Got "## {heading}".'
        )
    if not text.partition("\n## ")[0].strip():
        raise ReleaseError(f"CHANGELOG.md says nothing of version {version}.")
    return version


def check_working_tree(root: Path) -> None:
    """Checks that everything is committed, and that the version is not tagged yet.

    Raises:
        ReleaseError: There are changes, or there is the tag.
    """
    changes = _run(["git", "status", "--porcelain"], root).strip()
    if changes:
        raise ReleaseError(f"Commit or remove these changes first:\n{changes}")
    tag = f"v{check_version(root)}"
    if tag in _run(["git", "tag", "--list", tag], root).split():
        raise ReleaseError(f"The tag {tag} exists already. Choose a new version.")


def check_publishing(user: str, datasets: Sequence[Path]) -> None:
    """Checks what publishing needs, before anything is published.

    Raises:
        ReleaseError: A token, a card or a dataset is missing, or two datasets have the same name.
        HubError: The user's name is invalid, or there is no token for the Hub.
    """
    if "UV_PUBLISH_TOKEN" not in os.environ:
        raise ReleaseError("Set UV_PUBLISH_TOKEN to a token of the package index.")
    hub_files(CHECKPOINT, {"checkpoints/pick_place": f"{user}/deltaco_pick_place"})
    names = [dataset_id(user, root) for root in datasets]
    if len(set(names)) < len(names):
        raise ReleaseError(
            f"Datasets are published under the names of their folders, which must differ: {names}."
        )
    for root, name in zip(datasets, names, strict=True):
        check_push(name)
        if not is_finished(root):
            raise ReleaseError(f"{root} holds no finished dataset of `deltaco collect`.")
    check_push(f"{user}/deltaco_pick_place")


def build_wheel(dist: Path) -> Path:
    """Builds the wheel and the source distribution, and returns the wheel."""
    for old in dist.glob("lerobot_policy_deltaco-*"):
        old.unlink()
    _run([_uv(), "build", "--python", sys.executable, "--out-dir", str(dist.resolve())], ROOT)
    (wheel,) = dist.glob("*.whl")
    return wheel


def try_wheel(wheel: Path) -> None:
    """Installs a wheel in an empty environment, and uses it from an empty folder.

    Raises:
        ReleaseError: It cannot be installed, or does not do what it should.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment, elsewhere = Path(folder, "venv"), Path(folder, "elsewhere")
        elsewhere.mkdir()
        _run([_uv(), "venv", "--python", sys.executable, str(environment)], ROOT)
        python, deltaco = str(environment / "bin" / "python"), str(environment / "bin" / "deltaco")
        # In the repository's folder, where uv is told to build PyBullet with NumPy.
        _run([_uv(), "pip", "install", "--python", python, f"{wheel}[sim,offline]"], ROOT)
        _run([python, "-c", TRIAL], elsewhere)
        _run([deltaco, "collect", "--tasks", "4", "--episodes-per-task", "1", "--root", "data"], elsewhere)
        checkpoint = next(environment.rglob("checkpoints/pick_place"))
        _run([deltaco, "evaluate", str(checkpoint), "--tasks", "24", "--trials", "1"], elsewhere)


# Publishing


def publish(user: str, datasets: Sequence[Path]) -> None:
    """Publishes the package, the trained policy and datasets, in this order."""
    _run([_uv(), "publish", *map(str, DIST.glob("lerobot_policy_deltaco-*"))], ROOT)
    policy = f"{user}/deltaco_pick_place"
    addresses = [
        push_files(hub_files(CHECKPOINT, {"checkpoints/pick_place": policy}), policy),
        *(push(root, dataset_id(user, root)) for root in datasets),
    ]
    sys.stdout.writelines(f"Published {address}\n" for address in addresses)


def dataset_id(user: str, root: Path) -> str:
    """Returns the repository of a dataset, which is named after its folder."""
    return f"{user}/deltaco_{root.resolve().name}"


def hub_files(folder: Path, names: Mapping[str, str]) -> dict[str, bytes]:
    """Reads the files of a folder, and replaces names in its card.

    Args:
        folder: The folder, without folders in it.
        names: Repositories, by the names that stand for them in the card.

    Raises:
        ReleaseError: There is no card, or a name does not occur in it.
    """
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}
    for name, repo_id in names.items():
        if name.encode() not in files.get(CARD, b""):
            raise ReleaseError(f"{folder / CARD} does not say {name!r}, which is replaced by {repo_id!r}.")
        files[CARD] = files[CARD].replace(name.encode(), repo_id.encode())
    return files


def push_files(files: Mapping[str, bytes], repo_id: str) -> str:
    """Uploads files to the repository of a policy, and returns its address."""
    api = HfApi()
    url = api.create_repo(repo_id, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        api.upload_folder(repo_id=repo_id, folder_path=folder, delete_patterns="*")
    return str(url)


def _uv() -> str:
    """Returns this environment's uv, or the name of another one."""
    beside = Path(sys.executable).with_name("uv")
    return str(beside) if beside.exists() else "uv"


def _run(command: Sequence[str], folder: Path) -> str:
    """Returns the output of a command, which sees nothing of this environment's packages.

    Raises:
        ReleaseError: It fails, or there is no such command.
    """
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    try:
        result = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
    except FileNotFoundError as error:
        raise ReleaseError(f"`{command[0]}` is missing. Install it.") from error
    if result.returncode != 0:
        raise ReleaseError(f"`{' '.join(command)[:200]}` failed:\n{(result.stdout + result.stderr)[-3000:]}")
    return result.stdout


if __name__ == "__main__":
    main()
