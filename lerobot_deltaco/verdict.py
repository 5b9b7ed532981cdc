"""What a sentence asks for in a scene of the benchmark, and whether an episode has done it.

Templates and people's sentences go through one parser: it finds the container by its color or its position,
and takes the words of the rest as a description of one or more of the paper's 32 objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import NamedTuple

from gym_deltaco.layout import Layout
from gym_deltaco.tasks import COLORS, CONTAINER_WORDS, OBJECTS, SHAPES, ContainerWord, ObjectLabel

# Phrases and words that people use, by the benchmark's word.
_SAME_PHRASES = {
    r"black[ -](and|&)[ -]white|black[ /-]white|white[ -](and|&)[ -]black|checkered": "blackandwhite",
    r"free[ -]form(ed)?": "freeform",
}
_SYNONYMS = {
    "blackandwhite": "black",
    "gray": "grey silver",
    "cup": "mug teacup",
    "chalice": "goblet grail",
    "canoe": "boat kayak",
    "cylinder": "cylindrical tube pipe",
    "trapezoidal": "trapezoid trapezium prismatic",
    "bottle": "flask",
    "hole": "ring",
    "donut": "doughnut torus",
    "sofa": "couch settee",
    "bathtub": "tub",
    "back": "rear",
    "left": "leftmost",
    "right": "rightmost",
}


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SAME_WORDS = {typed: word for word, synonyms in _SYNONYMS.items() for typed in synonyms.split()}
_CONTAINER_NOUNS = _words("bin bins container box basket bucket crate tray")
_PREPOSITIONS = _words("in into inside within to onto on at toward towards from")
_BETWEEN = _words("the a hand most side colored coloured color one far very that is")
# Words that say too little about the object by themselves; within a whole name, they count.
_WEAK_WORDS = _words("bin tray can top table half two bottom flat lid box handle t in round")
_IGNORED = _words(
    "put place move drop take pick grab bring carry set lift please would object thing item shape shaped "
    "color colored colour coloured with like that this them then there which looks made light dark over"
)
_WORDS_OF_COLORS = {color.replace(" ", ""): color for color in COLORS}
_WORDS_OF_SHAPES = {word: shape for shape in SHAPES for word in shape.split() if word != "round"}
_NAMES = {tuple(label.name.split()): label.index for label in OBJECTS}
_WORDS_OF_NAMES = {word for name in _NAMES for word in name}
_VOCABULARY = sorted(
    {*_WORDS_OF_COLORS, *_WORDS_OF_SHAPES, *_WORDS_OF_NAMES, *CONTAINER_WORDS, *_SAME_WORDS} - _WEAK_WORDS
)
_SIMILARITY = 0.8  # from which on an unknown word of four letters or more is a misspelled one


class Request(NamedTuple):
    """What a sentence asks for.

    Attributes:
        objects: Indices of the paper's objects that fit its words; None if it describes none.
        words: The words that describe the object.
        container: Word for the container; None if it names none.
        understood: Words that were understood as others, such as ("botle", "bottle").
    """

    objects: frozenset[int] | None
    words: tuple[str, ...]
    container: ContainerWord | None
    understood: tuple[tuple[str, str], ...]

    @property
    def phrase(self) -> str:
        """The object in words."""
        if self.objects is not None and len(self.objects) == 1:
            return f"the {object_name(OBJECTS[next(iter(self.objects))])}"
        full = {**_WORDS_OF_COLORS, **_WORDS_OF_SHAPES}
        words = " ".join(dict.fromkeys(full.get(word, word) for word in self.words))
        return f"the {words}" + ("" if self.words and self.words[-1] in _WORDS_OF_SHAPES else " object")


def parse_instruction(sentence: str) -> Request:
    """Parses a template sentence or a paraphrase."""
    text = sentence.casefold()
    for pattern, same in _SAME_PHRASES.items():
        text = re.sub(rf"\b({pattern})\b", same, text)
    words, understood = [], []
    for typed in re.findall(r"[a-z]+", text):
        word = _understand(typed)
        words.append(word)
        if word != typed and not (typed == "black" and word == "blackandwhite"):
            understood.append((typed, word))
    container, words = _split_container(words)
    found, used = _find_objects(words)
    return Request(found, used, container, tuple(understood))


def _understand(word: str) -> str:
    """Returns the benchmark's word for a synonym, a plural or a misspelling; other words as they are."""
    if word in _VOCABULARY or word in _WEAK_WORDS:
        return _SAME_WORDS.get(word, word)
    if len(word) < 4 or word in _IGNORED | _CONTAINER_NOUNS | _PREPOSITIONS | _BETWEEN:
        return word
    similar = get_close_matches(word, _VOCABULARY, 1, _SIMILARITY)
    return _SAME_WORDS.get(similar[0], similar[0]) if similar else word


def _split_container(words: list[str]) -> tuple[ContainerWord | None, list[str]]:
    """Returns the word for the container, and the words outside of its phrase."""

    def end_of_noun(position: int) -> int | None:
        """Returns the position after "bin" in "red bin" or "left-hand bin"; None without one."""
        position += 1
        while position < len(words) and words[position] in _BETWEEN:
            position += 1
        return position + 1 if position < len(words) and words[position] in _CONTAINER_NOUNS else None

    def start_of_phrase(position: int) -> int:
        """Returns the position of "in" or "bin" in "in the red" or "bin that is red"."""
        start = position
        while start > 0 and words[start - 1] in _BETWEEN:
            start -= 1
        begin = _PREPOSITIONS | _CONTAINER_NOUNS if start < position else _PREPOSITIONS
        return start - 1 if start > 0 and words[start - 1] in begin else position

    candidates = [n for n, word in enumerate(words) if word in CONTAINER_WORDS]
    # "the red bin" comes before "in the red one", and that before a position anywhere. Red things without
    # either are objects.
    with_noun = [n for n in candidates if end_of_noun(n) is not None]
    after = [n for n in candidates if start_of_phrase(n) < n]
    anywhere = [n for n in candidates if words[n] != "red"]
    chosen = next((group[-1] for group in (with_noun, after, anywhere) if group), None)
    if chosen is None:
        return None, words
    word: ContainerWord = next(each for each in CONTAINER_WORDS if each == words[chosen])
    start, end = start_of_phrase(chosen), end_of_noun(chosen) or chosen + 1
    return word, words[:start] + words[end:]


def _find_objects(words: Sequence[str]) -> tuple[frozenset[int] | None, tuple[str, ...]]:
    """Returns the objects that words describe, None if no word does, and the words that do."""
    named = [
        (len(name), index)
        for name, index in _NAMES.items()
        for start in range(len(words) - len(name) + 1)
        if tuple(words[start : start + len(name)]) == name
    ]
    if named:
        _, index = max(named)
        return frozenset([index]), tuple(OBJECTS[index].name.split())
    used = tuple(
        dict.fromkeys(
            word
            for word in words
            if word in _WORDS_OF_COLORS or word in _WORDS_OF_SHAPES or word in _WORDS_OF_NAMES - _WEAK_WORDS
        )
    )
    if not used:
        return None, ()
    return frozenset(label.index for label in OBJECTS if all(_fits(word, label) for word in used)), used


def _fits(word: str, label: ObjectLabel) -> bool:
    if word in _WORDS_OF_COLORS:
        return label.color == _WORDS_OF_COLORS[word]
    return label.shape == _WORDS_OF_SHAPES.get(word) or word in label.name.split()


def object_name(label: ObjectLabel) -> str:
    """Returns the color and the name of an object, such as "blue t cup"."""
    return f"{label.color} {label.name}"


def container_name(layout: Layout, number: int) -> str:
    """Returns the color and the position of a container, such as "green bin (back left)"."""
    container = layout.containers[number]
    i, j = container.quadrant
    return f"{container.color} bin ({('back', 'front')[j]} {('right', 'left')[i]})"


class Verdict(NamedTuple):
    """Whether an episode did what was asked.

    Attributes:
        is_success: Whether it has; None if nothing was understood.
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
    moved = _describe_moved(layout, placed, grasped)
    said, shown = parse_instruction(sentence), parse_instruction(demonstrated)
    notes = []
    if sentence and said.objects is None and said.container is None:
        notes.append(f"“{sentence}” names neither an object nor a bin of the benchmark.")
    elif sentence:
        parts = [] if said.objects is None else [said.phrase]
        parts += [] if said.container is None else [f"the {said.container} bin"]
        notes.append(f"The sentence asks for {' in '.join(parts)}.")
    if said.understood:
        mapped = ", ".join(f"“{typed}” as “{word}”" for typed, word in said.understood)
        notes.append(f"Understood {mapped.replace('blackandwhite', 'black and white')}.")
    if sentence and said.objects is None and said.container is None:
        return Verdict(None, "Not judged", moved, " ".join(notes))
    # Which objects and containers of the scene are meant; None for any.
    objects = _matching(layout, said.objects)
    by_demonstration = _matching(layout, shown.objects)
    if said.objects is None and shown.objects is not None:
        objects = by_demonstration
        notes.append(f"The demonstration shows {shown.phrase}.")
    elif objects and by_demonstration is not None:
        if objects & by_demonstration:
            objects &= by_demonstration
        else:
            notes.append(f"The demonstration shows another object: {shown.phrase}.")
    word = said.container or (None if sentence else shown.container)
    containers = None
    if word is not None:
        containers = {n for n, item in enumerate(layout.containers) if item.satisfies(word)}
        if not sentence:
            notes.append(f"Its task names the {word} bin.")
    if objects is not None and not objects:
        return Verdict(None, "Not judged", moved, " ".join([*notes, "No such object stands in this scene."]))
    if containers is not None and not containers:
        return Verdict(None, "Not judged", moved, " ".join([*notes, "No such bin stands in this scene."]))
    right = [
        pair
        for pair in placed
        if (objects is None or pair[0] in objects) and (containers is None or pair[1] in containers)
    ]
    if right:
        return Verdict(True, "Success", moved, " ".join(notes))
    in_bins = dict(placed)
    wrong = []
    if objects is not None and grasped >= 0 and grasped not in objects:
        wrong.append("object")
    if containers is not None and grasped in in_bins and in_bins[grasped] not in containers:
        wrong.append("bin")
    return Verdict(False, f"Wrong {' and '.join(wrong)}" if wrong else "Not done", moved, " ".join(notes))


def _matching(layout: Layout, indices: frozenset[int] | None) -> set[int] | None:
    """Returns the numbers of a scene's objects that are among some; None for None."""
    if indices is None:
        return None
    return {n for n, item in enumerate(layout.objects) if item.label.index in indices}


def _describe_moved(layout: Layout, placed: frozenset[tuple[int, int]], grasped: int) -> str:
    names = [object_name(item.label) for item in layout.objects]
    put = [f"the {names[item]} into the {container_name(layout, bin_)}" for item, bin_ in sorted(placed)]
    if put:
        return f"It put {' and '.join(put)}."
    return (
        "It grasped nothing." if grasped < 0 else f"It grasped the {names[grasped]}, but put it into no bin."
    )
