"""Layouts follow the specification, and do not give the target away."""

import functools
import itertools
from collections import Counter

import numpy as np
import pytest

from gym_deltaco import layout as layout_module
from gym_deltaco.layout import sample_layout, twin_word
from gym_deltaco.objects.labels import OBJECTS
from gym_deltaco.objects.object_sets import select_objects
from gym_deltaco.scene_config import ADVERSARIAL_DRAWS, AMBIGUITIES, DEFAULT_SCENE, SceneConfig
from gym_deltaco.tasks import TASKS, default_objects, get_task

SIDES = ["front", "back", "left", "right"]
# By quadrant (i, j): center of a container, m, and words for its position
CENTERS = {(0, 0): (0.515, 0.18), (0, 1): (0.515, 0.32), (1, 0): (0.675, 0.18), (1, 1): (0.675, 0.32)}
WORDS = {(i, j): {("right", "left")[i], ("back", "front")[j]} for i, j in CENTERS}
# x of objects by i, and y by j, m
OBJECT_X = {0: (0.44, 0.552), 1: (0.628, 0.74)}
OBJECT_Y = {0: (0.14, 0.222), 1: (0.298, 0.38)}
CONTAINER_HALF_EXTENTS = (0.075, 0.0525)
TWINS = SceneConfig(ambiguity="object")
GREEN_TASK, RED_TASK, FRONT_TASK, RIGHT_TASK = 4, 54, 104, 295


@functools.cache
def draw(task_id, scene, seed):
    return sample_layout(get_task(task_id), scene, np.random.default_rng((seed, task_id)))


@functools.cache
def draw_all(ambiguity):
    """Returns (task, layout) for three scenes of each task."""
    scene = SceneConfig(ambiguity=ambiguity)
    return [(task, draw(task.index, scene, seed)) for task in TASKS for seed in range(3)]


@pytest.fixture(params=AMBIGUITIES)
def layouts(request):
    return draw_all(request.param)


def quadrant_of(item):
    """Returns the quadrant in whose region an object lies."""
    (quadrant,) = (
        (i, j)
        for i, j in CENTERS
        if OBJECT_X[i][0] <= item.xy[0] <= OBJECT_X[i][1] and OBJECT_Y[j][0] <= item.xy[1] <= OBJECT_Y[j][1]
    )
    return quadrant


def target_and_twin(layout):
    target = layout.objects[layout.target_object]
    (twin,) = (item for item in layout.objects if item.label == target.label and item is not target)
    return target, twin


def assert_frequency(count, n, probability):
    """Checks a number of hits in `n` draws, within 4.5 standard deviations."""
    spread = np.sqrt(n * probability * (1 - probability))
    assert np.abs(np.asarray(count) - n * probability).max() <= 4.5 * spread


def test_one_container_fits_the_task_and_is_the_target(layouts):
    for task, layout in layouts:
        green, red = layout.containers
        assert (green.color, red.color) == ("green", "red")
        assert green.quadrant != red.quadrant
        fits = []
        for container in layout.containers:
            np.testing.assert_allclose(container.quadrant.container_center, CENTERS[container.quadrant])
            fits.append(task.container in {container.color} | WORDS[container.quadrant])
        assert fits.count(True) == 1
        assert fits.index(True) == layout.target_container


def test_containers_take_every_allowed_pair_of_quadrants_equally_often():
    for task_id, n_pairs in ((GREEN_TASK, 12), (RED_TASK, 12), (FRONT_TASK, 8), (RIGHT_TASK, 8)):
        layouts = [draw(task_id, DEFAULT_SCENE, seed) for seed in range(300)]
        counts = Counter(tuple(item.quadrant for item in layout.containers) for layout in layouts)
        assert len(counts) == n_pairs
        assert_frequency([*counts.values()], 300, 1 / n_pairs)
        if n_pairs == 8:  # a position task, whose container has any color
            assert_frequency(sum(layout.target_container for layout in layouts), 300, 1 / 2)


def test_objects_lie_in_both_free_quadrants_and_keep_their_distances(layouts):
    for _, layout in layouts:
        taken = {container.quadrant for container in layout.containers}
        homes = {quadrant_of(item) for item in layout.objects}
        assert (len(layout.objects), len(homes)) == (3, 2)
        assert homes.isdisjoint(taken)
        for one, other in itertools.combinations(layout.objects, 2):
            assert np.linalg.norm(one.xy - other.xy) >= 0.065
        for item, quadrant in itertools.product(layout.objects, taken):
            radius = np.linalg.norm(item.model.mesh.vertices[:, :2], axis=1).max()
            offset = np.abs(item.xy - CENTERS[quadrant]) - CONTAINER_HALF_EXTENTS
            assert np.linalg.norm(np.maximum(offset, 0)) >= radius
        for item in layout.objects:
            assert item.model.yaw_range[0] <= item.yaw <= item.model.yaw_range[1]


def test_number_and_place_do_not_give_the_target_away():
    for ambiguity in AMBIGUITIES:
        layouts = [layout for _, layout in draw_all(ambiguity)]
        n = len(layouts)
        counts = Counter(layout.target_object for layout in layouts)
        assert_frequency([counts[number] for number in range(3)], n, 1 / 3)
        if ambiguity == "container":
            homes = [[quadrant_of(item) for item in layout.objects] for layout in layouts]
            of_targets = [home[layout.target_object] for home, layout in zip(homes, layouts, strict=True)]
            n_alone = sum(home.count(own) == 1 for home, own in zip(homes, of_targets, strict=True))
            assert_frequency(n_alone, n, 1 / 3)


def test_every_object_that_fits_becomes_the_target_and_all_objects_are_distractors():
    layouts = [draw(33, DEFAULT_SCENE, seed) for seed in range(400)]  # brown
    targets = {layout.objects[layout.target_object].label.index for layout in layouts}
    assert targets == set(TASKS[33].targets)
    assert len(targets) == 11
    seen = {item.label.index for layout in layouts for item in layout.objects}
    assert seen == {label.index for label in OBJECTS}


def test_scenes_are_drawn_from_the_chosen_objects():
    for ambiguity in AMBIGUITIES:
        scene = SceneConfig(ambiguity=ambiguity, objects=default_objects("scenario_a_clean_train"))
        layouts = [draw(GREEN_TASK, scene, seed) for seed in range(200)]
        assert {item.label.index for layout in layouts for item in layout.objects} == set(range(24))
    task = get_task(1005)  # black and white cup
    matching = {label.index for label in select_objects("random:400") if task.object.describes(label)}
    targets = set()
    for seed in range(100):
        layout = draw(1005, SceneConfig(objects="random:400"), seed)
        indices = [item.label.index for item in layout.objects]
        targets.add(indices[layout.target_object])
        assert matching & set(indices) == {indices[layout.target_object]}
        assert not set(indices) & set(range(24, 32))
    assert targets == matching


def test_exactly_one_object_fits_the_instruction():
    for task, layout in draw_all("container"):
        fits = [task.object.describes(item.label) for item in layout.objects]
        assert fits.count(True) == 1
        assert fits.index(True) == layout.target_object
        assert len({item.label.index for item in layout.objects}) == 3


@pytest.mark.parametrize("draw_of", ADVERSARIAL_DRAWS)
def test_distractors_are_adversarial_as_often_as_specified(monkeypatch, draw_of):
    # Accept the first positions, which are drawn after the objects: this saves most of the time.
    monkeypatch.setattr(layout_module, "_is_clear", lambda *_: True)
    n = 400
    # The black and white chalice has three similar objects among the 31 others, the yellow round hole one.
    for (task_id, similar), probability in itertools.product([(4, {0, 2, 7}), (39, {25})], (0.0, 0.6, 1.0)):
        scene = SceneConfig(adversarial_probability=probability, adversarial_draw=draw_of)
        layouts = [draw.__wrapped__(task_id, scene, seed) for seed in range(n)]
        counts = [sum(item.label.index in similar for item in layout.objects) for layout in layouts]
        # Neither of two uniform ones is similar.
        uniform = (31 - len(similar)) / 31 * (30 - len(similar)) / 30
        assert_frequency(counts.count(0), n, (1 - probability) ** (1 if draw_of == "scene" else 2) * uniform)
        if probability == 1:
            assert set(counts) == {min(2, len(similar))}


def test_target_has_an_identical_twin_on_the_other_side():
    for task, layout in draw_all("object"):
        target, twin = target_and_twin(layout)
        (third,) = (item for item in layout.objects if item.label != target.label)
        assert task.object.describes(target.label)
        assert not task.object.describes(third.label)
        # The rule of the specification
        column = task.index // 50
        sides = SIDES if column < 2 else SIDES[:2] if column < 4 else SIDES[2:]
        word = sides[task.index % len(sides)]
        assert twin_word(task) == word
        assert word in WORDS[quadrant_of(target)]
        assert word not in WORDS[quadrant_of(twin)]
    # The side does not follow from the container.
    same = [twin_word(task) == task.container for task in TASKS if task.is_position_task]
    assert np.mean(same) == 0.5
    examples = {0: "front", 3: "right", 50: "left", 101: "back", 150: "front", 201: "right", 298: "left"}
    assert {index: twin_word(TASKS[index]) for index in examples} == examples


def test_twins_take_every_pair_of_quadrants_on_two_sides_equally_often():
    for task_id in (GREEN_TASK, RED_TASK, FRONT_TASK, RIGHT_TASK):
        layouts = [draw(task_id, TWINS, seed) for seed in range(200)]
        counts = Counter(tuple(map(quadrant_of, target_and_twin(layout))) for layout in layouts)
        assert len(counts) == 4
        assert_frequency([*counts.values()], 200, 1 / 4)
        if TASKS[task_id].is_position_task:
            assert_frequency(sum(layout.target_container for layout in layouts), 200, 1 / 2)
    # The third object beside them is uniform.
    layouts = [draw(GREEN_TASK, TWINS, seed) for seed in range(500)]
    counts = Counter(item.label.index for layout in layouts for item in layout.objects)
    assert len(counts) == 32
    assert_frequency(sum(counts[index] for index in (0, 2, 7)), 500, 3 / 31)
