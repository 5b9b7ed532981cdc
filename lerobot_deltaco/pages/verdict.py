"""What a sentence asks for in a scene of the benchmark, and whether an episode has done it.

The sentence is read by the phrases from which the benchmark makes its paraphrases (`gym_deltaco.phrases`),
and by the names of the paper's objects.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from functools import cache
from typing import Any, NamedTuple

from gym_deltaco.layout import Layout
from gym_deltaco.phrases import read_phrases
from gym_deltaco.tasks import (
    COLORS,
    CONTAINER_COLORS,
    CONTAINER_WORDS,
    OBJECTS,
    SHAPES,
    ContainerWord,
    ObjectLabel,
)
from lerobot_deltaco.policies.deltaco_match.words import understand

Words = tuple[str, ...]

_ARTICLES = ("a", "an", "the")
# What the grammar lacks, and what says nothing about the object or the container
_FILLERS = ("would you", "will you", "if you", "you to", "thank you", "thanks", "which", "table")
# Words that mean nothing by themselves, but turn around what "closest" means
_PEOPLE = ("me", "you")


class Request(NamedTuple):
    """What a sentence asks for.

    Attributes:
        described: Properties of the object, as pairs such as ("color", "red"), ("shape", "bowl"), ("name",
            "t cup") and ("part of the name", "lampshade"); empty if it describes none.
        containers: Words for the container, such as "left"; more than one if the sentence contradicts itself.
        unclear: Words of the grammar that are used in another way than there.
        unknown: Words that are not in the grammar.
    """

    described: frozenset[tuple[str, str]]
    containers: frozenset[ContainerWord]
    unclear: Words
    unknown: Words

    def fits(self, label: ObjectLabel) -> bool:
        """Returns whether an object has all properties that the sentence gives."""
        own = {("name", label.name), ("color", label.color), ("shape", label.shape)}
        return self.described <= own | {("part of the name", word) for word in label.name.split()}

    @property
    def object_phrase(self) -> str:
        """The object in words."""
        fitting = [label for label in OBJECTS if self.fits(label)]
        if len(fitting) == 1:
            return f"the {object_name(fitting[0])}"
        values = {"shape": "object", **dict(self.described)}
        order = ("color", "name", "part of the name", "shape")
        return f"the {' '.join(values[kind] for kind in order if kind in values)}"

    @property
    def phrase(self) -> str:
        """The object and the container in words."""
        bins = " or ".join(sorted(self.containers))
        return " in ".join([self.object_phrase] * bool(self.described) + [f"the {bins} bin"] * bool(bins))


def parse_instruction(sentence: str) -> Request:
    """Parses a sentence: covers its words with phrases, names first and then the longest."""
    meanings, known = _lexicon()
    typed = _words(sentence)
    understood = understand(" ".join(typed), known)
    words = tuple(right or word for right, word in zip(understood, typed, strict=True))
    spans = [
        (start, end)
        for start in range(len(words))
        for end in range(start + 1, len(words) + 1)
        if words[start:end] in meanings
    ]
    spans.sort(key=lambda span: (meanings[words[slice(*span)]][0] != "name", span[0] - span[1]))
    left, found = set(range(len(words))), set[tuple[str, str]]()
    for start, end in spans:
        if left.issuperset(range(start, end)):
            left.difference_update(range(start, end))
            found.add(meanings[words[start:end]])
    return Request(
        frozenset(meaning for meaning in found if meaning[0] not in ("", "container")),
        frozenset(word for word in CONTAINER_WORDS if ("container", word) in found),
        tuple(typed[n] for n in sorted(left) if words[n] in known),
        tuple(typed[n] for n in sorted(left) if words[n] not in known),
    )


@cache
def _lexicon() -> tuple[dict[Words, tuple[str, str]], Words]:
    """Returns what each phrase says, as a kind and a value (empty for nothing), and all their words."""
    phrases = {part: _both_splits(lists) for part, lists in read_phrases().items()}
    meanings: dict[Words, tuple[str, str]] = {}

    def add(phrase: str, kind: str = "", value: str = "") -> None:
        meanings[_words(phrase)] = (kind, value)

    names = Counter(word for label in OBJECTS for word in set(label.name.split()))
    for word, n in names.items():
        if n == 1 and len(word) > 3:
            add(word, "part of the name", word)
    says_nothing = [phrases[part] for part in ("patterns", "verb", "take", "in", "noun")]
    says_nothing += phrases["object"].values()
    for text in itertools.chain(_FILLERS, *says_nothing):
        for part in re.split(r"{\w+}", text):
            add(part)
            for word in _words(part):
                if word not in _PEOPLE:
                    add(word)
    for kind, values in (("color", COLORS), ("shape", SHAPES)):
        for value in values:
            for phrase in phrases[kind][value]:
                add(phrase, kind, value)
    for word in CONTAINER_WORDS:
        for template in phrases["container"][word]:
            for noun in phrases["noun"]:
                add(template.format(noun=noun), "container", word)
            # "into the red one", "to the left"
            for preposition, noun in itertools.product(phrases["in"], ("", "one")):
                add(f"{preposition} {template.format(noun=noun)}", "container", word)
            # "the box that is closest to me", but not "back" alone, which may be a misspelled "black"
            bare = template.format(noun="")
            if word not in CONTAINER_COLORS and len(_words(bare)) > 1:
                add(bare, "container", word)
    for label in OBJECTS:
        add(label.name, "name", label.name)
    meanings.pop((), None)
    return meanings, tuple(sorted({word for phrase in meanings for word in phrase}))


def _both_splits(lists: Any) -> Any:
    """Returns phrases without their splits."""
    if set(lists) == {"train", "held_out"}:
        return lists["train"] + lists["held_out"]
    return {name: _both_splits(each) for name, each in lists.items()}


def _words(text: str) -> Words:
    found = re.findall(r"[a-z]+", text.casefold().replace("&", " and ").replace("'s", " is"))
    return tuple(word for word in found if word not in _ARTICLES)


def object_name(label: ObjectLabel) -> str:
    """Returns the color and the name of an object, such as "blue t cup"."""
    return f"{label.color} {label.name}"


class Verdict(NamedTuple):
    """Whether an episode did what was asked.

    Attributes:
        is_success: Whether it has; None if that cannot be told.
        headline: The verdict in a few words.
        moved: What was moved where, as a sentence.
        asked: What was asked for, as sentences.
    """

    is_success: bool | None
    headline: str
    moved: str
    asked: str


def judge(
    layout: Layout,
    placed: frozenset[tuple[int, int]],
    grasped: int,
    sentence: str = "",
    demonstrated: str = "",
) -> Verdict:
    """Judges an episode by what was asked for, whatever the scene was drawn for.

    The sentence counts; what it leaves open, the demonstration says.

    Args:
        layout: Objects and containers of the scene.
        placed: Pairs of an object and a container in which it has come to rest.
        grasped: Number of the object that the gripper held last; -1 for none.
        sentence: Instruction that the policy received; empty for none.
        demonstrated: Task string of the demonstration that the policy received; empty for none.
    """
    said, shown = parse_instruction(sentence), parse_instruction(demonstrated)
    fitting, in_demonstration = (
        {n for n, item in enumerate(layout.objects) if request.fits(item.label)} for request in (said, shown)
    )
    objects = (fitting & in_demonstration or fitting) if said.described else in_demonstration
    words = said.containers if sentence else shown.containers
    containers = {
        n for n, item in enumerate(layout.containers) if all(item.satisfies(word) for word in words)
    }
    notes = [f"Understood as: {said.phrase}."] if said.phrase else []
    if said.unknown:
        notes.append(f"Unknown words: {_quoted(said.unknown)}.")
    if not sentence:
        notes.append(f"The demonstration shows {shown.phrase}.")
    elif demonstrated and not said.described:
        notes.append(f"The demonstration shows {shown.object_phrase}.")
    elif demonstrated and not fitting & in_demonstration:
        notes.append(f"The demonstration shows another object: {shown.object_phrase}.")
    doubts = {
        "The sentence names neither an object nor a bin of the benchmark.": sentence and not said.phrase,
        f"It is not clear what {_quoted(said.unclear)} means there.": said.unclear,
        "The sentence names more than one bin.": len(said.containers) > 1,
        "So it is not clear which object is meant.": said.unknown
        and (not said.described or len(objects) > 1),
        "No such object stands in this scene.": not objects,
        "No such bin stands in this scene.": not containers,
    }
    doubt = next((text for text, holds in doubts.items() if holds), None)
    moved = _describe_moved(layout, placed, grasped)
    if doubt is not None:
        return Verdict(None, "Not judged", moved, " ".join([*notes, doubt]))
    if any(item in objects and container in containers for item, container in placed):
        return Verdict(True, "Success", moved, " ".join(notes))
    wrong = ["object"] if grasped >= 0 and grasped not in objects else []
    wrong += ["bin"] if dict(placed).get(grasped, min(containers)) not in containers else []
    return Verdict(False, f"Wrong {' and '.join(wrong)}" if wrong else "Not done", moved, " ".join(notes))


def _quoted(words: Words) -> str:
    return ", ".join(f"“{word}”" for word in words)


def _describe_moved(layout: Layout, placed: frozenset[tuple[int, int]], grasped: int) -> str:
    names = [object_name(item.label) for item in layout.objects]
    put = [f"the {names[item]} into {_container_name(layout, bin_)}" for item, bin_ in sorted(placed)]
    if put:
        return f"It put {' and '.join(put)}."
    return (
        "It grasped nothing." if grasped < 0 else f"It grasped the {names[grasped]}, but put it into no bin."
    )


def _container_name(layout: Layout, number: int) -> str:
    """Returns the color and the position of a container, such as "the green bin (back left)"."""
    container = layout.containers[number]
    i, j = container.quadrant
    return f"the {container.color} bin ({('back', 'front')[j]} {('right', 'left')[i]})"
