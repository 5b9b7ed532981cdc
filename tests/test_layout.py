"""Every scene that can be drawn is allowed by the specification, and none gives the target away."""

import functools
import itertools
from collections import Counter

import numpy as np
import pytest

from gym_deltaco import layout as layout_module
from gym_deltaco.layout import AMBIGUITIES, sample_layout, twin_word
from gym_deltaco.object_sets import ADVERSARIAL_DRAWS, OBJECT_SETS, select_objects
from gym_deltaco.tasks import CONTAINER_COLORS, CONTAINER_WORDS, OBJECTS, TASKS, get_task
from gym_deltaco.workspace import QUADRANTS, container_matches

SEEDS_PER_TASK = 3
SIDES = ["front", "back", "left", "right"]
# By quadrant (i, j), right to left and back to front: where a container stands, and x and y of an object, m.
CONTAINER_CENTERS = {
    (0, 0): (0.515, 0.18),
    (0, 1): (0.515, 0.32),
    (1, 0): (0.675, 0.18),
    (1, 1): (0.675, 0.32),
}
OBJECT_X = {0: (0.44, 0.552), 1: (0.628, 0.74)}
OBJECT_Y = {0: (0.14, 0.222), 1: (0.298, 0.38)}
WORDS = {
    (0, 0): {"right", "back"},
    (0, 1): {"right", "front"},
    (1, 0): {"left", "back"},
    (1, 1): {"left", "front"},
}
CONTAINER_HALF_EXTENTS = (0.075, 0.0525)

GREEN_TASK, RED_TASK, FRONT_TASK, RIGHT_TASK = 4, 54, 104, 295


def draw(task_id, ambiguity, seed):
    return sample_layout(TASKS[task_id], ambiguity, np.random.default_rng((seed, task_id)))


@functools.cache
def draw_all(ambiguity):
    """(task, layout) of all tasks and several seeds."""
    return [(task, draw(task.index, ambiguity, seed)) for task in TASKS for seed in range(SEEDS_PER_TASK)]


@pytest.fixture(params=AMBIGUITIES)
def layouts(request):
    return draw_all(request.param)


@pytest.fixture
def clear_layouts():
    return draw_all("container")


@pytest.fixture
def twin_layouts():
    return draw_all("object")


def corner(quadrant):
    return quadrant.i, quadrant.j


def corner_of_object(item):
    """The quadrant in whose region the middle of an object lies."""
    (corner,) = (
        (i, j)
        for i, j in CONTAINER_CENTERS
        if OBJECT_X[i][0] <= item.xy[0] <= OBJECT_X[i][1] and OBJECT_Y[j][0] <= item.xy[1] <= OBJECT_Y[j][1]
    )
    return corner


def words_of(container):
    return {container.color} | WORDS[corner(container.quadrant)]


# Containers


def test_one_green_and_one_red_container_stand_in_two_quadrants(layouts):
    for _, layout in layouts:
        green, red = layout.containers
        assert (green.color, red.color) == ("green", "red")
        assert corner(green.quadrant) != corner(red.quadrant)
        for container in layout.containers:
            np.testing.assert_allclose(
                container.quadrant.container_center, CONTAINER_CENTERS[corner(container.quadrant)]
            )


def test_the_word_of_the_task_describes_the_target_container_and_not_the_other_one(layouts):
    for task, layout in layouts:
        fits = [task.container in words_of(container) for container in layout.containers]
        assert fits.count(True) == 1
        assert fits.index(True) == layout.target_container


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
@pytest.mark.parametrize("task_id", [FRONT_TASK, RIGHT_TASK])
def test_the_target_of_a_position_task_has_a_random_color(task_id, ambiguity):
    n = 400
    n_green = sum(draw(task_id, ambiguity, seed).target_container == 0 for seed in range(n))
    assert abs(n_green - n / 2) < 4.5 * np.sqrt(n / 4)


@pytest.mark.parametrize(
    ("task_id", "n_pairs"), [(GREEN_TASK, 12), (RED_TASK, 12), (FRONT_TASK, 8), (RIGHT_TASK, 8)]
)
def test_containers_take_every_allowed_pair_of_quadrants_equally_often(task_id, n_pairs):
    n = 800
    counts = Counter(
        tuple(corner(container.quadrant) for container in draw(task_id, "container", seed).containers)
        for seed in range(n)
    )
    assert len(counts) == n_pairs
    share = 1 / n_pairs
    assert np.abs(np.array([*counts.values()]) - n * share).max() < 4.5 * np.sqrt(n * share * (1 - share))


# Objects


def test_objects_lie_in_the_quadrants_without_containers(layouts):
    for _, layout in layouts:
        taken = {corner(container.quadrant) for container in layout.containers}
        homes = {corner_of_object(item) for item in layout.objects}
        assert len(layout.objects) == 3
        assert homes.isdisjoint(taken)
        assert len(homes) == 2, "both of the other quadrants hold an object"


def test_objects_keep_their_distance_from_each_other(layouts):
    for _, layout in layouts:
        for one, other in itertools.combinations(layout.objects, 2):
            assert np.linalg.norm(one.xy - other.xy) >= 0.065


def test_objects_are_at_least_their_radius_away_from_containers(layouts):
    for _, layout in layouts:
        for item, container in itertools.product(layout.objects, layout.containers):
            radius = np.linalg.norm(item.model.mesh.vertices[:, :2], axis=1).max()
            center = np.array(CONTAINER_CENTERS[corner(container.quadrant)])
            nearest = np.clip(item.xy, center - CONTAINER_HALF_EXTENTS, center + CONTAINER_HALF_EXTENTS)
            assert np.linalg.norm(item.xy - nearest) >= radius


def test_objects_are_turned_as_the_gripper_can_take_them(layouts):
    for _, layout in layouts:
        for item in layout.objects:
            low, high = item.model.yaw_range
            assert low <= item.yaw <= high


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_the_order_of_the_objects_does_not_give_the_target_away(ambiguity):
    n = 900
    counts = Counter(draw(seed % 300, ambiguity, seed).target_object for seed in range(n))
    assert set(counts) == {0, 1, 2}
    assert np.abs(np.array([*counts.values()]) - n / 3).max() < 4.5 * np.sqrt(n * 2 / 9)


def test_every_object_that_fits_the_instruction_becomes_the_target():
    task = TASKS[33]  # brown
    layouts = (draw(task.index, "container", seed) for seed in range(200))
    seen = {layout.objects[layout.target_object].label.index for layout in layouts}
    assert seen == set(task.targets)
    assert len(seen) == 11


# Scheme i: the instruction is clear


def test_exactly_one_object_matches_a_clear_instruction(clear_layouts):
    for task, layout in clear_layouts:
        matching = [n for n, item in enumerate(layout.objects) if item.label.index in task.targets]
        assert matching == [layout.target_object]
        assert len({item.label.index for item in layout.objects}) == 3


def test_no_distractor_has_the_color_or_shape_that_is_asked_for(clear_layouts):
    for task, layout in clear_layouts:
        target = layout.objects[layout.target_object].label
        for number, item in enumerate(layout.objects):
            if number != layout.target_object:
                assert task.kind != "color" or item.label.color != target.color
                assert task.kind != "shape" or item.label.shape != target.shape


# Objects that share the target's color or shape, and the share of them among the two distractors that follows
# from one drawn from them with probability 0.6, and else from all others.
ADVERSARIES = [
    # Smushed dumbbell, black and white chalice: 3 of the 31 others are alike.
    (4, {0, 2, 7}, (0.6 + 0.4 * 3 / 31 + 0.6 + 0.4 * (0.64 * 2 + 0.36 * 3) / 30) / 2),
    # Yellow: the lampshade, and only one of the 31 others has its shape. Once it is drawn, nothing is alike.
    (39, {25}, (0.6 + 0.4 / 31 + (0.4 * 30 / 31) * (0.6 + 0.4 / 30)) / 2),
]


@pytest.mark.parametrize(("task_id", "alike", "share"), ADVERSARIES)
def test_distractors_are_adversarial_as_often_as_specified(task_id, alike, share):
    n = 600
    n_alike = 0
    for seed in range(n):
        layout = draw(task_id, "container", seed)
        n_alike += sum(item.label.index in alike for item in layout.objects)
    assert n_alike / (2 * n) == pytest.approx(share, abs=4.5 * np.sqrt(0.25 / (2 * n)))


def test_all_32_objects_stand_as_distractors():
    seen = set()
    for seed in range(400):
        layout = draw(GREEN_TASK, "container", seed)
        seen |= {item.label.index for item in layout.objects}
    assert seen == {label.index for label in OBJECTS}


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_the_share_of_adversarial_distractors_can_be_chosen(probability):
    alike, n = {0, 2, 7}, 300  # of the smushed dumbbell
    indices = [
        item.label.index
        for seed in range(n)
        for item in sample_layout(
            TASKS[4], "container", np.random.default_rng(seed), adversarial_probability=probability
        ).objects
        if item.label.index != 4
    ]
    share = sum(index in alike for index in indices) / len(indices)
    # Drawn uniformly, 3 of the 31 others are alike.
    expected = 1.0 if probability else 3 / 31
    assert share == pytest.approx(expected, abs=4.5 * np.sqrt(expected * (1 - expected) / (2 * n)))


# Layouts of the version before `adversarial_draw`: the objects in their order, and the generator's next
# number, which depends on how many were drawn.
EARLIER_LAYOUTS = [
    (4, "container", "all", 0, [4, 16, 0], 2061532435),
    (4, "container", "all", 1, [2, 7, 4], 2745907368),
    (4, "container", "all", 2, [0, 10, 4], 961154287),
    (39, "container", "all", 1, [22, 25, 29], 625792807),
    (39, "container", "all", 2, [25, 3, 29], 1366429244),
    (39, "container", "all", 3, [25, 29, 5], 3687839017),
    (295, "container", "scenario_a_train", 0, [2, 15, 18], 3069263244),
    (104, "container", "random:100", 1, [106, 75, 4], 2745907368),
    (4, "object", "all", 0, [4, 27, 4], 1093525229),
]


@pytest.mark.parametrize("explicit", [{}, {"adversarial_draw": "each"}], ids=["default", "each"])
@pytest.mark.parametrize(("task_id", "ambiguity", "objects", "seed", "indices", "number"), EARLIER_LAYOUTS)
def test_layouts_are_those_of_earlier_versions(task_id, ambiguity, objects, seed, indices, number, explicit):
    rng = np.random.default_rng(seed)
    layout = sample_layout(TASKS[task_id], ambiguity, rng, select_objects(objects), **explicit)
    assert [item.label.index for item in layout.objects] == indices
    assert rng.integers(2**32) == number


def shares_alike(task_id, alike, n, **settings):
    """Shares of the scenes in which none, one and both of the distractors are alike to the target."""
    counts = Counter()
    for seed in range(n):
        layout = sample_layout(TASKS[task_id], "container", np.random.default_rng(seed), **settings)
        counts[sum(item.label.index in alike for item in layout.objects)] += 1
    return np.array([counts[number] / n for number in range(3)])


def shares_by_the_rule(n_alike, n_others, probability, draw):
    """The shares that `shares_alike` estimates, by the rule: exact for at least one object that is alike."""

    def next_is_alike(n_chosen_alike, n_chosen, is_adversarial):
        left = n_alike - n_chosen_alike
        return 1.0 if is_adversarial and left else left / (n_others - n_chosen)

    shares = np.zeros(3)
    for first, second in itertools.product([True, False], repeat=2):
        if draw == "scene":
            weight = (probability if first else 1 - probability) if first == second else 0.0
        else:
            weight = np.prod([probability if each else 1 - probability for each in (first, second)])
        one = next_is_alike(0, 0, first)
        both, only_second = one * next_is_alike(1, 1, second), (1 - one) * next_is_alike(0, 1, second)
        shares += weight * np.array([1 - one - only_second, one - both + only_second, both])
    return shares


@pytest.mark.parametrize("probability", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("draw", ADVERSARIAL_DRAWS)
@pytest.mark.parametrize(("task_id", "alike"), [(task_id, alike) for task_id, alike, _ in ADVERSARIES])
def test_one_draw_decides_for_each_distractor_or_for_both_of_a_scene(
    monkeypatch, task_id, alike, draw, probability
):
    # Objects are drawn before their places. To take the first places that are drawn saves most of the time.
    monkeypatch.setattr(layout_module, "_is_clear", lambda *_: True)
    n = 1000
    shares = shares_alike(task_id, alike, n, adversarial_probability=probability, adversarial_draw=draw)
    expected = shares_by_the_rule(len(alike), 31, probability, draw)
    assert expected.sum() == pytest.approx(1)
    assert (np.abs(shares - expected) <= 4.5 * np.sqrt(expected * (1 - expected) / n) + 1e-12).all()


def test_the_draws_differ_only_between_the_extremes():
    for n_alike in (1, 3):
        for probability in (0.0, 1.0):
            each, scene = (shares_by_the_rule(n_alike, 31, probability, draw) for draw in ADVERSARIAL_DRAWS)
            assert scene == pytest.approx(each)
    # In 0.6 of the scenes both are adversarial, and uniform draws add a few; independently, in 0.36.
    each, scene = (shares_by_the_rule(3, 31, 0.6, draw)[2] for draw in ADVERSARIAL_DRAWS)
    assert scene == pytest.approx(0.6 + 0.4 * (3 / 31) * (2 / 30))
    assert each == pytest.approx((0.6 + 0.4 * 3 / 31) * (0.6 + 0.4 * 2 / 30))


def test_the_draw_does_not_matter_for_twins():
    for seed in range(20):
        each, scene = (
            sample_layout(TASKS[4], "object", np.random.default_rng(seed), adversarial_draw=draw)
            for draw in ADVERSARIAL_DRAWS
        )
        assert numbers(scene) == numbers(each)


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_scenes_can_be_drawn_without_the_test_objects(ambiguity):
    seen = {
        item.label.index
        for seed in range(400)
        for item in sample_layout(
            TASKS[GREEN_TASK], ambiguity, np.random.default_rng(seed), OBJECT_SETS["scenario_a_train"]
        ).objects
    }
    assert seen == set(range(24))


def test_scenes_can_be_drawn_from_random_objects():
    objects = select_objects("random:400")
    task = get_task(1005)  # black and white cup
    matching = {label.index for label in objects if task.describes(label)}
    layouts = [sample_layout(task, "container", np.random.default_rng(seed), objects) for seed in range(100)]
    for layout in layouts:
        indices = [item.label.index for item in layout.objects]
        assert matching & set(indices) == {indices[layout.target_object]}
        assert not set(indices) & set(range(24, 32))
    assert {layout.objects[layout.target_object].label.index for layout in layouts} == matching


def test_the_target_is_alone_in_its_quadrant_as_often_as_any_object():
    n = 900
    n_alone = 0
    for seed in range(n):
        layout = draw(seed % 300, "container", seed)
        homes = [corner_of_object(item) for item in layout.objects]
        n_alone += homes.count(homes[layout.target_object]) == 1
    assert n_alone / n == pytest.approx(1 / 3, abs=4.5 * np.sqrt(2 / 9 / n))


# Scheme ii: the target has a twin


def expected_twin_word(task_id):
    """The rule of the specification."""
    column = task_id // 50
    if column < 2:
        return SIDES[task_id % 4]
    return (SIDES[:2] if column < 4 else SIDES[2:])[task_id % 2]


def test_two_objects_are_identical_and_the_third_does_not_match(twin_layouts):
    for task, layout in twin_layouts:
        indices = [item.label.index for item in layout.objects]
        target = indices[layout.target_object]
        assert target in task.targets
        assert indices.count(target) == 2
        (other,) = (index for index in indices if index != target)
        assert other not in task.targets


@pytest.mark.parametrize(
    ("task_id", "word"),
    [(0, "front"), (1, "back"), (2, "left"), (3, "right"), (50, "left"), (99, "right")]
    + [(100, "front"), (101, "back"), (150, "front"), (151, "back")]
    + [(200, "left"), (201, "right"), (298, "left"), (299, "right")],
)
def test_examples_of_the_side_of_the_target(task_id, word):
    assert twin_word(TASKS[task_id]) == word


def test_the_target_lies_on_its_side_and_its_twin_on_the_other(twin_layouts):
    for task, layout in twin_layouts:
        word = expected_twin_word(task.index)
        assert twin_word(task) == word
        target = layout.objects[layout.target_object]
        (twin,) = (
            item
            for n, item in enumerate(layout.objects)
            if item.label == target.label and n != layout.target_object
        )
        assert word in WORDS[corner_of_object(target)]
        assert word not in WORDS[corner_of_object(twin)]


def test_the_word_of_a_position_task_is_that_of_its_twins_side_in_half_of_the_tasks():
    same = [expected_twin_word(task.index) == task.container for task in TASKS if task.is_position_task]
    assert np.mean(same) == 0.5


@pytest.mark.parametrize("task_id", [GREEN_TASK, RED_TASK, FRONT_TASK, RIGHT_TASK])
def test_twins_take_every_pair_of_quadrants_on_two_sides_equally_often(task_id):
    n = 400
    counts = Counter()
    for seed in range(n):
        layout = draw(task_id, "object", seed)
        target = layout.objects[layout.target_object]
        (twin,) = (
            item
            for n, item in enumerate(layout.objects)
            if item.label == target.label and n != layout.target_object
        )
        counts[corner_of_object(target), corner_of_object(twin)] += 1
    assert len(counts) == 4
    assert np.abs(np.array([*counts.values()]) - n / 4).max() < 4.5 * np.sqrt(n * 3 / 16)


def test_the_third_object_beside_twins_is_any_that_does_not_match():
    # Smushed dumbbell: 31 others; 3 are alike, and are not preferred.
    n = 700
    counts = Counter()
    for seed in range(n):
        layout = draw(GREEN_TASK, "object", seed)
        counts.update(item.label.index for item in layout.objects if item.label.index != GREEN_TASK)
    assert len(counts) == 31
    n_alike = sum(counts[index] for index in (0, 2, 7))
    share = 3 / 31
    assert abs(n_alike - n * share) < 4.5 * np.sqrt(n * share * (1 - share))


# Draws


def numbers(layout):
    """Everything that a layout says, as plain values."""
    return (
        [(item.label.index, *item.xy.tolist(), item.yaw) for item in layout.objects],
        [(container.color, corner(container.quadrant)) for container in layout.containers],
        layout.target_object,
        layout.target_container,
    )


@pytest.mark.parametrize("ambiguity", AMBIGUITIES)
def test_a_layout_is_a_function_of_the_generator(ambiguity):
    for task_id in range(0, 300, 17):
        first = numbers(draw(task_id, ambiguity, 0))
        np.random.seed(5)  # noqa: NPY002  (the global state must not matter)
        draw(task_id + 1, ambiguity, 1)
        assert numbers(draw(task_id, ambiguity, 0)) == first
        assert numbers(draw(task_id, ambiguity, 1)) != first


@pytest.mark.parametrize("quadrant", QUADRANTS, ids=str)
def test_a_container_matches_its_color_and_the_words_for_its_place(quadrant):
    place = {("right", "left")[quadrant.i], ("back", "front")[quadrant.j]}
    for color in CONTAINER_COLORS:
        matching = {word for word in CONTAINER_WORDS if container_matches(word, color, quadrant)}
        assert matching == {color} | place
