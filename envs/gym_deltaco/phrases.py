"""Paraphrases: the tasks in people's words, from a grammar.

`phrases.yaml` lists phrases for each part of an instruction. A sentence draws one for each part, sometimes
without articles, and sometimes with a typing error. Kinds of tasks that it does not list keep their phrase
for the object.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from gym_deltaco.tasks import Task

PhraseSplit = Literal["train", "held_out"]

_FILE = Path(__file__).with_name("phrases.yaml")
_P_NO_ARTICLE, _P_TYPO = 0.3, 0.1  # probabilities that a sentence lacks its articles, or has an error
_MIN_TYPO_LENGTH = 5  # letters, of a word that is misspelled
_P_HELD_OUT = 0.4  # probability that a part of a held-out sentence is a held-out phrase
_ENDS = ("", "", ".", "!")


def paraphrase(task: Task, split: PhraseSplit, rng: np.random.Generator) -> str:
    """Returns the instruction of a task in people's words.

    Args:
        task: The task.
        split: "train"; or "held_out", for a sentence with a phrase that is in no training sentence.
        rng: Source of the draws.
    """
    while True:
        sentence, has_new_phrase = _draw_sentence(task, split, rng)
        if has_new_phrase or split == "train":
            return sentence


def _draw_sentence(task: Task, split: PhraseSplit, rng: np.random.Generator) -> tuple[str, bool]:
    """Draws a sentence, and returns whether it has a held-out phrase."""
    phrases, is_new = read_phrases(), False

    def draw(lists: Mapping[str, list[str]]) -> str:
        nonlocal is_new
        new = split == "held_out" and rng.random() < _P_HELD_OUT
        is_new |= new
        choice = lists["held_out" if new else "train"]
        return choice[int(rng.integers(len(choice)))]

    parts: dict[str, str] = {part: draw(phrases[part]) for part in ("verb", "take", "in", "noun")}
    if task.kind in phrases["object"]:
        words = {
            name: draw(phrases[name][value])
            for name, value in (("color", task.object.color), ("shape", task.object.shape))
            if value is not None
        }
        parts["object"] = draw(phrases["object"][task.kind]).format(name=task.object.name, **words)
    else:
        parts["object"] = f"the {task.object.phrase}"
    parts["container"] = draw(phrases["container"][task.container]).format(**parts)
    sentence = draw(phrases["patterns"]).format(**parts)
    if rng.random() < _P_NO_ARTICLE:
        sentence = re.sub(r"\b(the|a) ", "", sentence)
    if rng.random() < _P_TYPO:
        sentence = _misspell(sentence, rng)
    if rng.random() < 0.5:
        sentence = sentence[0].upper() + sentence[1:]
    return sentence + _ENDS[int(rng.integers(len(_ENDS)))], is_new


def _misspell(sentence: str, rng: np.random.Generator) -> str:
    """Returns a sentence with two letters of a word swapped, or one left out or doubled."""
    words = [match for match in re.finditer(r"[a-z]+", sentence) if len(match[0]) >= _MIN_TYPO_LENGTH]
    if not words:
        return sentence
    word = words[int(rng.integers(len(words)))]
    position = int(rng.integers(1, len(word[0]) - 1))
    before, pair, after = word[0][:position], word[0][position : position + 2], word[0][position + 2 :]
    typos = (before + pair[::-1] + after, before + pair[1:] + after, before + pair[0] + pair + after)
    return sentence[: word.start()] + typos[int(rng.integers(3))] + sentence[word.end() :]


@cache
def read_phrases() -> dict[str, Any]:
    """Returns the phrases of `phrases.yaml`."""
    return yaml.safe_load(_FILE.read_text(encoding="utf-8"))
