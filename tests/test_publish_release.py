"""`make release HUB_USER=...` publishes: rehearsed with real clients, a fake Hub and a fake package index."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from fake_hub import TOKEN, USER, WITHOUT_CARD_CHECK, FakeHub
from fake_index import FakeIndex

from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan

ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / "scripts"
UV = Path(sys.executable).with_name("uv")


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """A folder with the wheel and the source distribution."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "--directory", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "two_tasks"
    collect(root, CollectionPlan("4,32", 1))
    return root


def publish(*arguments, environment):
    code = f"import sys; sys.path.insert(0, {str(SCRIPTS)!r}); from publish_release import main; main()"
    return python(WITHOUT_CARD_CHECK + code, *arguments, environment=environment)


@pytest.mark.parametrize(
    ("part", "card", "message"),
    [
        ("policy", None, r"has no README\.md"),
        ("policy", "A policy.", r"README\.md does not say 'checkpoints/pick_place'"),
        ("environment", "An environment.", r"README\.md does not say 'USER/NAME'"),
    ],
)
def test_a_card_that_cannot_be_published_is_refused_before_anything_is(
    tmp_path, monkeypatch, part, card, message
):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("publish_release")
    folder = tmp_path / "checkpoints" / "pick_place"
    folder.mkdir(parents=True)
    for name, value in (("ROOT", tmp_path), ("CHECKPOINT", folder), ("ENVIRONMENT", folder)):
        monkeypatch.setattr(script, name, value)
    if card is not None:
        (folder / "README.md").write_text(card)
    with pytest.raises(script.ReleaseError, match=message):
        script.Release(USER, [], tmp_path).check((part,))


def python(code, *arguments, environment, folder=None):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_a_release_is_published_and_everything_in_it_can_be_used(dist, dataset, tmp_path):
    with FakeHub() as hub, FakeIndex() as index:
        environment = {**hub.environment(tmp_path / "maintainer"), **index.environment()}
        arguments = (USER, "--dist", dist, "--datasets", dataset)
        for _ in range(2):  # what is published can be published again
            result = publish(*arguments, environment=environment)
            assert result.returncode == 0, result.stdout + result.stderr
        assert result.stdout.splitlines() == [
            "Published package lerobot_policy_deltaco",
            f"Published {hub.url}/{USER}/deltaco_pick_place",
            f"Published {hub.url}/{USER}/deltaco",
            f"Published {hub.url}/datasets/{USER}/deltaco_two_tasks",
        ]
        assert {Path(name).suffix for name in index.files} == {".whl", ".gz"}

        # A stranger, without credentials.
        target = tmp_path / "site"
        install = ["pip", "install", "--no-deps", "--no-cache", "--target", str(target)]
        indexed = ["--index-url", f"{index.url}/simple", "--python", sys.executable]
        subprocess.run([UV, *install, *indexed, "lerobot_policy_deltaco"], check=True, capture_output=True)
        stranger = {**hub.environment(tmp_path / "stranger", token=None), "PYTHONPATH": str(target)}
        code = f"""
import lerobot_deltaco
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import close_envs, make_env
assert lerobot_deltaco.__file__.startswith({str(target)!r})
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
dataset = LeRobotDataset("{USER}/deltaco_two_tasks")
policy = DeltacoPolicy.from_pretrained("{USER}/deltaco_pick_place")
envs = make_env("{USER}/deltaco:scenario_b_test.py", trust_remote_code=True)
print(dataset.num_episodes, policy.config.demo_encoder, *(len(group) for group in envs.values()))
close_envs(envs)
"""
        result = python(code, environment=stranger, folder=tmp_path)
        assert result.returncode == 0, result.stderr
        assert result.stdout.splitlines()[-1] == "2 correspondence 24 30"

        cards = {
            name: hub.repos["model", f"{USER}/{name}"].files()["README.md"].decode()
            for name in ("deltaco", "deltaco_pick_place")
        }
        assert "USER/NAME" not in cards["deltaco"]
        assert f'make_env("{USER}/deltaco"' in cards["deltaco"]
        assert f"lerobot-eval --policy.path={USER}/deltaco_pick_place" in cards["deltaco_pick_place"]


@pytest.mark.slow
def test_a_part_that_fails_names_what_is_left_and_can_be_repeated(dist, dataset, tmp_path):
    with FakeHub() as hub:
        environment = hub.environment(tmp_path / "maintainer")
        hub.refused = f"models/{USER}/deltaco/"
        parts = ("--parts", "policy", "environment", "datasets")
        result = publish(USER, "--dist", dist, "--datasets", dataset, *parts, environment=environment)
        assert result.returncode == 1
        assert "Published" in result.stdout
        assert "Go on with --parts environment datasets." in result.stderr
        hub.refused = None
        left = ("--parts", "environment", "datasets")
        result = publish(USER, "--dist", dist, "--datasets", dataset, *left, environment=environment)
        assert result.returncode == 0, result.stderr
        assert set(hub.repos) == {
            ("model", f"{USER}/deltaco_pick_place"),
            ("model", f"{USER}/deltaco"),
            ("dataset", f"{USER}/deltaco_two_tasks"),
        }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("without", "arguments", "message"),
    [
        ("UV_PUBLISH_TOKEN", (), "Set UV_PUBLISH_TOKEN"),
        ("HF_TOKEN", (), "no credentials for the Hugging Face Hub"),
        (None, ("--datasets", "missing"), "missing"),
        (None, ("--dist", "empty"), "must have one wheel. It has 0"),
    ],
)
def test_nothing_is_published_of_a_release_that_cannot_be(without, arguments, message, dist, tmp_path):
    with FakeHub() as hub, FakeIndex() as index:
        environment = {**hub.environment(tmp_path / "maintainer"), **index.environment()}
        environment.pop(without, None)
        result = publish(USER, "--dist", dist, *arguments, environment=environment)
        assert result.returncode == 1
        assert result.stderr.startswith("Nothing was published: ")
        assert message in result.stderr
        assert TOKEN not in result.stderr
        assert not hub.repos
        assert not index.files
