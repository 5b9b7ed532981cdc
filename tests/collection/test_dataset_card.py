"""The card of a dataset: what it says agrees with the files."""

import json
import re
import shlex
import shutil
from dataclasses import asdict

import pytest
import tyro
from huggingface_hub import DatasetCard

from gym_deltaco.env import ACTION_SCALE
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.collection.dataset_card import dataset_card
from lerobot_deltaco.collection.writer import INFO_FILE

PLAN = CollectionPlan("4,32,90", 4)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A dataset of one task of each kind."""
    root = tmp_path_factory.mktemp("dataset")
    collect(root, PLAN)
    return root


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


def test_card_counts_tasks_and_attempts_and_names_the_files(dataset):
    card = dataset_card(dataset)
    (config,) = DatasetCard(card).data.configs
    assert set(dataset.glob(config["data_files"])) == set((dataset / "data").rglob("*.parquet"))
    assert "| A | 2 of 198 | 1 of 102 |" in card
    rates = re.findall(r"^\| (\w+) \| (\d+) \| (\d+) \| ([\d.]+)% \|$", card, re.MULTILINE)
    assert {kind: int(n_episodes) for kind, _, n_episodes, _ in rates} == {"name": 4, "color": 4, "shape": 4}
    for _, n_attempts, n_episodes, rate in rates:
        assert float(rate) == pytest.approx(100 * int(n_episodes) / int(n_attempts), abs=0.05)


def test_command_in_the_card_makes_the_same_plan(dataset):
    command = re.search(r"^deltaco collect --root DIR (.+)$", dataset_card(dataset), re.MULTILINE)[1]
    assert tyro.cli(CollectionPlan, args=shlex.split(command)) == PLAN


def test_card_of_other_scenes_says_so(dataset, tmp_path):
    assert "--env.scene" not in dataset_card(dataset)
    copy = shutil.copytree(dataset, tmp_path / "copy")
    path = copy / "meta/deltaco.json"
    origin = json.loads(path.read_text())
    scene = SceneConfig("object", "scenario_a_train", 0.2, "scene", image_size=64)
    path.write_text(json.dumps({**origin, "plan": {**origin["plan"], "scene": asdict(scene)}}))
    options = "image_size=64 ambiguity=object objects=scenario_a_train adversarial_probability=0.2"
    words = [f"--env.scene.{option}" for option in [*options.split(), "adversarial_draw=scene"]]
    assert f"--env.task=4 {' '.join(words)} --eval.n_episodes" in " ".join(dataset_card(copy).split())
