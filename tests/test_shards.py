"""Shards that are joined are the dataset that one machine would have collected, byte for byte."""

import json
import shutil
from dataclasses import replace

import pytest
from in_process_collection import collect_in_process, remember_episodes

from gym_deltaco.env import PickPlaceEnv
from lerobot_deltaco.commands.collect import main
from lerobot_deltaco.data import collection, collection_workers
from lerobot_deltaco.data.collection import CollectionError, collect
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.data.finished_dataset import STAGING, verify_dataset
from lerobot_deltaco.data.shards import Shard, collect_shard, join_shards, shards_folder

# Seven data files, the last of which is not full.
PLAN = CollectionPlan("90,4", 10)
EPISODES_PER_FILE = 3
ARGUMENTS = ["--tasks", "90,4", "--episodes-per-task", "10", "--workers", "1"]


@pytest.fixture(scope="module")
def remembered():
    """`collect_episode`, which simulates each episode only once in this module."""
    env = PickPlaceEnv()
    yield remember_episodes(env)
    env.close()


@pytest.fixture
def in_process(remembered, monkeypatch):
    """Lets collections run in this process. Returns the episodes that were collected: (task, number)."""
    return collect_in_process(monkeypatch, remembered, EPISODES_PER_FILE)


@pytest.fixture
def whole(in_process, tmp_path):
    """The files of the dataset of one machine."""
    collect(tmp_path / "whole", PLAN)
    in_process.clear()
    return contents(tmp_path / "whole")


def contents(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def collect_all(root, count, numbers=None):
    for number in numbers or range(1, count + 1):
        collect_shard(root, PLAN, Shard(number, count))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 20, 23])
def test_the_joined_dataset_is_that_of_one_machine(whole, in_process, tmp_path, count):
    """Whether shards end within data files or between them, and also if some are empty."""
    root = tmp_path / "dataset"
    collect_all(root, count)
    assert len(in_process) == len(set(in_process)) == PLAN.n_episodes
    summary = join_shards(root, PLAN)
    assert len(in_process) == summary.episodes == PLAN.n_episodes
    assert contents(root) == whole
    assert verify_dataset(root).has_digests


@pytest.mark.slow
def test_commands_collect_shards_by_workers_and_join_them(tmp_path, capsys):
    plan = ["--tasks", "90,4", "--episodes-per-task", "2", "--workers", "1"]
    for step in (["--shard", "1/2"], ["--shard", "2/2"], ["--join"]):
        main([*plan, "--root", str(tmp_path / "many"), *step])
    assert "2 of 4 episodes" in capsys.readouterr().out
    collect(tmp_path / "one", CollectionPlan("90,4", 2))
    for folder in ("data", "meta"):
        assert contents(tmp_path / "many" / folder) == contents(tmp_path / "one" / folder)
    assert (tmp_path / "many" / "README.md").exists()


def test_an_episode_is_in_one_shard():
    for n_episodes in (1, 5, 12, 1000):
        for count in (1, 2, 7, 12):
            shards = [Shard(number, count).episodes(n_episodes) for number in range(1, count + 1)]
            assert [index for shard in shards for index in shard] == list(range(n_episodes))
            assert max(map(len, shards)) - min(map(len, shards)) <= 1


def test_an_interrupted_shard_goes_on(whole, in_process, tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    collect_one = collection_workers.collect_episode

    def fails(*arguments):
        if len(in_process) == 4:
            raise KeyboardInterrupt
        return collect_one(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(collection_workers, "collect_episode", fails)
        with pytest.raises(KeyboardInterrupt):
            collect_shard(root, PLAN, Shard(1, 2))
    with pytest.raises(CollectionError, match="1/2 lacks 6 of 10 episodes, 2/2 is missing. Collect these"):
        join_shards(root, PLAN)
    assert not root.exists()
    collect_all(root, 2)
    assert len(in_process) == PLAN.n_episodes
    assert collect_shard(root, PLAN, Shard(1, 2)).episodes_per_s is None
    join_shards(root, PLAN)
    assert contents(root) == whole
    # Once the dataset is there, its shards are no longer needed.
    shutil.rmtree(shards_folder(root))
    assert join_shards(root, PLAN).episodes_per_s is None
    assert collect_shard(root, PLAN, Shard(1, 2)).episodes_per_s is None
    assert not shards_folder(root).exists()


@pytest.mark.parametrize("links", [True, False], ids=["links", "copies"])
def test_an_interrupted_join_goes_on(whole, tmp_path, monkeypatch, links):
    root = tmp_path / "dataset"
    collect_all(root, 3)

    def refused(*_):
        raise OSError("another disk")

    if not links:
        monkeypatch.setattr("os.link", refused)
    replace_file, n_left = collection.os.replace, [0]

    def interrupted(source, target):
        n_left[0] -= 1
        if n_left[0] == 0:
            raise KeyboardInterrupt
        replace_file(source, target)

    n_interrupts = 0
    for n_done in range(1, 60, 6):
        n_left[0] = n_done
        with monkeypatch.context() as patch:
            patch.setattr(collection.os, "replace", interrupted)
            try:
                join_shards(root, PLAN)
            except KeyboardInterrupt:
                n_interrupts += 1
                continue
        break
    assert n_interrupts > 1
    assert contents(root) == whole


def test_a_damaged_file_of_a_shard_is_found(whole, tmp_path):
    root = tmp_path / "dataset"
    collect_all(root, 3)
    joined = next(shards_folder(root).rglob("*.parquet"))
    episode = next(shards_folder(root).rglob("*.arrow"))
    for path in (joined, episode):
        good = path.read_bytes()
        path.write_bytes(good[:100] + bytes([good[100] ^ 1]) + good[101:])
        with pytest.raises(CollectionError, match=f"{path} is damaged"):
            join_shards(root, PLAN)
        path.write_bytes(good)
    join_shards(root, PLAN)
    assert contents(root) == whole


def test_shards_that_do_not_belong_together_are_refused(in_process, tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with pytest.raises(CollectionError, match="no shards in .*dataset.shards. Collect them first"):
        join_shards(root, PLAN)
    collect_all(root, 2)
    other = replace(PLAN, seed=1)
    with pytest.raises(CollectionError, match=r"shard 1/2 of other arguments \(seed: 0 there, 1 now\)"):
        join_shards(root, other)
    with pytest.raises(CollectionError, match="seed: 0 there, 1 now"):
        collect_shard(root, other, Shard(2, 2))
    with monkeypatch.context() as patch:
        versions = {**collection.versions(), "pybullet": "3.2.5"}
        patch.setattr("lerobot_deltaco.data.shards.versions", lambda: versions)
        with pytest.raises(CollectionError, match=r"versions: .*Use the same arguments and versions"):
            join_shards(root, PLAN)
    with pytest.raises(CollectionError, match="adversarial_draw: each there, scene now"):
        join_shards(root, replace(PLAN, adversarial_draw="scene"))
    collect_all(root, 3, [1])
    with pytest.raises(CollectionError, match="holds shards of 2 and of 3"):
        join_shards(root, PLAN)


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    root = tmp_path / "dataset"
    folder = Shard(1, 2).folder(root)
    folder.mkdir(parents=True)
    (folder / "notes.txt").touch()
    with pytest.raises(CollectionError, match="something else than shard 1/2"):
        collect_shard(root, PLAN, Shard(1, 2))


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "1/0", "a/b", "-1/2"])
def test_wrong_shards_are_refused(text, capsys, tmp_path):
    with pytest.raises(SystemExit):
        main([*ARGUMENTS, "--root", str(tmp_path / "dataset"), f"--shard={text}"])
    assert f"A shard is I/N, from 1/N to N/N, such as 3/8. Got '{text}'" in capsys.readouterr().err


def test_missing_shards_end_the_command_with_their_names(tmp_path, capsys):
    root = tmp_path / "dataset"
    (shards_folder(root) / "2-of-3" / STAGING).mkdir(parents=True)
    with pytest.raises(SystemExit):
        main([*ARGUMENTS, "--root", str(root), "--join"])
    assert "1/3 is missing, 2/3 is missing, 3/3 is missing" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*ARGUMENTS, "--root", str(root), "--join", "--append"])
    assert "cannot be combined" in capsys.readouterr().err


def test_a_shard_has_a_summary(in_process, tmp_path):
    summary = tmp_path / "summary.json"
    main([*ARGUMENTS, "--root", str(tmp_path / "dataset"), "--shard=1/20", "--summary", str(summary)])
    found = json.loads(summary.read_text())
    assert (found["episodes"], found["all_episodes"]) == (1, 20)
