"""Named sets of objects from which scenes are drawn."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from types import MappingProxyType

from gym_deltaco.objects.foreign_objects import foreign_label, foreign_model, is_foreign
from gym_deltaco.objects.objects import ObjectModel, object_model
from gym_deltaco.objects.random_objects import FIRST_INDEX, random_label, random_model
from gym_deltaco.tasks import (
    FIRST_FOREIGN_INDEX,
    FOLDS,
    FOREIGN_MESHES,
    FOREIGN_VALIDATION_MESHES,
    MESHES,
    OBJECTS,
    SCENARIOS,
    ObjectLabel,
    fold_pairs,
)


def _foreign_labels(meshes: Iterable[int]) -> tuple[ObjectLabel, ...]:
    return tuple(foreign_label(FIRST_FOREIGN_INDEX + mesh) for mesh in meshes)


OBJECT_SETS = MappingProxyType(
    {
        # Test objects are distractors in training scenes, as in the authors' code:
        # https://github.com/Alacarter/roboverse-deltaco, commit d6d407b.
        "all": OBJECTS,
        # Without the 8 test objects of scenario A.
        "scenario_a_train": tuple(label for label in OBJECTS if label.index in SCENARIOS["a"].train_rows),
        "foreign": _foreign_labels(FOREIGN_MESHES),
        "foreign_validation": _foreign_labels(FOREIGN_VALIDATION_MESHES),
        # Also those that the expert does not manage
        "foreign_unchecked": _foreign_labels(MESHES),
    }
)
MAX_OBJECTS = 10_000
# Default objects of task sets that do not draw their scenes from all objects
_OBJECTS_OF_TASK_SETS = MappingProxyType(
    {
        "scenario_a_clean_train": "scenario_a_train",
        "foreign": "foreign",
        "foreign_validation": "foreign_validation",
    }
)


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
    paper = OBJECT_SETS["scenario_a_train"]
    n_random = n_objects - len(paper)
    if not 0 <= n_random <= MAX_OBJECTS - len(paper):
        raise ValueError(
            f"`objects` must be random:N or fold_K:N with N from {len(paper)} to {MAX_OBJECTS}. Got {name!r}."
        )
    labels = (*paper, *(random_label(FIRST_INDEX + number) for number in range(n_random)))
    if fold is None:
        return labels
    held_out = fold_pairs(fold)
    return tuple(
        label
        for label in labels
        if label.index not in FOLDS[fold]
        and not (label.index >= FIRST_INDEX and (label.color, label.shape) in held_out)
    )


def find_label(index: int) -> ObjectLabel:
    """Returns the label of an object: 0..31 the paper's, 32..10007 random, 20500..20999 foreign."""
    if is_foreign(index):
        return foreign_label(index)
    return OBJECTS[index] if index < FIRST_INDEX else random_label(index)


def find_model(index: int) -> ObjectModel:
    """Returns the geometry of an object: 0..31 the paper's, 32..10007 random, 20500..20999 foreign.

    Raises:
        ImportError: The object is foreign, and PyBullet is not installed.
    """
    if is_foreign(index):
        return foreign_model(index)
    return object_model(index) if index < FIRST_INDEX else random_model(index)


def default_objects(tasks: str) -> str:
    """Returns the name of the default set of objects for a selection of tasks, such as "scenario_a_test"."""
    return _OBJECTS_OF_TASK_SETS.get(tasks.strip(), "all")
