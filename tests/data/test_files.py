"""Files that recorders, converters and interruptions leave behind are named, before LeRobot opens them."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset
from small_policies import TABLE_TASKS, small_policy

from lerobot_deltaco.data.reading import open_dataset, open_folder_or_hub
from lerobot_deltaco.data.training_data import DatasetEpisodes
from lerobot_deltaco.errors import UserError


@pytest.fixture
def root(table, tmp_path):
    return shutil.copytree(table.root, tmp_path / "table")


def info(change):
    def edit(root):
        path = root / "meta/info.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return edit


def table_of(pattern, change):
    def edit(root):
        (path,) = root.glob(pattern)
        change(pd.read_parquet(path)).to_parquet(path)

    return edit


def cut(pattern):
    def edit(root):
        (path,) = root.glob(pattern)
        path.write_bytes(path.read_bytes()[:-40])

    return edit


def statistics(name, factor, offset=0.0):
    def edit(root):
        path = root / "meta/stats.json"
        content = json.loads(path.read_text())
        values = content["observation.state"][name]
        content["observation.state"][name] = (factor * np.array(values) + offset).tolist()
        path.write_text(json.dumps(content))

    return edit


DATA, EPISODES = "data/chunk-000/*.parquet", "meta/episodes/chunk-000/*.parquet"
WRONG_STATISTICS = "statistics of `observation.state` .* Compute them again"
FAULTS = {
    "garbage": (lambda root: (root / "meta/info.json").write_text("{garbage"), r"info\.json cannot be read"),
    "no_features": (info(lambda i: i.pop("features")), "does not say which `features`"),
    "fps": (info(lambda i: i.update(fps=0)), r"`fps` in .*info\.json must be a positive number.* Got 0"),
    "no_episodes": (info(lambda i: i.update(total_episodes=0)), "has no episodes"),
    "ahead": (info(lambda i: i.update(total_episodes=10**9)), "counts 1000000000 episodes, but .* has 48"),
    "names": (
        info(lambda i: i["features"]["observation.image"].update(names=None)),
        "camera 'observation.image' in .* has no `names`",
    ),
    "shape": (info(lambda i: i["features"]["action"].pop("shape")), "'action' .* must have a `dtype` and a"),
    "task_column": (
        table_of("meta/tasks.parquet", lambda tasks: tasks.reset_index(names="task")),
        r"tasks\.parquet must have the task strings as its index.* Its columns are task, task_index",
    ),
    "empty_task": (
        table_of("meta/tasks.parquet", lambda tasks: tasks.set_axis([" ", *tasks.index[1:]])),
        "has an empty task string",
    ),
    "no_length": (table_of(EPISODES, lambda t: t.drop(columns="length")), "has no column 'length'"),
    "cut_table": (cut(EPISODES), r"cannot be read as Parquet: .*finalize"),
    "cut_data": (cut(DATA), r"data.*\.parquet cannot be read as Parquet: .*finalize"),
    "rows": (
        table_of(DATA, lambda t: t[t["episode_index"] < 46].reset_index(drop=True)),
        "Episode 46 has 0 frames in .* but 7 by",
    ),
    "std_zero": (statistics("std", 0), WRONG_STATISTICS),
    "std_large": (statistics("std", 1000), WRONG_STATISTICS),
    "std_small": (statistics("std", 0.3), WRONG_STATISTICS),
    "mean": (statistics("mean", 1, 0.5), WRONG_STATISTICS),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_before_the_dataset_is_opened(root, fault):
    change, message = FAULTS[fault]
    change(root)
    with pytest.raises(UserError, match=f"(?s){message}"):
        open_folder_or_hub(str(root))


def test_a_policy_names_a_table_of_tasks_that_lerobot_train_opens(root):
    change, message = FAULTS["task_column"]
    change(root)
    dataset = LeRobotDataset("test/table", root=root)
    with pytest.raises(UserError, match=message):
        small_policy(dataset, "deltaco_match", prepare=False)


def test_a_good_dataset_opens_and_so_do_episodes_beside_damaged_ones(root):
    assert open_folder_or_hub(str(root)).meta.total_episodes == 48
    table_of(DATA, lambda t: t[t["episode_index"] < 46].reset_index(drop=True))(root)
    assert open_dataset("", "test/table", root, [0, 45]).episodes == [0, 45]


def test_tasks_are_those_of_the_frames_if_the_table_of_episodes_has_none(root):
    table_of(EPISODES, lambda t: t.drop(columns="tasks"))(root)  # as LeRobot's conversion to videos
    dataset = open_folder_or_hub(str(root))
    assert set(DatasetEpisodes(dataset).episode_tasks()) == set(TABLE_TASKS)
