"""A dataset's card, and the way to the Hub and back, with real clients and a fake Hub."""

import json
import re
import shlex
import shutil
from dataclasses import asdict

import pytest
import torch
import tyro
from fake_hub import TOKEN, USER, FakeHub, Repo
from huggingface_hub import DatasetCard
from lerobot.datasets import LeRobotDataset
from PIL import Image

from gym_deltaco.env import ACTION_SCALE
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import TASKS
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.collection.dataset_card import TASKS_IMAGE, dataset_card
from lerobot_deltaco.collection.hub import HubError, create_repository, push
from lerobot_deltaco.collection.writer import INFO_FILE

REPO_ID = f"{USER}/three.tasks"
KEY = "dataset", REPO_ID
PLAN = CollectionPlan("4,32,90", 4)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A dataset of one task of each kind."""
    root = tmp_path_factory.mktemp("dataset")
    collect(root, PLAN)
    return root


@pytest.fixture
def copy(dataset, tmp_path):
    return shutil.copytree(dataset, tmp_path / "copy")


@pytest.fixture
def hub():
    with FakeHub() as hub:
        yield hub


def test_metadata_are_what_the_hub_searches(dataset):
    text = dataset_card(dataset)
    assert text.startswith("---\n")
    data = DatasetCard(text).data
    assert (data.license, data.task_categories) == ("apache-2.0", ["robotics"])
    assert {"LeRobot", "deltaco", "gym_deltaco"} <= set(data.tags)
    assert "4,32,90" in data.pretty_name
    (config,) = data.configs
    assert set(dataset.glob(config["data_files"])) == set((dataset / "data").rglob("*.parquet"))


def test_card_describes_every_column(dataset):
    features = json.loads((dataset / INFO_FILE).read_text())["features"]
    rows = dict(re.findall(r"^\| `([\w.]+)` \|(.+)$", dataset_card(dataset), re.MULTILINE))
    assert list(rows) == list(features)
    for name, feature in features.items():
        dtype, shape, what, *_ = (cell.strip() for cell in rows[name].split("|"))
        assert dtype == feature["dtype"]
        assert re.findall(r"\d+", shape) == [str(size) for size in feature["shape"]]
        assert what
        assert all(f"`{dimension}`" in what for dimension in feature["names"] or [])
    assert f"in units of {ACTION_SCALE} m" in rows["action"]


def test_card_counts_tasks_and_successes(dataset):
    card = dataset_card(dataset)
    counts = dict(re.findall(r"^\| (\w+) \| (\d+) \| Put ", card, re.MULTILINE))
    assert counts == {"name": "1", "color": "1", "shape": "1"}
    for task_id in PLAN.task_ids:
        assert TASKS[task_id].instruction in card
    assert "| A | 2 of 198 | 1 of 102 |" in card
    rates = re.findall(r"^\| (\w+) \| (\d+) \| (\d+) \| ([\d.]+)% \|$", card, re.MULTILINE)
    assert {kind: int(kept) for kind, _, kept, _ in rates} == {"name": 4, "color": 4, "shape": 4}
    for _, attempts, kept, rate in rates:
        assert float(rate) == pytest.approx(100 * int(kept) / int(attempts), abs=0.05)


def test_command_in_the_card_makes_the_same_plan(dataset):
    command = re.search(r"^deltaco collect --root DIR (.+)$", dataset_card(dataset), re.MULTILINE)[1]
    assert tyro.cli(CollectionPlan, args=shlex.split(command)) == PLAN


def test_card_of_other_scenes_says_so(dataset, copy):
    usual = " ".join(dataset_card(dataset).split())
    assert "--env.scene" not in usual
    assert "Test objects are visible" in usual
    path = copy / "meta/deltaco.json"
    origin = json.loads(path.read_text())
    scene = SceneConfig("object", "scenario_a_train", 0.2, "scene", image_size=64)
    path.write_text(json.dumps({**origin, "plan": {**origin["plan"], "scene": asdict(scene)}}))
    card = " ".join(dataset_card(copy).split())
    options = "image_size=64 ambiguity=object objects=scenario_a_train adversarial_probability=0.2"
    words = [f"--env.scene.{option}" for option in [*options.split(), "adversarial_draw=scene"]]
    for text in (
        "two of the objects are identical",
        "Scenes are made of the objects `scenario_a_train`",
        "with probability 0.2** instead of the paper's 0.6",
        "One draw decides for both distractors",
        f"--env.task=4 {' '.join(words)} --eval.n_episodes",
    ):
        assert text in card
        assert text not in usual
    assert "Test objects are visible" not in card


def test_pushed_dataset_is_fetched_by_its_name(hub, copy, tmp_path, monkeypatch, capsys):
    hub.connect(monkeypatch, tmp_path / "home")
    # An earlier, larger dataset in the same repository.
    earlier = {"data/chunk-000/file-009.parquet": b"", "meta/notes.json": b"", "notes": b""}
    repo = hub.repos[KEY] = Repo(earlier)
    repo.revisions["v3.0"] = earlier
    create_repository(REPO_ID, private=True)
    assert push(copy, REPO_ID) == f"{hub.url}/datasets/{REPO_ID}"
    stored = repo.files("v3.0")
    local = {str(path.relative_to(copy)) for path in copy.rglob("*") if path.is_file()}
    assert set(stored) - {".gitattributes"} == {*local, "notes"}
    assert all(stored[name] == (copy / name).read_bytes() for name in local - {"README.md"})
    assert stored["README.md"].decode().strip() == dataset_card(copy, REPO_ID).strip()
    assert re.findall(r"!\[.+\]\((.+)\)", stored["README.md"].decode()) == [TASKS_IMAGE]
    assert Image.open(copy / TASKS_IMAGE).width > 3 * 256
    assert stored == repo.files()

    example = re.search(r"```python\n(.+?)```", dataset_card(copy, REPO_ID), re.DOTALL)[1]
    exec(example, found := {})
    assert TASKS[4].instruction in capsys.readouterr().out
    dataset, local = found["dataset"], LeRobotDataset("any/name", root=copy)
    assert len(dataset) == len(local) == 360
    for frame, kept in zip(dataset, local, strict=True):
        assert frame.keys() == kept.keys()
        for name, value in kept.items():
            assert torch.equal(frame[name], value) if torch.is_tensor(value) else frame[name] == value, name


def test_what_cannot_be_pushed_is_one_line(hub, copy, tmp_path, monkeypatch):
    def create_and_push(repo_id):
        create_repository(repo_id)
        push(copy, repo_id)

    hub.refused = "POST /api/datasets/.*/commit/"
    for repo_id, token, reason in (
        (REPO_ID, None, "Forbidden.*HF_TOKEN a token with write access"),
        (REPO_ID, TOKEN, "This Hub does not do that"),
        ("us er/name", TOKEN, "The repository id is USER/NAME"),
    ):
        hub.connect(monkeypatch, tmp_path, token)
        with pytest.raises(HubError, match=f"^Cannot push to '{repo_id}': .*{reason}.* can be repeated.$"):
            create_and_push(repo_id)
