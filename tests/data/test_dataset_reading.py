"""Damaged and contradictory datasets, and other forms of their metadata: an error names what is wrong."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy_config
from small_policies import (
    DELTACO,
    EPISODES,
    batch_of,
    run_training,
    small_policy,
    use_fake_encoder,
    write_dataset,
)

from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.data.reading import dimension_names, open_dataset
from lerobot_deltaco.data.training_data import DatasetEpisodes, DemonstrationFormat, read_demonstrations
from lerobot_deltaco.policies.base import language
from lerobot_deltaco.policies.base.configuration import check_image_shapes
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy

TOP = "observation.images.top"
DATA, TABLE = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"


@pytest.fixture
def root(dataset, tmp_path):
    return shutil.copytree(dataset.root, tmp_path / "copy")


def change(path, name, change_values):
    """Changes the values of a column in a Parquet file."""
    table = pq.read_table(path)
    values = table[name].to_pylist()
    change_values(values)
    column = pa.array(values, table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), table.schema.field(name), column), path)


def swap(values):
    values[0], values[3] = values[3], values[0]


def put(row, value, dimension=None):
    """Changes a value, or a number of it."""

    def change_values(values):
        if dimension is None:
            values[row] = value
        else:
            values[row][dimension] = value

    return change_values


@pytest.mark.parametrize(
    ("file", "column", "change_values", "message"),
    [
        (TABLE, "tasks", swap, r"Episode 0 .*: its task is \['stack the cups'\], but \['pour the tea'\] by"),
        (TABLE, "tasks", put(2, []), r"Episode 2 .*: its task is \['stack the cups'\], but \[\] by"),
        (
            TABLE,
            "length",
            put(1, 4),
            "Episode 1 .*(the table contradicts itself|has 5 frames in .*, but 4 by)",
        ),
        (TABLE, "dataset_from_index", swap, "Episode 0 of .*: the table contradicts itself"),
        (TABLE, "episode_index", swap, "Episode 0 of .*: the table contradicts itself"),
        (
            DATA,
            "episode_index",
            put(12, 0),
            "Episode 0 .*(not those with the indices|has 6 frames in .*, but 5 by)",
        ),
        (DATA, "frame_index", put(12, 0), "Episode 2 .*: its frames are not those with the indices"),
        (DATA, "task_index", put(12, 2), r"Episode 2 .*: it has several tasks, \['stack the cups', 'w"),
        (DATA, "task_index", put(12, 9), r"Episode 2 .*: it has several tasks, .*number 9"),
        (DATA, "action", put(7, np.nan, 1), "`action` is not finite: dimension 1 is nan in frame 2 of ep"),
        (DATA, "action", put(7, 9.0, 1), "`action` is outside of the range in .*stats.json: dimension 1"),
        (TASKS, "task_index", put(0, 2), "row 0 has the `task_index` 2"),
    ],
)
def test_contradictions_name_the_episode_and_the_file(root, file, column, change_values, message):
    change(root / file, column, change_values)
    with pytest.raises(ValueError, match=message) as error:
        open_dataset("--dataset.root", "test/foreign", root)
    assert str(root) in str(error.value)
    with pytest.raises(ValueError, match=message):
        FramesInMemory(LeRobotDataset("test/foreign", root=root, return_uint8=True))


def test_missing_files_and_statistics_are_named(root, tmp_path):
    (root / "meta/stats.json").rename(tmp_path / "stats.json")
    with pytest.raises(ValueError, match=r"meta/stats.json has no statistics of `action`"):
        open_dataset("--dataset.root", "test/foreign", root)
    (tmp_path / "stats.json").rename(root / "meta/stats.json")
    for file in (DATA, TASKS):
        (root / file).rename(tmp_path / "moved")
        with pytest.raises(FileNotFoundError, match=f"copy/{file} is missing"):
            open_dataset("--dataset.root", "test/foreign", root)
        with pytest.raises(FileNotFoundError, match=f"copy/{file} is missing"):
            run_training(root, tmp_path / "run", DELTACO)
        (tmp_path / "moved").rename(root / file)


def cut(image):
    return {**image, "bytes": image["bytes"][:40]}


@pytest.mark.parametrize("row", [10, 12])
def test_a_cut_image_and_one_of_another_size_name_their_frame(root, row):
    change(root / DATA, TOP, lambda values: values.__setitem__(row, cut(values[row])))
    message = f"The image {TOP} in frame {row % 5} of episode 2 .*{DATA}. cannot be decoded"
    dataset = open_dataset("--dataset.root", "test/foreign", root)
    with pytest.raises(ValueError, match=message):
        FramesInMemory(dataset)
    if row == 10:  # the first of its episode
        with pytest.raises(ValueError, match=message):
            read_demonstrations(DatasetEpisodes(dataset), DemonstrationFormat(TOP, 16))
    # So does an image of another size.
    other = pq.read_table(root / DATA)["observation.images.wrist"].to_pylist()[0]
    change(root / DATA, TOP, put(row, other))
    found = f"in frame {row % 5} of episode 2 .* has 24 x 24 pixels, but by meta/info.json the shape is"
    with pytest.raises(ValueError, match=f"The image {TOP} {found}"):
        FramesInMemory(LeRobotDataset("test/foreign", root=root, return_uint8=True))


def test_depth_and_other_cameras_are_refused_with_a_remedy():
    for channels in (1, 4):
        with pytest.raises(ValueError, match=r"Got \{'depth': .*remove_feature .*\['depth'\]"):
            check_image_shapes({"rgb": (3, 48, 48), "depth": (channels, 48, 48)})


def test_names_are_read_in_any_form_or_an_error():
    for names in (
        ["x", "y", "gripper"],
        [["x", "y", "gripper"]],  # Unitree's converter
        {"motors": ["x", "y", "gripper"]},
        {"arm": ["x", "y"], "hand": ["gripper"]},
        {"gripper": 2, "x": 0, "y": 1},  # LeRobot's gamepad
    ):
        assert dimension_names({"shape": (3,), "names": names}) == ["x", "y", "gripper"]
    for names in (["x", "gripper"], {"motors": 3}, [1, 2, 3], {"gripper": [0, 1]}):
        with pytest.raises(ValueError, match=r"The `names` of 'action' .* set them to null"):
            dimension_names({"shape": (3,), "names": names})


@pytest.mark.parametrize(("stds", "index"), [([3, 1, 0.1], 1), ([3, 0.1, 1], 2), ([3, 0, 0], 2)])
def test_the_gripper_that_moves_is_chosen(stds, index, caplog):
    config = make_policy_config("deltaco", device="cpu")
    features = {"action": {"shape": (3,), "names": ["arm", "left_gripper", "right_gripper"]}}
    config.set_dataset_feature_metadata(features)
    config.set_dataset_feature_metadata(features, {"action": {"std": np.array(stds)}})
    assert config.gripper == str(index)
    name = features["action"]["names"][index]
    assert f"moves most, dimension {index} of the action ({name})" in caplog.text


@pytest.mark.parametrize(
    ("policy", "tasks"),
    [
        ("deltaco_match", ["put 🍎 in", "put 🍌 in", "wave"]),
        ("deltaco_match", ["put block 1 in the bin", "wave", "put block 2 in the bin"]),
        ("deltaco_match", ["放下苹果", "放下香蕉", "wave"]),
        ("deltaco", ["wave", "sing", "dance"]),
    ],
)
def test_instructions_that_the_policy_cannot_tell_apart(tmp_path, monkeypatch, caplog, policy, tasks):
    use_fake_encoder(monkeypatch)
    dataset = write_dataset(tmp_path / "data", tasks)
    if policy == "deltaco":
        same = torch.nn.functional.normalize(torch.ones(384), dim=0)
        encode = {"wave": same, "dance": same, "sing": -same}
        encoder = lambda texts: torch.stack([encode[text] for text in texts])  # noqa: E731
        monkeypatch.setattr(language, "load_language_encoder", lambda name: encoder)
        made, before, _ = small_policy(dataset, "deltaco", method="language_only")
        for _ in range(2):
            made(before(batch_of(dataset, [0, 5])))
        expected = "2 of 3 tasks from others by their instructions, such as 'wave' and 'dance'"
    else:
        small_policy(dataset, policy)
        expected = "2 of 3 tasks" if "🍎" in tasks[0] else ""
    assert caplog.text.count("cannot tell") == bool(expected)
    assert expected in caplog.text


@pytest.fixture
def banks(spy):
    """Demonstrations that policies are trained with."""
    banks = []
    spy(TaskConditionedPolicy, "fit", lambda _, data: banks.append(data.demonstrations))
    return banks


@pytest.mark.parametrize("in_memory", [True, False])
def test_only_the_chosen_episodes_are_needed(root, tmp_path, banks, in_memory):
    # As the files of other episodes are, theirs are damaged.
    change(root / DATA, TOP, lambda values: values.__setitem__(5, cut(values[5])))
    change(root / DATA, "action", put(7, np.nan, 1))
    options = {**DELTACO, "dataset.episodes": "[0,2,3]", "policy.demo_encoder": "attention"}
    if not in_memory:  # LeRobot does not tell a policy
        options["policy.training_episodes"] = options["dataset.episodes"]
    run_training(root, tmp_path / "run", options, in_memory, steps=1, save_freq=1)
    assert banks[0].episodes.tolist() == [0, 2, 3]


@pytest.mark.parametrize("step", [1, -1])
def test_held_out_episodes_are_not_demonstrations(root, tmp_path, banks, step):
    tasks = [names[0] for names in open_dataset("", "test/small", root).meta.episodes["tasks"]]
    order = [*range(len(tasks))][::step]
    options = {**DELTACO, "policy.demo_encoder": "attention", "dataset.eval_split": 0.5}
    options["dataset.episodes"] = str(order)
    run_training(root, tmp_path / "run", options, steps=1, save_freq=1)
    halves = [[n for n in order if tasks[n] == task] for task in set(tasks)]
    assert set(banks[0].episodes.tolist()) == {n for half in halves for n in half[: len(half) // 2]}


def test_fine_tuning_honors_the_rename_map(root, tmp_path, banks):
    first = run_training(root, tmp_path / "first", {**DELTACO, "policy.demo_encoder": "attention"}, steps=2)
    banks.clear()
    other = write_dataset(tmp_path / "other", EPISODES, ("front", "hand")).root
    names = {"observation.images.front": TOP, "observation.images.hand": "observation.images.wrist"}
    options = {"policy.path": first / "000002" / "pretrained_model", "rename_map": json.dumps(names)}
    tuned = run_training(other, tmp_path / "tuned", options, steps=1, save_freq=1)
    assert (tuned / "000001").is_dir()
    form = DemonstrationFormat("observation.images.front", 48)
    expected = read_demonstrations(DatasetEpisodes(open_dataset("", "test/small", other)), form)
    assert torch.equal(banks[0].frames, expected.frames)


def test_demonstrations_in_other_units_are_warned_of(root, dataset, monkeypatch, caplog):
    use_fake_encoder(monkeypatch)
    demos = {"demo_repo_id": "test/shown", "demo_root": str(root), "demo_encoder": "attention"}
    small_policy(dataset, "deltaco", **demos)
    assert not [record for record in caplog.records if record.name.startswith("lerobot_deltaco")]
    stats = json.loads((root / "meta/stats.json").read_text())
    for name in stats["action"].keys() - {"count"}:
        stats["action"][name][2] *= 57.3
    (root / "meta/stats.json").write_text(json.dumps(stats))
    change(root / DATA, "action", lambda rows: [row.__setitem__(2, row[2] * 57.3) for row in rows])
    small_policy(dataset, "deltaco", **demos)
    assert "`action` does not fit: its dimension 2 is between" in caplog.text
    caplog.clear()
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["action"]["names"] = ["a", "b_gripper", "c"]
    (root / "meta/info.json").write_text(json.dumps(info))
    small_policy(dataset, "deltaco", **demos)
    assert "but ['a', 'b_gripper', 'c'] in the demonstrations in test/shown" in caplog.text
