"""The verdict of `deltaco play`, and what is behind its page, which `test_play_browser.py` tests."""

import importlib
import re
from types import SimpleNamespace
from urllib.parse import parse_qsl

import numpy as np
import pytest
import torch
from small_policies import DEMONSTRATED, load_tiny_policy

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.layout import Layout, PlacedContainer
from gym_deltaco.sim.workspace import CONTAINER_FLOOR, Quadrant
from gym_deltaco.tasks import OBJECTS, TASKS, get_task
from lerobot_deltaco.evaluation.photos import image_locations
from lerobot_deltaco.evaluation.video import Recording
from lerobot_deltaco.pages.player import BOTH, DEMONSTRATION, INSTRUCTION, POINT, Choice, Player
from lerobot_deltaco.pages.verdict import describe_outcome, judge, object_name
from lerobot_deltaco.policies.deltaco_match.findings import describe_words
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace

# The verdict

NAMES, BINS = ["t cup", "short handle cup", "bathtub"], ["green", "red"]  # blue, blue and gray
POSITIONS = np.array([[0.48, 0.2, -0.35], [0.56, 0.2, -0.35], [0.5, 0.36, -0.35]])


def layout():
    """Two blue cups and a bathtub; a green bin at the back left, and a red one at the front left."""
    labels = [next(label for label in OBJECTS if label.name == name) for name in NAMES]
    containers = (PlacedContainer("green", Quadrant(1, 0)), PlacedContainer("red", Quadrant(1, 1)))
    return Layout(tuple(SimpleNamespace(label=label) for label in labels), containers, 0, 0)


def recording(name, bin_, pick=None, place="green", end=POSITIONS):
    """An episode in which an object was put into a bin, or only grasped, after the policy located another."""
    number = -1 if name is None else NAMES.index(name)
    placements = frozenset() if bin_ is None else frozenset([(number, BINS.index(bin_))])
    localization = None
    if pick is not None:
        centers = [[*item.quadrant.container_center, CONTAINER_FLOOR] for item in layout().containers]
        points = np.array([POSITIONS[NAMES.index(pick)], centers[BINS.index(place)]])
        locations = torch.tensor(image_locations(points))[None] + 0.05
        localization = PickPlace(
            locations,
            torch.zeros(1),
            torch.zeros(1, 2, 4, 4),
            None,
            (False, False),
            torch.ones(1),
            torch.ones(1),
            torch.zeros(1, dtype=torch.bool),
            locations[:, 0],
        )
    return Recording([], localization, layout(), np.array([POSITIONS, end]), placements, number)


def test_locations_are_those_of_the_image():
    env = PickPlaceEnv(4)
    for seed in range(5):
        env.reset(seed=seed)
        image = env.scene.render(256)
        for channel, item in zip((1, 0), env.scene.layout.containers, strict=True):
            center = np.array([[*item.quadrant.container_center, CONTAINER_FLOOR]])
            x, y = ((image_locations(center)[0] + 1) * 128).astype(int)
            assert image[y, x].argmax() == channel
    env.close()


T_CUP, BATHTUB = (
    next(task for task in TASKS if f" {name} in left" in task.instruction) for name in (NAMES[::2])
)
BLUE, GRAY = (f"Put {color} colored object in front bin." for color in ("blue", "gray"))


@pytest.mark.parametrize(
    ("sentence", "demonstrated", "name", "bin_", "expected"),
    [
        (T_CUP.instruction, None, "t cup", "red", "Success"),  # both bins are on the left
        (T_CUP.instruction, None, "bathtub", "red", "Wrong object"),
        (BLUE, None, "short handle cup", "red", "Success"),
        (BLUE, None, "short handle cup", "green", "Wrong bin"),
        (BLUE, None, "bathtub", "green", "Wrong object and bin"),
        (BLUE, None, "bathtub", None, "Wrong object"),
        (BLUE, None, None, None, "Not done"),
        # Of several objects that fit, the demonstration shows one.
        (BLUE, T_CUP, "short handle cup", "red", "Wrong object"),
        ("put it in the RED bin", BATHTUB, "bathtub", "red", "Success"),
        ("Put it in red bin.", BATHTUB, "t cup", "red", "Wrong object"),
        ("", BATHTUB, "bathtub", "green", "Success"),
        # Nothing is judged that contradicts itself or is not there.
        (GRAY, T_CUP, "t cup", "red", "Not judged"),
        ("Put it in the red bin.", None, "t cup", "red", "Not judged"),
        ("Put it in the right bin.", T_CUP, "t cup", "red", "Not judged"),
        (TASKS[0].instruction, None, "t cup", "green", "Not judged"),
    ],
)
def test_the_benchmarks_sentences_are_judged_by_what_they_ask_for(
    sentence, demonstrated, name, bin_, expected
):
    verdict = judge(recording(name, bin_), sentence, demonstrated)
    assert verdict.headline == expected
    assert verdict.is_success is {"Success": True, "Not judged": None}.get(expected, False)


@pytest.mark.parametrize(
    "sentence",
    [
        "don't put it in the red bin",
        "the blue cup where the gray one is",
        "stack the cup on the bathtub",
        "put both in the red bin",
        "left",
    ],
)
def test_no_success_is_claimed_for_free_sentences(sentence):
    for bin_, headline in (("red", "Did what it understood"), ("green", "Did not do what it understood")):
        verdict = judge(recording("t cup", bin_, "t cup", "red"), sentence, T_CUP, "Words.")
        assert verdict.is_success is None
        assert verdict.headline == headline
        put, understood, reason = verdict.lines
        assert put.startswith(f"It put the blue t cup into the {bin_} bin")
        assert (
            understood == "Understood as: the blue t cup (100 % sure) into the red bin (front left). Words."
        )
        assert reason.startswith("Only the benchmark's own sentences are judged")


def test_the_outcome_says_what_was_moved_and_what_left_the_tray():
    assert describe_outcome(recording("bathtub", None)) == (
        "It grasped the gray bathtub, but put it into no bin."
    )
    end = POSITIONS + [[0, 0, -1], [0, -0.3, 0], [0, 0, 0]]
    assert describe_outcome(recording(None, None, end=end)) == (
        "It grasped nothing. The blue t cup fell off the table. The blue short handle cup left the tray."
    )


def test_words_are_shown_as_the_policy_reads_them():
    matching = SimpleNamespace(
        understood=lambda _: [("blue", "blue"), ("goblett", "goblet")], vocabulary=["blue", "goblet", "bin"]
    )
    assert describe_words(matching, "Blue goblett, shiny bin!") == (
        "Words for the object: “blue”, “goblett”. Read “goblett” as “goblet”. Unknown words: “shiny”."
    )


# The page's functions


@pytest.fixture(scope="module")
def player(tmp_path_factory):
    return Player(load_tiny_policy(tmp_path_factory.mktemp("play")))


def test_a_run_has_a_video_a_picture_and_a_verdict(player):
    view = player.run(player.default_choice(4, 1000))
    assert view.video.startswith("data:video/mp4;base64,")
    assert all(picture.startswith("data:image/jpeg;base64,") for picture in (view.picture, *view.ends))
    assert view.demonstration == "The demonstration shows the black and white smushed dumbbell."
    assert view.is_right is not None
    assert re.match(r"It (put|grasped) ", view.lines[0])
    assert re.match(r"Understood as: .* \(\d+ % sure\) .*", view.lines[1])


def test_every_task_has_a_demonstration(player):
    assert 4 in DEMONSTRATED
    assert 0 not in DEMONSTRATED
    for task_id in (0, 4):
        choice = player.default_choice(task_id, 1)
        demonstration = player.demonstration(choice)
        assert demonstration.task == get_task(task_id).instruction
        assert player.demonstration(choice) is demonstration
        assert (player.demonstration(choice._replace(demo_number=5)).frames != demonstration.frames).any()


def test_either_input_can_be_left_out_if_the_policy_has_learned_it(player):
    assert player.inputs == (BOTH, DEMONSTRATION, INSTRUCTION, POINT)
    choice = player.default_choice(26, 3)._replace(instruction="Put it in the red bin.")
    alone = player.run(choice._replace(inputs=DEMONSTRATION))
    assert (alone.instruction, len(alone.ends)) == ("", 2)
    alone = player.run(choice._replace(inputs=INSTRUCTION))
    assert (alone.demonstration, alone.ends) == ("", [])
    assert alone.lines[-1] == "Not judged: the sentence names no object, and there is no demonstration."
    with pytest.raises(ValueError, match="Type an instruction first"):
        player.run(choice._replace(instruction=" "))


def test_what_is_pointed_at_is_to_be_picked(player):
    choice = player.default_choice(26, 3)._replace(instruction="Put it in the red bin.", inputs=POINT)
    for point in ("", "here", "1,2,3", "0.5,0.5"):
        with pytest.raises(ValueError, match="Click on an object"):
            player.run(choice._replace(point=point))
    player.show_scene(choice)
    scene = player._env.scene
    positions = [scene.object_pose(n).position for n in range(3)]
    x, y = image_locations(np.array(positions))[1]
    view = player.run(choice._replace(point=f"{500 * (x + 1):.0f},{500 * (y + 1):.0f}"))
    name = object_name(scene.layout.objects[1].label)
    assert f"Understood as: the {name} (100 % sure)" in view.lines[1]
    assert view.is_right is not None
    assert (view.demonstration, view.ends) == ("", [])
    view = player.run(choice._replace(point="0,0"))
    assert view.lines[-1] == "Not judged: no object is at the point."


def test_the_comparison_crosses_two_demonstrations_with_two_sentences(player):
    four = player.comparison(player.default_choice(4, 1000))
    assert len({(choice.task_id, choice.seed) for choice in four}) == 1
    pairs = {((choice.demo_task, choice.demo_number), choice.instruction) for choice in four}
    assert len(pairs) == 4
    assert [len({pair[n] for pair in pairs}) for n in range(2)] == [2, 2]
    _, layout = player.show_scene(four[0])
    there = {item.label.index for item in layout.objects}
    assert all(there & set(get_task(choice.demo_task).targets) for choice in four)
    # A demonstration of another object than the scene's target is kept.
    other = get_task(four[2].demo_task)
    again = player.comparison(four[0]._replace(demo_task=other.index, demo_number=3))
    assert {(choice.demo_task, choice.demo_number) for choice in again[:2]} == {(other.index, 3)}


def test_the_address_holds_the_choice(player):
    choice = Choice(26, 7, 4, 12, "Put it & wave.", POINT, "120,950")
    assert player.parse_choice(dict(parse_qsl(choice.query.removeprefix("?")))) == choice
    for query in (
        {},
        {"task_id": "x", "seed": "-1", "demo_task": "999", "demo_number": "?", "inputs": "all"},
    ):
        assert player.parse_choice(query).demo_task < len(TASKS)


def test_there_are_sentences_to_try_in_every_scene(player):
    pytest.importorskip("gradio", reason="the extra `play` is not installed")  # which takes 3 s to import
    play = importlib.import_module("lerobot_deltaco.pages.play")
    for task_id in range(0, 300, 17):
        choice = player.default_choice(task_id, task_id)
        _, layout = player.show_scene(choice)
        assert len(set(play.suggest_sentences(choice, layout))) == 5
