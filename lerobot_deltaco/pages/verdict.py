"""What an episode did, what the policy understood, and whether that was asked for.

What the policy understood is what it computed: the words that it reads as the object's, and the object and
the container at its pick and place locations. What was asked for is known for the benchmark's own sentences
only; for others, the verdict compares what happened with what the policy understood.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.containers import CONTAINER_WORDS, ContainerWord
from gym_deltaco.layout import Layout
from gym_deltaco.objects.labels import ObjectLabel
from gym_deltaco.sim.workspace import CONTAINER_FLOOR, TABLE_TOP, TRAY_CENTER, TRAY_HALF_EXTENTS
from gym_deltaco.tasks import TASKS, Task
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.evaluation.photos import image_locations
from lerobot_deltaco.evaluation.video import Recording
from lerobot_deltaco.policies.deltaco_match.words import words_of

# A location belongs to what is within this distance of it: a tenth of the image's side. In the benchmark, the
# centers of objects are at least 0.26 apart, and the shipped policy's place locations are within 0.13 of the
# container's center.
TOLERANCE = 0.2
_ARTICLES = ("a", "an", "the")


class Verdict(NamedTuple):
    """Whether an episode did what was asked.

    Attributes:
        is_success: Whether it did; None if only the user knows what was asked.
        headline: The verdict in a few words.
        lines: What happened, what the policy understood, and why there is no verdict, as sentences.
    """

    is_success: bool | None
    headline: str
    lines: list[str]


class Understanding(NamedTuple):
    """What a policy chose to do at the start of an episode.

    Attributes:
        object: Number of the object at the pick location; -1 for none.
        container: Number of the container at the place location; -1 for none.
        confidence: Probability of the pick location among the proposals.
    """

    object: int
    container: int
    confidence: float


def judge(
    recording: Recording,
    sentence: str,
    demonstrated: Task | None,
    words: str = "",
    pointed: ObjectPrompt | None = None,
) -> Verdict:
    """Judges an episode.

    Args:
        recording: The episode.
        sentence: Instruction that the policy received; empty for none.
        demonstrated: Task whose demonstration the policy received; None for none.
        words: How the policy read the sentence, as of `findings.describe_words`.
        pointed: Point on the object to pick, whatever the sentence calls it; None for none.
    """
    understanding, placements = understand_locations(recording), recording.placements
    lines = [describe_outcome(recording)]
    if understanding is not None:
        lines.append(f"{_describe_understanding(recording.layout, understanding)} {words}".strip())
    asked = asked_for(recording.layout, sentence, demonstrated)
    if pointed is not None:
        asked = _asked_by_point(recording, sentence, pointed)
    if isinstance(asked, str):
        headline = "Not judged"
        if understanding is not None:
            is_done = (understanding.object, understanding.container) in placements
            headline = "Did what it understood" if is_done else "Did not do what it understood"
        return Verdict(None, headline, [*lines, asked])
    objects, containers = asked
    if any(item in objects and container in containers for item, container in placements):
        return Verdict(True, "Success", lines)
    grasped = recording.grasped_object
    wrong = ["object"] if grasped >= 0 and grasped not in objects else []
    wrong += ["bin"] if dict(placements).get(grasped, min(containers)) not in containers else []
    return Verdict(False, f"Wrong {' and '.join(wrong)}" if wrong else "Not done", lines)


# What was asked for


def asked_for(layout: Layout, sentence: str, demonstrated: Task | None) -> tuple[set[int], set[int]] | str:
    """Returns the objects and the containers of a scene that fit, or why this is unknown.

    It is known for the instructions of the 300 tasks, and for "Put it in the red bin." and the like, where
    the demonstration says which object.
    """
    task, word = demonstrated, None if demonstrated is None else demonstrated.container
    if sentence:
        task, word = _sentences().get(_key(sentence), (None, None))
    if word is None:
        return "Only the benchmark's own sentences are judged: is this what you meant?"
    tasks = [known for known in (task, demonstrated) if known is not None]
    if not tasks:
        return "Not judged: the sentence names no object, and there is no demonstration."
    labels = [item.label for item in layout.objects]
    objects = set.intersection(*(set(known.object.meant(labels)) for known in tasks))
    containers = {n for n, item in enumerate(layout.containers) if item.satisfies(word)}
    if not objects:
        both = "both the demonstration and the sentence" if len(tasks) == 2 else "that"
        return f"Not judged: no object in this scene fits {both}."
    return (objects, containers) if containers else "Not judged: no bin in this scene fits that."


def _asked_by_point(
    recording: Recording, sentence: str, pointed: ObjectPrompt
) -> tuple[set[int], set[int]] | str:
    """Returns the object at a point and the containers that a sentence names, or why these are unknown."""
    _, word = _sentences().get(_key(sentence), (None, None))
    if word is None:
        return "Only the benchmark's own sentences are judged: is this what you meant?"
    item = _nearest(np.array(pointed.location), image_locations(recording.positions[0]))
    containers = {n for n, each in enumerate(recording.layout.containers) if each.satisfies(word)}
    if item < 0:
        return "Not judged: no object is at the point."
    return ({item}, containers) if containers else "Not judged: no bin in this scene fits that."


@cache
def _sentences() -> dict[tuple[str, ...], tuple[Task | None, ContainerWord]]:
    """Returns the task and the container that each known sentence asks for."""
    known: dict[tuple[str, ...], tuple[Task | None, ContainerWord]] = {
        _key(f"Put it in {word} bin."): (None, word) for word in CONTAINER_WORDS
    }
    return known | {_key(task.instruction): (task, task.container) for task in TASKS}


def _key(sentence: str) -> tuple[str, ...]:
    return tuple(word for word in words_of(sentence) if word not in _ARTICLES)


# What the policy understood


def understand_locations(recording: Recording) -> Understanding | None:
    """Returns what is at the policy's locations; None for policies that find none."""
    if recording.localization is None:
        return None
    centers = np.array([item.quadrant.container_center for item in recording.layout.containers])
    floor = np.column_stack([centers, np.full(len(centers), CONTAINER_FLOOR)])
    pick, place = recording.localization.locations[0].cpu().numpy()
    return Understanding(
        _nearest(pick, image_locations(recording.positions[0])),
        _nearest(place, image_locations(floor)),
        recording.localization.confidence.item(),
    )


def _nearest(location: NDArray[np.float64], others: NDArray[np.float64]) -> int:
    distances = np.linalg.norm(others - location, axis=1)
    return int(distances.argmin()) if distances.min() < TOLERANCE else -1


# In words


def describe_outcome(recording: Recording) -> str:
    """Returns what was picked, where it was put, and what left the tray, as sentences."""
    names = [object_name(item.label) for item in recording.layout.objects]
    put = [
        f"the {names[item]} into {_container_name(recording.layout, bin_)}"
        for item, bin_ in sorted(recording.placements)
    ]
    grasped = recording.grasped_object
    if put:
        text = f"It put {' and '.join(put)}."
    elif grasped >= 0:
        text = f"It grasped the {names[grasped]}, but put it into no bin."
    else:
        text = "It grasped nothing."
    for name, (x, y, z) in zip(names, recording.positions[1], strict=True):
        if z < TABLE_TOP:
            text += f" The {name} fell off the table."
        elif (np.abs(np.subtract((x, y), TRAY_CENTER)) > TRAY_HALF_EXTENTS).any():
            text += f" The {name} left the tray."
    return text


def _describe_understanding(layout: Layout, understanding: Understanding) -> str:
    number, container, confidence = understanding
    what = "no object" if number < 0 else f"the {object_name(layout.objects[number].label)}"
    where = "to a place outside the bins" if container < 0 else f"into {_container_name(layout, container)}"
    return f"Understood as: {what} ({100 * confidence:.0f} % sure) {where}."


def object_name(label: ObjectLabel) -> str:
    """Returns the color and the name of an object, such as "blue t cup"."""
    return f"{label.color} {label.name}"


def _container_name(layout: Layout, number: int) -> str:
    """Returns the color and the position of a container, such as "the green bin (back left)"."""
    container = layout.containers[number]
    i, j = container.quadrant
    return f"the {container.color} bin ({('back', 'front')[j]} {('right', 'left')[i]})"
