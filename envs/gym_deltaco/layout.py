"""What a scene consists of: three objects, two containers, and where each is. No physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, AdversarialDraw, find_label, find_model
from gym_deltaco.objects import ObjectModel
from gym_deltaco.tasks import CONTAINER_COLORS, OBJECTS, ContainerColor, ContainerWord, ObjectLabel, Task
from gym_deltaco.workspace import CONTAINER_HALF_EXTENTS, QUADRANTS, Quadrant, container_matches

Ambiguity = Literal["container", "object"]
AMBIGUITIES: tuple[str, ...] = get_args(Ambiguity)

N_OBJECTS = 3
MIN_OBJECT_DISTANCE = 0.065  # m
# Half the opened gripper's extents, with the expert's noise: nothing else stands where its fingers come down.
GRIPPER_CLEARANCE = (0.052, 0.018)  # m, in x and y
_MAX_TRIES = 10_000
_POSITION_AXES: tuple[tuple[ContainerWord, ContainerWord], ...] = (("front", "back"), ("left", "right"))


class PlacedObject(NamedTuple):
    """An object and where it is let fall."""

    model: ObjectModel
    xy: NDArray[np.float64]  # (2,), m
    yaw: float  # rad

    @property
    def label(self) -> ObjectLabel:
        """Name, shape and color."""
        return self.model.label


class PlacedContainer(NamedTuple):
    """A container and where it stands."""

    color: ContainerColor
    quadrant: Quadrant

    def satisfies(self, word: ContainerWord) -> bool:
        """Whether a word of an instruction describes it."""
        return container_matches(word, self.color, self.quadrant)


class Layout(NamedTuple):
    """A scene: one of the objects and one of the containers are what the task asks for."""

    objects: tuple[PlacedObject, ...]
    containers: tuple[PlacedContainer, ...]  # green, red
    target_object: int  # index into `objects`
    target_container: int  # index into `containers`


def sample_layout(
    task: Task,
    ambiguity: Ambiguity,
    rng: np.random.Generator,
    objects: Sequence[ObjectLabel] = OBJECTS,
    adversarial_probability: float = ADVERSARIAL_PROBABILITY,
    adversarial_draw: AdversarialDraw = "each",
) -> Layout:
    """Draws a scene for a task.

    Args:
        task: The task that the instruction asks for.
        ambiguity: "container": exactly one object fits the instruction, which is what a demonstration
            alone leaves open about containers (the paper's scheme i). "object": the target has an identical
            twin on the other side of the tray, and only the demonstration tells which of the two (scheme ii).
        rng: Source of all draws.
        objects: Objects that the scene is made of; the task asks for at least one of them.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1. In scheme ii, none is.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.

    Returns:
        The scene.
    """
    target = int(rng.choice([label.index for label in objects if task.describes(label)]))
    if ambiguity == "container":
        distractors = _sample_distractors(
            task, find_label(target), rng, objects, adversarial_probability, adversarial_draw
        )
        containers, object_quadrants = _sample_quadrants(task, rng)
    else:
        distractors = (
            target,
            int(rng.choice([label.index for label in objects if not task.describes(label)])),
        )
        containers, object_quadrants = _sample_twin_quadrants(task, rng)
    models = [find_model(index) for index in (target, *distractors)]
    placed = _place_objects(models, object_quadrants, containers, ambiguity, rng)
    order = rng.permutation(N_OBJECTS)
    return Layout(
        objects=tuple(placed[index] for index in order),
        containers=containers,
        target_object=int(np.flatnonzero(order == 0)[0]),
        target_container=next(
            i for i, container in enumerate(containers) if container.satisfies(task.container)
        ),
    )


def twin_word(task: Task) -> ContainerWord:
    """Scheme ii: the side of the tray on which a task's target stands; its twin is on the other side."""
    if not task.is_position_task:
        return ("front", "back", "left", "right")[task.index % 4]
    axis = next(axis for axis in _POSITION_AXES if task.container in axis)
    return axis[task.index % 2]


def _sample_distractors(
    task: Task,
    target: ObjectLabel,
    rng: np.random.Generator,
    objects: Sequence[ObjectLabel],
    adversarial_probability: float,
    adversarial_draw: AdversarialDraw,
) -> tuple[int, int]:
    """Two objects that the instruction does not describe, often alike to the target in color or shape."""
    others = [label for label in objects if not task.describes(label) and label.index != target.index]
    alike = [label.index for label in others if label.color == target.color or label.shape == target.shape]
    # None: each distractor has a draw of its own.
    shared_draw = rng.random() if adversarial_draw == "scene" else None
    chosen: list[int] = []
    while len(chosen) < N_OBJECTS - 1:
        left = [index for index in alike if index not in chosen]
        if not (left and (rng.random() if shared_draw is None else shared_draw) < adversarial_probability):
            left = [label.index for label in others if label.index not in chosen]
        chosen.append(int(rng.choice(left)))
    return chosen[0], chosen[1]


def _sample_quadrants(
    task: Task, rng: np.random.Generator
) -> tuple[tuple[PlacedContainer, ...], tuple[Quadrant, Quadrant]]:
    """Scheme i: containers in two random quadrants, of which a position word describes exactly one."""
    pairs = [
        (QUADRANTS[green], QUADRANTS[red])
        for green in range(len(QUADRANTS))
        for red in range(len(QUADRANTS))
        if green != red
    ]
    if task.is_position_task:
        pairs = [pair for pair in pairs if sum(quadrant.satisfies(task.container) for quadrant in pair) == 1]
    pair = pairs[rng.integers(len(pairs))]
    free = tuple(quadrant for quadrant in QUADRANTS if quadrant not in pair)
    return _containers(*pair), (free[0], free[1])


def _sample_twin_quadrants(
    task: Task, rng: np.random.Generator
) -> tuple[tuple[PlacedContainer, ...], tuple[Quadrant, Quadrant]]:
    """Scheme ii: the target's quadrant first, its twin's second; the containers take the other two."""
    word = twin_word(task)
    side = [quadrant for quadrant in QUADRANTS if quadrant.satisfies(word)]
    other_side = [quadrant for quadrant in QUADRANTS if not quadrant.satisfies(word)]
    target, twin = side[rng.integers(2)], other_side[rng.integers(2)]
    free = [quadrant for quadrant in QUADRANTS if quadrant not in (target, twin)]
    if rng.integers(2):
        free.reverse()
    return _containers(free[0], free[1]), (target, twin)


def _containers(green: Quadrant, red: Quadrant) -> tuple[PlacedContainer, ...]:
    return tuple(
        PlacedContainer(color, quadrant)
        for color, quadrant in zip(CONTAINER_COLORS, (green, red), strict=True)
    )


def _place_objects(
    models: list[ObjectModel],
    quadrants: tuple[Quadrant, Quadrant],
    containers: tuple[PlacedContainer, ...],
    ambiguity: Ambiguity,
    rng: np.random.Generator,
) -> list[PlacedObject]:
    """Draws where the objects stand, until all of them can be grasped.

    The target comes first; in scheme ii it takes the first quadrant and its twin the second. Each quadrant
    holds at least one object.
    """
    for _ in range(_MAX_TRIES):
        homes = [0, 1, int(rng.integers(2))]
        if ambiguity == "container":
            rng.shuffle(homes)
        placed = []
        for model, home in zip(models, homes, strict=True):
            region = quadrants[home].object_region
            placed.append(
                PlacedObject(model, rng.uniform(region.low, region.high), rng.uniform(*model.yaw_range))
            )
        if _is_clear(placed, containers):
            return placed
    raise RuntimeError(f"No room for {[model.label.name for model in models]} in {_MAX_TRIES} tries.")


def _is_clear(placed: list[PlacedObject], containers: tuple[PlacedContainer, ...]) -> bool:
    """Whether the objects keep their distances, and the opened gripper can come down around each of them."""
    footprints = [item.model.footprint(item.yaw) for item in placed]
    for index, item in enumerate(placed):
        for container in containers:
            gap = np.abs(item.xy - container.quadrant.container_center) - CONTAINER_HALF_EXTENTS
            if np.hypot(*np.maximum(gap, 0)) < item.model.radius or (gap < GRIPPER_CLEARANCE).all():
                return False
        for other, neighbor in enumerate(placed):
            if other == index:
                continue
            offset = np.abs(item.xy - neighbor.xy)
            if (
                np.hypot(*offset) < MIN_OBJECT_DISTANCE
                or (offset - footprints[other] < GRIPPER_CLEARANCE).all()
                or (offset - footprints[other] < footprints[index]).all()
            ):
                return False
    return True
