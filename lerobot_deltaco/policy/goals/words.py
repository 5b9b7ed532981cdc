"""The words of instructions: which of them a policy knows from its training."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


def words_of(sentence: str) -> frozenset[str]:
    """The words of a sentence, in lower case, without digits and punctuation."""
    return frozenset(re.findall(r"[^\W\d_]+", sentence.lower()))


def vocabulary_of(sentences: Iterable[str]) -> list[str]:
    """All words of sentences, in alphabetical order."""
    return sorted(frozenset[str]().union(*map(words_of, sentences)))


class KnownWords(NamedTuple):
    """What of instructions is known.

    Attributes:
        present: Which words of a vocabulary each has, (instructions, words) float: 0 or 1.
        are_all: Whether it has words and no others, (instructions,) bool.
    """

    present: Tensor
    are_all: Tensor


def known_words(vocabulary: Sequence[str], instructions: Sequence[str]) -> KnownWords:
    """Which words of a vocabulary instructions have.

    Args:
        vocabulary: Words.
        instructions: Instructions.
    """
    places = {word: n for n, word in enumerate(vocabulary)}
    present = torch.zeros(len(instructions), len(vocabulary))
    for row, instruction in enumerate(instructions):
        for word in words_of(instruction) & places.keys():
            present[row, places[word]] = 1
    are_all = torch.tensor(
        [frozenset() < words_of(instruction) <= places.keys() for instruction in instructions]
    )
    return KnownWords(present, are_all.reshape(len(instructions)))
