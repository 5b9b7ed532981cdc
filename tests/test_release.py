"""What `make release` checks of versions, change log and wheel."""

import importlib.util
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
_SPEC = importlib.util.spec_from_file_location("check_release", ROOT / "scripts" / "check_release.py")
check_release = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(check_release)

CHANGES = """# Changelog

## 1.2.0 (2026-11-30)

### Added

- A thing.

## 1.1.0 (2026-10-01)

- Old.
"""


@pytest.fixture
def repository(tmp_path):
    """A repository that is ready for the release of 1.2.0."""
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.2.0"\n')
    (tmp_path / "CITATION.cff").write_text("title: x\nversion: 1.2.0\n")
    (tmp_path / "CHANGELOG.md").write_text(CHANGES)
    return tmp_path


def test_a_repository_that_is_ready_passes(repository):
    assert check_release.check_version(repository) == "1.2.0"


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("CITATION.cff", "1.2.0", "1.1.0", "pyproject.toml has version 1.2.0, CITATION.cff has 1.1.0"),
        ("CHANGELOG.md", "1.2.0 (2026-11-30)", "Unreleased", 'Got "## Unreleased"'),
        ("CHANGELOG.md", "- A thing.", "", "lists no changes of version 1.2.0"),
    ],
)
def test_what_is_missing_is_named(repository, file, before, after, message):
    path = repository / file
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(check_release.ReleaseError) as error:
        check_release.check_version(repository)
    assert message in str(error.value)


def test_the_tree_must_be_clean_and_the_version_new(repository):
    def git(*words):
        identity = ["-c", "user.name=Test", "-c", "user.email=test@example.org"]
        subprocess.run(["git", *identity, *words], cwd=repository, check=True, capture_output=True)

    git("init")
    with pytest.raises(check_release.ReleaseError, match="Commit or remove"):
        check_release.check_working_tree(repository)
    git("add", "-A")
    git("commit", "-m", "Release 1.2.0")
    check_release.check_working_tree(repository)
    git("tag", "v1.2.0")
    with pytest.raises(check_release.ReleaseError, match=r"The tag v1\.2\.0 is there already"):
        check_release.check_working_tree(repository)


def test_a_folder_without_exactly_one_wheel_is_refused(tmp_path):
    with pytest.raises(check_release.ReleaseError, match="has 0"):
        check_release.find_wheel(tmp_path)
    wheel = tmp_path / "lerobot_policy_deltaco-1.2.0-py3-none-any.whl"
    wheel.touch()
    assert check_release.find_wheel(tmp_path) == wheel


def test_a_command_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(check_release.ReleaseError, match="`git` is missing"):
        check_release.check_working_tree(tmp_path)


def test_a_rehearsal_is_not_published():
    # -n: nothing is run.
    command = ["make", "-n", "-C", str(ROOT), "release", "HUB_USER=me"]
    result = subprocess.run([*command, "ARGS=--rehearse"], capture_output=True, text=True)
    assert result.returncode != 0
    assert "A rehearsal publishes nothing: leave out HUB_USER" in result.stderr
    assert "publish_release.py" not in result.stdout
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "publish_release.py me" in result.stdout


def test_the_versions_of_this_repository_agree():
    citation = (ROOT / "CITATION.cff").read_text()
    project = check_release.tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {project['version']}\n" in citation
