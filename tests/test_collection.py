"""A collection is a function of its arguments, whatever happens to it on the way."""

import errno
import fcntl
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pyarrow.parquet as pq
import pytest
from gymnasium.utils import seeding
from in_process_collection import collect_in_process, remember_episodes
from lerobot.datasets import LeRobotDataset
from PIL import Image

from gym_deltaco import EPISODE_STEPS, EXPERT_NOISE
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.layout import sample_layout
from gym_deltaco.object_sets import find_label
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import SCENARIOS, TASKS
from lerobot_deltaco.cards.dataset_card import write_card
from lerobot_deltaco.commands.collect import main
from lerobot_deltaco.data import collection, collection_plan, collection_workers
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection import CollectionError, collect
from lerobot_deltaco.data.collection_plan import DATA_SETS, CollectionPlan
from lerobot_deltaco.data.finished_dataset import HISTORY_FILE, STAGING, read_tasks, verify_dataset
from lerobot_deltaco.data.integrity import DIGESTS_FILE, write_checked_json

# Two tasks of different kinds, not in the benchmark's order, in files that end where no task does.
PLAN = CollectionPlan("90,4", 3)
EPISODES_PER_FILE = 4
# Small, for what is done over and over; two files.
SMALL_PLAN = CollectionPlan("90,4", 2)
SMALL_FILES = 3
ARGUMENTS = ["--tasks", "90,4", "--episodes-per-task", "3"]


@pytest.fixture(scope="module")
def env():
    env = PickPlaceEnv()
    yield env
    env.close()


@pytest.fixture(scope="module")
def remembered(env):
    """`collect_episode`, which simulates each episode only once in this module."""
    return remember_episodes(env)


@pytest.fixture
def in_process(monkeypatch, remembered):
    """Lets collections run in this process. Returns the episodes that were collected: (task, number)."""
    return collect_in_process(monkeypatch, remembered, EPISODES_PER_FILE)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The dataset of `PLAN`, by one worker process."""
    root = tmp_path_factory.mktemp("finished") / "dataset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collection, "EPISODES_PER_FILE", EPISODES_PER_FILE)
        collect(root, PLAN, n_workers=1)
    return root


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def contents(root):
    """The bytes of all files of a dataset, hidden ones included; not those that describe it to people."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != "README.md" and "assets" not in path.parts
    }


def read_frames(root):
    return pd.concat(
        [pd.read_parquet(path) for path in sorted((root / "data").glob("*/*.parquet"))], ignore_index=True
    )


def decoded(cell):
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


def history(root):
    return json.loads((root / HISTORY_FILE).read_text())


# Contents


def test_the_dataset_does_not_depend_on_the_number_of_workers(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", EPISODES_PER_FILE)
    collect(tmp_path, PLAN, n_workers=2)
    assert contents(tmp_path) == contents(finished)


def test_the_tests_own_executor_makes_the_same_dataset(finished, tmp_path, in_process):
    collect(tmp_path, PLAN)
    assert contents(tmp_path) == contents(finished)


def test_another_seed_gives_other_episodes(finished, tmp_path, in_process):
    collect(tmp_path, replace(PLAN, seed=1))
    seeds, other_seeds = (set(read_frames(root)["benchmark.seed"]) for root in (finished, tmp_path))
    assert len(seeds) == len(other_seeds) == PLAN.n_episodes
    assert not seeds & other_seeds


def test_episodes_replayed_from_their_seeds_are_the_same_to_the_bit(finished):
    env = PickPlaceEnv()
    for _, episode in read_frames(finished).groupby("episode_index"):
        first = episode.iloc[0]
        observation, info = env.reset(
            seed=int(first["benchmark.seed"]), options={"task_id": first["benchmark.task_id"]}
        )
        assert info["objects"][info["target_object"]] == first["benchmark.target_object"]
        assert info["target_container"] == first["benchmark.target_container"]
        assert len(episode) == EPISODE_STEPS
        for _, frame in episode.iterrows():
            np.testing.assert_array_equal(decoded(frame["observation.image"]), observation["pixels"])
            np.testing.assert_array_equal(frame["observation.state"], observation["agent_pos"])
            observation, reward, _, _, info = env.step(frame["action"])
            assert frame["next.reward"] == reward
            assert frame["next.success"] == info["is_success"]
        assert info["is_success"]
    env.close()


def test_every_episode_succeeds_and_ends_once(finished):
    frames = read_frames(finished)
    last = frames["frame_index"] == EPISODE_STEPS - 1
    assert frames.loc[last, "next.success"].all()
    np.testing.assert_array_equal(frames["next.done"], last)
    np.testing.assert_array_equal(frames["next.reward"], frames["next.success"].astype(float))


def test_tasks_come_in_the_order_of_the_selection(finished):
    frames = read_frames(finished)
    assert frames["benchmark.task_id"].tolist() == np.repeat([90, 4], 3 * EPISODE_STEPS).tolist()
    assert frames["task_index"].tolist() == np.repeat([0, 1], 3 * EPISODE_STEPS).tolist()
    tasks = read_tasks(finished, 2)
    assert tasks == [TASKS[90].instruction, TASKS[4].instruction]


def test_seeds_are_those_of_the_first_attempts_that_succeed(tmp_path, env, in_process):
    plan = CollectionPlan("4,32", 2, noise=0.3)
    summary = collect(tmp_path, plan)
    seeds, attempts = [], Counter()
    for task_id in (4, 32):
        for number in range(2):
            for attempt in range(100):
                attempts[str(task_id)] += 1
                seed = episode_seed(0, "train", task_id, number, attempt)
                *_, last = expert_episode(env, task_id, seed, noise=0.3)
                if last.info["is_success"]:
                    seeds.append(seed)
                    break
    assert attempts.total() > plan.n_episodes  # else this would test nothing
    frames = read_frames(tmp_path)
    assert frames["benchmark.seed"][::EPISODE_STEPS].tolist() == seeds
    assert history(tmp_path)[-1]["attempts"] == attempts
    assert summary.attempts == attempts.total()
    kinds = {TASKS[int(task_id)].kind: 2 / n for task_id, n in attempts.items()}
    assert summary.success_rates == kinds


def test_an_expert_that_never_succeeds_ends_the_collection(tmp_path, env, monkeypatch, capsys, in_process):
    monkeypatch.setattr(collection_plan, "MAX_ATTEMPTS", 2)
    with pytest.raises(SystemExit) as exit_info:
        main(["--tasks", "4", "--episodes-per-task", "1", "--noise", "1e6", "--root", str(tmp_path)])
    assert exit_info.value.code == 1
    assert "failed 2 times in a row at task 4, episode 0" in capsys.readouterr().err


# Selections


@pytest.mark.parametrize(
    ("name", "n_tasks", "split"),
    [
        ("T198", 198, "train"),
        ("T48", 48, "train"),
        ("T54", 54, "train"),
        ("E48", 48, "validation"),
        ("E54", 54, "validation"),
        ("E102", 102, "validation"),
        ("T150", 150, "train"),
        ("V48", 48, "validation"),
    ],
)
def test_named_data_sets_have_their_tasks_and_splits(name, n_tasks, split):
    plan = CollectionPlan(name, 1)
    assert len(set(plan.task_ids)) == len(plan.task_ids) == n_tasks
    assert plan.split == split


def test_data_sets_of_the_paper_fit_together():
    tasks = {name: set(task_ids) for name, (task_ids, _) in DATA_SETS.items()}
    assert tasks["T198"] == set(SCENARIOS["a"].train_tasks)
    assert tasks["E102"] == set(range(300)) - tasks["T198"]
    assert not tasks["E48"] & tasks["E54"]
    assert tasks["E48"] | tasks["E54"] == tasks["E102"]
    assert {TASKS[task_id].kind for task_id in tasks["T48"]} == {"name"}
    assert {TASKS[task_id].kind for task_id in tasks["T54"]} == {"color", "shape"}
    assert tasks["T48"] == tasks["E48"] <= set(SCENARIOS["b"].train_tasks)
    assert tasks["T54"] == tasks["E54"] == set(SCENARIOS["b"].test_tasks)


def test_data_sets_for_choosing_settings_split_the_training_tasks():
    tasks = {name: set(task_ids) for name, (task_ids, _) in DATA_SETS.items()}
    assert tasks["T150"] | tasks["V48"] == tasks["T198"]
    assert not tasks["T150"] & tasks["V48"]


@pytest.mark.parametrize(
    ("tasks", "split"),
    [
        ("scenario_a_test", "validation"),
        ("scenario_b_test", "validation"),
        ("scenario_a_clean_test", "validation"),
        ("scenario_a_validation", "validation"),
        ("scenario_a_selection_train", "train"),
        ("0,scenario_a_validation", "train"),
        ("scenario_a_train", "train"),
        ("all", "train"),
        ("4,50-53", "train"),
    ],
)
def test_held_out_tasks_are_for_validation_and_all_else_for_training(tasks, split):
    assert CollectionPlan(tasks, 1).split == split
    assert CollectionPlan(tasks, 1, split="train").split == "train"
    assert CollectionPlan(tasks, 1, split="validation").split == "validation"


def test_training_and_validation_never_show_the_same_scene(finished, tmp_path, in_process):
    collect(tmp_path, replace(PLAN, split="validation"))
    training, validation = (set(read_frames(root)["benchmark.seed"]) for root in (finished, tmp_path))
    assert not training & validation
    assert all(episode_seed(0, "validation", 90, number) in validation for number in range(3))


# Objects and distractors


@pytest.mark.parametrize(
    ("tasks", "objects"),
    [("T198", "all"), ("scenario_a_clean_train", "scenario_a_train"), ("scenario_a_clean_test", "all")],
)
def test_scenes_are_made_of_the_objects_of_the_task_set(tasks, objects):
    assert CollectionPlan(tasks, 1).objects == objects
    assert CollectionPlan("4", 1, objects="scenario_a_train").objects == "scenario_a_train"


def test_a_dataset_says_of_what_its_scenes_are_made_where_that_is_not_the_papers(tmp_path):
    usual = CollectionPlan("4", 1)
    assert set(usual.features["observation.image"]["info"]) == {"renderer", "benchmark", "ambiguity"}
    changed = replace(usual, tasks="1000", objects="random:100", adversarial_probability=0.0)
    collect(tmp_path, changed)
    info = json.loads((tmp_path / "meta/info.json").read_text())["features"]["observation.image"]["info"]
    assert (info["objects"], info["adversarial_probability"]) == ("random:100", 0.0)
    (target,) = set(read_frames(tmp_path)["benchmark.target_object"])
    assert find_label(target).color == "black and white"
    assert find_label(target).shape == "vase"
    write_card(tmp_path)
    card = (tmp_path / "README.md").read_text()
    assert "--env.objects=random:100 --env.adversarial_probability=0.0" in card
    assert "Put black and white colored, vase shaped object in green bin." in card
    assert "One draw decides" not in card


def test_a_dataset_whose_distractors_are_drawn_together_says_so(tmp_path, in_process):
    collect(tmp_path, replace(CollectionPlan("4", 1), adversarial_draw="scene"))
    info = json.loads((tmp_path / "meta/info.json").read_text())["features"]["observation.image"]["info"]
    assert set(info) == {"renderer", "benchmark", "ambiguity", "adversarial_draw"}
    write_card(tmp_path)
    card = (tmp_path / "README.md").read_text()
    assert "One draw decides for both distractors of a scene" in card
    assert "--env.adversarial_draw=scene" in card
    assert "--adversarial-draw scene" in card


def test_episodes_are_collected_with_the_draw_of_the_plan():
    plan = CollectionPlan("4", 1, adversarial_draw="scene")
    with closing(PickPlaceEnv(**{**plan.env_settings, "image_size": 8})) as env:
        for seed in range(8):
            _, info = env.reset(seed=seed, options={"task_id": 4})
            rng, _ = seeding.np_random(seed)
            layout = sample_layout(TASKS[4], "container", rng, adversarial_draw="scene")
            assert info["objects"].tolist() == [item.label.index for item in layout.objects]


# Adding to a dataset


def test_more_episodes_of_the_same_tasks_continue_their_seeds(finished, copy, tmp_path, in_process):
    before = contents(copy)
    collect(copy, replace(PLAN, episodes_per_task=2), append=True)
    after = contents(copy)
    for path, old in before.items():
        if path.startswith(("data/", "meta/episodes/")):
            assert after[path] == old
    assert in_process == [(90, 3), (90, 4), (4, 3), (4, 4)]
    # The episodes are those of a longer collection, in another order.
    collect(tmp_path / "longer", replace(PLAN, episodes_per_task=5))
    frames, longer = (read_frames(root) for root in (copy, tmp_path / "longer"))
    assert frames["index"].tolist() == list(range(10 * EPISODE_STEPS))
    assert frames["episode_index"].tolist() == np.repeat(range(10), EPISODE_STEPS).tolist()
    assert sorted(frames["benchmark.seed"]) == sorted(longer["benchmark.seed"])
    assert len(set(frames["benchmark.seed"])) == 10
    assert len(read_tasks(copy, 2)) == 2
    # Statistics are those of all episodes, in whatever order.
    stats, longer_stats = (
        json.loads((root / files.STATS_FILE).read_text()) for root in (copy, tmp_path / "longer")
    )
    for feature in ("observation.image", "observation.state", "action", "benchmark.seed"):
        for name in ("min", "max", "mean", "std", "count", "q50"):
            np.testing.assert_allclose(stats[feature][name], longer_stats[feature][name], rtol=1e-6)


def test_other_seeds_and_splits_begin_anew_when_they_are_added(copy, in_process):
    collect(copy, CollectionPlan("4", 1, seed=1), append=True)
    collect(copy, CollectionPlan("4", 1, split="validation"), append=True)
    collect(copy, CollectionPlan("4", 1), append=True)
    collect(copy, CollectionPlan("4", 1), append=True)
    assert in_process == [(4, 0), (4, 0), (4, 3), (4, 4)]
    assert len(set(read_frames(copy)["benchmark.seed"])) == PLAN.n_episodes + 4


def test_more_tasks_go_to_the_end(copy, in_process):
    summary = collect(copy, CollectionPlan("32,4", 1), append=True)
    assert read_tasks(copy, 3) == [TASKS[i].instruction for i in (90, 4, 32)]
    frames = read_frames(copy)
    assert frames["task_index"][-2 * EPISODE_STEPS :].tolist() == np.repeat([2, 1], EPISODE_STEPS).tolist()
    assert [entry["plan"]["tasks"] for entry in history(copy)] == ["90,4", "32,4"]
    assert summary.episodes == PLAN.n_episodes + 2
    assert summary.new_episodes == 2
    dataset = LeRobotDataset("user/deltaco", root=copy)
    assert dataset.num_episodes == PLAN.n_episodes + 2
    assert dataset[len(dataset) - EPISODE_STEPS - 1]["task"] == TASKS[32].instruction


def test_an_interrupted_addition_leaves_the_old_dataset_readable(copy, tmp_path, in_process, monkeypatch):
    added = CollectionPlan("32", 2)
    expected = shutil.copytree(copy, tmp_path / "expected")
    collect(expected, added, append=True)

    before = contents(copy)
    monkeypatch.setattr(collection_workers, "_join", fail_with(OSError("The disk is full.")))
    with pytest.raises(OSError, match="full"):
        collect(copy, added, append=True)
    assert before.items() <= contents(copy).items()
    assert LeRobotDataset("user/deltaco", root=copy).num_episodes == PLAN.n_episodes
    for arguments in [(added, False), (replace(added, episodes_per_task=3), True), (PLAN, False)]:
        with pytest.raises(CollectionError, match="unfinished collection of other arguments"):
            collect(copy, arguments[0], append=arguments[1])

    monkeypatch.undo()
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", EPISODES_PER_FILE)
    collect(copy, added, append=True)
    assert contents(copy) == contents(expected)


@pytest.mark.parametrize(
    "change",
    [{"image_size": 32}, {"ambiguity": "object"}, {"objects": "random:100"}, {"adversarial_draw": "scene"}],
    ids=str,
)
def test_other_images_are_not_added(copy, change, in_process):
    with pytest.raises(CollectionError, match="images differ in size, ambiguity, renderer"):
        collect(copy, replace(PLAN, **change), append=True)
    assert not in_process


def without_draw(plan):
    """A plan as versions before `adversarial_draw` wrote it down."""
    return {name: value for name, value in plan.items() if name != "adversarial_draw"}


def test_a_dataset_of_an_earlier_version_has_a_draw_for_each_distractor(copy, in_process):
    entry = history(copy)[0]
    assert entry["plan"]["adversarial_draw"] == "each"
    (copy / HISTORY_FILE).write_text(json.dumps([{**entry, "plan": without_draw(entry["plan"])}]))
    (copy / DIGESTS_FILE).unlink()
    assert collect(copy, PLAN).episodes_per_s is None
    with pytest.raises(CollectionError, match="finished dataset of other arguments"):
        collect(copy, replace(PLAN, adversarial_draw="scene"))
    with pytest.raises(CollectionError, match="probability or draw of adversarial distractors"):
        collect(copy, replace(PLAN, adversarial_draw="scene"), append=True)
    assert not in_process


def test_a_collection_that_an_earlier_version_began_goes_on(finished, tmp_path, monkeypatch, in_process):
    with monkeypatch.context() as patch:
        patch.setattr(collection_workers, "_join", fail_with(OSError("full")))
        with pytest.raises(OSError, match="full"):
            collect(tmp_path, PLAN)
    plan_file = tmp_path / STAGING / "plan.json"
    write_checked_json(plan_file, without_draw(collection.identity(PLAN)))
    with pytest.raises(CollectionError, match="adversarial_draw: each there, scene now"):
        collect(tmp_path, replace(PLAN, adversarial_draw="scene"))
    collect(tmp_path, PLAN)
    assert contents(tmp_path) == contents(finished)


def test_there_must_be_something_to_add_to(tmp_path, in_process):
    with pytest.raises(CollectionError, match="no finished dataset to add to"):
        collect(tmp_path, PLAN, append=True)
    assert list(tmp_path.iterdir()) == []


# Interruptions


def fail_with(error):
    def fail(*_, **__):
        raise error

    return fail


class KilledError(BaseException):
    """Stands for the end of the process."""


@contextmanager
def failing_step(number, is_fatal):
    """Lets a step that changes the disk fail; if that is fatal, then nothing is changed after it either.

    Yields:
        A list of the steps that were tried.
    """
    steps = []
    with pytest.MonkeyPatch.context() as patch:

        def counted(function):
            def step(*arguments, **options):
                steps.append((function.__name__, arguments))
                if is_fatal and len(steps) >= number:
                    raise KilledError
                if len(steps) == number:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return function(*arguments, **options)

            return step

        # A folder that exists already hides that making it failed.
        for function in (os.replace, os.unlink, os.rmdir, *([os.mkdir] if is_fatal else [])):
            patch.setattr(os, function.__name__, counted(function))
        yield steps


@pytest.mark.parametrize(
    ("append", "is_fatal"),
    [
        pytest.param(False, True, id="new, killed"),
        pytest.param(True, False, id="added, full disk"),
        pytest.param(False, False, id="new, full disk", marks=pytest.mark.slow),
        pytest.param(True, True, id="added, killed", marks=pytest.mark.slow),
    ],
)
def test_whatever_step_fails_the_next_run_completes_the_same_dataset(
    tmp_path, monkeypatch, in_process, append, is_fatal
):
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", SMALL_FILES)
    first = tmp_path / "first"
    if append:
        collect(first, CollectionPlan("4,32", 1))
    # Twice, because the simulator has files of its own when it starts.
    for root in (tmp_path / "warm", tmp_path / "expected"):
        if append:
            shutil.copytree(first, root)
        with failing_step(10**9, is_fatal) as steps:
            collect(root, SMALL_PLAN, append=append)
    expected = contents(root)
    n_steps = len(steps)
    assert n_steps > 25
    for number in range(1, n_steps + 1):
        root = tmp_path / str(number)
        if append:
            shutil.copytree(first, root)
        in_process.clear()
        with (
            failing_step(number, is_fatal) as steps,
            pytest.raises(KilledError if is_fatal else OSError),
        ):
            collect(root, SMALL_PLAN, append=append)
        is_done = history(root)[-1]["plan"]["tasks"] == SMALL_PLAN.tasks if is_finished(root) else False
        is_removing = is_done and not (root / STAGING / "plan.json").exists()
        # Only for an addition is this another command: its arguments were already followed.
        if not (append and is_removing):
            collect(root, SMALL_PLAN, append=append)
        else:
            with pytest.raises(CollectionError, match="finished dataset of other arguments"):
                collect(root, CollectionPlan("5", 1))
        assert contents(root) == expected, steps[number - 1]
        # No finished episode was lost, and at most the one that failed was run again.
        counts = Counter(in_process)
        assert len(counts) == SMALL_PLAN.n_episodes
        assert counts.total() <= SMALL_PLAN.n_episodes + 1
        shutil.rmtree(root)


def is_finished(root):
    path = root / files.INFO_FILE
    return path.exists() and json.loads(path.read_text())["codebase_version"] == files.CODEBASE_VERSION


def test_many_complete_files_may_wait_to_be_joined(tmp_path, monkeypatch, in_process):
    """More of them than there are jobs for the workers at a time."""
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", 1)
    plan = CollectionPlan("4,90,32", 3)
    expected = tmp_path / "expected"
    collect(expected, plan)
    join = collection_workers._join
    monkeypatch.setattr(collection_workers, "_join", lambda part: None)
    with pytest.raises(CollectionError, match="missing"):
        collect(tmp_path / "root", plan)
    monkeypatch.setattr(collection_workers, "_join", join)
    collect(tmp_path / "root", plan)
    assert contents(tmp_path / "root") == contents(expected)


COMMAND = """
import resource, signal, sys
from lerobot_deltaco.data import collection
from lerobot_deltaco.commands import collect

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
    collect._share = lambda *_: None  # the card takes longer than the episodes
    collection.EPISODES_PER_FILE = int(sys.argv[1])
    if sys.argv[2] != "-":
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
    collect.main(sys.argv[3:])
"""


def start(root, *arguments, episodes_per_file=EPISODES_PER_FILE, max_file_size="-"):
    """Starts the command in a process group of its own."""
    return subprocess.Popen(
        [
            *(sys.executable, "-c", COMMAND, str(episodes_per_file), str(max_file_size)),
            *("--root", str(root), *(arguments or ARGUMENTS), "--workers", "2"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )


def wait_until(condition, seconds=300):  # a busy machine takes its time
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "It did not come to it."
        time.sleep(0.01)


def n_waiting(root):
    """Number of episodes that wait for their data file."""
    return len(list((root / STAGING / "episodes").glob("*.arrow")))


def test_an_interrupt_ends_with_a_message_and_the_next_run_goes_on(finished, tmp_path, in_process):
    process = start(tmp_path)
    wait_until(lambda: n_waiting(tmp_path) > 0)
    # Meanwhile, no other process may collect there.
    with pytest.raises(CollectionError, match="Another process is collecting into"):
        collect(tmp_path, PLAN)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes of the command
    _, error = process.communicate(timeout=300)
    assert process.returncode == 130, error
    assert "Interrupted. Run the same command again to continue." in error
    assert "Traceback" not in error
    with pytest.raises(ValueError, match="unfinished; run its `deltaco-collect` command again to go on"):
        LeRobotDataset("user/deltaco", root=tmp_path)
    n_kept = n_waiting(tmp_path)
    collect(tmp_path, PLAN)
    assert len(in_process) <= PLAN.n_episodes - n_kept
    assert contents(tmp_path) == contents(finished)


@pytest.mark.slow
def test_an_interrupt_while_the_workers_start_is_no_worse(tmp_path):
    process = start(tmp_path)
    wait_until(lambda: psutil.Process(process.pid).children() or process.poll() is not None)
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 130, error
    assert "Traceback" not in error


def kill_until_finished(root, rng, n_kills, arguments, episodes_per_file):
    """Runs the command, and kills it at random moments, at most so many times. Returns how many it were."""
    for n_killed in range(n_kills + 1):
        before = stored(root)
        process = start(root, *arguments, episodes_per_file=episodes_per_file)
        workers = []
        if n_killed < n_kills:
            # Mostly once something more is stored, else while the workers start.
            is_late = rng.random() < 0.7
            wait_until(
                lambda p=process, b=before, late=is_late: (
                    p.poll() is not None or (stored(root) - b if late else psutil.Process(p.pid).children())
                )
            )
            time.sleep(rng.uniform(0, 1))
            workers = psutil.Process(process.pid).children() if process.poll() is None else []
            process.kill()
        _, error = process.communicate(timeout=300)
        # Its workers do not outlive it.
        assert not psutil.wait_procs(workers, timeout=60)[1]
        if process.returncode != -signal.SIGKILL:
            assert process.returncode == 0, error
            return n_killed
    raise AssertionError("It never ended.")


def stored(root):
    """Files of what is finished so far."""
    return {path for path in (root / STAGING).rglob("*") if path.suffix in (".arrow", ".parquet")}


def test_killed_it_completes_the_same_dataset(finished, tmp_path, in_process):
    process = start(tmp_path)
    wait_until(lambda: n_waiting(tmp_path) > 0)
    process.kill()
    process.communicate(timeout=300)
    assert not is_finished(tmp_path)
    collect(tmp_path, PLAN)
    assert contents(tmp_path) == contents(finished)


@pytest.mark.slow
def test_killed_many_times_it_completes_the_same_dataset(tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", 5)
    plan = CollectionPlan("90,4,32", 9)
    collect(tmp_path / "expected", plan, n_workers=2)
    arguments = ["--tasks", plan.tasks, "--episodes-per-task", str(plan.episodes_per_task)]
    n_killed = kill_until_finished(tmp_path / "root", random.Random(1), 50, arguments, 5)
    assert n_killed > 2
    assert contents(tmp_path / "root") == contents(tmp_path / "expected")


@pytest.mark.parametrize(
    ("max_file_size", "n_kept"),
    [
        pytest.param(20_000, 0, id="an episode", marks=pytest.mark.slow),
        pytest.param(100_000, EPISODES_PER_FILE, id="a data file"),
    ],
)
def test_a_write_that_fails_ends_with_a_message_and_the_next_run_goes_on(
    finished, tmp_path, in_process, max_file_size, n_kept
):
    """A limit on the size of files stands for a full disk."""
    process = start(tmp_path, max_file_size=max_file_size)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 1, error
    assert "Traceback" not in error
    assert os.strerror(errno.EFBIG) in error
    assert not is_finished(tmp_path)
    assert (n_waiting(tmp_path) > 0) == (n_kept > 0)
    assert n_waiting(tmp_path) >= n_kept
    assert not list(tmp_path.rglob("*.part"))
    collect(tmp_path, PLAN)
    assert contents(tmp_path) == contents(finished)


def test_a_worker_that_is_killed_is_reported_and_the_next_run_goes_on(finished, tmp_path, in_process):
    process = start(tmp_path)
    wait_until(lambda: n_waiting(tmp_path) > 0)
    workers = [
        child for child in psutil.Process(process.pid).children() if "spawn_main" in " ".join(child.cmdline())
    ]
    workers[0].kill()
    _, error = process.communicate(timeout=300)
    assert process.returncode == 1, error
    assert "A worker process ended unexpectedly" in error
    assert "Traceback" not in error
    collect(tmp_path, PLAN)
    assert contents(tmp_path) == contents(finished)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_folder_is_reported(tmp_path, capsys):
    tmp_path.chmod(0o555)
    with pytest.raises(SystemExit) as exit_info:
        main(["--root", str(tmp_path / "new"), *ARGUMENTS])
    assert exit_info.value.code == 1
    assert "Permission denied" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["mkdir", "replace", "open"])
def test_an_error_of_the_disk_is_a_message(tmp_path, monkeypatch, capsys, in_process, name):
    error = PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / "x"))
    if name == "open":
        monkeypatch.setattr(Path, "open", fail_with(error))
    else:
        monkeypatch.setattr(os, name, fail_with(error))
    with pytest.raises(SystemExit) as exit_info:
        main(["--root", str(tmp_path / "new"), *ARGUMENTS])
    assert exit_info.value.code == 1
    message = capsys.readouterr().err
    assert "deltaco-collect: [Errno 13] Permission denied" in message
    assert str(tmp_path) in message


# Refusals


def test_the_same_arguments_again_have_nothing_to_do(copy, capsys, in_process):
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    summary = collect(copy, PLAN)
    assert summary.episodes == summary.new_episodes == PLAN.n_episodes
    assert summary.episodes_per_s is None
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before
    main(["--root", str(copy), *ARGUMENTS])
    assert "nothing to do" in capsys.readouterr().out
    assert not in_process


@pytest.mark.parametrize(
    "change",
    [
        {"tasks": "4,90"},
        {"episodes_per_task": 4},
        {"seed": 1},
        {"split": "validation"},
        {"noise": 0.2},
        {"ambiguity": "object"},
        {"image_size": 32},
        {"objects": "scenario_a_train"},
        {"adversarial_probability": 0.0},
        {"adversarial_draw": "scene"},
    ],
    ids=str,
)
def test_other_arguments_are_refused(copy, tmp_path, monkeypatch, in_process, change):
    other = replace(PLAN, **change)
    before = contents(copy)
    with pytest.raises(CollectionError, match="finished dataset of other arguments"):
        collect(copy, other)
    assert contents(copy) == before

    unfinished = tmp_path / "unfinished"
    monkeypatch.setattr(collection_workers, "_join", fail_with(OSError("full")))
    with pytest.raises(OSError, match="full"):
        collect(unfinished, PLAN)
    before = contents(unfinished)
    ((name, value),) = change.items()
    with pytest.raises(CollectionError) as error:
        collect(unfinished, other)
    assert f"{name}: {getattr(PLAN, name)} there, {value} now" in str(error.value)
    assert contents(unfinished) == before


def test_a_folder_with_something_else_is_refused(tmp_path, in_process):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(CollectionError, match=r"not empty \(thesis.tex\)"):
        collect(tmp_path, PLAN)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("codebase_version", ["v3.0", "v2.1"])
def test_a_dataset_of_another_origin_is_refused(tmp_path, in_process, codebase_version):
    (tmp_path / "meta").mkdir()
    (tmp_path / files.INFO_FILE).write_text(json.dumps({"codebase_version": codebase_version}))
    for append in (False, True):
        with pytest.raises(CollectionError, match="`deltaco-collect` did not make"):
            collect(tmp_path, PLAN, append=append)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path, capsys):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as exit_info:
        main(["--root", str(tmp_path / "file"), *ARGUMENTS])
    assert exit_info.value.code == 1
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_a_dataset_that_another_process_has_finished_meanwhile_is_not_touched(copy, monkeypatch, in_process):
    """That is, between the first look at the folder and the lock."""
    bases = iter([None, collection._read_base(copy)])
    monkeypatch.setattr(collection, "_read_base", lambda root: next(bases))
    monkeypatch.setattr(collection, "_check_may_begin", lambda *_: None)
    before = contents(copy)
    with pytest.raises(CollectionError, match="just finished"):
        collect(copy, PLAN)
    assert before.items() <= contents(copy).items()
    assert not in_process


def test_workers_of_a_killed_run_are_waited_for(tmp_path, in_process):
    """They end by themselves, but not in the same instant."""
    (tmp_path / STAGING).mkdir()
    with (tmp_path / STAGING / collection_workers.WORKERS_LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        seconds = 0.2
        threading.Timer(seconds, lambda: fcntl.flock(lock, fcntl.LOCK_UN)).start()
        start = time.monotonic()
        collect(tmp_path, CollectionPlan("4", 1))
        assert time.monotonic() - start > seconds


# Damaged files


def flipped(path, share):
    """Flips a bit of a file, at a share of its length."""
    stored = bytearray(path.read_bytes())
    stored[int(share * len(stored))] ^= 1
    path.write_bytes(stored)


def test_a_damaged_episode_is_named_and_can_be_collected_anew(finished, tmp_path, monkeypatch, in_process):
    join = collection_workers._join
    monkeypatch.setattr(collection_workers, "_join", fail_with(OSError("full")))
    with pytest.raises(OSError, match="full"):
        collect(tmp_path, PLAN)
    monkeypatch.setattr(collection_workers, "_join", join)
    damaged = tmp_path / STAGING / "episodes" / "0000002.arrow"
    old = damaged.read_bytes()
    for damage in (
        lambda: damaged.write_bytes(old[: len(old) // 2]),
        lambda: damaged.write_bytes(b""),
        lambda: damaged.write_bytes(old[:-10] + bytes(10)),
        *(partial(flipped, damaged, share) for share in (0.01, 0.3, 0.6, 0.999)),
    ):
        damage()
        with pytest.raises(CollectionError, match="damaged.*Delete it and run the command again") as error:
            collect(tmp_path, PLAN)
        assert str(damaged) in str(error.value)
        damaged.write_bytes(old)
    damaged.unlink()
    in_process.clear()
    collect(tmp_path, PLAN)
    assert in_process.count((90, 2)) == 1
    assert contents(tmp_path) == contents(finished)


@pytest.mark.parametrize("damaged", ["joined/data/chunk-000/file-001.parquet", "parts/00001.json"])
def test_a_damaged_file_that_waits_is_named_and_can_be_collected_anew(
    finished, tmp_path, monkeypatch, in_process, damaged
):
    prepare = collection._prepare_commit
    monkeypatch.setattr(collection, "_prepare_commit", fail_with(OSError("full")))
    with pytest.raises(OSError, match="full"):
        collect(tmp_path, PLAN)
    monkeypatch.setattr(collection, "_prepare_commit", prepare)
    path = tmp_path / STAGING / damaged
    flipped(path, 0.4)
    part_file = tmp_path / STAGING / "parts/00001.json"
    with pytest.raises(CollectionError, match="damaged.*collected again") as error:
        collect(tmp_path, PLAN)
    assert str(path) in str(error.value)
    assert f"Delete {part_file}" in str(error.value)
    part_file.unlink()
    in_process.clear()
    collect(tmp_path, PLAN)
    assert len(in_process) == PLAN.n_episodes - EPISODES_PER_FILE
    assert contents(tmp_path) == contents(finished)


def test_a_collection_whose_arguments_are_lost_is_not_continued(copy, tmp_path, monkeypatch, in_process):
    monkeypatch.setattr(collection_workers, "_join", fail_with(OSError("full")))
    new, added = tmp_path / "new", copy
    for root, plan, append in ((new, PLAN, False), (added, CollectionPlan("32", 2), True)):
        with pytest.raises(OSError, match="full"):
            collect(root, plan, append=append)
        plan_file = root / STAGING / "plan.json"
        kept = plan_file.read_bytes()
        flipped(plan_file, 0.5)
        with pytest.raises(CollectionError, match=r"plan\.json is damaged"):
            collect(root, plan, append=append)
        plan_file.unlink()
        before = contents(root)
        for asked in (plan, replace(plan, seed=7)):
            with pytest.raises(CollectionError, match=r"arguments are lost: .*plan\.json is missing"):
                collect(root, asked, append=append)
        assert contents(root) == before
        plan_file.write_bytes(kept)
        with pytest.raises(OSError, match="full"):
            collect(root, plan, append=append)


def test_an_addition_that_was_interrupted_at_its_end_is_not_mistaken_for_a_new_dataset(
    copy, monkeypatch, in_process
):
    write_tasks = files.write_tasks
    monkeypatch.setattr(files, "write_tasks", fail_with(OSError("full")))
    added = CollectionPlan("32", 1)
    with pytest.raises(OSError, match="full"):
        collect(copy, added, append=True)
    assert not is_finished(copy)
    commit = copy / STAGING / "commit.json"
    kept = commit.read_bytes()
    flipped(commit, 0.5)
    with pytest.raises(CollectionError, match=r"commit\.json is damaged"):
        collect(copy, added, append=True)
    commit.unlink()
    before = contents(copy)
    with pytest.raises(CollectionError, match=r"commit\.json.* is missing"):
        collect(copy, added, append=True)
    assert contents(copy) == before
    commit.write_bytes(kept)
    monkeypatch.setattr(files, "write_tasks", write_tasks)
    assert collect(copy, added, append=True).episodes == PLAN.n_episodes + 1
    assert verify_dataset(copy).has_digests


@pytest.mark.parametrize(
    "file",
    [
        "data/chunk-000/file-001.parquet",
        *map(str, (HISTORY_FILE, files.INFO_FILE, files.STATS_FILE, files.TASKS_FILE)),
    ],
)
@pytest.mark.parametrize("append", [False, True])
def test_a_damaged_file_of_the_dataset_is_named(copy, in_process, file, append):
    os.truncate(copy / file, (copy / file).stat().st_size // 2)
    with pytest.raises(CollectionError, match="damaged") as error:
        collect(copy, PLAN, append=append)
    assert str(copy / file) in str(error.value)


def with_unknown_argument(history):
    return [{**history[0], "plan": {**history[0]["plan"], "wings": 2}}]


def with_other_attempts(history):
    return [{**history[0], "attempts": {"4": 3}}]


@pytest.mark.parametrize(
    ("file", "change", "reason"),
    [
        *((files.INFO_FILE, lambda _, new=new: new, "must be a") for new in ([], {}, None, 3)),
        (files.INFO_FILE, lambda info: {**info, "total_frames": "180"}, "`total_frames` must be an integer"),
        (files.INFO_FILE, lambda info: {**info, "features": {"action": []}}, "`features` must be a mapping"),
        *(
            (HISTORY_FILE, lambda _, new=new: new, "must be a list|no collection|plan")
            for new in ({}, [], [{}])
        ),
        (HISTORY_FILE, with_unknown_argument, r"the unknown \['wings'\]; it may be of a later version"),
        (HISTORY_FILE, with_other_attempts, "those of the plan's tasks"),
        *((files.STATS_FILE, lambda _, new=new: new, "must be a|lacks") for new in ([], {}, {"action": {}})),
        (
            files.STATS_FILE,
            lambda stats: {**stats, "action": {**stats["action"], "mean": [None]}},
            "finite numbers",
        ),
    ],
)
def test_a_file_of_the_wrong_shape_is_named(copy, in_process, file, change, reason):
    path = copy / file
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    for append in (False, True):
        with pytest.raises(CollectionError, match=f"damaged.*({reason})") as error:
            collect(copy, PLAN, append=append)
        assert str(path) in str(error.value)


def test_a_changed_file_of_the_dataset_is_not_added_to(copy, in_process):
    stats = json.loads((copy / files.STATS_FILE).read_text())
    stats["action"]["mean"][0] += 1
    (copy / files.STATS_FILE).write_text(json.dumps(stats))
    with pytest.raises(CollectionError, match=r"stats\.json is damaged.*SHA-256.*delete meta/SHA256SUMS"):
        collect(copy, PLAN, append=True)
    (copy / DIGESTS_FILE).unlink()
    collect(copy, CollectionPlan("4", 1), append=True)
    # From then on, all files have a checksum.
    assert verify_dataset(copy).has_digests


def test_a_missing_data_file_is_reported(copy, in_process):
    (copy / "data/chunk-000/file-000.parquet").unlink()
    n_left = (PLAN.n_episodes - EPISODES_PER_FILE) * EPISODE_STEPS
    with pytest.raises(CollectionError, match=f"{n_left} frames instead of {PLAN.n_episodes * 30}"):
        collect(copy, PLAN, append=True)


# The command


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["--tasks", "T99"], "Unknown task selection 'T99'"),
        (["--tasks", "T99"], "E102"),
        (["--tasks", "300"], "0 to 299"),
        (["--tasks", "9-4"], "The range '9-4' is empty"),
        (["--tasks", ""], "is empty"),
        (["--episodes-per-task", "0"], "`episodes_per_task` must be at least 1. Got 0."),
        (["--episodes-per-task", "many"], "invalid int value: 'many'"),
        (["--seed", "-1"], "`seed` must be at least 0. Got -1."),
        (["--objects", "none"], "`objects` must be one of all, scenario_a_train, random:N. Got 'none'"),
        (["--tasks", "1000"], "Task 1000 asks for a black and white colored, vase shaped object, of which"),
        (["--adversarial-probability", "1.5"], "`adversarial_probability` must be between 0 and 1. Got 1.5"),
        (["--adversarial-draw", "both"], "invalid choice: 'both' (choose from"),
        (["--noise", "-0.1"], "`noise` must be at least 0. Got -0.1."),
        (["--noise", "nan"], "`noise` must be a finite number. Got nan."),
        (["--noise", "inf"], "`noise` must be a finite number. Got inf."),
        (["--image-size", "99999"], "`image_size` must be at most 4096. Got 99999."),
        (["--image-size", "7"], "`image_size` must be at least 8. Got 7."),
        (["--split", "evaluation"], "invalid choice: 'evaluation'"),
        (["--ambiguity", "both"], "invalid choice: 'both'"),
        (["--workers", "0"], "--workers must be at least 1. Got 0."),
        (["--push-to-hub"], "--push-to-hub needs --repo-id"),
        (["--nosuch"], "unrecognized arguments: --nosuch"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_wrong_arguments_are_explained_in_one_line(tmp_path, capsys, changes, message):
    root = tmp_path / "new"
    with pytest.raises(SystemExit) as exit_info:
        main(["--root", str(root), *ARGUMENTS, *changes])
    assert exit_info.value.code == 2
    *usage, line = capsys.readouterr().err.splitlines()
    assert message in line
    assert usage[0].startswith("usage: deltaco-collect")
    assert not root.exists()


@pytest.mark.parametrize("missing", ["--tasks", "--episodes-per-task", "--root"])
def test_necessary_arguments_are_named(tmp_path, capsys, missing):
    arguments = {"--tasks": "4", "--episodes-per-task": "1", "--root": str(tmp_path)}
    del arguments[missing]
    with pytest.raises(SystemExit) as exit_info:
        main([word for option in arguments.items() for word in option])
    assert exit_info.value.code == 2
    assert f"required: {missing}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change", [{"split": "evaluation"}, {"ambiguity": "both"}, {"seed": -1}, {"adversarial_draw": "both"}]
)
def test_a_plan_checks_its_arguments(change):
    ((name, value),) = change.items()
    with pytest.raises(ValueError, match=rf"`{name}` must be .*Got {value!r}"):
        replace(PLAN, **change)


def test_the_default_noise_is_that_of_the_expert(tmp_path, in_process):
    main(["--root", str(tmp_path / "x"), "--tasks", "4", "--episodes-per-task", "1"])
    assert history(tmp_path / "x")[0]["plan"]["noise"] == EXPERT_NOISE == CollectionPlan("4", 1).noise


def test_a_summary_that_cannot_be_written_is_noticed_before_the_collection(tmp_path, capsys, in_process):
    (tmp_path / "folder").mkdir()
    for file, message in (("mistyped/s.json", "there is no folder"), ("folder", "which is a folder")):
        with pytest.raises(SystemExit):
            main(["--root", str(tmp_path / "dataset"), *ARGUMENTS, "--summary", str(tmp_path / file)])
        assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder"]
    assert in_process == []


def test_the_summary_has_what_was_done(tmp_path, capsys, in_process):
    root, summary_file = tmp_path / "dataset", tmp_path / "summary.json"
    start = time.perf_counter()
    main(["--root", str(root), *ARGUMENTS, "--summary", str(summary_file)])
    seconds = time.perf_counter() - start
    summary = json.loads(summary_file.read_text())
    assert summary["episodes"] == summary["new_episodes"] == PLAN.n_episodes
    assert summary["attempts"] == sum(history(root)[0]["attempts"].values())
    assert set(summary["success_rates"]) == {"name", "shape"}
    assert summary["episodes_per_s"] > PLAN.n_episodes / seconds
    assert summary["bytes_per_episode"] == pytest.approx(
        sum(map(len, contents(root).values())) / PLAN.n_episodes
    )
    output = capsys.readouterr()
    assert f"{PLAN.n_episodes} episodes" in output.out
    assert f"{PLAN.n_episodes}/{PLAN.n_episodes}" in output.err  # the progress bar


def test_the_dataset_records_how_it_was_made(finished):
    (entry,) = history(finished)
    assert CollectionPlan(**entry["plan"]) == PLAN
    assert set(entry["versions"]) == {"lerobot_policy_deltaco", "pybullet", "numpy"}
    info = json.loads((finished / files.INFO_FILE).read_text())
    assert info["features"]["observation.image"]["info"]["renderer"] == entry["renderer"]
    assert "TinyRenderer" in entry["renderer"]
    assert info["robot_type"] == "widowx_250"


def test_a_finished_dataset_has_no_other_files(finished):
    assert {path for path in contents(finished) if not path.startswith(("data/", "meta/episodes/"))} == {
        str(file)
        for file in (files.INFO_FILE, files.STATS_FILE, files.TASKS_FILE, HISTORY_FILE, DIGESTS_FILE)
    }
    assert sorted(path.name for path in finished.iterdir()) == ["data", "meta"]
    n_rows = [pq.read_metadata(path).num_rows for path in sorted((finished / "data").rglob("*.parquet"))]
    assert n_rows == [
        EPISODES_PER_FILE * EPISODE_STEPS,
        (PLAN.n_episodes - EPISODES_PER_FILE) * EPISODE_STEPS,
    ]


def test_worker_processes_load_neither_torch_nor_lerobot():
    """They import the command's module; those packages would take 10 s in each."""
    code = """
import sys, lerobot_deltaco.commands.collect
sys.exit(bool({"torch", "lerobot"} & set(sys.modules)))
"""
    subprocess.run([sys.executable, "-c", code], check=True)
