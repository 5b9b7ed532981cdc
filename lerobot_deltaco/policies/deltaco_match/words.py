"""Words of instructions: known ones, misspelled ones, and which of them describe the object."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Sequence
from functools import cache

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

NO_WORD, UNKNOWN_WORD = 0, 1  # indices of words; those of the vocabulary follow
_N_SPECIAL = 2
INSTRUCTION_DIM = 64
_WORD_STD, _P_DROP_WORD = 0.3, 0.2
# Words are rare in batches: their tables learn as much faster than the rest of the network.
_LEARNING_SPEED = 10.0
_N_NEIGHBORS = 2  # words on either side that tell what a word is about
# A word is taken for a known one if so much of it is the same (as a ratio), and it is not too short.
_MIN_SIMILARITY, _MIN_LENGTH = 0.8, 4


# Chinese, Japanese and Korean have no spaces between words: each character is one.
_CHARACTER = "[\u3040-\u30ff\u3400-\u9fff\uac00-\ud7af]"
# Marks that combine with the letter before them belong to its word.
_MARKS = "".join(chr(n) for n in range(0x300, 0x10000) if unicodedata.category(chr(n)).startswith("M"))
_WORD = re.compile(rf"{_CHARACTER}|(?:(?!{_CHARACTER})[^\W\d_][{_MARKS}]*)+|\d+")


def words_of(sentence: str) -> list[str]:
    """Returns the words and numbers of a sentence in their order, in lower case, without punctuation."""
    return _WORD.findall(unicodedata.normalize("NFC", sentence).lower())


def vocabulary_of(sentences: Iterable[str]) -> list[str]:
    """Returns all words of sentences, in alphabetical order."""
    return sorted(set().union(*map(words_of, sentences)))


def understand(sentence: str, vocabulary: Sequence[str]) -> list[str | None]:
    """Returns each word of a sentence as it is understood: as a known word, or not at all (None).

    A word outside the vocabulary is taken for the most similar known one, if that is similar enough.
    """
    words = tuple(vocabulary)
    return [_understand_word(word, words) for word in words_of(sentence)]


@cache
def _understand_word(word: str, vocabulary: tuple[str, ...]) -> str | None:
    if word in vocabulary:
        return word
    if len(word) < _MIN_LENGTH:
        return None
    return next(iter(difflib.get_close_matches(word, vocabulary, 1, _MIN_SIMILARITY)), None)


def encode_words(sentences: Sequence[str], vocabulary: Sequence[str]) -> Tensor:
    """Returns the indices of the words of sentences, (sentences, words) int64.

    `NO_WORD` fills up shorter sentences. `UNKNOWN_WORD` stands for words that are not understood.
    """
    index = {word: n for n, word in enumerate(vocabulary, start=_N_SPECIAL)}
    rows = [
        [UNKNOWN_WORD if word is None else index[word] for word in understand(text, vocabulary)] or [NO_WORD]
        for text in sentences
    ]
    return nn.utils.rnn.pad_sequence([torch.tensor(row) for row in rows], True, NO_WORD)


class WordWeights(nn.Module):
    """Weighs words by whether they are about the object: "red" is in "red cup", and not in "red bin".

    A second instance learns the same for the place. A weight depends on the word and on two words at
    either side.

    Args:
        n_words: Size of the vocabulary.
    """

    def __init__(self, n_words: int) -> None:
        super().__init__()
        self.own = nn.Embedding(n_words + _N_SPECIAL, 1)
        self.neighbors = nn.ModuleList(nn.Embedding(n_words + _N_SPECIAL, 1) for _ in range(2 * _N_NEIGHBORS))
        for table in self.modules():
            if isinstance(table, nn.Embedding):
                nn.init.zeros_(table.weight)

    def forward(self, words: Tensor) -> Tensor:
        """Maps indices of words, (batch, words), to weights in 0..1, (batch, words)."""
        padded = F.pad(words, (_N_NEIGHBORS, _N_NEIGHBORS), value=NO_WORD)
        logits = self.own(words)[..., 0]
        distances = [n for n in range(-_N_NEIGHBORS, _N_NEIGHBORS + 1) if n]
        for table, distance in zip(self.neighbors, distances, strict=True):
            first = _N_NEIGHBORS + distance
            logits = logits + table(padded[:, first : first + words.shape[1]])[..., 0]
        return torch.sigmoid(_LEARNING_SPEED * logits) * (words != NO_WORD)


class InstructionEncoder(nn.Module):
    """Embeds instructions as weighted sums of their words' vectors.

    Args:
        n_words: Size of the vocabulary.
    """

    def __init__(self, n_words: int) -> None:
        super().__init__()
        self.weights = WordWeights(n_words)
        self.vectors = nn.Embedding(n_words + _N_SPECIAL, INSTRUCTION_DIM)
        nn.init.normal_(self.vectors.weight, std=_WORD_STD / _LEARNING_SPEED)

    def forward(self, words: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Embeds sentences, (batch, INSTRUCTION_DIM); zeros for an empty one.

        Args:
            words: Indices of the words, (batch, words).
            generator: In training, source of the draws of words that are left out, on the CPU.
        """
        if generator is not None:
            dropped = torch.rand(words.shape, generator=generator).to(words.device) < _P_DROP_WORD
            words = torch.where(dropped & (words != NO_WORD), UNKNOWN_WORD, words)
        vectors = _LEARNING_SPEED * self.vectors(words) * (words > UNKNOWN_WORD)[..., None]
        return torch.einsum("bw,bwd->bd", self.weights(words), vectors)
