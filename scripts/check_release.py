"""Checks everything that a release needs: `make release`, or `make release ARGS=--rehearse` beforehand.

The wheel is built, installed with its dependencies in an empty environment, and used there from an empty
folder.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
DISTRIBUTION = "lerobot_policy_deltaco"

# What the installed package does, each in an interpreter of its own.
TRIALS = {
    "makes the environment": """
import gymnasium
env = gymnasium.make("gym_deltaco:gym_deltaco/PickPlace-v0", task_id=4)
observation, info = env.reset(seed=0)
assert observation["pixels"].shape == (48, 48, 3)
env.step(env.action_space.sample())
env.close()
""",
    "is found by LeRobot": """
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
assert "deltaco" in PreTrainedConfig.get_known_choices()
assert "deltaco" in EnvConfig.get_known_choices()
""",
    "brings its templates": f"""
from importlib.metadata import files
names = {{str(file) for file in files("{DISTRIBUTION}")}}
assert any(name.endswith("datasets_cards/policy.md") for name in names), names
""",
}


class ReleaseError(Exception):
    """Something that a release needs is missing; the message says what."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs all checks, and stops at the first that fails."""
    # Without abbreviations: `make release` looks for --rehearse itself.
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument(
        "--rehearse",
        action="store_true",
        help="skip the checks of version, change log and working tree, which only hold for a release",
    )
    parser.add_argument(
        "--dist", type=Path, default=ROOT / "dist", metavar="DIR", help="folder of the wheel (%(default)s)"
    )
    options = parser.parse_args(arguments)
    steps: list[tuple[str, Callable[[], object]]] = []
    if not options.rehearse:
        steps += [
            ("version and change log", lambda: check_version(ROOT)),
            ("working tree", lambda: check_working_tree(ROOT)),
        ]
    steps += [
        ("wheel", lambda: build_wheel(options.dist)),
        ("empty environment", lambda: try_wheel(find_wheel(options.dist))),
        ("documentation", build_documentation),
    ]
    for name, step in steps:
        sys.stdout.write(f"{name} ...\n")
        sys.stdout.flush()
        try:
            step()
        except ReleaseError as error:
            parser.exit(1, f"{name}: {error}\n")
    sys.stdout.write(f"Everything is ready for a release. The wheel is {find_wheel(options.dist)}.\n")


def check_version(root: Path) -> str:
    """Checks that one version is named everywhere, and that the change log has a dated section of it.

    Args:
        root: The repository's folder.

    Returns:
        The version.

    Raises:
        ReleaseError: Versions differ, or the change log is not ready.
    """
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = re.search(
        r"^version: (\S+)$", (root / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    if citation is None or citation[1] != version:
        found = citation[1] if citation else "no version"
        raise ReleaseError(f"pyproject.toml has version {version}, CITATION.cff has {found}.")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    heading, _, text = changes.partition("\n## ")[2].partition("\n")
    if not re.fullmatch(rf"{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", heading):
        raise ReleaseError(
            f'The first section of CHANGELOG.md must be "## {version} (YEAR-MONTH-DAY)". Got "## {heading}". '
            "Move the unreleased changes there."
        )
    if "\n- " not in text.partition("\n## ")[0]:
        raise ReleaseError(f"CHANGELOG.md lists no changes of version {version}.")
    return version


def check_working_tree(root: Path) -> None:
    """Checks that everything is committed, and that the version is not tagged yet.

    Args:
        root: The repository's folder.

    Raises:
        ReleaseError: There are changes, or there is the tag.
    """
    changes = _run(["git", "status", "--porcelain"], root).strip()
    if changes:
        raise ReleaseError(f"Commit or remove these changes first:\n{changes}")
    tag = f"v{check_version(root)}"
    if tag in _run(["git", "tag", "--list", tag], root).split():
        raise ReleaseError(f"The tag {tag} is there already. Choose a new version.")


def build_wheel(dist: Path) -> None:
    """Builds the wheel and the source distribution, from a copy of what git tracks.

    Args:
        dist: Folder to build into; earlier builds in it are removed.

    Raises:
        ReleaseError: The build fails, or the wheel lacks something.
    """
    for old in (*dist.glob("*.whl"), *dist.glob("*.tar.gz")):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        tracked = _run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], ROOT)
        for name in filter(None, tracked.split("\0")):
            if (ROOT / name).is_file():
                target = Path(folder, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, target)
        _run([uv(), "build", "--python", sys.executable, "--out-dir", str(dist.resolve())], Path(folder))
    names = set(zipfile.ZipFile(find_wheel(dist)).namelist())
    for needed in (f"{DISTRIBUTION}.py", "gym_deltaco/env.py", "lerobot_deltaco/modeling_deltaco.py"):
        if needed not in names:
            raise ReleaseError(f"The wheel lacks {needed}.")
    if any(name.startswith(("tests/", "docs/")) for name in names):
        raise ReleaseError("The wheel has tests or documentation in it.")


def find_wheel(dist: Path) -> Path:
    """The wheel in a folder.

    Raises:
        ReleaseError: There is none, or there are several.
    """
    wheels = list(dist.glob(f"{DISTRIBUTION}-*.whl"))
    if len(wheels) != 1:
        raise ReleaseError(f"{dist} must have one wheel. It has {len(wheels)}.")
    return wheels[0]


def try_wheel(wheel: Path) -> None:
    """Installs a wheel in an empty environment, and uses it from an empty folder.

    Args:
        wheel: The wheel.

    Raises:
        ReleaseError: It cannot be installed, or does not do what it should.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment, elsewhere = Path(folder, "venv"), Path(folder, "elsewhere")
        elsewhere.mkdir()
        _run([uv(), "venv", "--python", sys.executable, str(environment)], ROOT)
        python = environment / "bin" / "python"
        # In the repository's folder, where uv finds that PyBullet is built with NumPy.
        _run([uv(), "pip", "install", "--python", str(python), f"{wheel}[{_extras()}]"], ROOT)
        for what, code in TRIALS.items():
            try:
                _run([str(python), "-c", code], elsewhere)
            except ReleaseError as error:
                raise ReleaseError(f"The installed package fails where it {what}: {error}") from None
        scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
        for script in scripts:
            _run([str(environment / "bin" / script), "--help"], elsewhere)
        collect = [str(environment / "bin" / "deltaco-collect"), "--tasks", "4", "--episodes-per-task", "1"]
        _run([*collect, "--root", str(elsewhere / "data"), "--workers", "1"], elsewhere)


def _extras() -> str:
    """The extras that a user installs: the simulator, if it is one, and what works offline."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    return ",".join(name for name in ("sim", "offline") if name in extras)


def build_documentation() -> None:
    """Builds the documentation, as `make docs` does.

    Raises:
        ReleaseError: There is a warning or an error.
    """
    arguments = ["--builder", "html", "--fail-on-warning", "--fresh-env", "--quiet"]
    _run([sys.executable, "-m", "sphinx", *arguments, "docs", "docs/_build/html"], ROOT)


def uv() -> str:
    """Path of this environment's uv, or the name of another one."""
    beside = Path(sys.executable).with_name("uv")
    return str(beside) if beside.exists() else "uv"


def _run(command: Sequence[str], folder: Path) -> str:
    """Output of a command. It sees nothing of this environment's packages.

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
        if error.filename != command[0]:
            raise
        raise ReleaseError(f"`{command[0]}` is missing. Install it.") from error
    if result.returncode != 0:
        raise ReleaseError(f"`{' '.join(command)[:200]}` failed:\n{(result.stdout + result.stderr)[-3000:]}")
    return result.stdout


if __name__ == "__main__":
    main()
