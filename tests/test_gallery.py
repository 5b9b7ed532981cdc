"""The gallery draws every image, says honestly what it shows, and fails in one line."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.gallery import episodes
from gym_deltaco.gallery.episodes import Episode
from gym_deltaco.gallery.objects import draw_random_objects, object_views
from gym_deltaco.object_sets import select_objects
from gym_deltaco.objects import object_model
from gym_deltaco.sheets import caption, down
from gym_deltaco.simulation import Simulation
from gym_deltaco.tasks import OBJECTS, get_task
from lerobot_deltaco.commands.gallery import main

IMAGES = {
    "objects_by_name.png",
    "objects_by_shape.png",
    "objects_by_color.png",
    "scenes.png",
    "episode.png",
    "episode.gif",
    "ambiguity.png",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the command writes, run twice."""
    folder = tmp_path_factory.mktemp("gallery") / "new" / "images"
    main(["--out", str(folder), "--tasks", "7"])
    main(["--out", str(folder), "--tasks", "4,187"])
    return folder


def test_there_are_the_images_and_the_page_and_nothing_half_written(folder):
    assert {path.name for path in folder.iterdir()} == IMAGES | {"index.md"}


def test_random_objects_are_drawn_if_asked_for(tmp_path):
    simulation = Simulation()
    labels = [label for label in select_objects("random:27") if label.index >= len(OBJECTS)]
    ticks = []
    figure = draw_random_objects(tmp_path, labels, simulation, lambda: ticks.append(1))
    simulation.close()
    assert len(ticks) == len(labels) == 3
    assert "3 random objects" in figure.text
    with Image.open(tmp_path / figure.file) as image:
        assert len(image.convert("RGB").getcolors(1 << 24)) > 50


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--objects", "random:9"], "random:N with N from 24"), (["--tasks", "1000"], "Task 1000 asks for")],
)
def test_objects_that_there_are_not_end_in_one_line(tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit):
        main(["--out", str(tmp_path / "new"), *arguments])
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", sorted(IMAGES))
def test_an_image_is_large_enough_to_see_and_small_enough_to_load(folder, name):
    with Image.open(folder / name) as image:
        image.load()
        assert min(image.size) >= 256
        assert max(image.size) <= 2000
        assert len(image.convert("RGB").getcolors(1 << 24)) > 50
    assert (folder / name).stat().st_size < 300_000


def test_the_animation_shows_each_episode_from_its_start(folder):
    with Image.open(folder / "episode.gif") as image:
        assert image.info["loop"] == 0
        assert 10 <= image.n_frames <= 2 * 31


def test_the_page_has_every_image_and_links_to_nothing_else(folder):
    text = (folder / "index.md").read_text()
    assert set(re.findall(r"\]\((.*?)\)", text)) == IMAGES


def test_the_second_run_replaced_the_first_ones_images(folder):
    text = (folder / "index.md").read_text()
    assert get_task(4).instruction in text
    assert get_task(187).instruction in text
    assert get_task(7).instruction not in text


def test_a_seed_gives_the_same_images_again(folder, tmp_path):
    main(["--out", str(tmp_path), "--tasks", "4,187", "--seed", "0"])
    for name in (*IMAGES, "index.md"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_each_object_is_seen_from_nearby_and_at_48_px():
    simulation = Simulation()
    views = [[np.array(view, int) for view in object_views(simulation, None)]]
    for index in range(len(OBJECTS)):
        views.append([np.array(view, int) for view in object_views(simulation, object_model(index))])
    simulation.close()
    (empty_close_up, empty_crop), *objects = views
    for close_up, crop in objects:
        differs = (np.abs(close_up - empty_close_up) > 20).any(axis=-1)
        assert differs.mean() > 0.03
        assert not differs[0].any()  # nothing is cut off
        assert not differs[-1].any()
        differs = (np.abs(crop - empty_crop) > 20).any(axis=-1)
        assert differs.mean() > 0.06


@pytest.mark.parametrize(
    ("info", "success_step", "outcome"),
    [
        ({"is_success": True}, 2, "success after step 2"),
        ({"is_success": False, "grasped_object": -1}, None, "no success in 3 steps (last grasped: nothing)"),
        ({"is_success": False, "grasped_object": 1}, None, "no success in 3 steps (last grasped: jar)"),
    ],
)
def test_the_outcome_of_an_episode_is_what_its_info_says(info, success_step, outcome):
    info["objects"] = np.array([0, 31, 5])
    frames = [Image.new("RGB", (1, 1))] * 4
    assert Episode(get_task(0), frames, [""] * 4, info, success_step).outcome == outcome


def test_an_expert_that_fails_is_recorded_to_its_end():
    class Idle(episodes.PickPlaceEnv):
        def step(self, action):
            return super().step(np.array([0.0, 0.0, 1.0, 1.0]))

    env = Idle()
    episode = episodes.record(env, 4, 0)
    env.close()
    assert len(episode.frames) == 31
    assert episode.outcome == "no success in 30 steps (last grasped: nothing)"


def failure(arguments, capsys):
    """The message of a command that fails; its exit status is checked."""
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    assert caught.value.code not in (0, None)
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tasks", "4,nonsense"], "Unknown task selection 'nonsense'"),
        (["--tasks", ""], "is empty"),
        (["--tasks", "300"], "from 0 to 299"),
        (["--seed", "-1"], "--seed must be at least 0"),
    ],
)
def test_bad_arguments_are_one_line(tmp_path, capsys, arguments, message):
    error = failure(["--out", tmp_path / "images", *arguments], capsys)
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "images").exists()


def test_a_file_is_no_folder(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    for out in (file, file / "images"):
        error = failure(["--out", out], capsys)
        assert "file" in error
        assert error.count("\n") == 1
    assert file.read_text() == "mine"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_to_is_one_line(tmp_path, capsys):
    tmp_path.chmod(0o500)
    error = failure(["--out", tmp_path], capsys)
    tmp_path.chmod(0o700)
    assert "cannot write to" in error
    assert error.count("\n") == 1


def test_an_interrupted_write_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "file"
    path.write_text("whole")

    def interrupted():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_to_where_a_folder_is_leaves_no_other_file(tmp_path):
    def write():
        with atomic_write(tmp_path / "folder") as temporary:
            temporary.write_text("whole")

    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write()
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


def test_it_runs_as_a_module():
    command = [sys.executable, "-m", "lerobot_deltaco.commands.gallery", "--help"]
    assert "--out DIR" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_captions_wrap_and_stack():
    short, long = caption("one", 60), caption("one two three four", 60)
    assert short.width == long.width == 60
    assert long.height > short.height
    assert caption("one", 60, n_lines=3).height == 3 * short.height
    assert down([short, long], gap=5).size == (60, short.height + long.height + 5)
