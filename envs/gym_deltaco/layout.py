"""Layouts of scenes: three objects, two containers, and their positions. No physics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.containers import CONTAINER_COLORS, ContainerColor, ContainerWord
from gym_deltaco.objects.labels import ObjectLabel, find_label
from gym_deltaco.objects.models import find_model
from gym_deltaco.objects.object_sets import select_objects
from gym_deltaco.objects.objects import ObjectModel
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.sim.workspace import CONTAINER_HALF_EXTENTS, QUADRANTS, Quadrant, container_matches
from gym_deltaco.tasks import Task

N_OBJECTS = 3
MIN_OBJECT_DISTANCE = 0.065  # m
# Half extents of the open gripper in x and y, with a margin for the expert's noise. Nothing else stands where
# the fingers come down.
GRIPPER_CLEARANCE = (0.052, 0.018)  # m
_MAX_TRIES = 10_000
_POSITION_AXES: tuple[tuple[ContainerWord, ContainerWord], ...] = (("front", "back"), ("left", "right"))


class PlacedObject(NamedTuple):
    """An object and the pose from which it is dropped."""

    model: ObjectModel
    xy: NDArray[np.float64]  # (2,), m
    yaw: float  # rad

    @property
    def label(self) -> ObjectLabel:
        """Name, shape and color."""
        return self.model.label


class PlacedContainer(NamedTuple):
    """A container and its quadrant."""

    color: ContainerColor
    quadrant: Quadrant

    def satisfies(self, word: ContainerWord) -> bool:
        """Returns whether a word of an instruction describes the container."""
        return container_matches(word, self.color, self.quadrant)


class Layout(NamedTuple):
    """Objects and containers of a scene, with the object and the container that the task asks for."""

    objects: tuple[PlacedObject, ...]
    containers: tuple[PlacedContainer, ...]  # green, red
    target_object: int  # index into `objects`
    target_container: int  # index into `containers`


def sample_layout(task: Task, scene: SceneConfig, rng: np.random.Generator) -> Layout:
    """Draws a layout for a task.

    Args:
        task: Task whose instruction the scene must fit.
        scene: Settings of the scenes, whose objects include one that fits the task, and distractors.
        rng: Source of all draws.

    Returns:
        The layout. With ambiguity "container", exactly one object fits the instruction. With "object", two
        identical objects do; they stand on opposite sides of the tray, and the target is the one on the side
        `twin_word(task)`.

    Raises:
        ValueError: There are too few distractors, beside which an object is the one that the task asks for.
    """
    target, others = _sample_target(task, scene, rng)
    if scene.ambiguity == "container":
        distractors = _sample_distractors(find_label(target), others, scene, rng)
        containers, object_quadrants = _sample_quadrants(task, rng)
    else:
        distractors = target, int(rng.choice([label.index for label in others]))
        containers, object_quadrants = _sample_twin_quadrants(task, rng)
    models = [find_model(index) for index in (target, *distractors)]
    placed = _place_objects(models, object_quadrants, containers, scene.ambiguity, rng)
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
    """Returns the side of the tray on which a task's target stands with ambiguity "object"."""
    if not task.is_position_task:
        return ("front", "back", "left", "right")[task.index % 4]
    axis = next(axis for axis in _POSITION_AXES if task.container in axis)
    return axis[task.index % 2]


def _sample_target(task: Task, scene: SceneConfig, rng: np.random.Generator) -> tuple[int, list[ObjectLabel]]:
    """Draws the target, and returns its index and its possible distractors, of which there are enough."""
    labels = select_objects(scene.objects)
    fitting = [label.index for label in labels if task.object.describes(label)]
    while fitting:
        target = int(rng.choice(fitting))
        others = task.object.distractors(find_label(target), labels)
        if len(others) >= N_OBJECTS - 1:
            return target, others
        fitting.remove(target)  # such as the smallest object for "the largest"
    raise ValueError(
        f"Task {task.index} asks for a {task.object.phrase}, but the objects {scene.objects!r} have no "
        "scene in which only one fits. Choose other tasks, or other `objects`."
    )


def _sample_distractors(
    target: ObjectLabel, others: list[ObjectLabel], scene: SceneConfig, rng: np.random.Generator
) -> tuple[int, int]:
    """Draws two objects that the instruction does not describe, often with the target's color or shape."""
    similar = [label.index for label in others if label.color == target.color or label.shape == target.shape]
    shared_draw = rng.random() if scene.adversarial_draw == "scene" else None
    distractors: list[int] = []
    while len(distractors) < N_OBJECTS - 1:
        candidates = [index for index in similar if index not in distractors]
        # Each distractor has its own draw, unless the scene has one for both.
        if (
            not candidates
            or (rng.random() if shared_draw is None else shared_draw) >= scene.adversarial_probability
        ):
            candidates = [label.index for label in others if label.index not in distractors]
        distractors.append(int(rng.choice(candidates)))
    return distractors[0], distractors[1]


def _sample_quadrants(
    task: Task, rng: np.random.Generator
) -> tuple[tuple[PlacedContainer, ...], tuple[Quadrant, Quadrant]]:
    """Draws quadrants for ambiguity "container": a position word describes exactly one of the two containers.

    Returns:
        The containers, and the two quadrants of the objects.
    """
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
    """Draws quadrants for ambiguity "object".

    Returns:
        The containers, and the quadrants of the target and of its twin.
    """
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
    ambiguity: str,
    rng: np.random.Generator,
) -> list[PlacedObject]:
    """Draws poses of the objects until the gripper can reach all of them.

    The target comes first. With ambiguity "object", it takes the first quadrant and its twin the second. Each
    quadrant holds at least one object.
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
    """Returns whether objects are far enough apart, and the open gripper fits around each of them."""
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
