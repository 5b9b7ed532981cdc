"""The table of tasks, its splits and the seeds of episodes, against the specification written out."""

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest

from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import OBJECTS, SCENARIOS, TASK_SETS, TASKS, VALIDATION, get_task, select_tasks

# The paper's table: name, shape, color.
PAPER_OBJECTS = """\
conic cup, cup, black and white
fountain vase, vase, brown
circular table, chalice, blue
hex deep bowl, bowl, brown
smushed dumbbell, chalice, black and white
square prism bin, trapezoidal prism, brown
narrow tray, trapezoidal prism, brown
colunnade top, chalice, gray
stalagcite chunk, freeform, white
bongo drum bowl, bowl, red
pacifier vase, vase, white
beehive funnel, vase, brown
crooked lid trash can, cylinder, gray
toilet bowl, bowl, white
pepsi bottle, bottle, red
tongue chair, freeform, red
modern canoe, canoe, orange
pear ringed vase, vase, orange
short handle cup, cup, blue
bullet vase, vase, brown
glass half gallon, bottle, gray
flat bottom sack vase, vase, brown
trapezoidal bin, trapezoidal prism, brown
vintage canoe, canoe, brown
bathtub, bowl, gray
flowery half donut, round hole, gray
t cup, cup, blue
cookie circular lidless tin, bowl, brown
box sofa, trapezoidal prism, brown
two layered lampshade, round hole, yellow
conic bin, cup, gray
jar, cylinder, blue"""
PAPER_COLORS = ["black and white", "brown", "blue", "gray", "white", "red", "orange", "yellow"]
PAPER_SHAPES = [
    *("vase", "chalice", "freeform", "bottle", "canoe"),
    *("cup", "bowl", "trapezoidal prism", "cylinder", "round hole"),
]
CONTAINERS = ["green", "red", "front", "back", "left", "right"]
N_TABLE_ROWS = 50


def test_objects_are_those_of_the_paper_in_its_order():
    rows = [tuple(line.split(", ")) for line in PAPER_OBJECTS.splitlines()]
    assert [(label.name, label.shape, label.color) for label in OBJECTS] == rows
    assert [label.index for label in OBJECTS] == list(range(32))


def test_every_task_has_the_instruction_of_its_row_and_column():
    phrases = [
        f"{color} colored, {shape} shaped {name}"
        for name, shape, color in (line.split(", ") for line in PAPER_OBJECTS.splitlines())
    ]
    phrases += [f"{color} colored object" for color in PAPER_COLORS]
    phrases += [f"{shape} shaped object" for shape in PAPER_SHAPES]
    expected = [f"Put {phrase} in {container} bin." for container in CONTAINERS for phrase in phrases]
    assert len(expected) == 300
    assert [task.instruction for task in TASKS] == expected
    assert [task.index for task in TASKS] == list(range(300))


@pytest.mark.parametrize(
    ("index", "instruction"),
    [
        (4, "Put black and white colored, chalice shaped smushed dumbbell in green bin."),
        (32, "Put black and white colored object in green bin."),
        (99, "Put round hole shaped object in red bin."),
        (134, "Put blue colored object in front bin."),
        (200, "Put black and white colored, cup shaped conic cup in left bin."),
        (292, "Put freeform shaped object in right bin."),
        (295, "Put cup shaped object in right bin."),
    ],
)
def test_examples_of_instructions(index, instruction):
    assert TASKS[index].instruction == instruction


def test_index_is_50_times_the_column_plus_the_row():
    for column, row in itertools.product(range(6), range(N_TABLE_ROWS)):
        task = TASKS[50 * column + row]
        assert (task.column, task.row, task.container) == (column, row, CONTAINERS[column])
        assert task.is_position_task == (column >= 2)
        assert task.kind == ("name" if row < 32 else "color" if row < 40 else "shape")


def test_targets_are_the_objects_that_the_instruction_describes():
    for task in TASKS:
        row = task.row
        if row < 32:
            expected = [row]
        elif row < 40:
            expected = [label.index for label in OBJECTS if label.color == PAPER_COLORS[row - 32]]
        else:
            expected = [label.index for label in OBJECTS if label.shape == PAPER_SHAPES[row - 40]]
        assert list(task.targets) == expected
        assert expected, "every color and shape has an object"
        assert [label.index for label in OBJECTS if task.describes(label)] == expected


def test_the_only_yellow_object_is_number_29():
    assert get_task(39).targets == (29,)


def test_tasks_are_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        TASKS[0].index = 1
    with pytest.raises(TypeError):
        TASK_SETS["all"] = ()


# Scenarios


SPLITS = {
    "a": ([*range(24), *range(36, 45)], [*range(24, 36), *range(45, 50)], 198, 102),
    "b": ([*range(32), *range(36, 45)], [*range(32, 36), *range(45, 50)], 246, 54),
}


@pytest.mark.parametrize("name", SPLITS)
def test_scenarios_split_the_rows_as_published(name):
    train_rows, test_rows, n_train, n_test = SPLITS[name]
    scenario = SCENARIOS[name]
    assert scenario.name == name
    for tasks, rows, count in (
        (scenario.train_tasks, train_rows, n_train),
        (scenario.test_tasks, test_rows, n_test),
    ):
        assert len(tasks) == count
        assert sorted(tasks) == sorted(50 * column + row for column in range(6) for row in rows)
        assert list(tasks) == sorted(tasks)
    assert set(scenario.train_tasks).isdisjoint(scenario.test_tasks)
    assert {*scenario.train_tasks, *scenario.test_tasks} == set(range(300))


def test_there_are_two_scenarios_and_no_more():
    assert set(SCENARIOS) == {"a", "b"}


def test_scenario_b_tests_on_a_part_of_what_a_tests_on():
    assert set(SCENARIOS["b"].test_tasks) < set(SCENARIOS["a"].test_tasks)


# Validation tasks


VALIDATION_ROWS = [6, 10, 12, 16, 36, 38, 40, 44]


def test_validation_tasks_are_those_of_eight_training_rows():
    held_out, remaining = (set(TASK_SETS[f"scenario_a_{name}"]) for name in ("validation", "selection_train"))
    assert held_out == {50 * column + row for column in range(6) for row in VALIDATION_ROWS}
    assert len(held_out) == 48
    assert len(remaining) == 150
    assert held_out | remaining == set(SCENARIOS["a"].train_tasks)
    assert not held_out & remaining
    kinds = [TASKS[row].kind for row in VALIDATION.test_rows]
    assert (kinds.count("name"), kinds.count("color"), kinds.count("shape")) == (4, 2, 2)


def test_validation_rows_follow_their_rule():
    names = {row for row in VALIDATION.test_rows if TASKS[row].kind == "name"}
    # 1. A held-out object is never a target.
    assert not names & {target for task in VALIDATION.train_tasks for target in TASKS[task].targets}
    # 2. What a held-out color or shape asks for is partly held out by name, and partly a target by name.
    for row in set(VALIDATION.test_rows) - names:
        targets = set(TASKS[row].targets)
        assert targets & names
        assert targets & set(VALIDATION.train_rows)
    # 3. The objects differ in color and shape; one shape is in no remaining instruction.
    assert len({OBJECTS[row].color for row in names}) == len({OBJECTS[row].shape for row in names}) == 4
    remaining = " ".join(TASKS[task].instruction for task in VALIDATION.train_tasks)
    assert {OBJECTS[row].shape for row in names if OBJECTS[row].shape not in remaining} == {"cylinder"}


# The clean scenario


def test_the_clean_scenario_is_a_without_its_yellow_training_tasks():
    train, test = (TASK_SETS[f"scenario_a_clean_{split}"] for split in ("train", "test"))
    yellow = [task.index for task in TASKS if task.object_phrase == "yellow colored object"]
    assert {*train, *yellow} == set(SCENARIOS["a"].train_tasks)
    assert len(train) == 192
    assert test == SCENARIOS["a"].test_tasks


def test_clean_training_tasks_have_no_test_object_as_a_target():
    targets = {target for task in TASK_SETS["scenario_a_clean_train"] for target in TASKS[task].targets}
    assert targets == set(range(24))


# Tasks by color and shape


def test_tasks_by_color_and_shape_say_both():
    for column, (color, shape) in itertools.product(range(6), itertools.product(PAPER_COLORS, PAPER_SHAPES)):
        index = 1000 + 80 * column + 10 * PAPER_COLORS.index(color) + PAPER_SHAPES.index(shape)
        task = get_task(index)
        assert task.instruction == f"Put {color} colored, {shape} shaped object in {CONTAINERS[column]} bin."
        assert (task.kind, task.column) == ("color_shape", column)
        expected = [label.index for label in OBJECTS if (label.color, label.shape) == (color, shape)]
        assert list(task.targets) == expected


def test_random_training_tasks_ask_for_no_pair_of_a_test_object():
    tasks = [get_task(index) for index in TASK_SETS["random_train"]]
    assert len(tasks) == 198 + 6 * 72
    assert [task.index for task in tasks[:198]] == list(SCENARIOS["a"].train_tasks)
    assert len({task.instruction for task in tasks}) == len(tasks)
    for task in tasks[198:]:
        assert task.kind == "color_shape"
        assert not set(task.targets) & set(range(24, 32))


# Selections


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        ("4", [4]),
        ("0", [0]),
        ("299", [299]),
        ("4,50-73", [4, *range(50, 74)]),
        ("50-73,4", [*range(50, 74), 4]),
        ("7-7", [7]),
        (" 4 , 6 - 8 ", [4, 6, 7, 8]),
        ("5,4,5,3-6", [5, 4, 3, 6]),
        ("all", list(range(300))),
        ("9,all", [9, *range(9), *range(10, 300)]),
        ("004,", [4]),
    ],
)
def test_a_selection_keeps_its_order_and_names_each_task_once(selection, expected):
    assert list(select_tasks(selection)) == expected


@pytest.mark.parametrize("scenario", SPLITS)
@pytest.mark.parametrize("split", ["train", "test"])
def test_a_selection_names_a_set(scenario, split):
    rows = SPLITS[scenario][split == "test"]
    expected = sorted(50 * column + row for column in range(6) for row in rows)
    assert list(select_tasks(f"scenario_{scenario}_{split}")) == expected


def test_sets_ranges_and_indices_mix():
    selected = select_tasks("scenario_b_test,0-9,32")
    assert list(selected) == [*SCENARIOS["b"].test_tasks, *range(10)]


@pytest.mark.parametrize("selection", ["", " ", ",", " , ,"])
def test_an_empty_selection_is_an_error_that_lists_the_sets(selection):
    with pytest.raises(ValueError, match="is empty") as error:
        select_tasks(selection)
    for name in (repr(selection), *TASK_SETS):
        assert name in str(error.value)


@pytest.mark.parametrize("term", ["scenario_c_test", "scenario_a", "A", "4-", "-4", "4.0", "4-5-6", "four"])
def test_an_unknown_selection_is_an_error_that_lists_the_valid_ones(term):
    with pytest.raises(ValueError, match="Unknown task selection") as error:
        select_tasks(f"4,{term}")
    for name in (repr(term), *TASK_SETS, "0 to 299"):
        assert name in str(error.value)


def test_a_range_that_ends_before_its_start_is_an_error():
    with pytest.raises(ValueError, match="'73-50' is empty"):
        select_tasks("4,73-50")


@pytest.mark.parametrize(
    ("selection", "culprit"), [("300", "300"), ("0-300", "300"), ("2000-2001", "2000"), ("290-1000", "300")]
)
def test_a_selected_index_out_of_range_is_an_error(selection, culprit):
    with pytest.raises(ValueError, match=rf"integer from 0 to 299\. Got {culprit}"):
        select_tasks(selection)


@pytest.mark.parametrize("index", [-1, 300, 4.5, "4", None, float("nan"), float("inf"), [4]])
def test_a_task_id_must_be_an_integer_from_0_to_299(index):
    with pytest.raises(ValueError, match=r"`task_id` must be an integer from 0 to 299\. Got "):
        get_task(index)


@pytest.mark.parametrize("index", [0, 299, np.int64(4), np.array(4), 4.0])
def test_a_task_id_may_be_any_kind_of_integer(index):
    assert get_task(index).index == index
    assert type(get_task(index).index) is int


# Seeds


def test_seeds_of_episodes_are_distinct_and_valid_for_reset():
    arguments = list(
        itertools.product(
            (0, 1), ("train", "validation", "evaluation"), (*range(0, 300, 25), 299), range(12), range(3)
        )
    )
    seeds = [episode_seed(*each) for each in arguments]
    assert len(set(seeds)) == len(arguments)
    assert all(type(seed) is int and 0 <= seed < 2**63 for seed in seeds)
    # They fill the range: of thousands, some lie in each of its eight parts.
    assert {seed >> 60 for seed in seeds} == set(range(8))


def test_the_first_attempt_is_number_0():
    assert episode_seed(3, "train", 5, 7) == episode_seed(3, "train", 5, 7, attempt=0)


PINNED = {
    (0, "train", 0, 0, 0): 4334430513956379144,
    (0, "evaluation", 4, 1, 0): 8462192741596667043,
    (7, "validation", 299, 12, 3): 1511646788253033313,
}


def test_seeds_never_change():
    # Published datasets are made from these.
    assert {arguments: episode_seed(*arguments) for arguments in PINNED} == PINNED


def test_seeds_are_those_of_numpys_seed_sequence():
    (state,) = np.random.SeedSequence((7, 1, 299, 12, 3)).generate_state(1, np.uint64)
    assert episode_seed(7, "validation", 299, 12, 3) == int(state) // 2


def test_seeds_are_the_same_in_another_process():
    script = f"from gym_deltaco.seeding import episode_seed; print([episode_seed(*a) for a in {[*PINNED]}])"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == str([*PINNED.values()])


def test_an_unknown_split_is_an_error_that_lists_the_valid_ones():
    with pytest.raises(ValueError, match="train, validation, evaluation.*'test'"):
        episode_seed(0, "test", 0, 0)


@pytest.mark.parametrize("position", [0, 2, 3, 4])
def test_a_negative_number_in_a_seed_is_an_error(position):
    arguments = [0, "train", 0, 0, 0]
    arguments[position] = -1
    with pytest.raises(ValueError, match=r"count from 0\. Got .*-1"):
        episode_seed(*arguments)
