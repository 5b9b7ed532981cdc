"""The verdict on typed sentences, and what the page of `deltaco play` does, without a browser."""

import re
from types import SimpleNamespace
from urllib.parse import parse_qsl

import pytest
from small_policies import DEMONSTRATED, save_tiny_policy

from gym_deltaco.layout import Layout, PlacedContainer
from gym_deltaco.tasks import COLOR_SHAPE_TASKS, OBJECTS, TASKS, get_task
from gym_deltaco.workspace import Quadrant
from lerobot_deltaco.verdict import judge, parse_instruction

pytest.importorskip("gradio", reason="the extra `play` is not installed")
from lerobot_deltaco.play import (
    BOTH,
    DEMONSTRATION,
    INSTRUCTION,
    Choice,
    Player,
    suggest_sentences,
)

# The parser


def test_every_template_is_parsed_as_its_task():
    for task in (*TASKS, *COLOR_SHAPE_TASKS):
        found = parse_instruction(task.instruction)
        assert (found.objects, found.container) == (frozenset(task.targets), task.container), task.instruction
        assert not found.understood


def test_every_object_is_known_by_its_bare_name():
    for label in OBJECTS:
        found = parse_instruction(f"please drop the {label.name} into the box at the back")
        assert (found.objects, found.container) == ({label.index}, "back"), label.name


@pytest.mark.parametrize(
    ("sentence", "object_name", "container"),
    [
        ("Put it in the green bin.", None, "green"),
        ("into the left one, the red bowl please", "bongo drum bowl", "left"),
        ("put the red bowl to the right", "bongo drum bowl", "right"),
        ("the couch on the right goes into the red container", "box sofa", "red"),
        ("grab the pepsi and put it in the bin that is red", "pepsi bottle", "red"),
        ("red bowl, red bin", "bongo drum bowl", "red"),
        ("move the grey BOTLE to the left-hand bin", "glass half gallon", "left"),
        ("can you put the black cup in the rear basket?", "conic cup", "back"),
        ("take the conic bin to the front", "conic bin", "front"),
        ("the yellow ring, green box", "two layered lampshade", "green"),
        ("bathtub", "bathtub", None),
    ],
)
def test_peoples_sentences_are_parsed(sentence, object_name, container):
    found = parse_instruction(sentence)
    names = None if found.objects is None else [OBJECTS[index].name for index in found.objects]
    assert (names, found.container) == (None if object_name is None else [object_name], container)


def test_what_was_understood_as_something_else_is_said():
    assert parse_instruction("put the blue mug into the rigth bin").understood == (
        ("mug", "cup"),
        ("rigth", "right"),
    )


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
        # Nothing is judged that was not understood, or that is not there.
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
    verdict = outcome("t cup", "red", "put the gray botle to the front", BATHTUB)
    assert verdict.moved == "It put the blue t cup into the red bin (front left)."
    assert "asks for the gray glass half gallon in the front bin" in verdict.asked
    assert "“botle” as “bottle”" in verdict.asked
    assert (
        "The demonstration shows another object: the gray bathtub"
        in outcome("t cup", "red", "the t cup, red bin", BATHTUB).asked
    )
    assert outcome("bathtub", None).moved == "It grasped the gray bathtub, but put it into no bin."


# The page


@pytest.fixture(scope="module")
def player(tmp_path_factory):
    folder = tmp_path_factory.mktemp("play")
    return Player(save_tiny_policy(folder / "policy"), folder)


def test_a_run_has_a_video_a_picture_and_a_verdict(player):
    choice = player.default_choice(4, 1000)
    assert choice.recorded == -1  # the checkpoint has one of this task
    steps = []
    run = player.run(choice, steps.append)
    assert steps == list(range(31))
    assert run.video.stat().st_size > 1000
    assert run.picture.height >= 320
    assert "asks for the black and white smushed dumbbell in the green bin" in run.verdict.asked
    assert re.fullmatch(r"The policy was \d+% sure of the object.*\.", run.confidence)
    assert run.footnote.startswith("The scene's task 4, ")


def test_every_task_has_a_demonstration(player):
    assert 0 not in DEMONSTRATED
    choice = player.default_choice(0, 1)
    assert choice.recorded == 0
    shown = player.demonstration(choice.demonstrated, choice.recorded)
    assert shown.task == get_task(0).instruction
    assert player.demonstration(0, 0) is shown
    assert player.demonstration(4, 5) is not player.demonstration(4, -1)


def test_either_input_can_be_left_out_if_the_policy_has_learned_it(player):
    assert player.uses == (BOTH, DEMONSTRATION, INSTRUCTION)
    choice = player.default_choice(26, 3)._replace(sentence="Put it in the red bin.")
    alone = player.run(choice._replace(use=DEMONSTRATION)).verdict.asked
    assert "sentence" not in alone
    assert "demonstration shows the blue t cup" in alone
    assert "demonstration" not in player.run(choice._replace(use=INSTRUCTION)).verdict.asked
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
    for choice in four:
        assert there & set(get_task(choice.demonstrated).targets)


def test_the_address_holds_the_choice(player):
    choice = Choice(26, 7, 4, 12, "Put it & wave.", INSTRUCTION)
    assert player.parse_choice(dict(parse_qsl(choice.query.removeprefix("?")))) == choice
    for query in ({}, {"task_id": "x", "seed": "-1", "demonstrated": "999", "recorded": "?", "use": "all"}):
        assert player.parse_choice(query).demonstrated < len(TASKS)


def test_the_suggested_sentences_can_be_judged_in_their_scene(player):
    for task_id in range(0, 300, 7):
        choice = player.default_choice(task_id, task_id)
        _, layout = player.show_scene(choice)
        for sentence in suggest_sentences(choice, layout):
            verdict = judge(layout, frozenset(), -1, sentence, get_task(task_id).instruction)
            assert verdict.headline == "Not done", sentence
