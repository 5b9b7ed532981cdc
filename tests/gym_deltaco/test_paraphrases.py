"""Sentences for the tasks: CSV files that people wrote, and the grammar."""

import difflib

import pytest

from gym_deltaco.paraphrases import GRAMMAR, choose_instructions, read_paraphrases, write_training_sentences
from gym_deltaco.tasks import ALL_TASKS, TASKS, get_task
from lerobot_deltaco.policies.base.sentences import read_sentences

OURS = """task_id,instruction
4,move the speckled hourglass into the green box
4,"the dumbbel, please, to the green one"
90,dropp the round  thing at the front
4,Move the speckled hourglass into the GREEN box
"""
AUTHORS = ",Task ID,Instruction\r\n0,90,hourglass to green \r\n1,4,ring to the front\r\n"
SHARED = "task_id,instruction\n0,a\n0,b\n0,c\n1,C\n1,d\n1,e\n2,e\n"


def write(path, text):
    path.write_text(text, encoding="utf-8", newline="")
    return path


def test_both_formats_are_read(tmp_path):
    ours = read_paraphrases(write(tmp_path / "ours.csv", "\ufeff" + OURS))
    assert ours == {
        4: ("move the speckled hourglass into the green box", "the dumbbel, please, to the green one"),
        90: ("dropp the round thing at the front",),
    }
    authors = read_paraphrases(write(tmp_path / "authors.csv", AUTHORS))
    assert list(authors.items()) == [(4, ("ring to the front",)), (90, ("hourglass to green",))]


def test_held_out_sentences_are_not_trained_on(tmp_path):
    path = write(tmp_path / "shared.csv", SHARED)
    assert read_paraphrases(path, "held_out") == {0: ("c",), 1: ("e",), 2: ("e",)}
    assert read_paraphrases(path, "train") == {0: ("a", "b"), 1: ("d",)}
    assert read_paraphrases(path, "all") == {0: ("a", "b", "c"), 1: ("C", "d", "e"), 2: ("e",)}
    with pytest.raises(ValueError, match=r"one of all, train, held_out\. Got 'test'"):
        read_paraphrases(path, "test")


def test_invalid_file_is_an_error_that_names_the_line(tmp_path):
    for text, message in [
        ("", "line 1: expected the columns task_id,instruction or"),
        ("4,a sentence\n", r"line 1: .* Got '4,a sentence'"),
        ("task_id,instruction\n", "has no instructions"),
        ("task_id,instruction\n4,put, it\n", r"line 2: expected 2 columns\. Got 3"),
        ("task_id,instruction\n4,a\n300,b\n", r"line 3: .*from 0 to 299.* Got 300"),
        ("task_id,instruction\nfour,a\n", r"line 2: .*from 0 to 299.* Got 'four'"),
        ("task_id,instruction\n4,  \n", "line 2: the instruction is empty"),
        ('task_id,instruction\n4,"put it\n', "line 2: "),
    ]:
        path = write(tmp_path / "mine.csv", text)
        with pytest.raises(ValueError, match=f"mine.csv.*{message}"):
            read_paraphrases(path)
    # So is a file that cannot be read.
    (tmp_path / "latin.csv").write_bytes("task_id,instruction\n4,caf\xe9\n".encode("latin-1"))
    for path in (tmp_path / "missing.csv", tmp_path / "latin.csv", tmp_path):
        with pytest.raises(ValueError, match=f"Cannot read the paraphrases {path}"):
            read_paraphrases(path)


def test_instructions_are_templates_a_file_or_one_sentence(tmp_path):
    path = write(tmp_path / "shared.csv", SHARED)
    assert choose_instructions([0, 1]) is None
    assert choose_instructions([1], path, "held_out") == {1: ("e",)}
    chosen = choose_instructions([4, 0], instruction=" put it  there ")
    assert chosen == {4: ("put it there",), 0: ("put it there",)}
    with pytest.raises(ValueError, match=r"no instruction for task 2 \('Put .*'\) and 1 more tasks"):
        choose_instructions([0, 2, 3], path, "train")
    with pytest.raises(ValueError, match="not both"):
        choose_instructions([0], path, instruction="go")
    with pytest.raises(ValueError, match="It is empty"):
        choose_instructions([0], instruction=" ")


def test_training_takes_sentences_by_task_string(tmp_path):
    instructions = [get_task(task_id).instruction for task_id in (0, 1, 4)]

    def written(source):
        write_training_sentences(tmp_path / "sentences.csv", source, (0, 1, 4))
        return read_sentences(tmp_path / "sentences.csv")

    shared = written(write(tmp_path / "shared.csv", SHARED))
    assert shared == {instructions[0]: ("a", "b"), instructions[1]: ("d",)}
    grammar = written(GRAMMAR)
    assert list(grammar) == instructions
    assert grammar[instructions[2]] == read_paraphrases(GRAMMAR, "train", [4])[4]


# The grammar


@pytest.fixture(scope="module")
def sentences():
    return {split: read_paraphrases(GRAMMAR, split) for split in ("train", "held_out", "all")}


def test_every_task_has_sentences_of_both_splits(sentences):
    for split in ("train", "held_out"):
        assert list(sentences[split]) == [n for n, task in ALL_TASKS.items() if task.object.index is None]
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
                name = task.object.name.split()
                assert all(difflib.get_close_matches(word, words, 1, 0.6) for word in name), sentence
            if not task.is_position_task and task.kind == "shape":
                other = {"green": "red", "red": "green"}[task.container]
                assert other not in words
