"""A dataset's card, and the way to the Hub and back, with real clients and a fake Hub."""

import argparse
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_hub import TOKEN, USER, WITHOUT_CARD_CHECK, FakeHub, Repo
from fresh_python import run_python
from huggingface_hub import DatasetCard, constants
from PIL import Image

from gym_deltaco.tasks import OBJECTS, SCENARIOS, TASKS
from lerobot_deltaco.cards.dataset_card import (
    CARD_FILE,
    CARD_FILES,
    DESCRIPTIONS,
    EPISODE_IMAGE,
    TASKS_IMAGE,
    card_text,
    has_current_card,
    write_card,
)
from lerobot_deltaco.commands import collect as collect_command
from lerobot_deltaco.commands import push as push_command
from lerobot_deltaco.data import collection
from lerobot_deltaco.data.collection import CollectionError, collect
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.data.dataset_files import INFO_FILE
from lerobot_deltaco.data.finished_dataset import HISTORY_FILE, UNFINISHED
from lerobot_deltaco.data.hub import HubError, check_credentials, check_dataset, check_repo_id
from lerobot_deltaco.data.integrity import DIGESTS_FILE

REPO_ID = f"{USER}/three.tasks"
KEY = "dataset", REPO_ID
PLANS = CollectionPlan("4,32", 2), CollectionPlan("90", 1, seed=3, split="validation", noise=0.05)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A dataset of three tasks, one of each kind, in two collections, and its card."""
    root = tmp_path_factory.mktemp("dataset")
    collect(root, PLANS[0])
    collect(root, PLANS[1], append=True)
    write_card(root)
    return root


@pytest.fixture
def copy(dataset, tmp_path):
    return shutil.copytree(dataset, tmp_path / "copy")


@pytest.fixture(scope="module")
def hub():
    with FakeHub() as hub:
        yield hub


def outcome(program, *arguments, environment, with_card_check=False):
    """How a Python program ends, with the card's check at the real Hub left out unless it is wanted."""
    before = "" if with_card_check else WITHOUT_CARD_CHECK
    return run_python(before + program, *arguments, env=environment)


def command(name):
    return f"from lerobot_deltaco.commands.{name} import main; main()"


PUSH, COLLECT = command("push"), command("collect")
ONE_EPISODE = ("--tasks", "4", "--episodes-per-task", 1, "--workers", 1)


def run(program, *arguments, environment):
    result = outcome(program, *arguments, environment=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


# The card


def test_the_metadata_are_what_the_hub_searches(dataset):
    card = DatasetCard.load(dataset / CARD_FILE)
    assert card.data.license == "apache-2.0"
    assert card.data.language == ["en"]
    assert card.data.task_categories == ["robotics"]
    assert card.data.size_categories == ["n<1K"]
    assert {"LeRobot", "deltaco", "gym_deltaco"} <= set(card.data.tags)
    assert "4,32" in card.data.pretty_name
    (config,) = card.data.configs
    stored = {str(path.relative_to(dataset)) for path in dataset.glob(config["data_files"])}
    assert stored == {str(path.relative_to(dataset)) for path in dataset.rglob("data/**/*.parquet")}


def test_the_images_are_there_and_shown(dataset):
    shown = re.findall(r"!\[.+\]\((.+)\)", (dataset / CARD_FILE).read_text())
    assert set(shown) == {str(TASKS_IMAGE), str(EPISODE_IMAGE)}
    with Image.open(dataset / TASKS_IMAGE) as image:
        assert image.width > 3 * 256
    with Image.open(dataset / EPISODE_IMAGE) as animation:
        assert animation.n_frames == 30
        assert min(animation.size) > 256


def test_the_animations_of_people_and_of_the_dataset_show_the_same(copy):
    """An episode that cannot be drawn again is shown as it is stored."""
    redrawn = animation_frames(copy)
    for path in copy.glob("data/*/*.parquet"):
        table = pq.read_table(path)
        column = table.schema.get_field_index("benchmark.seed")
        other = table.set_column(column, "benchmark.seed", [np.arange(len(table))])
        pq.write_table(other, path)
    write_card(copy)
    stored = animation_frames(copy)
    assert len(stored) == len(redrawn)
    for a, b in zip(stored, redrawn, strict=True):
        coarse = [np.asarray(frame.resize((24, 24), Image.Resampling.BOX), dtype=float) for frame in (a, b)]
        assert not np.array_equal(a, b)
        assert np.abs(coarse[0] - coarse[1]).mean() < 10


def animation_frames(root):
    with Image.open(root / EPISODE_IMAGE) as animation:
        frames = []
        for number in range(animation.n_frames):
            animation.seek(number)
            size = animation.width - 8  # without the frame; the caption is above
            frames.append(
                animation.convert("RGB").crop(
                    (4, animation.height - size - 4, size + 4, animation.height - 4)
                )
            )
        return frames


def test_every_feature_is_in_the_table(dataset):
    features = json.loads((dataset / INFO_FILE).read_text())["features"]
    assert set(DESCRIPTIONS) == set(features)
    rows = dict(re.findall(r"^\| `([\w.]+)` \|(.+)$", (dataset / CARD_FILE).read_text(), re.MULTILINE))
    assert list(rows) == list(features)
    for name, feature in features.items():
        dtype, shape, what, *_ = (cell.strip() for cell in rows[name].split("|"))
        assert dtype == feature["dtype"]
        assert re.findall(r"\d+", shape) == [str(size) for size in feature["shape"]]
        assert what.startswith(DESCRIPTIONS[name][0])
        assert all(f"`{part}`" in what for part in feature["names"] or [])


def test_the_commands_in_the_card_are_those_that_made_it(dataset, monkeypatch):
    block = re.search(r"```bash\n(deltaco-collect.+?)```", (dataset / CARD_FILE).read_text(), re.DOTALL)[1]
    made = []

    def instead(root, plan, n_workers, append):
        made.append((plan, append))
        raise CollectionError

    monkeypatch.setattr(collection, "collect", instead)
    for line in block.splitlines():
        with pytest.raises(SystemExit):
            collect_command.main(line.split()[1:])
    assert made == [(PLANS[0], False), (PLANS[1], True)]


def test_the_expert_is_counted_by_kind(dataset):
    table = re.findall(r"^\| (\w+) \| (\d+) \| (\d+) \| ([\d.]+)% \|$", card_text(dataset), re.MULTILINE)
    assert {kind: int(kept) for kind, _, kept, _ in table} == {"name": 2, "color": 2, "shape": 1}
    for _, attempts, kept, rate in table:
        assert float(rate) == pytest.approx(100 * int(kept) / int(attempts), abs=0.05)


def test_what_the_card_says_of_object_29_is_so(dataset):
    assert [label.index for label in OBJECTS if label.color == "yellow"] == [29]
    train = {task: TASKS[task].targets for task in SCENARIOS["a"].train_tasks}
    assert sum(targets == (29,) for targets in train.values()) == 6
    assert {target for targets in train.values() for target in targets} == {*range(24), 29}
    assert len([task for task in SCENARIOS["a"].test_tasks if TASKS[task].row == 29]) == 6
    card = " ".join(card_text(dataset).split())
    assert "Object 29, the two layered lampshade, is the only yellow one" in card
    assert "target of the six yellow training tasks" in card
    assert "every split draws its scenes from all 32 objects" in card


def test_the_card_is_a_function_of_the_dataset(dataset, copy):
    write_card(copy)
    for file in CARD_FILES:
        assert (copy / file).read_bytes() == (dataset / file).read_bytes()


def test_a_card_of_other_images_names_the_options_of_the_environment(copy):
    assert "--env.image_size" not in card_text(copy)
    assert "--env.ambiguity" not in card_text(copy)
    info = json.loads((copy / INFO_FILE).read_text())
    info["features"]["observation.image"]["shape"] = [64, 64, 3]
    info["features"]["observation.image"]["info"]["ambiguity"] = "object"
    (copy / INFO_FILE).write_text(json.dumps(info))
    for program in ("lerobot-train", "lerobot-eval"):
        block = re.search(rf"```bash\n{program}.+?```", card_text(copy), re.DOTALL)[0]
        assert {"--env.image_size=64", "--env.ambiguity=object"} <= set(block.split())
    assert "identical" in card_text(copy)


def test_a_dataset_that_was_edited_has_a_card_too(copy):
    for file in (HISTORY_FILE, DIGESTS_FILE):
        (copy / file).unlink()
    check_dataset(copy)
    text = card_text(copy)
    assert "LeRobot's dataset tools" in text
    assert "deltaco-collect --" not in text


def test_collecting_more_renews_the_card(copy):
    assert has_current_card(copy)
    new_row = "| 5..5 | 1 (`5`) | 1 | train | 0 | 0.1 |"
    assert new_row not in (copy / CARD_FILE).read_text()
    options = ["--tasks", "5", "--episodes-per-task", "1", "--workers", "1", "--append"]
    collect_command.main(["--root", str(copy), *options])
    assert has_current_card(copy)
    assert new_row in (copy / CARD_FILE).read_text()


# What is refused


@pytest.mark.parametrize("repo_id", ["", "name", "a/b/c", "user/", "us er/name", "u/na--me", "u/" + 97 * "n"])
@pytest.mark.parametrize("main", [push_command.main, collect_command.main], ids=["push", "collect"])
def test_a_bad_name_is_refused_before_anything_else(main, repo_id, tmp_path, capsys):
    arguments = ["--root", str(tmp_path / "new"), "--repo-id", repo_id]
    if main is collect_command.main:
        arguments += ["--tasks", "4", "--episodes-per-task", "1", "--push-to-hub"]
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert "The repository id must be USER/NAME." in last_line
    assert repr(repo_id) in last_line
    assert not (tmp_path / "new").exists()


def test_good_names_are_accepted():
    for repo_id in ("user/name", "a-b/c_d.E1"):
        check_repo_id(repo_id)


def test_pushing_a_collection_needs_a_name(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        collect_command.main(
            ["--tasks", "4", "--episodes-per-task", "1", "--root", str(tmp_path / "new"), "--push-to-hub"]
        )
    assert "--push-to-hub needs --repo-id USER/NAME" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def unfinished(root):
    info = json.loads((root / INFO_FILE).read_text())
    (root / INFO_FILE).write_text(json.dumps({**info, "codebase_version": UNFINISHED}))


def added_to(root):
    (root / ".collecting").mkdir()
    (root / ".collecting/plan.json").touch()


def empty(root):
    shutil.rmtree(root / "meta")


def of_others(root):
    info = json.loads((root / INFO_FILE).read_text())
    del info["features"]["benchmark.task_id"]
    (root / INFO_FILE).write_text(json.dumps(info))


def cut_off(root):
    path = root / "data/chunk-000/file-000.parquet"
    path.write_bytes(path.read_bytes()[:-100])


def without_a_file(root):
    (root / "data/chunk-000/file-001.parquet").unlink()


def with_a_flipped_bit(root):
    path = root / "data/chunk-000/file-000.parquet"
    stored = bytearray(path.read_bytes())
    stored[len(stored) // 2] ^= 1
    path.write_bytes(stored)


def without_statistics(root):
    (root / "meta/stats.json").unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (unfinished, r"unfinished.*Run its `deltaco-collect` command"),
        (added_to, r"unfinished.*Run its `deltaco-collect` command"),
        (empty, r"holds no dataset: meta/info\.json is missing"),
        (of_others, "`deltaco-collect` did not make"),
        (cut_off, r"file-000\.parquet is damaged"),
        (without_a_file, "120 frames instead of 150"),
        (with_a_flipped_bit, r"file-000\.parquet is damaged.*SHA-256"),
        (without_statistics, r"stats\.json is damaged or missing"),
    ],
)
def test_a_dataset_that_is_not_whole_is_refused(copy, damage, message, capsys):
    check_dataset(copy)
    damage(copy)
    with pytest.raises(HubError, match=message):
        check_dataset(copy)
    with pytest.raises(SystemExit, match="1"):
        push_command.main(["--root", str(copy), "--repo-id", REPO_ID])
    errors = capsys.readouterr().err
    assert re.search(message, errors)
    assert errors.count("\n") == 1


def test_the_hub_is_needed(monkeypatch):
    with pytest.raises(HubError, match="HF_HUB_OFFLINE or TRANSFORMERS_OFFLINE is set"):
        check_credentials()  # the tests are offline
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr("lerobot_deltaco.data.hub.get_token", lambda: None)
    with pytest.raises(HubError, match="Set HF_TOKEN to a token that may write"):
        check_credentials()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        pytest.param({"HF_TOKEN": ""}, "Set HF_TOKEN to a token that may write", id="no token"),
        pytest.param({"HF_TOKEN": "hf_wrong"}, "does not accept the credentials", id="wrong token"),
        pytest.param(
            *({"HF_ENDPOINT": "http://127.0.0.1:9"}, "http://127.0.0.1:9 cannot be reached"),
            id="no Hub",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_missing_credentials_are_found_before_collecting(hub, tmp_path, changes, message):
    new = tmp_path / "new"
    options = ("--root", new, *ONE_EPISODE, "--repo-id", REPO_ID, "--push-to-hub")
    result = outcome(COLLECT, *options, environment={**hub.environment(tmp_path), **changes})
    assert result.returncode == 1
    (error,) = [line for line in result.stderr.splitlines() if not line.startswith("pybullet build time")]
    assert message in error
    assert not new.exists()
    assert KEY not in hub.repos


def test_an_image_that_cannot_be_shown_is_no_finished_dataset(copy, capsys):
    path = copy / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    column = table.schema.get_field_index("observation.image")
    cells = [{"bytes": b"no image", "path": cell["path"]} for cell in table["observation.image"].to_pylist()]
    pq.write_table(table.set_column(column, table.schema.field(column), [cells]), path)
    for file in CARD_FILES:
        (copy / file).unlink()
    with pytest.raises(SystemExit, match="1"):
        collect_command._share(
            argparse.ArgumentParser("deltaco-collect"),
            argparse.Namespace(root=copy, repo_id=None, push_to_hub=False),
        )
    errors = capsys.readouterr().err
    assert "file-000.parquet is damaged" in errors
    assert "--verify" in errors
    assert "finished" not in errors


# The way to the Hub and back


def test_a_pushed_dataset_is_fetched_by_its_name(hub, copy, tmp_path):
    # What an earlier, larger dataset has left there, and what lies about here.
    earlier = hub.repos[KEY] = Repo("public")
    earlier.commit("main", {"data/chunk-000/file-009.parquet": b"", "meta/notes.json": b"", "notes": b""})
    earlier.tags["v3.0"] = earlier.branches["main"]
    (copy / "notes.txt").touch()
    (copy / "data/chunk-000/.file-000.parquet.7.part").touch()
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}

    output = run(PUSH, "--root", copy, "--repo-id", REPO_ID, environment=hub.environment(tmp_path / "a"))
    assert f"{hub.url}/datasets/{REPO_ID}" in output
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before

    stored = hub.repos[KEY].files("v3.0")
    local = {
        str(path.relative_to(copy)): path.read_bytes()
        for folder in ("data", "meta")
        for path in (copy / folder).rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }
    assert set(stored) == {*local, *map(str, CARD_FILES), "notes"}
    assert all(stored[path] == content for path, content in local.items())
    assert hub.repos[KEY].tags["v3.0"] == hub.repos[KEY].branches["main"]
    assert stored[str(CARD_FILE)].decode() == card_text(copy, REPO_ID)
    assert f'LeRobotDataset("{REPO_ID}")' in card_text(copy, REPO_ID)

    example = re.search(r"```python\n(.+?)```", card_text(copy, REPO_ID), re.DOTALL)[1]
    compare = f"""{example}
import sys, torch
local = LeRobotDataset("any/name", root=sys.argv[1])
assert len(dataset) == len(local) == 150
for fetched, kept in zip(dataset, local, strict=True):
    assert fetched.keys() == kept.keys()
    for name, value in kept.items():
        assert torch.equal(fetched[name], value) if torch.is_tensor(value) else fetched[name] == value, name
"""
    output = run(compare, copy, environment=hub.environment(tmp_path / "b"))
    assert TASKS[4].instruction in output


@pytest.mark.parametrize(
    ("refused", "message", "has_arrived"),
    [
        pytest.param("repos/create", "Nothing has arrived.", False, id="at first"),
        pytest.param(
            *("POST /api/datasets/.*/commit/", f"{REPO_ID} has either all of the new files or none", False),
            id="at the commit",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("POST /api/datasets/.*/tag/", "All files have arrived, but the tag 'v3.0'", True),
            id="at the tag",
        ),
    ],
)
def test_a_push_that_stops_says_what_has_arrived(copy, tmp_path, refused, message, has_arrived):
    with FakeHub() as hub:
        hub.refused = refused
        # The card's check at a fixed address is not needed: this Hub is another one.
        result = outcome(
            *(PUSH, "--root", copy, "--repo-id", REPO_ID),
            environment=hub.environment(tmp_path),
            with_card_check=True,
        )
        stored = set(hub.repos[KEY].files()) if KEY in hub.repos else set()
    assert result.returncode == 1, result.stderr
    assert message in result.stderr.splitlines()[-1]
    assert "cannot be reached" not in result.stderr
    assert "Traceback" not in result.stderr
    assert (str(DIGESTS_FILE) in stored) == (str(CARD_FILE) in stored) == has_arrived


def test_collecting_starts_without_heavy_imports():
    program = f"import sys; import {collect_command.__name__}; print([*sys.modules])"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"'torch'", "'lerobot'", "'huggingface_hub'"} & set(re.findall(r"'\w+'", result.stdout))


@pytest.mark.slow
def test_collected_pushed_and_trained_from(hub, tmp_path):
    repo_id = f"{USER}/trained"
    run(
        COLLECT,
        *("--root", tmp_path / "new", *ONE_EPISODE, "--push-to-hub", "--repo-id", repo_id),
        environment=hub.environment(tmp_path / "a"),
    )
    assert ".collecting" not in " ".join(hub.repos["dataset", repo_id].files())
    run(
        "from lerobot.scripts.lerobot_train import main; main()",
        *("--policy.type=act", "--policy.pretrained_backbone_weights=null", "--policy.dim_model=32"),
        *("--policy.n_heads=2", "--policy.device=cpu", f"--dataset.repo_id={repo_id}"),
        *(f"--policy.repo_id={USER}/policy", "--policy.push_to_hub=true"),
        *("--steps=1", "--batch_size=2", "--num_workers=0", f"--output_dir={tmp_path / 'train'}"),
        environment=hub.environment(tmp_path / "b"),
    )
    assert (tmp_path / "train/checkpoints/last/pretrained_model/model.safetensors").exists()
    # The policy went there too: the fake Hub serves models as well.
    assert {"config.json", "model.safetensors"} <= set(hub.repos["model", f"{USER}/policy"].files())


@pytest.mark.slow
def test_private_repositories_and_branches(hub, dataset, tmp_path):
    repo_id = f"{USER}/branched"
    run(
        PUSH,
        *("--root", dataset, "--repo-id", repo_id, "--private", "--branch", "draft"),
        environment=hub.environment(tmp_path),
    )
    repo = hub.repos["dataset", repo_id]
    assert repo.visibility == "private"
    assert not repo.tags
    assert not repo.files("main")
    assert str(CARD_FILE) in repo.files("draft")


@pytest.mark.slow
def test_a_token_that_may_only_read_is_named(hub, dataset, tmp_path):
    hub.read_only = True
    try:
        result = outcome(
            PUSH,
            *("--root", dataset, "--repo-id", f"{USER}/forbidden"),
            environment=hub.environment(tmp_path, TOKEN),
        )
    finally:
        hub.read_only = False
    assert result.returncode == 1
    assert "Set HF_TOKEN to a token that may write" in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
