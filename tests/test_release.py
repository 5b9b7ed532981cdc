"""What `make release` checks and publishes."""

import subprocess
from pathlib import Path

import pytest
from fake_hub import USER, WITHOUT_CARD_CHECK, FakeHub
from fresh_python import run_python

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


def test_what_publishing_needs_is_checked_before(release, tmp_path, monkeypatch):
    monkeypatch.delenv("UV_PUBLISH_TOKEN", raising=False)
    with pytest.raises(release.ReleaseError, match="Set UV_PUBLISH_TOKEN"):
        release.check_publishing(USER, ())
    monkeypatch.setenv("UV_PUBLISH_TOKEN", "token")
    monkeypatch.setattr("lerobot_deltaco.hub.get_token", lambda: "token")
    release.check_publishing(USER, ())
    with pytest.raises(release.ReleaseError, match="holds no finished dataset"):
        release.check_publishing(USER, [tmp_path])
    with pytest.raises(release.ReleaseError, match="does not say 'USER/NAME'"):
        release.hub_files(release.CHECKPOINT, {"USER/NAME": "me/deltaco"})
    with pytest.raises(SystemExit, match="A rehearsal publishes nothing"):
        release.release(USER, rehearse=True)


PUBLISH = """
import sys
sys.path.insert(0, {scripts!r})
import release
release._run = lambda command, folder: print(*command)
release.publish({user!r}, ())
"""
USE = """
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
policy = DeltacoMatchPolicy.from_pretrained("{user}/deltaco_pick_place")
print(len(policy.demonstrations))
"""


@pytest.mark.slow
def test_what_is_published_can_be_used_by_a_stranger(tmp_path):
    with FakeHub() as hub:
        program = WITHOUT_CARD_CHECK + PUBLISH.format(scripts=str(SCRIPTS), user=USER)
        for _ in range(2):  # it can be published again
            result = run_python(program, env=hub.environment(tmp_path / "maintainer"))
            assert result.returncode == 0, result.stderr
        assert f"Published {hub.url}/{USER}/deltaco_pick_place" in result.stdout
        card = hub.repos["model", f"{USER}/deltaco_pick_place"].files()["README.md"].decode()
        assert f"{USER}/deltaco_pick_place" in card
        stranger = hub.environment(tmp_path / "stranger", token=None)
        result = run_python(USE.format(user=USER), env=stranger, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        assert int(result.stdout.splitlines()[-1]) == 102


def test_make_passes_its_variables_to_the_script():
    command = ["make", "-n", "-C", str(SCRIPTS.parent), "release", "HUB_USER=me", "DATASETS=data/train"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "scripts/release.py --user me --datasets data/train" in result.stdout
