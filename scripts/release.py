"""Checks what a release needs: `make release`. The commands that publish it are printed at the end.

The wheel is built, installed in an empty environment, and used there from an empty folder.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"

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
PUBLISHING = """Everything is ready for a release. To publish it, with UV_PUBLISH_TOKEN and HF_TOKEN set:
    uv publish dist/*
    hf upload USER/deltaco_pick_place checkpoints/pick_place
    deltaco collect --tasks scenario_a_train --episodes-per-task 50 --root data/train --push-to-hub USER/NAME
"""


class ReleaseError(Exception):
    """Raised when something that a release needs is missing; the message says what."""


def main(rehearse: bool = False) -> None:
    """Checks everything; stops at the first problem.

    Args:
        rehearse: Whether to skip the checks of version, change log and working tree.
    """
    try:
        if not rehearse:
            check_version(ROOT)
            check_working_tree(ROOT)
        try_wheel(build_wheel(DIST))
        _run(
            [sys.executable, "-m", "sphinx", "-b", "html", "-W", "-E", "-q", "docs", "docs/_build/html"], ROOT
        )
    except ReleaseError as error:
        sys.exit(f"release: {error}")
    sys.stdout.write(PUBLISHING)


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


def _uv() -> str:
    """Returns this environment's uv, or the name of another one."""
    beside = Path(sys.executable).with_name("uv")
    return str(beside) if beside.exists() else "uv"


def _run(command: Sequence[str], folder: Path) -> str:
    """Returns the output of a command, which sees nothing of this environment's packages.

    Raises:
        ReleaseError: It fails.
    """
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        raise ReleaseError(f"`{' '.join(command)[:200]}` failed:\n{(result.stdout + result.stderr)[-3000:]}")
    return result.stdout


if __name__ == "__main__":
    import tyro

    tyro.cli(main, description=(__doc__ or "").partition("\n")[0])
