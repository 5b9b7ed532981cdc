"""Named sets of objects from which scenes are drawn."""

from __future__ import annotations

import re
from functools import cache
from types import MappingProxyType

from gym_deltaco.objects.labels import (
    EXPERT_MESHES,
    FIRST_RANDOM_INDEX,
    MESHES,
    OBJECTS,
    SCENARIO_A_TRAIN,
    ObjectLabel,
    mesh_label,
    random_label,
)

OBJECT_SETS = MappingProxyType(
    {
        # Test objects are distractors in training scenes, as in the authors' code:
        # https://github.com/Alacarter/roboverse-deltaco, commit d6d407b.
        "all": OBJECTS,
        "scenario_a_train": SCENARIO_A_TRAIN,
        "out_of_distribution": tuple(map(mesh_label, EXPERT_MESHES[:96])),
        "out_of_distribution_validation": tuple(map(mesh_label, EXPERT_MESHES[96:192])),
        # Including those that the expert cannot pick and place
        "out_of_distribution_unchecked": tuple(map(mesh_label, MESHES)),
    }
)
MAX_OBJECTS = 10_000
# Scenario A's training objects in three folds of eight, for choosing settings on novel objects. Each fold has
# three brown objects and five of other colors, two vases and six of other shapes.
FOLDS = ((0, 1, 2, 5, 9, 10, 20, 23), (3, 4, 6, 8, 11, 12, 14, 17), (7, 13, 15, 16, 18, 19, 21, 22))


def select_objects(name: str) -> tuple[ObjectLabel, ...]:
    """Returns the objects of a set.

    Args:
        name: One of `OBJECT_SETS`; "random:N" with N from 24 to 10000: scenario A's 24 training objects and
            N - 24 random ones; or "fold_K:N": the same without the objects of fold K (0, 1 or 2), and without
            random objects that have the color and the shape of one of them. A larger set includes the
            smaller ones.

    Raises:
        ValueError: The set does not exist.
    """
    count = re.fullmatch(r"(random|fold_([0-2])):(\d{1,9})", name) if isinstance(name, str) else None
    if count is not None:
        return _with_random_objects(name, int(count[3]), None if count[2] is None else int(count[2]))
    if not isinstance(name, str) or name not in OBJECT_SETS:
        raise ValueError(
            f"`objects` must be one of {', '.join(OBJECT_SETS)}, random:N, fold_K:N. Got {name!r}."
        )
    return OBJECT_SETS[name]


@cache
def _with_random_objects(name: str, n_objects: int, fold: int | None) -> tuple[ObjectLabel, ...]:
    n_paper = len(SCENARIO_A_TRAIN)
    if not n_paper <= n_objects <= MAX_OBJECTS:
        raise ValueError(
            f"`objects` must be random:N or fold_K:N with N from {n_paper} to {MAX_OBJECTS}. Got {name!r}."
        )
    random_indices = range(FIRST_RANDOM_INDEX, FIRST_RANDOM_INDEX + n_objects - n_paper)
    labels = (*SCENARIO_A_TRAIN, *map(random_label, random_indices))
    if fold is None:
        return labels
    held_out = {(OBJECTS[index].color, OBJECTS[index].shape) for index in FOLDS[fold]}
    return tuple(
        label
        for label in labels
        if label.index not in FOLDS[fold]
        and not (label.index in random_indices and (label.color, label.shape) in held_out)
    )
