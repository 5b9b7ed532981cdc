"""A dataset's card, and the way to the Hub and back, with real clients and a fake Hub."""

import json
import re
import shlex
import shutil
from dataclasses import asdict

import pytest
import tyro
from fake_hub import USER, FakeHub, Repo
from fresh_python import run_python
from huggingface_hub import DatasetCard
from PIL import Image

from gym_deltaco.env import ACTION_SCALE
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import TASKS
from lerobot_deltaco.cards import TASKS_IMAGE, dataset_card
from lerobot_deltaco.collect import CollectionPlan, collect
from lerobot_deltaco.dataset_writer import INFO_FILE

REPO_ID = f"{USER}/three.tasks"
KEY = "dataset", REPO_ID
PLAN = CollectionPlan("4,32,90", 4)

PUSH = """
import sys
from pathlib import Path
from lerobot_deltaco.hub import HubError, create_repository, push
try:
    create_repository(sys.argv[2], private=True)
    print(push(Path(sys.argv[1]), sys.argv[2]))
except HubError as error:
    sys.exit(str(error))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A dataset of one task of each kind."""
    root = tmp_path_factory.mktemp("dataset")
    collect(root, PLAN)
    return root


@pytest.fixture
def copy(dataset, tmp_path):
    return shutil.copytree(dataset, tmp_path / "copy")


@pytest.fixture(scope="module")
def hub():
    with FakeHub() as hub:
        yield hub


def run_push(hub, home, root, repo_id=REPO_ID, **options):
    return run_python(PUSH, root, repo_id, env=hub.environment(home, **options))


# The card


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
    for text in (
        "two of the objects are identical",
        "Scenes are made of the objects `scenario_a_train`",
        "with probability 0.2** instead of the paper's 0.6",
        "One draw decides for both distractors",
        "--env.task=4 --env.scene.image_size=64 --env.scene.ambiguity=object "
        "--env.scene.objects=scenario_a_train --env.scene.adversarial_probability=0.2 "
        "--env.scene.adversarial_draw=scene --eval.n_episodes",
    ):
        assert text in card
        assert text not in usual
    assert "Test objects are visible" not in card


# The Hub


def test_pushed_dataset_is_fetched_by_its_name(hub, copy, tmp_path):
    # An earlier, larger dataset in the same repository.
    earlier = {"data/chunk-000/file-009.parquet": b"", "meta/notes.json": b"", "notes": b""}
    repo = hub.repos[KEY] = Repo(files=earlier)
    repo.revisions["v3.0"] = earlier
    result = run_push(hub, tmp_path / "a", copy)
    assert result.returncode == 0, result.stderr
    assert f"{hub.url}/datasets/{REPO_ID}" in result.stdout

    stored = repo.files("v3.0")
    local = {str(path.relative_to(copy)) for path in copy.rglob("*") if path.is_file()}
    assert set(stored) - {".gitattributes"} == {*local, "notes"}
    assert all(stored[name] == (copy / name).read_bytes() for name in local - {"README.md"})
    assert stored["README.md"].decode().strip() == dataset_card(copy, REPO_ID).strip()
    assert re.findall(r"!\[.+\]\((.+)\)", stored["README.md"].decode()) == [TASKS_IMAGE]
    assert Image.open(copy / TASKS_IMAGE).width > 3 * 256
    assert stored == repo.files()

    example = re.search(r"```python\n(.+?)```", dataset_card(copy, REPO_ID), re.DOTALL)[1]
    compare = f"""{example}
import sys, torch
local = LeRobotDataset("any/name", root=sys.argv[1])
assert len(dataset) == len(local) == 360
for fetched, kept in zip(dataset, local, strict=True):
    assert fetched.keys() == kept.keys()
    for name, value in kept.items():
        assert torch.equal(fetched[name], value) if torch.is_tensor(value) else fetched[name] == value, name
"""
    result = run_python(compare, copy, env=hub.environment(tmp_path / "b"))
    assert result.returncode == 0, result.stderr
    assert TASKS[4].instruction in result.stdout


@pytest.mark.parametrize(
    ("repo_id", "options", "reason"),
    [
        (REPO_ID, {}, "This Hub does not do that"),
        (REPO_ID, {"token": None}, "HF_TOKEN a token with write access"),
        ("us er/name", {}, "The repository id is USER/NAME"),
    ],
    ids=["refused", "no token", "invalid id"],
)
def test_what_cannot_be_pushed_is_one_line(copy, tmp_path, repo_id, options, reason):
    with FakeHub() as hub:
        hub.refused = "POST /api/datasets/.*/commit/"
        result = run_push(hub, tmp_path, copy, repo_id, **options)
    assert result.returncode == 1
    *_, last = result.stderr.splitlines()
    assert last.startswith(f"Cannot push to '{repo_id}': ")
    assert reason in last
    assert last.endswith("A push can be repeated.")
