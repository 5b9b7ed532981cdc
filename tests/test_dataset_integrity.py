"""A finished dataset is checked byte by byte, and damage is named."""

import random
import re
import shutil
import subprocess

import numpy as np
import pyarrow.parquet as pq
import pytest

from gym_deltaco.atomic_files import write_json
from lerobot_deltaco.cards.templates import markdown_code, markdown_text
from lerobot_deltaco.commands.collect import main
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import EPISODE_LENGTH, FPS, CollectionPlan
from lerobot_deltaco.data.finished_dataset import HISTORY_FILE, check_description, verify_dataset
from lerobot_deltaco.data.integrity import (
    DIGESTS_FILE,
    DatasetError,
    file_digest,
    read_checked,
    read_checked_json,
    read_digests,
    write_checked,
    write_checked_json,
    write_digests,
)

PLAN = CollectionPlan("90,4", 1)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A dataset of two tasks, as `deltaco-collect` leaves it, without the simulator's work."""
    root = tmp_path_factory.mktemp("finished")
    rng = np.random.default_rng(0)
    columns = []
    for episode, task_id in enumerate(PLAN.task_ids):
        frames = {
            name: np.full(EPISODE_LENGTH, task_id if name == "benchmark.task_id" else 1, dtype=np.int64)
            for name in PLAN.features
            if name.startswith("benchmark.")
        }
        frames |= {
            "observation.image": rng.integers(0, 255, (EPISODE_LENGTH, 48, 48, 3), dtype=np.uint8),
            "observation.state": rng.normal(size=(EPISODE_LENGTH, 10)).astype(np.float32),
            "action": rng.uniform(-1, 1, (EPISODE_LENGTH, 4)).astype(np.float32),
            "next.reward": np.zeros(EPISODE_LENGTH, np.float32),
            "next.done": np.zeros(EPISODE_LENGTH, bool),
            "next.success": np.ones(EPISODE_LENGTH, bool),
        }
        columns.append(files.episode_columns(frames, FPS, episode, episode * EPISODE_LENGTH, episode))
    schema = files.data_schema(PLAN.features)
    tables = [files.episode_table(episode, schema) for episode in columns]
    files.write_data_file(root / files.numbered(files.DATA_FILE, 0), tables, schema)
    statistics = [files.episode_statistics(episode) for episode in columns]
    tasks = ["Put the shape in the bin.", "Put the name in the bin."]
    episodes_file = root / files.numbered(files.EPISODES_FILE, 0)
    files.write_episodes_file(episodes_file, 0, 0, 0, tasks, [EPISODE_LENGTH] * 2, statistics)
    files.write_tasks(root / files.TASKS_FILE, tasks)
    write_json(root / files.STATS_FILE, files.statistics_to_json(statistics[0]))
    info = files.dataset_info(PLAN.features, FPS, "widowx_250", 2, 2 * EPISODE_LENGTH, 2)
    write_json(root / files.INFO_FILE, info)
    entry = {
        "plan": {"tasks": "90,4", "episodes_per_task": 1},
        "benchmark": "gym_deltaco/PickPlace-v0",
        "renderer": "PyBullet",
        "versions": {"numpy": "2"},
        "attempts": {"90": 1, "4": 2},
    }
    write_json(root / HISTORY_FILE, [entry])
    names = [path.relative_to(root) for path in root.rglob("*") if path.is_file()]
    write_digests(root, {str(name): file_digest(root / name) for name in names})
    return root


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def flip(path, place):
    stored = bytearray(path.read_bytes())
    stored[place] ^= 1
    path.write_bytes(stored)


def test_a_dataset_that_is_whole_is_found_so(finished, capsys):
    found = verify_dataset(finished)
    assert found.episodes == 2
    assert found.has_digests
    listed = [path for path in finished.rglob("*") if path.is_file()]
    assert found.n_files == len(listed)
    assert found.n_bytes == sum(path.stat().st_size for path in listed)
    main(["--verify", "--root", str(finished)])
    assert f"2 episodes in {len(listed)} files" in capsys.readouterr().out


def test_the_list_is_that_of_the_command_sha256sum(finished):
    if shutil.which("sha256sum") is None:
        pytest.skip("there is no sha256sum")
    result = subprocess.run(
        ["sha256sum", "--check", "--strict", str(DIGESTS_FILE)], cwd=finished, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr


def test_every_flipped_bit_is_found_and_its_file_named(copy):
    rng = random.Random(0)
    paths = [path for path in sorted(copy.rglob("*")) if path.is_file()]
    assert len(paths) == 7
    for path in paths:
        whole = path.read_bytes()
        for _ in range(5):
            flip(path, rng.randrange(len(whole)))
            with pytest.raises(DatasetError) as error:
                verify_dataset(copy)
            # A changed list names a file that does not have the checksum in it.
            assert path == copy / DIGESTS_FILE or str(path) in str(error.value)
            path.write_bytes(whole)
    verify_dataset(copy)


def test_a_missing_file_and_one_too_many_are_found(copy):
    path = copy / files.numbered(files.DATA_FILE, 0)
    other = path.with_name("file-001.parquet")
    schema = pq.read_schema(path)
    pq.write_table(schema.empty_table(), other)
    with pytest.raises(DatasetError, match=r"file-001\.parquet does not belong to the dataset"):
        verify_dataset(copy)
    other.unlink()
    (copy / HISTORY_FILE).unlink()
    with pytest.raises(DatasetError, match=r"deltaco\.json is damaged or missing \(meta/SHA256SUMS lists it"):
        verify_dataset(copy)


def test_without_checksums_everything_is_read(copy, capsys):
    (copy / DIGESTS_FILE).unlink()
    main(["--verify", "--root", str(copy)])
    assert "there are no checksums" in capsys.readouterr().out
    path = copy / files.numbered(files.DATA_FILE, 0)
    table = pq.read_table(path)
    image = table["observation.image"][3]["bytes"].as_py()
    stored = path.read_bytes()
    place = stored.find(image[200:232])  # PNG is hardly compressed once more
    assert place > 0
    flip(path, place)
    with pytest.raises(DatasetError, match=r"file-000\.parquet is damaged"):
        verify_dataset(copy)
    path.write_bytes(stored)
    shifted = table.set_column(table.schema.get_field_index("index"), "index", [np.arange(1, len(table) + 1)])
    pq.write_table(shifted, path)
    with pytest.raises(DatasetError, match="numbered from 0"):
        verify_dataset(copy)


def test_the_command_says_what_is_damaged(copy, capsys):
    flip(copy / files.numbered(files.DATA_FILE, 0), 5000)
    with pytest.raises(SystemExit) as exit_info:
        main(["--verify", "--root", str(copy)])
    assert exit_info.value.code == 1
    # Before the message stands a progress bar, on a line of its own if another test left one unfinished.
    message = re.search(r"deltaco-collect: .*", capsys.readouterr().err, re.DOTALL)[0]
    assert re.search(r"file-000\.parquet is damaged or missing \(its SHA-256", message)
    assert message.count("\n") == 1


def test_the_command_verifies_a_folder_and_nothing_else(finished, tmp_path, capsys):
    for arguments, message in (
        (["--verify"], "required: --root"),
        (["--verify", "--root", str(finished), "--append"], "unrecognized arguments: --append"),
    ):
        with pytest.raises(SystemExit) as exit_info:
            main(arguments)
        assert exit_info.value.code == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--verify", "--root", str(tmp_path / "mistyped")])
    assert "mistyped holds no dataset" in capsys.readouterr().err
    assert not (tmp_path / "mistyped").exists()


@pytest.mark.parametrize(
    "text",
    ["no checksum", "0" * 64 + " one space", "z" * 64 + "  meta/info.json", "0" * 64 + "  ../secret"],
)
def test_a_list_that_is_none_is_named(copy, text):
    (copy / DIGESTS_FILE).write_text(text + "\n")
    with pytest.raises(DatasetError, match="SHA256SUMS is damaged"):
        read_digests(copy)


def test_tasks_that_are_not_numbered_are_named(copy):
    files.write_tasks(copy / files.TASKS_FILE, ["only one"])
    with pytest.raises(DatasetError, match=r"tasks\.parquet is damaged.*must number 2 instructions"):
        check_description(copy)
    pq.write_table(pq.read_table(copy / files.TASKS_FILE).drop_columns("task_index"), copy / files.TASKS_FILE)
    with pytest.raises(DatasetError, match=r"tasks\.parquet is damaged"):
        check_description(copy)


def test_files_carry_the_checksum_of_their_contents(tmp_path):
    path = tmp_path / "new" / "file"
    for contents in (b"", b"some bytes"):
        write_checked(path, contents)
        assert read_checked(path, "") == contents
    for place in (0, -1):
        flip(path, place)
        with pytest.raises(DatasetError, match="file is damaged.*checksum.*Do something"):
            read_checked(path, "Do something.")
        flip(path, place)
    write_checked_json(path, {"a": [1, 2.5, None]})
    assert read_checked_json(path, "") == {"a": [1, 2.5, None]}
    for damage in (b"[]", b"{}", b"3", b"", path.read_bytes().replace(b"2.5", b"2.6")):
        path.write_bytes(damage)
        with pytest.raises(DatasetError, match="file is damaged.*Do something"):
            read_checked_json(path, "Do something.")


# Strings from outside in a card


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Put the cup in the bin.", "Put the cup in the bin."),
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)&gt;"),
        ("a | b", "a \\| b"),
        ("[click](http://x)", "\\[click\\](http://x)"),
        ("**bold** `code` _x_", "\\*\\*bold\\*\\* \\`code\\` \\_x\\_"),
        ("# no heading", "\\# no heading"),
        ("1. no list", "1\\. no list"),
        ("- no list", "\\- no list"),
        ("two\n\n## lines", "two ## lines"),
        ("R&D", "R&amp;D"),
    ],
)
def test_strings_from_outside_are_shown_as_they_are(text, shown):
    assert markdown_text(text) == shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [("front", "`front`"), ("a`b", "`` a`b ``"), ("a|b", "`a\\|b`"), ("``", "``` `` ```"), ("a\nb", "`a b`")],
)
def test_code_from_outside_cannot_end_itself(text, shown):
    assert markdown_code(text) == shown
