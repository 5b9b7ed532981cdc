"""What `make release` checks."""

import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture
def release(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    import release

    return release


@pytest.fixture
def repository(tmp_path):
    """A repository that is ready for the release of 1.2.0."""
    files = {
        "pyproject.toml": '[project]\nversion = "1.2.0"\n',
        "CITATION.cff": "title: x\nversion: 1.2.0\n",
        "CHANGELOG.md": "# Log\n\n## 1.2.0 (2026-11-30)\n\n- A thing.\n\n## 1.1.0 (2026-10-01)\n\n- Old.\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("CITATION.cff", "1.2.0", "1.1.0", "pyproject.toml has version 1.2.0, CITATION.cff has another one"),
        ("CHANGELOG.md", "1.2.0 (2026-11-30)", "Unreleased", 'Got "## Unreleased"'),
        ("CHANGELOG.md", "- A thing.", "", "says nothing of version 1.2.0"),
    ],
)
def test_a_version_that_is_not_ready_is_refused(release, repository, file, before, after, message):
    assert release.check_version(repository) == "1.2.0"
    path = repository / file
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(release.ReleaseError) as error:
        release.check_version(repository)
    assert message in str(error.value)


def test_the_tree_must_be_clean_and_the_version_new(release, repository):
    def git(*words):
        identity = ["-c", "user.name=Test", "-c", "user.email=test@example.org"]
        subprocess.run(["git", *identity, *words], cwd=repository, check=True, capture_output=True)

    git("init")
    with pytest.raises(release.ReleaseError, match="Commit or remove"):
        release.check_working_tree(repository)
    git("add", "-A")
    git("commit", "-m", "Release 1.2.0")
    release.check_working_tree(repository)
    git("tag", "v1.2.0")
    with pytest.raises(release.ReleaseError, match=r"The tag v1\.2\.0 exists already"):
        release.check_working_tree(repository)
