"""The page without a browser: what its buttons do, with a small untrained policy in the real environment."""

import asyncio
import gc
import inspect
import io
import json
import os
import random
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import av
import httpx
import huggingface_hub
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from small_policies import use_fake_encoder

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.tasks import OBJECTS, TASKS
from lerobot_deltaco.commands import play as play_command
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.explanation import GRASP_COLOR, draw_explanation
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.play import engine as engine_module
from lerobot_deltaco.play import sources
from lerobot_deltaco.play.checkpoints import checkpoints_folder, find_checkpoint
from lerobot_deltaco.play.datasets import EpisodeDataset
from lerobot_deltaco.play.demonstrations import Demonstration
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.episodes import MAX_SENTENCE, RENDER_SIZE, Player, checked_sentence
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.modalities import BOTH, DEMONSTRATION_ALONE, INSTRUCTION_ALONE
from lerobot_deltaco.play.session import Actions, Session
from lerobot_deltaco.play.videos import LIFETIME, VideoFiles
from lerobot_deltaco.play.worker import Worker
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, load_demonstrations
from lerobot_deltaco.policy.goals.conditioning import FoundGoals
from lerobot_deltaco.policy.options import PATHS
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS

# Two names and a color, each in a container's color and at a place.
DEMONSTRATED = [TASKS[index].instruction for index in (4, 15, 36, 204)]
N_EACH = 2


def save_policy(folder, **options):
    """A checkpoint of an untrained policy with demonstrations of some tasks."""
    torch.manual_seed(0)
    config = DeltacoConfig(
        device="cpu",
        backbone="strided",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        **{"gripper": "3", **options},
    )
    policy = DeltacoPolicy(config).eval()
    if config.uses_demo:
        frames = torch.randint(0, 256, (len(DEMONSTRATED) * N_EACH, 2, 3, 48, 48), dtype=torch.uint8)
        tasks = [task for task in DEMONSTRATED for _ in range(N_EACH)]
        policy.eval_demonstrations = DemonstrationSet(frames, tasks, range(len(tasks)))
    policy.save_pretrained(folder)
    stats = {"observation.state": {"mean": torch.zeros(10), "std": torch.ones(10)}}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


DATASET_TASKS = [DEMONSTRATED[0], DEMONSTRATED[0], TASKS[9].instruction]
LENGTH = 6


def write_dataset(folder, camera="observation.image", n_states=10, use_videos=False):
    """A dataset with an episode for each of `DATASET_TASKS`, whose images grow brighter."""
    features = {
        camera: {
            "dtype": "video" if use_videos else "image",
            "shape": (64, 64, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (n_states,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    dataset = LeRobotDataset.create("test/demos", 24, features, root=folder, use_videos=use_videos)
    for number, task in enumerate(DATASET_TASKS):
        for step in range(LENGTH):
            gripper = -1 if 2 <= step < 4 else 1
            dataset.add_frame(
                {
                    camera: np.full((64, 64, 3), 60 * number + 10 * step, np.uint8),
                    "observation.state": np.full(n_states, 10 * number + step, np.float32),
                    "action": np.array([0, 0, 0, gripper], np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return folder


pytestmark = pytest.mark.usefixtures("fake_language")


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder of checkpoints: with goals, without, and without demonstrations."""
    folder = tmp_path_factory.mktemp("checkpoints")
    with pytest.MonkeyPatch.context() as monkeypatch:
        use_fake_encoder(monkeypatch)
        save_policy(folder / "goals", demo_encoder="correspondence")
        save_policy(folder / "attention", demo_encoder="attention")
        save_policy(folder / "language", demo_encoder="attention", method="language_only")
        dropouts = {"demo_dropout": 0.3, "instruction_dropout": 0.3}
        save_policy(folder / "either", demo_encoder="correspondence", **dropouts)
        save_policy(folder / "no_demo", demo_encoder="correspondence", demo_dropout=0.3)
        save_policy(folder / "demo_only", demo_encoder="correspondence", method="demo_only")
    write_dataset(folder / "dataset")
    return folder


@pytest.fixture
def engine(checkpoints):
    return Engine(str(checkpoints / "goals"), [checkpoints], is_hub_allowed=False)


@pytest.fixture
def actions(engine):
    return Actions(engine, random.Random(0))


@pytest.fixture
def session(actions, engine):
    opened = actions.open_checkpoint(Session(), engine.default_checkpoint)
    return actions.choose_scene(opened, 4, 3)


def last(sessions):
    *_, session = sessions
    return session


# Drawing


def goals_at(column, row, size=24):
    maps = torch.full((1, 2, size, size), -20.0)
    maps[0, :, row, column] = 20
    places = torch.tensor([[[(column + 0.5) / size * 2 - 1, (row + 0.5) / size * 2 - 1]] * 2])
    return FoundGoals(places, None, maps, maps.flatten(2).softmax(dim=2).view_as(maps))


def pinkness(image, x, y):
    """How close a pixel is to the color of the grasp, 0..1."""
    return 1 - np.abs(image[y, x].astype(float) - GRASP_COLOR).mean() / 255


def test_a_map_is_drawn_where_it_is_great():
    size, scene = 240, np.full((48, 48, 3), 120, np.uint8)
    ends = np.stack([scene, scene])
    image = draw_explanation(scene, ends, goals_at(6, 18), panel_size=size)
    assert image.dtype == np.uint8
    assert image.shape[1] > 3 * size
    assert pinkness(image, 65, 185) > pinkness(image, 185, 65) + 0.2
    plain = draw_explanation(scene, ends, None, panel_size=size)
    assert (plain[:size, :size] == 120).all()


def test_attention_is_not_drawn_where_the_demonstration_does_not_matter():
    scene = np.full((48, 48, 3), 120, np.uint8)
    goals = goals_at(6, 18)._replace(from_demonstration=(True, False))
    image = draw_explanation(scene, np.stack([scene, scene]), goals, panel_size=96)
    assert not (image[:96, :96] == 120).all()
    second = image[:96, 96 + 8 : 2 * 96 + 8]
    assert (second == 120).all()


def test_a_scene_alone_is_one_panel():
    scene = np.zeros((48, 48, 3), np.uint8)
    assert draw_explanation(scene, None, None, panel_size=100).shape[1] == 100


# The worker


def test_a_stream_stays_in_one_thread_and_raises_its_errors():
    def generate():
        yield threading.get_ident()
        yield threading.get_ident()
        raise PlayError("enough")

    stream = Worker().stream(generate)
    first, second = next(stream), next(stream)
    assert first == second != threading.get_ident()
    with pytest.raises(PlayError, match="enough"):
        next(stream)


def test_a_closed_worker_ends_at_the_next_step_of_a_stream():
    worker, is_closed = Worker(), threading.Event()

    def generate():
        try:
            while True:
                time.sleep(0.01)
                yield 1
        finally:
            is_closed.set()

    stream = worker.stream(generate)
    next(stream)
    assert worker.close(30)
    assert is_closed.is_set()
    busy = Worker()
    stream = busy.stream(lambda: (time.sleep(0.01 if n < 1 else 600) for n in range(2)))
    next(stream)
    assert not busy.close(0.1)


def test_a_stream_that_is_left_is_closed_and_the_next_one_runs():
    worker, is_closed = Worker(), threading.Event()

    def generate():
        try:
            while True:
                yield 1
        finally:
            is_closed.set()

    stream = worker.stream(generate)
    assert next(stream) == 1
    stream.close()
    assert is_closed.wait(30)
    assert worker.call(lambda: 2) == 2


def test_the_thread_of_a_worker_ends_with_it():
    worker = Worker()
    thread = worker.call(threading.current_thread)
    del worker
    gc.collect()
    thread.join(30)
    assert not thread.is_alive()


def test_what_a_function_used_is_not_kept():
    class Something:
        pass

    worker, used = Worker(), Something()
    known = weakref.ref(used)
    worker.call(partial(id, used))
    del used
    deadline = time.monotonic() + 30
    while known() is not None:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_end_of_the_program_does_not_wait_for_an_episode():
    code = (
        "import itertools, time\n"
        "from lerobot_deltaco.play.worker import Worker\n"
        "stream = Worker().stream(lambda: (time.sleep(0.01 if n < 9 else 600) for n in itertools.count()))\n"
        "for n in range(9): next(stream)\n"
        "print('over')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr) == (0, "over\n", "")


# Checkpoints


def damaged(checkpoints, tmp_path, file, change):
    folder = tmp_path / "damaged"
    shutil.copytree(checkpoints / "goals", folder)
    content = json.loads((folder / file).read_text())
    change(content)
    (folder / file).write_text(json.dumps(content))
    return folder


def test_a_checkpoint_is_found_in_an_allowed_folder_alone(checkpoints, tmp_path):
    folder = checkpoints / "goals"
    assert find_checkpoint(f" {folder} ", [checkpoints], False) == folder.resolve()
    for name in (str(folder), "/etc", "~root", f"{tmp_path}/../..", "a\0b", "x" * 9999, "USER/NAME"):
        with pytest.raises(PlayError, match="no checkpoint .* may load"):
            find_checkpoint(name, [tmp_path], False)
    with pytest.raises(PlayError, match="is empty"):
        find_checkpoint("  ", [tmp_path], True)


def test_a_link_does_not_lead_out_of_an_allowed_folder(checkpoints, tmp_path):
    (tmp_path / "link").symlink_to(checkpoints / "goals")
    with pytest.raises(PlayError, match="no checkpoint"):
        find_checkpoint(str(tmp_path / "link"), [tmp_path], False)


def test_a_repository_that_cannot_be_fetched_is_explained():
    with pytest.raises(PlayError, match="'USER/NAME' .*Hub"):
        find_checkpoint("USER/NAME", [], True)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "policy_preprocessor.json",
            lambda content: content["steps"].insert(0, {"class": "os.system", "config": {}}),
            "asks for the step 'os.system'",
        ),
        (
            "policy_postprocessor.json",
            lambda content: content["steps"][0].update(registry_name="other_step"),
            "asks for the step 'other_step'",
        ),
        (
            "policy_preprocessor.json",
            lambda content: content["steps"][-1].update(state_file="../../secret.safetensors"),
            "names the file",
        ),
        ("policy_preprocessor.json", lambda content: content.update(steps=3), "no list of steps"),
        ("config.json", lambda content: content.update(type="act"), "of the type 'act'"),
    ],
)
def test_a_checkpoint_that_could_run_code_is_refused(checkpoints, tmp_path, file, change, message):
    folder = damaged(checkpoints, tmp_path, file, change)
    with pytest.raises(PlayError, match=message):
        find_checkpoint(str(folder), [tmp_path], False)


def test_every_option_that_may_be_a_file_is_known():
    """Those that the configuration describes as one."""
    described = dict(
        re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", inspect.cleandoc(DeltacoConfig.__doc__), re.MULTILINE)
    )
    is_path = re.compile("^(CSV file|File|Folder) |a folder with")
    assert {name for name, text in described.items() if is_path.search(text)} == set(PATHS)


@pytest.mark.parametrize("value", ["/etc/passwd", "", ["x/y"]], ids=["a file", "nothing", "a list"])
@pytest.mark.parametrize("option", [*PATHS, "demo_repo_id"])
def test_a_checkpoint_that_could_read_or_write_files_is_refused(checkpoints, tmp_path, option, value):
    folder = damaged(checkpoints, tmp_path, "config.json", lambda content: content.update({option: value}))
    with pytest.raises(PlayError, match=f"`{option}`"):
        find_checkpoint(str(folder), [tmp_path], False)


@pytest.mark.parametrize("encoder", [*VISION_ENCODERS, None])
def test_a_checkpoint_whose_image_encoder_would_be_downloaded_is_refused(checkpoints, tmp_path, encoder):
    def change(content):
        content.update(demo_encoder="pretrained", vision_encoder=encoder)

    folder = damaged(checkpoints, tmp_path, "config.json", change)
    if encoder == "efficientnet-lite0":
        assert find_checkpoint(str(folder), [tmp_path], True) == folder.resolve()
        return
    with pytest.raises(PlayError, match=f"image encoder {encoder!r}.*downloaded.*efficientnet-lite0 alone"):
        find_checkpoint(str(folder), [tmp_path], True)


def test_a_broken_checkpoint_is_explained(checkpoints, tmp_path):
    folder = damaged(checkpoints, tmp_path, "config.json", lambda content: content.update(method="magic"))
    with pytest.raises(PlayError, match="^The checkpoint cannot be loaded: `method` must be one of .*magic"):
        Player(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(PlayError, match=r"config.json cannot be read"):
        find_checkpoint(str(folder), [tmp_path], False)
    (folder / "model.safetensors").unlink()
    with pytest.raises(PlayError, match=r"model.safetensors is missing"):
        find_checkpoint(str(folder), [tmp_path], False)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("tasks.safetensors", b"nothing", "tasks.safetensors cannot be used: .* deltaco-embed wrote"),
        ("model.safetensors", b"nothing", "its files are damaged or of another version"),
        ("policy_preprocessor.json", b"{", "policy_preprocessor.json is no file of a processor"),
    ],
)
def test_visitors_do_not_see_paths_of_the_machine(checkpoints, tmp_path, caplog, file, content, message):
    folder = shutil.copytree(checkpoints / "goals", tmp_path / "damaged")
    (folder / file).write_bytes(content)
    with pytest.raises(PlayError, match=f"^The checkpoint cannot be loaded: {message}") as caught:
        Player(folder)
    assert str(tmp_path) not in str(caught.value)
    assert str(folder) in caplog.text  # for whoever serves the page


def test_an_engine_that_cannot_import_shows_no_details(engine, monkeypatch, caplog):
    def fail():
        raise OSError("/home/host/secret")

    monkeypatch.setattr(engine_module, "_import_episodes", fail)
    engine._start()
    assert engine.status.is_done
    assert not engine.status.is_ready
    assert "LeRobot cannot be loaded" in engine.status.text
    assert "secret" not in engine.status.text
    assert "secret" in caplog.text


def test_an_engine_says_why_it_cannot_start(checkpoints):
    engine = Engine(str(checkpoints / "nowhere"), [checkpoints], is_hub_allowed=False)
    engine._start()
    assert engine.status.is_done
    assert not engine.status.is_ready
    assert "nowhere" in engine.status.text


def test_an_engine_becomes_ready_in_the_background(engine):
    threads = torch.get_num_threads()
    try:
        engine.start()
        deadline = time.monotonic() + 120
        while not engine.status.is_done:
            assert time.monotonic() < deadline, engine.status.text
            time.sleep(0.05)
        assert engine.status.is_ready
    finally:
        torch.set_num_threads(threads)


def test_an_engine_keeps_few_checkpoints(checkpoints, engine, monkeypatch):
    monkeypatch.setattr(engine_module, "MAX_LOADED", 1)
    for name in ("goals", "language"):
        engine.load(str(checkpoints / name))
    assert list(engine._players) == [str(checkpoints / "language")]


# Sessions


def test_a_session_begins_with_a_scene_and_its_demonstration(actions, engine):
    session = actions.open_checkpoint(Session(), engine.default_checkpoint)
    assert TASKS[session.scene.task_id].instruction in DEMONSTRATED
    assert session.demonstrated[0] == session.sentence == TASKS[session.scene.task_id].instruction
    assert session.demonstration.ends.shape == (2, 48, 48, 3)
    assert len(session.view.objects) == 3


def test_a_run_shows_every_step_and_what_happened(actions, session):
    sessions = list(actions.run(session, " put it over there "))
    assert len(sessions) == 1 + EPISODE_STEPS
    run = sessions[-1].latest
    assert "Instruction: put it over there\n" in run.title
    assert "uccess" in run.moment.text
    assert run.moment.view.shape[1] > 3 * 200  # two images of the demonstration, and the scene
    assert not np.array_equal(sessions[0].latest.moment.image, run.moment.image)
    assert sessions[-1].sentence == "put it over there"


def test_a_run_repeats_itself_and_leaves_the_checkpoints_demonstrations(actions, engine, session):
    first, second = (last(actions.run(session, "go")).latest.moment for _ in range(2))
    assert np.array_equal(first.image, second.image)
    assert first.text == second.text
    counts = engine.call(engine.default_checkpoint, lambda player: player.demonstrated_tasks)
    assert counts == dict.fromkeys(DEMONSTRATED, N_EACH)


def test_a_swapped_demonstration_runs_in_the_same_scene_beside_the_last_run(actions, session):
    session = last(actions.run(session, "go"))
    swapped = last(actions.run_with_other_demonstration(session, "go"))
    assert swapped.earlier == session.latest
    assert swapped.scene == session.scene
    assert swapped.demonstrated[0] != session.demonstrated[0]
    assert not np.array_equal(swapped.latest.moment.view, session.latest.moment.view)


def test_a_swapped_instruction_makes_sense_in_the_scene_and_swaps_back(actions, session):
    swapped = last(actions.run_with_other_sentence(session))
    assert swapped.demonstrated == session.demonstrated
    labels = [OBJECTS[index] for index in session.view.info["objects"]]
    other = next(task for task in TASKS if task.instruction == swapped.sentence)
    assert other.index != session.scene.task_id
    assert any(other.describes(label) for label in labels)
    back = last(actions.run_with_other_sentence(swapped))
    assert back.sentence == TASKS[session.scene.task_id].instruction


def test_the_experts_episode_becomes_the_demonstration(actions, session):
    with pytest.raises(PlayError, match="Let the expert do it first"):
        actions.use_recorded(session)
    session = last(actions.run_expert(session))
    assert "Success. It grasped the smushed dumbbell" in session.latest.moment.text
    session = actions.use_recorded(session)
    assert isinstance(session.demonstration, Demonstration)
    assert session.demonstrated is None
    changed = np.abs(np.diff(session.demonstration.ends.astype(int), axis=0)).max()
    assert changed > 50
    assert "uccess" in last(actions.run(session, "go")).latest.moment.text


def test_a_demonstration_of_an_expert_that_failed_says_so(actions, session):
    session = last(actions.run_expert(actions.choose_scene(session, 85, 7183)))
    assert session.latest.moment.text.startswith("Expert. No success.")
    title = actions.use_recorded(session).demonstration.title
    assert title == f"{TASKS[85].instruction} (by the expert, seed 7183; it failed)"


@pytest.mark.parametrize(("name", "n_panels"), [("attention", 3), ("language", 1)])
def test_other_policies_show_what_they_receive(checkpoints, actions, name, n_panels):
    session = actions.open_checkpoint(Session(), str(checkpoints / name))
    moment = last(actions.run(session, "go")).latest.moment
    assert moment.view.shape[1] == n_panels * 224 + (n_panels - 1) * 8


def test_two_users_do_not_mix(actions, session):
    others = actions.choose_demonstration(actions.choose_scene(session, 204, 8), DEMONSTRATED[3], 2)
    alone = [last(actions.run(each, "go")).latest for each in (session, others)]
    together = [None, None]

    def run(number, each):
        together[number] = last(actions.run(each, "go")).latest

    threads = [threading.Thread(target=run, args=pair) for pair in enumerate((session, others))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for mine, expected in zip(together, alone, strict=True):
        assert mine.title == expected.title
        assert np.array_equal(mine.moment.image, expected.moment.image)
        assert np.array_equal(mine.moment.view, expected.moment.view)


# Videos


def n_images(video):
    """Number of images of an MP4 file, and their size."""
    with av.open(io.BytesIO(video)) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return len(images), images[0].shape


def test_the_experts_episode_has_a_video_of_all_of_it(actions, session):
    assert session.demonstration.video is None  # of a checkpoint, only the ends are known
    session = actions.use_recorded(last(actions.run_expert(session)))
    n_frames, shape = n_images(session.demonstration.video)
    assert n_frames >= EPISODE_STEPS
    assert shape == (RENDER_SIZE, RENDER_SIZE, 3)


def test_videos_are_files_of_the_page_and_are_forgotten():
    files = VideoFiles()
    first, second = (Path(files.put(video)) for video in (b"one", b"two"))
    assert first.read_bytes() == b"one"
    assert files.put(b"one") == str(first) != str(second)
    assert set(first.parent.iterdir()) == {first, second}
    os.utime(first, (0, time.time() - LIFETIME - 1))
    files.put(b"two")
    assert not first.exists()
    assert second.exists()
    del files
    gc.collect()
    assert not second.parent.exists()


def test_a_video_that_is_forgotten_at_that_moment_is_written_again(monkeypatch):
    files, touch = VideoFiles(), os.utime
    path = Path(files.put(b"one"))

    def touch_too_late(touched, *args):
        path.unlink()
        touch(touched, *args)

    monkeypatch.setattr(os, "utime", touch_too_late)
    assert Path(files.put(b"one")) == path
    assert path.read_bytes() == b"one"


# Datasets


def test_the_episodes_of_a_dataset_become_the_demonstrations(actions, checkpoints, session):
    session = actions.open_dataset(session, f" {checkpoints / 'dataset'} ")
    assert session.demonstrated_tasks == {DATASET_TASKS[0]: 2, DATASET_TASKS[2]: 1}
    assert session.demonstrated == (DATASET_TASKS[0], 1)  # the scene's own task
    session = actions.choose_demonstration(session, DATASET_TASKS[0], 2)
    demonstration = session.demonstration
    assert demonstration.ends.shape == (2, 48, 48, 3)
    assert demonstration.ends[0].max() == 60
    assert demonstration.ends[1].min() == 60 + 10 * (LENGTH - 1)
    n_frames, (height, width, _) = n_images(demonstration.video)
    assert n_frames >= LENGTH
    assert height == width >= 192
    run = last(actions.run(session, "go")).latest
    assert f"{DATASET_TASKS[0]} (2 of 2 in {checkpoints / 'dataset'})" in run.title
    with pytest.raises(PlayError, match="dataset has no demonstration of 'wave'"):
        actions.choose_demonstration(session, "wave", 1)


def test_the_grasp_of_an_episode_is_known_if_the_policy_asks_for_it(actions, checkpoints, session):
    session = actions.open_dataset(session, str(checkpoints / "dataset"))
    assert (session.demonstration.grasp_state == 3).all()  # one step after the gripper closes
    session = actions.open_checkpoint(session, str(checkpoints / "attention"))
    session = actions.open_dataset(session, str(checkpoints / "dataset"))
    assert session.demonstration.grasp_state is None


def test_an_episode_is_read_as_a_checkpoint_reads_its_own(actions, checkpoints, session):
    folder = checkpoints / "dataset"
    session = actions.choose_demonstration(actions.open_dataset(session, str(folder)), DATASET_TASKS[2], 1)
    own = load_demonstrations("test/demos", folder, None, "observation.image", 48, 2)
    expected = own.frames[own.rows[DATASET_TASKS[2]][0]].permute(0, 2, 3, 1).numpy()
    assert np.array_equal(session.demonstration.frames, expected)


def test_a_dataset_of_videos_is_shown(actions, session, checkpoints):
    folder = write_dataset(checkpoints / "videos", use_videos=True)
    session = actions.open_dataset(session, str(folder))
    assert n_images(session.demonstration.video)[0] >= LENGTH


def test_without_a_dataset_the_checkpoints_own_demonstrations_return(actions, checkpoints, session):
    session = actions.open_dataset(session, str(checkpoints / "dataset"))
    for own in (actions.open_dataset(session, " "), actions.open_checkpoint(session, session.checkpoint)):
        assert own.dataset is None
        assert own.demonstrated_tasks == dict.fromkeys(DEMONSTRATED, N_EACH)


def test_two_users_have_datasets_of_their_own(actions, checkpoints, session):
    other = actions.open_dataset(session, str(checkpoints / "dataset"))
    mine = actions.choose_demonstration(session, DEMONSTRATED[0], 2)
    swapped = last(actions.run_with_other_demonstration(other, "go"))
    assert swapped.demonstrated[0] == DATASET_TASKS[2]
    assert "of 2)" in mine.demonstration.title
    assert mine.dataset is None


def test_what_is_no_dataset_is_explained(actions, checkpoints, session, tmp_path):
    for name, message in (
        ("/etc", "no dataset '/etc' that this page may load. Enter the folder of a dataset in"),
        (str(checkpoints / "nowhere"), "no dataset .*nowhere"),
        ("USER/NAME", "no dataset 'USER/NAME'"),
        (str(checkpoints / "goals"), "not a LeRobotDataset: meta/info.json is missing"),
    ):
        with pytest.raises(PlayError, match=message):
            actions.open_dataset(session, name)
    with pytest.raises(PlayError, match="dataset 'USER/NAME' cannot be fetched .*Hub"):
        EpisodeDataset("USER/NAME", [], True)


class Repository:
    """The Hub's answer about a repository."""

    def __init__(self, *sizes):
        self.sha = "0123abc"
        self.siblings = [
            SimpleNamespace(rfilename=f"{n}.safetensors", size=size) for n, size in enumerate(sizes)
        ]
        # None of what is fetched.
        self.siblings.append(SimpleNamespace(rfilename="training.pt", size=10**12))


def serve(monkeypatch, repository, n_free):
    """Lets the Hub answer, and the disk have that many bytes free. Returns the revisions that are fetched."""
    fetched = []

    def fetch(repo_id, revision, local_files_only=False, **_):
        if not local_files_only:
            fetched.append(revision)
        raise LocalEntryNotFoundError("enough")

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(sources.HfApi, "repo_info", lambda *args, **kwargs: repository)
    monkeypatch.setattr(sources.shutil, "disk_usage", lambda folder: SimpleNamespace(free=n_free))
    monkeypatch.setattr(sources, "snapshot_download", fetch)
    return fetched


def test_the_files_whose_size_was_checked_are_fetched(monkeypatch):
    fetched = serve(monkeypatch, Repository(10**6, None), 10**10)
    with pytest.raises(PlayError, match="'USER/NAME' cannot be fetched"):
        find_checkpoint("USER/NAME", [], True)
    assert fetched == ["0123abc"]


@pytest.mark.parametrize(
    ("n_bytes", "n_free", "message"),
    [
        (2 * 10**9, 10**12, "has 2.0 GB; at most 1 are loaded"),
        (10**9, 5_900_000_000, "disk .* too full, with less than 5 GB"),
    ],
)
def test_what_is_too_large_is_not_fetched(monkeypatch, n_bytes, n_free, message):
    fetched = serve(monkeypatch, Repository(n_bytes), n_free)
    with pytest.raises(PlayError, match=message):
        find_checkpoint("USER/NAME", [], True)
    assert not fetched


def test_what_is_there_needs_no_space_and_is_found_again_without_the_hub(checkpoints, tmp_path, monkeypatch):
    folder = tmp_path / "models--USER--NAME" / "snapshots" / "0123abc"
    shutil.copytree(checkpoints / "goals", folder)
    (folder / "0.safetensors").touch()
    serve(monkeypatch, Repository(10**8), 0)
    monkeypatch.setattr(sources, "snapshot_download", lambda *args, **kwargs: str(folder))
    assert find_checkpoint("USER/NAME", [], True) == folder
    assert (folder.parents[1] / "refs" / "main").read_text() == "0123abc"


def test_a_disk_that_fails_is_not_shown(monkeypatch, caplog):
    serve(monkeypatch, Repository(10), 10**10)

    def fail(*args, **kwargs):
        raise PermissionError(13, "Permission denied", "/home/host/.cache")

    monkeypatch.setattr(sources, "snapshot_download", fail)
    with pytest.raises(PlayError, match="cannot be fetched") as caught:
        find_checkpoint("USER/NAME", [], True)
    assert "/home/host" not in str(caught.value)
    assert "/home/host" in caplog.text


def test_of_a_repository_only_data_are_fetched(checkpoints, monkeypatch):
    fetched = []

    def fetch(repo_id, repo_type, revision, allow_patterns, token):
        assert token is False  # the host may see more than its visitors
        fetched.append((repo_id, repo_type))
        assert all(pattern.startswith(("meta/", "data/", "videos/")) for pattern in allow_patterns)
        assert not any(pattern.endswith(("*", ".py")) for pattern in allow_patterns)
        return str(checkpoints / "dataset")

    monkeypatch.setattr(sources, "snapshot_download", fetch)
    assert sum(EpisodeDataset("USER/NAME", [], True).counts.values()) == len(DATASET_TASKS)
    assert fetched == [("USER/NAME", "dataset")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "observation.images.top"}, "no camera 'observation.image'.*observation.images.top"),
        ({"n_states": 7}, r"another robot: .*'observation.state' of the shape \(10,\).*\(7,\)"),
    ],
)
def test_a_dataset_that_does_not_fit_is_refused(actions, checkpoints, session, tmp_path, options, message):
    folder = write_dataset(checkpoints / tmp_path.name, **options)
    with pytest.raises(PlayError, match=message):
        actions.open_dataset(session, str(folder))


def test_a_policy_without_demonstrations_takes_no_dataset(actions, checkpoints, session):
    session = actions.open_checkpoint(session, str(checkpoints / "language"))
    with pytest.raises(PlayError, match="takes no demonstrations: its method is language_only"):
        actions.open_dataset(session, str(checkpoints / "dataset"))


def change_info(folder, **changes):
    path = folder / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data_path": "/etc/{chunk_index}"}, "refused: its `data_path`"),
        ({"video_path": "../{video_key}.mp4"}, "refused: its `video_path`"),
        ({"features": {"../../secret": {"dtype": "video"}}}, "refused: the feature '../../secret'"),
        ({"features": []}, "has no features"),
        ({"codebase_version": "v2.1"}, "cannot be read"),
    ],
)
def test_a_dataset_that_leads_elsewhere_is_refused(checkpoints, tmp_path, changes, message):
    folder = shutil.copytree(checkpoints / "dataset", tmp_path / "changed")
    change_info(folder, **changes)
    with pytest.raises(PlayError, match=message):
        EpisodeDataset(str(folder), [tmp_path], False)


def test_images_that_lie_in_other_files_are_not_read(checkpoints, tmp_path):
    folder = shutil.copytree(checkpoints / "dataset", tmp_path / "changed")
    (file,) = folder.glob("data/*/*.parquet")
    table = pq.read_table(file)
    images = [{"bytes": None, "path": "/etc/image.png"}] * len(table)
    place = table.schema.get_field_index("observation.image")
    field = table.schema.field(place)
    pq.write_table(table.set_column(place, field, pa.array(images, field.type)), file)
    with pytest.raises(PlayError, match="images of 'observation.image' lie in other files"):
        EpisodeDataset(str(folder), [tmp_path], False)


def test_columns_that_declare_themselves_as_files_are_not_read(checkpoints, tmp_path):
    folder = shutil.copytree(checkpoints / "dataset", tmp_path / "changed")
    (file,) = folder.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(file)
    declared = {"info": {"features": {"tasks": {"_type": "List", "feature": {"_type": "Image"}}}}}
    changed = table.replace_schema_metadata({"huggingface": json.dumps(declared)})
    pq.write_table(changed, file)
    with pytest.raises(PlayError, match="meta/episodes/.*parquet has a column of the type 'Image'"):
        EpisodeDataset(str(folder), [tmp_path], False)
    file.write_bytes(b"PAR1")
    with pytest.raises(PlayError, match="is damaged: meta/episodes/.* cannot be read"):
        EpisodeDataset(str(folder), [tmp_path], False)


def test_what_a_folder_lacks_is_not_downloaded(checkpoints, tmp_path, monkeypatch):
    folder = shutil.copytree(checkpoints / "dataset", tmp_path / "changed")
    shutil.rmtree(folder / "data")
    sent = []
    monkeypatch.setattr(httpx.Client, "send", lambda *args, **kwargs: sent.append(args))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    with pytest.raises(PlayError, match="cannot be read: files are missing"):
        EpisodeDataset(str(folder), [tmp_path], False)
    assert not sent
    assert not (folder / "data").exists()


# Leaving out a modality


@pytest.mark.parametrize(
    ("name", "choices", "reason"),
    [
        ("either", (BOTH, INSTRUCTION_ALONE, DEMONSTRATION_ALONE), "^$"),
        ("no_demo", (BOTH, INSTRUCTION_ALONE), "without the instruction: .*`instruction_dropout` 0"),
        ("goals", (BOTH,), "without either: .*`demo_dropout` and `instruction_dropout` 0"),
        ("language", (BOTH,), "never takes a demonstration"),
        ("demo_only", (BOTH,), "never takes an instruction"),
    ],
)
def test_only_what_was_learned_is_offered(actions, checkpoints, name, choices, reason):
    session = actions.open_checkpoint(Session(), str(checkpoints / name))
    assert session.use == BOTH
    assert session.uses.choices == choices
    assert re.search(reason, session.uses.reason)
    if name != "either":
        with pytest.raises(PlayError, match="This checkpoint can use both"):
            actions.choose_use(session, DEMONSTRATION_ALONE)


@pytest.fixture
def either(actions, checkpoints):
    """A session with a checkpoint that can do without one of the two."""
    opened = actions.open_checkpoint(Session(), str(checkpoints / "either"))
    return actions.choose_scene(opened, 4, 3)


def test_without_the_instruction_it_does_not_matter_and_none_is_needed(actions, either):
    session = actions.choose_use(either, DEMONSTRATION_ALONE)
    runs = [last(actions.run(session, sentence)).latest for sentence in ("", "put it in the red bin")]
    assert "Instruction: left out\nDemonstration: Put" in runs[0].title
    assert runs[0].title == runs[1].title
    assert np.array_equal(runs[0].moment.image, runs[1].moment.image)
    assert np.array_equal(runs[0].moment.view, runs[1].moment.view)
    with pytest.raises(PlayError, match="instruction is left out, so another one changes nothing"):
        last(actions.run_with_other_sentence(session))


def test_without_the_demonstration_it_does_not_matter_and_none_is_needed(actions, either):
    session = actions.choose_use(either, INSTRUCTION_ALONE)
    others = replace(session, demonstration=None)
    runs = [last(actions.run(each, "go")).latest for each in (session, others)]
    assert "Instruction: go\nDemonstration: left out" in runs[0].title
    assert np.array_equal(runs[0].moment.view, runs[1].moment.view)
    assert runs[0].moment.view.shape[1] == 224  # the scene alone
    with pytest.raises(PlayError, match="demonstration is left out"):
        last(actions.run_with_other_demonstration(session, "go"))
    with pytest.raises(PlayError, match="instruction is empty"):
        last(actions.run(session, " "))


def test_a_run_leaves_the_checkpoints_own_option(actions, either, engine):
    def option():
        return engine.call(either.checkpoint, lambda player: player.policy.config.leave_out)

    plain = last(actions.run(either, "go")).latest.moment
    session = actions.choose_use(either, INSTRUCTION_ALONE)
    stream = actions.run(session, "go")
    next(stream)
    stream.close()  # a user who leaves in the middle
    assert option() is None
    last(actions.run(session, "go"))
    assert option() is None
    again = last(actions.run(actions.choose_use(session, BOTH), "go")).latest.moment
    assert np.array_equal(plain.view, again.view)


# The page


@pytest.fixture
def page(engine):
    """The page, which is not served, once the engine is ready."""
    pytest.importorskip("gradio", reason="the extra `play` is not installed")
    from lerobot_deltaco.play.page import build_page

    threads = torch.get_num_threads()
    try:
        engine._start()
    finally:
        torch.set_num_threads(threads)
    return build_page(engine)


def component(page, name):
    (found,) = (block for block in page.blocks.values() if getattr(block, "elem_id", None) == name)
    return found


def event_of(page, name, event):
    """The number of an event, and its handler, which gives one update or several."""
    blocks = {None: page} if name is None else {name: component(page, name)}
    target = (blocks[name]._id, event)
    ((number, handler),) = ((number, item.fn) for number, item in page.fns.items() if target in item.targets)
    return number, handler


def updates_of(page, name, event, session, *inputs):
    """What a user's event changes on the page."""
    update = event_of(page, name, event)[1](session, *inputs)
    return [update] if isinstance(update, dict) else list(update)


def shown(page, updates, name):
    """What a component shows after updates; None if they leave it alone."""
    values = [update[component(page, name)] for update in updates if component(page, name) in update]
    value = values[-1] if values else None
    return value["value"] if isinstance(value, dict) else value


def session_after(updates):
    sessions = [value for update in updates for value in update.values() if isinstance(value, Session)]
    return sessions[-1] if sessions else None


def test_the_page_opens_the_first_checkpoint_and_says_which(page, engine, checkpoints):
    updates = updates_of(page, None, "load", Session())
    session = session_after(updates)
    assert session.checkpoint == engine.default_checkpoint
    assert shown(page, updates, "status") == f"Ready. The checkpoint is {engine.default_checkpoint}."
    assert shown(page, updates, "sentence") == session.sentence
    assert shown(page, updates, "message") == ""
    updates = updates_of(page, "load", "click", session, str(checkpoints / "language"))
    assert shown(page, updates, "status") == f"Ready. The checkpoint is {checkpoints / 'language'}."


@pytest.mark.parametrize(
    ("name", "event", "inputs"),
    [
        ("run", "click", ["go"]),
        ("swap_sentence", "click", []),
        ("seed", "blur", [4, 3]),
        ("modality", "input", [BOTH]),
    ],
)
def test_after_an_idle_hour_the_page_begins_anew(page, engine, name, event, inputs):
    updates = updates_of(page, name, event, Session(), *inputs)
    session = session_after(updates)
    assert session.checkpoint == engine.default_checkpoint
    assert "begun anew" in shown(page, updates, "message")
    assert shown(page, updates, "sentence") == session.sentence
    assert shown(page, updates, "seed") == session.scene.seed
    if event == "click":
        assert "uccess" in shown(page, updates, "latest_text")


def test_what_fails_after_an_idle_hour_is_explained_in_a_new_session(page, engine):
    updates = updates_of(page, "use", "click", Session())
    assert "Let the expert do it first" in shown(page, updates, "message")
    assert session_after(updates).checkpoint == engine.default_checkpoint


def test_leaving_the_seed_as_it_is_leaves_the_instruction(page, session):
    updates = updates_of(page, "seed", "blur", session, session.scene.task_id, session.scene.seed)
    assert shown(page, updates, "sentence") is None
    assert session_after(updates) is session


def test_a_page_that_cannot_write_a_video_says_so(page, actions, session, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    recorded = last(actions.run_expert(session))
    monkeypatch.setattr(VideoFiles, "put", fail)
    for name, inputs in (("use", []), ("run", ["go"])):
        used = actions.use_recorded(recorded)
        updates = updates_of(page, name, "click", used, *inputs)
        assert "not your fault" in shown(page, updates, "message")
        assert session_after(updates) is None


def test_a_page_that_is_too_busy_refuses_further_clicks(page):
    from lerobot_deltaco.play.page import MAX_WAITING

    number, _ = event_of(page, "swap_sentence", "click")

    async def click(n_users):
        # The page's queue is not started here, so that all of them wait.
        transport = httpx.ASGITransport(app=page.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            clicks = [
                {"data": [None], "fn_index": number, "session_hash": f"user {user}"}
                for user in range(n_users)
            ]
            answers = [await client.post("/gradio_api/queue/join", json=each) for each in clicks]
        return [answer.status_code for answer in answers]

    # At 503, Gradio's page says that it is busy.
    assert asyncio.run(click(MAX_WAITING + 1)) == [200] * MAX_WAITING + [503]


# Bad input


@pytest.mark.parametrize(
    ("sentence", "message"),
    [
        ("", "is empty"),
        (" \n ", "is empty"),
        (None, "is empty"),
        ("x" * (MAX_SENTENCE + 1), f"at most {MAX_SENTENCE} characters"),
        ("put\nit", "line breaks"),
        ("put \x07 it", "not printed"),
    ],
)
def test_a_bad_sentence_is_refused(sentence, message):
    with pytest.raises(PlayError, match=message):
        checked_sentence(sentence)


def test_a_sentence_is_data():
    assert (
        checked_sentence(" <img src=x onerror=alert(1)> {{7*7}} ") == "<img src=x onerror=alert(1)> {{7*7}}"
    )


def test_the_same_scene_again_leaves_the_instruction(actions, session):
    session = last(actions.run(session, "what I wrote"))
    assert actions.choose_scene(session, session.scene.task_id, session.scene.seed) is session
    other = actions.choose_scene(session, session.scene.task_id, session.scene.seed + 1)
    assert other.sentence == TASKS[session.scene.task_id].instruction


@pytest.mark.parametrize("seed", [None, "x", -1, 1.5, float("nan"), float("inf"), 2**40])
def test_a_bad_seed_is_refused(actions, session, seed):
    with pytest.raises(PlayError, match="seed must be an integer"):
        actions.choose_scene(session, 4, seed)


def test_a_demonstration_that_does_not_exist_is_refused(actions, session):
    with pytest.raises(PlayError, match="has the demonstrations 1 to 2. Got 3"):
        actions.choose_demonstration(session, DEMONSTRATED[0], 3)
    with pytest.raises(PlayError, match="no demonstration of 'wave'"):
        actions.choose_demonstration(session, "wave", 1)


def test_nothing_runs_before_a_checkpoint_is_loaded(actions):
    with pytest.raises(PlayError, match="No checkpoint is loaded yet"):
        last(actions.run(Session(), "go"))


# The command


def test_the_command_says_that_the_projects_checkpoint_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(play_command, "checkpoints_folder", lambda: tmp_path)
    with pytest.raises(SystemExit) as exit_:
        play_command.main([])
    assert exit_.value.code == 2
    assert f"not at {tmp_path}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "70000"], "--port must be 1 to 65535. Got 70000."),
        (["--port", "0"], "--port must be 1 to 65535. Got 0."),
        (["--allow", "MISSING"], "--allow must be a folder. There is none at MISSING."),
        (["--allow", __file__], f"--allow must be a folder. There is none at {__file__}."),
    ],
)
def test_a_bad_argument_is_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        play_command.main(arguments)
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_a_port_that_is_taken_or_an_address_of_another_machine_is_refused(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(SystemExit) as exit_:
            play_command.main(["--port", str(port)])
    assert exit_.value.code == 1
    error = capsys.readouterr().err
    assert error == f"deltaco-play: Port {port} is taken. Choose another with --port.\n"
    with pytest.raises(SystemExit) as exit_:
        play_command.main(["--host", "192.0.2.1", "--port", str(port)])
    assert exit_.value.code == 1
    assert f"cannot be served at 192.0.2.1, port {port}: " in capsys.readouterr().err


def test_an_interrupt_while_gradio_is_imported_is_one_line(monkeypatch, capsys):
    class Interrupt:
        def find_spec(self, name, *_):
            if name == "lerobot_deltaco.play.page":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "lerobot_deltaco.play.page", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupt(), *sys.meta_path])
    with pytest.raises(SystemExit) as exit_:
        play_command.main(["--port", str(free_port())])
    assert exit_.value.code == 130
    assert capsys.readouterr().err == "\ndeltaco-play: Interrupted.\n"


def free_port():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "[::1]"])
def test_the_current_folder_is_offered_to_this_machine_alone(checkpoints, tmp_path, monkeypatch, host):
    monkeypatch.chdir(tmp_path)
    own = checkpoints_folder()
    assert play_command.allowed_folders(host, [], "USER/NAME") == [own, tmp_path]
    for others in ("0.0.0.0", "::", "192.168.1.2", "robot.example", ""):
        assert play_command.allowed_folders(others, [], "USER/NAME") == [own]
        assert play_command.allowed_folders(others, [checkpoints], "USER/NAME") == [own, checkpoints]
    assert play_command.allowed_folders(host, [checkpoints], "USER/NAME") == [own, checkpoints]
    goals = checkpoints / "goals"
    assert play_command.allowed_folders("0.0.0.0", [], str(goals)) == [own, goals]


def test_the_page_stands_before_anything_heavy_is_imported():
    code = (
        "import sys, lerobot_deltaco.play.session, lerobot_deltaco.commands.play; "
        "print({'torch', 'lerobot', 'pybullet'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "set()"


def test_the_space_begins_with_the_projects_checkpoint():
    space = Path(__file__).parents[1] / "space"
    assert compile((space / "app.py").read_text(), "app.py", "exec")
    assert "lerobot_policy_deltaco[play,offline,sim]" in (space / "requirements.txt").read_text()
    card = (space / "README.md").read_text()
    assert "sdk: gradio" in card
    assert "app_file: app.py" in card
