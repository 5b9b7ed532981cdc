"""The verdict of `deltaco play`, and what is behind its page, which `test_play_browser.py` tests."""

import importlib
import re
from types import SimpleNamespace
from urllib.parse import parse_qsl

import numpy as np
import pytest
from small_policies import DEMONSTRATED, save_tiny_policy

from gym_deltaco.layout import Layout, PlacedContainer
from gym_deltaco.phrases import paraphrase
from gym_deltaco.sim.workspace import Quadrant
from gym_deltaco.tasks import COLOR_SHAPE_TASKS, OBJECTS, TASKS, get_task
from lerobot_deltaco.pages.verdict import judge, parse_instruction

# The parser

ALL_TASKS = (*TASKS, *COLOR_SHAPE_TASKS)


def described(task):
    """Properties of the object that a task's sentences give. That of a name is always given."""
    if task.kind == "name":
        return [(name, getattr(task.object, name)) for name in ("name", "color", "shape")]
    return [(name, getattr(task.object, name)) for name in task.kind.split("_")]


def is_understood(task, sentence):
    """Whether a sentence is understood as its task; None if the parser says that it cannot tell."""
    found = parse_instruction(sentence)
    if found.unclear or found.unknown or len(found.containers) > 1:
        return None
    may = described(task)
    must = may[:1] if task.kind == "name" else may
    return set(must) <= found.described <= set(may) and found.containers == {task.container}


def test_every_template_is_understood():
    assert all(is_understood(task, task.instruction) for task in ALL_TASKS)


@pytest.mark.parametrize("split", ["train", "held_out"])
def test_the_sentences_of_the_grammar_are_understood_and_none_as_another_task(split):
    found = []
    for task in ALL_TASKS:
        rng = np.random.default_rng((task.index, 7))
        found += [is_understood(task, paraphrase(task, split, rng)) for _ in range(5)]
    assert False not in found
    assert np.mean([each is True for each in found]) > 0.99


def test_other_sentences_with_the_same_words_are_understood():
    for sentence, object_name, containers in [
        ("Put it in the green bin.", None, "green"),
        ("into the left one, the red bowl please", "bongo drum bowl", "left"),
        ("put the red bowl to the right", "bongo drum bowl", "right"),
        ("grab the pepsi and put it in the box that's red", "pepsi bottle", "red"),
        ("red bowl, red bin", "bongo drum bowl", "red"),
        ("move the grey BOTLTE to the left-hand bin", "glass half gallon", "left"),
        ("take the conic bin to the front", "conic bin", "front"),
        ("take the conic bin to the box that is nearest to me", "conic bin", "front"),
        ("the yellow ring, green box", "two layered lampshade", "green"),
        ("bathtub", "bathtub", ""),
    ]:
        found = parse_instruction(sentence)
        names = [label.name for label in OBJECTS if found.fits(label)] if found.described else [None]
        assert (names, " ".join(found.containers), found.unclear) == ([object_name], containers, ())


def test_words_that_are_not_understood_are_named():
    for sentence, unclear, unknown in (
        ("the back and white cup in the far bin", ("back",), ()),
        ("put the jar into the bin nearest to the robot", ("nearest", "robot"), ()),
        ("put the jar into the bin closest to you", ("closest", "you"), ()),
        ("the blue mug in the shiny red bin", (), ("mug", "shiny")),
    ):
        found = parse_instruction(sentence)
        assert (found.unclear, found.unknown) == (unclear, unknown)


# The verdict

NAMES = ["t cup", "short handle cup", "bathtub"]  # blue, blue and gray


def layout():
    """Two blue cups and a bathtub; a green bin at the back left, and a red one at the front left."""
    labels = [next(label for label in OBJECTS if label.name == name) for name in NAMES]
    containers = (PlacedContainer("green", Quadrant(1, 0)), PlacedContainer("red", Quadrant(1, 1)))
    return Layout(tuple(SimpleNamespace(label=label) for label in labels), containers, 0, 0)


def outcome(name, bin_, sentence="", demonstrated=""):
    """The verdict if an object was put into a bin, or only grasped."""
    number = -1 if name is None else NAMES.index(name)
    placed = frozenset() if bin_ is None else frozenset([(number, ("green", "red").index(bin_))])
    return judge(layout(), placed, number, sentence, demonstrated)


T_CUP, BATHTUB = (
    f"Put {color} colored, {shape} shaped {name} in left bin."
    for color, shape, name in (("blue", "cup", "t cup"), ("gray", "bowl", "bathtub"))
)


@pytest.mark.parametrize(
    ("sentence", "demonstrated", "name", "bin_", "expected"),
    [
        ("the t cup into the front bin", "", "t cup", "red", "Success"),
        ("the t cup into the front bin", "", "t cup", "green", "Wrong bin"),
        ("the t cup into the front bin", "", "bathtub", "green", "Wrong object and bin"),
        ("the t cup into the front bin", "", "bathtub", None, "Wrong object"),
        ("the t cup into the front bin", "", None, None, "Not done"),
        # Several objects or bins may fit; a demonstration then says which.
        ("a blue cup to the left", "", "short handle cup", "green", "Success"),
        ("a blue cup to the left", T_CUP, "short handle cup", "green", "Wrong object"),
        ("Put it in the red bin.", BATHTUB, "bathtub", "red", "Success"),
        ("Put it in the red bin.", BATHTUB, "t cup", "red", "Wrong object"),
        ("the t cup, red bin", BATHTUB, "t cup", "red", "Success"),
        ("", BATHTUB, "bathtub", "green", "Success"),
        # Words that the parser does not know do no harm if only one object can be meant.
        ("the shiny bathtub, red bin", "", "bathtub", "red", "Success"),
        ("the blue mug to the left", T_CUP, "t cup", "green", "Success"),
        ("the blue mug to the left", "", "t cup", "green", "Not judged"),
        ("the mug to the left", T_CUP, "t cup", "green", "Not judged"),
        # Nothing is judged that was not understood, or that is not there.
        ("the t cup in the bin nearest to you", "", "t cup", "red", "Not judged"),
        ("the red bin, the green bin", BATHTUB, "bathtub", "red", "Not judged"),
        ("wave at me", BATHTUB, "t cup", "red", "Not judged"),
        ("the canoe, red bin", "", "t cup", "red", "Not judged"),
        ("the t cup, right bin", "", "t cup", "red", "Not judged"),
    ],
)
def test_the_verdict_is_about_what_was_asked_for(sentence, demonstrated, name, bin_, expected):
    verdict = outcome(name, bin_, sentence, demonstrated)
    assert verdict.headline == expected
    assert verdict.is_success is {"Success": True, "Not judged": None}.get(expected, False)


def test_the_verdict_says_what_was_moved_and_what_was_asked_for():
    verdict = outcome("t cup", "red", "put the gray flsak to the front bin, quickly", BATHTUB)
    assert verdict.moved == "It put the blue t cup into the red bin (front left)."
    assert "Understood as: the gray glass half gallon in the front bin." in verdict.asked
    assert "Unknown words: “quickly”." in verdict.asked
    asked = outcome("t cup", "red", "the t cup, red bin", BATHTUB).asked
    assert "The demonstration shows another object: the gray bathtub" in asked
    assert outcome("bathtub", None).moved == "It grasped the gray bathtub, but put it into no bin."


@pytest.fixture(scope="module")
def play():
    pytest.importorskip("gradio", reason="the extra `play` is not installed")  # which takes 3 s to import
    return importlib.import_module("lerobot_deltaco.pages.play")


@pytest.fixture(scope="module")
def player(play, tmp_path_factory):
    return play.Player(save_tiny_policy(tmp_path_factory.mktemp("play") / "policy"))


def test_a_run_has_a_video_a_picture_and_a_verdict(player):
    run = player.run(player.default_choice(4, 1000))
    assert run.video.startswith("data:video/mp4;base64,")
    assert run.picture.startswith("data:image/jpeg;base64,")
    assert "Understood as: the black and white smushed dumbbell in the green bin." in run.verdict.asked
    assert re.fullmatch(r"The policy was \d+% sure of the object.*\.", run.confidence)
    assert run.footnote.startswith("The scene's task 4, ")


def test_every_task_has_a_demonstration(player):
    assert 4 in DEMONSTRATED
    assert 0 not in DEMONSTRATED
    for task_id in (0, 4):
        choice = player.default_choice(task_id, 1)
        shown = player.demonstration(choice)
        assert shown.task == get_task(task_id).instruction
        assert player.demonstration(choice) is shown
        assert (player.demonstration(choice._replace(recorded=5)).frames != shown.frames).any()


def test_either_input_can_be_left_out_if_the_policy_has_learned_it(play, player):
    assert player.uses == (play.BOTH, play.DEMONSTRATION, play.INSTRUCTION)
    choice = player.default_choice(26, 3)._replace(sentence="Put it in the red bin.")
    alone = player.run(choice._replace(use=play.DEMONSTRATION)).verdict.asked
    assert alone == "The demonstration shows the blue t cup in the green bin."
    assert "demonstration" not in player.run(choice._replace(use=play.INSTRUCTION)).verdict.asked
    with pytest.raises(ValueError, match="Type an instruction first"):
        player.run(choice._replace(sentence=" "))


def test_the_comparison_crosses_two_demonstrations_with_two_sentences(player):
    four = player.comparison(player.default_choice(4, 1000))
    assert len({(choice.task_id, choice.seed) for choice in four}) == 1
    pairs = {((choice.demonstrated, choice.recorded), choice.sentence) for choice in four}
    assert len(pairs) == 4
    assert [len({pair[n] for pair in pairs}) for n in range(2)] == [2, 2]
    _, layout = player.show_scene(four[0])
    there = {item.label.index for item in layout.objects}
    assert all(there & set(get_task(choice.demonstrated).targets) for choice in four)
    # A demonstration of another object than the scene's own is kept.
    other = get_task(four[2].demonstrated)
    again = player.comparison(four[0]._replace(demonstrated=other.index, recorded=3))
    assert {(choice.demonstrated, choice.recorded) for choice in again[:2]} == {(other.index, 3)}


def test_the_address_holds_the_choice(play, player):
    choice = play.Choice(26, 7, 4, 12, "Put it & wave.", play.INSTRUCTION)
    assert player.parse_choice(dict(parse_qsl(choice.query.removeprefix("?")))) == choice
    for query in ({}, {"task_id": "x", "seed": "-1", "demonstrated": "999", "recorded": "?", "use": "all"}):
        assert player.parse_choice(query).demonstrated < len(TASKS)


def test_the_suggested_sentences_can_be_judged_in_their_scene(play, player):
    for task_id in range(0, 300, 17):
        choice = player.default_choice(task_id, task_id)
        _, layout = player.show_scene(choice)
        for sentence in play.suggest_sentences(choice, layout):
            verdict = judge(layout, frozenset(), -1, sentence, get_task(task_id).instruction)
            assert verdict.headline == "Not done", sentence
