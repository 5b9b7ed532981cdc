"""Paraphrases from the benchmark's phrases."""

import difflib

import pytest

from gym_deltaco.tasks import COLOR_SHAPE_TASKS, TASKS
from lerobot_deltaco.data.paraphrases import GRAMMAR, read_paraphrases


@pytest.fixture(scope="module")
def sentences():
    return {split: read_paraphrases(GRAMMAR, split) for split in ("train", "held_out", "all")}


def test_every_task_has_sentences_of_both_splits(sentences):
    for split in ("train", "held_out"):
        assert list(sentences[split]) == [task.index for task in (*TASKS, *COLOR_SHAPE_TASKS)]
        assert all(len(own) >= 4 for own in sentences[split].values())
    assert all(own == sentences["train"][n] + sentences["held_out"][n] for n, own in sentences["all"].items())
    distinct = {sentence for own in sentences["train"].values() for sentence in own}
    assert len(distinct) > 4000
    assert not any("True" in sentence.split() for sentence in distinct)  # "on", as YAML reads it
    assert not distinct & {sentence for own in sentences["held_out"].values() for sentence in own}


def test_sentences_name_what_the_task_asks_for(sentences):
    """Up to typing errors, a sentence by name has the name, and none has another container's color."""
    for task in TASKS[: len(TASKS) // 3]:
        for sentence in (*sentences["train"][task.index], *sentences["held_out"][task.index]):
            words = sentence.lower().rstrip(".!").replace(",", "").split()
            assert "{" not in sentence
            if task.kind == "name":
                name = task.object_phrase.split(" shaped ")[1].split()
                assert all(difflib.get_close_matches(word, words, 1, 0.6) for word in name), sentence
            if not task.is_position_task and task.kind == "shape":
                other = {"green": "red", "red": "green"}[task.container]
                assert other not in words
