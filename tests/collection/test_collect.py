"""A dataset is a function of its plan, whatever happens while it is collected."""

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from PIL import Image

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.env import ACTION_NAMES, STATE_NAMES, PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import TASKS
from lerobot_deltaco.collection import collect as collect_module
from lerobot_deltaco.collection import writer as dataset_writer
from lerobot_deltaco.collection.collect import CollectionError, CollectionPlan, collect, is_finished
from lerobot_deltaco.collection.writer import is_written

# Two tasks of different kinds, not in the benchmark's order, in four shards.
PLAN = CollectionPlan("90,4", 12)


@pytest.fixture(scope="module")
def env():
    env = PickPlaceEnv()
    yield env
    env.close()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("finished") / "dataset"
    collect(root, PLAN)
    return root


@pytest.fixture
def collected(finished, monkeypatch):
    """Takes episodes of `PLAN` from the finished dataset. Returns those asked for: (task, number)."""
    frames, asked = read_frames(finished), []
    features = collect_module.dataset_features(PLAN.scene).keys() - dataset_writer.DEFAULT_FEATURES.keys()

    def remembered(_, plan, task_id, number):
        asked.append((task_id, number))
        start = (PLAN.task_ids.index(task_id) * PLAN.episodes_per_task + number) * EPISODE_STEPS
        return {name: frames[name][start : start + EPISODE_STEPS] for name in features}

    monkeypatch.setattr(collect_module, "collect_episode", remembered)
    return asked


def contents(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def read_frames(root):
    """Returns the values of each column, (N, ...); images are decoded."""
    table = pq.read_table(root / "data")
    frames = {name: np.array(table[name].to_pylist()) for name in table.column_names[1:]}
    images = [Image.open(io.BytesIO(cell["bytes"])) for cell in table["observation.image"].to_pylist()]
    types = {field.name: field.type for field in table.schema}
    for name in ("observation.state", "action", "next.reward"):
        assert "float" in str(types[name])
        frames[name] = frames[name].astype(np.float32)
    return {"observation.image": np.stack([np.asarray(image) for image in images]), **frames}


def test_dataset_does_not_depend_on_the_number_of_workers(finished, tmp_path):
    assert "episodes/s" in collect(tmp_path, PLAN, workers=2)
    assert contents(tmp_path) == contents(finished)


def test_replayed_episodes_are_identical(finished, env):
    frames = read_frames(finished)
    assert len(STATE_NAMES) == frames["observation.state"].shape[1]
    assert len(ACTION_NAMES) == frames["action"].shape[1]
    for start in range(0, len(frames["index"]), 7 * EPISODE_STEPS):
        first = {name: values[start] for name, values in frames.items()}
        options = {"task_id": first["benchmark.task_id"]}
        observation, info = env.reset(seed=int(first["benchmark.seed"]), options=options)
        assert info["objects"][info["target_object"]] == first["benchmark.target_object"]
        assert info["target_container"] == first["benchmark.target_container"]
        for i in range(start, start + EPISODE_STEPS):
            np.testing.assert_array_equal(frames["observation.image"][i], observation["pixels"])
            np.testing.assert_array_equal(frames["observation.state"][i], observation["agent_pos"])
            observation, reward, _, _, info = env.step(frames["action"][i])
            assert frames["next.reward"][i] == reward
            assert frames["next.success"][i] == info["is_success"]
        assert info["is_success"]


def test_seeds_are_those_of_the_first_successful_attempts(tmp_path, env):
    plan = CollectionPlan("4,32", 2, noise=0.2)
    summary = collect(tmp_path, plan)
    seeds, attempts = [], {"name": 0, "color": 0}
    for task_id in (4, 32):
        for number in range(2):
            for attempt in range(100):
                attempts[TASKS[task_id].kind] += 1
                seed = episode_seed(0, "train", task_id, number, attempt)
                *_, last = expert_episode(env, task_id, seed, noise=0.2)
                if last.info["is_success"]:
                    seeds.append(seed)
                    break
    assert sum(attempts.values()) > plan.n_episodes  # else this would test nothing
    assert read_frames(tmp_path)["benchmark.seed"][::EPISODE_STEPS].tolist() == seeds
    description = collect_module.read_description(tmp_path)
    assert description["attempts"] == attempts
    assert description["episodes"] == {"name": 2, "color": 2}
    assert f"4 of {sum(attempts.values())} attempts" in summary


def test_scene_settings_reach_the_scenes_and_the_features(tmp_path):
    scene = SceneConfig(objects="random:100", adversarial_probability=0.0, image_size=16)
    plan = CollectionPlan("1000", 1, split="validation", scene=scene)
    collect(tmp_path, plan)
    image = json.loads((tmp_path / "meta/info.json").read_text())["features"]["observation.image"]
    assert image["shape"] == [16, 16, 3]
    assert (image["info"]["objects"], image["info"]["adversarial_probability"]) == ("random:100", 0.0)
    assert read_frames(tmp_path)["benchmark.target_object"].min() >= 32
    assert read_frames(tmp_path)["benchmark.seed"][0] == episode_seed(0, "validation", 1000, 0)
    assert collect_module.read_plan(tmp_path) == plan


def test_held_out_tasks_are_for_validation():
    held_out = ("scenario_a_test", "scenario_b_test", "scenario_a_validation")
    assert {CollectionPlan(tasks, 1).split for tasks in held_out} == {"validation"}
    others = ("scenario_a_train", "all", "4", "0,scenario_a_validation")
    assert {CollectionPlan(tasks, 1).split for tasks in others} == {"train"}
    assert CollectionPlan("scenario_a_test", 1, split="train").split == "train"


def test_invalid_plans_are_refused():
    for arguments, message in [
        ({"tasks": "scenario_c"}, "Valid are the task sets all, scenario_a_train"),
        ({"tasks": "24", "scene": SceneConfig(objects="scenario_a_train")}, "Task 24 asks for"),
        ({"episodes_per_task": 0}, "`episodes_per_task` must be at least 1. Got 0"),
        ({"noise": float("nan")}, "`noise` must be at least 0. Got nan"),
    ]:
        with pytest.raises(ValueError, match=message):
            CollectionPlan(**{"tasks": "4", "episodes_per_task": 1, **arguments})


# Interruptions

PROGRAM = """
import signal, sys
from pathlib import Path
from lerobot_deltaco.collection.collect import CollectionError, CollectionPlan, collect

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
    try:
        collect(Path(sys.argv[1]), CollectionPlan("90,4", 12), workers=2)
    except CollectionError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.mark.parametrize(
    "victim",
    ["main process", *(pytest.param(name, marks=pytest.mark.slow) for name in ("terminal", "worker"))],
)
def test_killed_collection_continues_with_the_missing_shards(finished, tmp_path, collected, victim):
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, process_group=0)
    end = time.monotonic() + 200
    while not (is_written(tmp_path, 0) or is_written(tmp_path, 1)):
        assert time.monotonic() < end
        time.sleep(0.01)
    children = psutil.Process(process.pid).children()
    if victim == "main process":
        process.kill()
    elif victim == "terminal":
        os.killpg(process.pid, signal.SIGINT)
    else:
        next(child for child in children if "spawn_main" in " ".join(child.cmdline())).kill()
    _, errors = process.communicate(timeout=200)
    assert process.returncode == {"main process": -signal.SIGKILL, "terminal": 130, "worker": 1}[victim]
    assert "Traceback" not in errors
    assert ("A worker process was killed" in errors) == (victim == "worker")
    # Workers do not outlive the main process.
    assert not psutil.wait_procs(children, timeout=60)[1]
    assert not is_finished(tmp_path)

    missing = [shard for number, shard in enumerate(PLAN.shards) if not is_written(tmp_path, number)]
    assert len(missing) < len(PLAN.shards)
    collect(tmp_path, PLAN)
    assert collected == [(PLAN.task_ids[i // 12], i % 12) for shard in missing for i in shard]
    assert contents(tmp_path) == contents(finished)


def test_whichever_write_fails_the_next_run_completes_the_same_dataset(tmp_path, collected, monkeypatch):
    plan = replace(PLAN, episodes_per_task=6)
    collect(tmp_path / "expected", plan)
    expected = contents(tmp_path / "expected")
    replace_file, n_calls = os.replace, 0

    def fail_once(source, target):
        nonlocal n_calls
        n_calls += 1
        if n_calls == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", fail_once)
    n_writes = 2 + 2 * len(plan.shards) + 3  # the description twice, two files a shard, and three of metadata
    for failing in range(1, n_writes + 1):
        root, n_calls = tmp_path / str(failing), 0
        with pytest.raises(CollectionError, match=f"Cannot write to {root}: No space left on device") as info:
            collect(root, plan)
        assert "\n" not in str(info.value)
        assert not is_finished(root)
        collect(root, plan)
        assert contents(root) == expected


def test_an_expert_that_never_succeeds_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(collect_module, "MAX_ATTEMPTS", 2)
    with pytest.raises(
        CollectionError, match="failed 2 times in a row at task 4, episode 0. A noise of 10000"
    ):
        collect(tmp_path, CollectionPlan("4", 1, noise=1e6))


def test_finished_dataset_of_the_same_plan_is_left_alone(finished, collected, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    # Also after an update of the renderer.
    monkeypatch.setattr(collect_module, "renderer", lambda: "another one")
    summary = collect(finished, PLAN, workers=2)
    assert "nothing to do" in summary
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before
    assert not collected


def test_another_plan_is_refused(finished, collected):
    changes = {
        "tasks: 90,4 there, 4,90 now": {"tasks": "4,90"},
        "noise: 0.1 there, 0.2 now": {"noise": 0.2},
        "image_size: 48 there, 32 now": {"scene": SceneConfig(image_size=32)},
    }
    for message, change in changes.items():
        with pytest.raises(CollectionError, match=re.escape(f"another plan ({message})")):
            collect(finished, replace(PLAN, **change))
    assert not collected


def test_folder_with_something_else_is_refused(tmp_path, collected):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(CollectionError, match="is not empty: it holds notes.txt. Name a new folder"):
        collect(tmp_path, PLAN)
    with pytest.raises(CollectionError, match="Cannot write to .*notes.txt: File exists"):
        collect(tmp_path / "notes.txt", PLAN)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
