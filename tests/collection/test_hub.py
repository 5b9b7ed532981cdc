"""A dataset's way to the Hub and back, with real clients and a fake Hub."""

import re

import pytest
import torch
from fake_hub import TOKEN, USER, FakeHub, Repo
from lerobot.datasets import LeRobotDataset

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.collection.dataset_card import TASKS_IMAGE, dataset_card
from lerobot_deltaco.collection.hub import HubError, create_repository, push

REPO_ID = f"{USER}/three.tasks"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A dataset of one task of each kind."""
    root = tmp_path_factory.mktemp("dataset")
    collect(root, CollectionPlan("4,32,90", 1))
    return root


@pytest.fixture
def hub():
    with FakeHub() as hub:
        yield hub


def test_pushed_dataset_replaces_an_earlier_one_and_is_fetched_by_its_name(
    hub, root, tmp_path, monkeypatch, capsys
):
    hub.connect(monkeypatch, tmp_path)
    earlier = {"data/chunk-000/file-009.parquet": b"", "meta/notes.json": b"", "notes": b""}
    repo = hub.repos["dataset", REPO_ID] = Repo(earlier)
    repo.revisions["v3.0"] = earlier
    create_repository(REPO_ID, private=True)
    assert push(root, REPO_ID) == f"{hub.url}/datasets/{REPO_ID}"
    stored = repo.files("v3.0")
    local = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
    assert TASKS_IMAGE in local
    assert set(stored) - {".gitattributes"} == {*local, "notes"}
    assert all(stored[name] == (root / name).read_bytes() for name in local - {"README.md"})
    assert stored == repo.files()

    # The card's example fetches it.
    example = re.search(r"```python\n(.+?)```", dataset_card(root, REPO_ID), re.DOTALL)[1]
    exec(example, names := {})
    assert TASKS[4].instruction in capsys.readouterr().out
    for frame, expected in zip(names["dataset"], LeRobotDataset("any/name", root=root), strict=True):
        assert frame.keys() == expected.keys()
        assert all(torch.equal(frame[key], value) for key, value in expected.items() if key != "task")


@pytest.mark.parametrize(
    ("repo_id", "token", "reason"),
    [
        (REPO_ID, None, "Forbidden.*HF_TOKEN a token with write access"),
        ("us er/name", TOKEN, "The repository id is USER/NAME"),
    ],
)
def test_what_cannot_be_pushed_is_one_line(hub, tmp_path, monkeypatch, repo_id, token, reason):
    hub.connect(monkeypatch, tmp_path, token)
    with pytest.raises(HubError, match=f"^Cannot push to '{repo_id}': .*{reason}.* can be repeated.$"):
        create_repository(repo_id)
