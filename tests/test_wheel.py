"""The wheel holds everything: the commands work without the clone."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def run(site, tmp_path, *arguments):
    """What a command of the wheel prints, run in an empty folder."""
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    ).stdout


def test_both_packages_have_types(site):
    assert all((site / package / "py.typed").is_file() for package in ("lerobot_deltaco", "gym_deltaco"))


def test_the_experiments_of_the_wheel_are_listed_and_dry_run(site, tmp_path):
    program = "import lerobot_deltaco, gym_deltaco; print(lerobot_deltaco.__file__, gym_deltaco.__file__)"
    assert run(site, tmp_path, "-c", program).count(str(site)) == 2
    experiment = ("-m", "lerobot_deltaco.commands.experiment")
    names = run(site, tmp_path, *experiment, "--list").split()
    assert names == sorted(
        path.relative_to(ROOT / "experiments").with_suffix("").as_posix()
        for path in (ROOT / "experiments").glob("*/*.yaml")
        if path.stem != "shared"
    )
    lines = run(site, tmp_path, *experiment, *names, "--dry-run", "--seed", "0", "1").splitlines()
    assert len([line for line in lines if line.startswith("deltaco-train ")]) == 2 * len(names)
    assert len([line for line in lines if line.startswith("deltaco-evaluate ")]) == 2 * len(names)
    assert len(lines) == len(set(lines))
    assert list(tmp_path.iterdir()) == []
    card = "from lerobot_deltaco.cards import render; print(render('citation.md'))"
    assert "yu2023deltaco" in run(site, tmp_path, "-c", card)
