"""Instructions written by people: files, splits, the environment and the command that fetches them."""

import threading
from contextlib import closing
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.instructions import (
    InstructionsError,
    by_task,
    check_tasks,
    parse_instructions,
    read_instructions,
    split_instructions,
)
from gym_deltaco.tasks import N_TASKS, get_task
from lerobot_deltaco.commands.instructions import main
from lerobot_deltaco.data import authors_instructions

OURS = """task_id,instruction
4,move the speckled hourglass into the green box
4,"the dumbbel, please, to the green one"
90,dropp the round  thing at the front
4,Move the speckled hourglass into the GREEN box
"""
AUTHORS = ",Task ID,Instruction\r\n0,4,hourglass to green \r\n1,90,ring to the front\r\n"


def test_both_formats_are_read(tmp_path):
    (tmp_path / "ours.csv").write_text("\ufeff" + OURS, encoding="utf-8")
    (tmp_path / "authors.csv").write_text(AUTHORS, newline="")
    assert read_instructions(tmp_path / "ours.csv") == {
        4: ("move the speckled hourglass into the green box", "the dumbbel, please, to the green one"),
        90: ("dropp the round thing at the front",),
    }
    assert read_instructions(tmp_path / "authors.csv") == {
        4: ("hourglass to green",),
        90: ("ring to the front",),
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must begin with a line that names the columns"),
        ("4,a sentence\n", "begins with '4,a sentence'"),
        ("task_id,instruction\n", "has no instructions"),
        ("task_id,instruction\n4,put, it\n", r"line 2: there must be 2 columns. Got 3"),
        ("task_id,instruction\n4,a\n300,b\n", r"line 3: .*from 0 to 299. Got 300"),
        ("task_id,instruction\nfour,a\n", r"line 2: .*from 0 to 299. Got 'four'"),
        ("task_id,instruction\n4,  \n", "line 2: the instruction is empty"),
        ('task_id,instruction\n4,"put it\n', "line 2: "),
    ],
)
def test_other_files_are_refused_with_the_line(text, message):
    with pytest.raises(InstructionsError, match=message):
        parse_instructions(text, "mine.csv")


def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / "latin.csv").write_bytes("task_id,instruction\n4,caf\xe9\n".encode("latin-1"))
    for path in (tmp_path / "missing.csv", tmp_path / "latin.csv", tmp_path):
        with pytest.raises(InstructionsError, match=f"{path} cannot be read"):
            read_instructions(path)


def test_no_held_out_sentence_is_trained_on():
    sentences = by_task([(0, "a"), (0, "b"), (0, "c"), (1, "C"), (1, "d"), (1, "e"), (2, "e")])
    held_out = split_instructions(sentences, "held_out")
    train = split_instructions(sentences, "train")
    assert held_out == {0: ("c",), 1: ("e",), 2: ("e",)}
    assert train == {0: ("a", "b"), 1: ("d",)}
    assert split_instructions(sentences, "all") == sentences
    with pytest.raises(ValueError, match="must be one of all, train, held_out. Got 'test'"):
        split_instructions(sentences, "test")


def test_a_task_without_a_sentence_is_named():
    check_tasks({0: ("a",)}, [0], "mine.csv")
    with pytest.raises(
        InstructionsError, match=r"mine.csv has no instruction for task 4 \('Put black.* and 1 others"
    ):
        check_tasks({0: ("a",)}, [0, 4, 5], "mine.csv")


# The environment


@pytest.fixture
def env():
    sentences = {4: tuple(f"sentence {n}" for n in range(5)), 90: ("only one",)}
    with closing(PickPlaceEnv(4, image_size=8, instructions=sentences)) as env:
        yield env


def test_an_episode_has_one_of_its_tasks_sentences_by_its_seed(env):
    instructions = []
    for seed in [*range(20), *range(20)]:
        env.reset(seed=seed)
        instructions.append(env.task_description)
    assert instructions[:20] == instructions[20:]
    assert set(instructions) == set(env.instructions[4])
    env.reset(seed=0, options={"task_id": 90})
    assert env.task_description == "only one"


def test_scenes_are_the_same_with_other_words(env):
    with closing(PickPlaceEnv(4, image_size=8)) as plain:
        for seed in (0, None, None):
            observation, _ = env.reset(seed=seed)
            expected, _ = plain.reset(seed=seed)
            np.testing.assert_array_equal(observation["pixels"], expected["pixels"])
            assert plain.task_description == plain.task.instruction


def test_an_episode_of_a_task_without_sentences_is_refused(env):
    env.reset(seed=0)
    instructions = env.task_description
    with pytest.raises(InstructionsError, match="no instruction for task 5"):
        env.reset(options={"task_id": 5})
    assert (env.task.index, env.task_description) == (4, instructions)


# The command


class Answers(BaseHTTPRequestHandler):
    def __init__(self, content, status, *args):
        self.content, self.status = content, status
        super().__init__(*args)

    def do_GET(self):  # noqa: N802
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(self.content)

    def log_message(self, *_):
        """Says nothing."""


@pytest.fixture
def serve():
    """Serves a content at the address that is returned."""
    servers = []

    def start(content, status=200):
        server = HTTPServer(("127.0.0.1", 0), partial(Answers, content, status))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}/all_human_data.csv"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def five_each(n_tasks=N_TASKS):
    rows = [f"{5 * task + n},{task},words {n} of {task}" for task in range(n_tasks) for n in range(5)]
    return "\n".join([",Task ID,Instruction", *rows]).encode()


def test_the_authors_file_is_fetched_and_checked(serve, tmp_path, capsys):
    file = tmp_path / "new" / "human.csv"
    main(["--url", serve(five_each()), "--out", str(file)])
    assert file.read_bytes() == five_each()
    assert capsys.readouterr().out.splitlines()[1:] == [
        "  all: 1500 of 300 tasks",
        "  train: 1200 of 300 tasks",
        "  held_out: 300 of 300 tasks",
    ]
    with pytest.raises(SystemExit):
        main(["--url", "http://127.0.0.1:1", "--out", str(file)])
    assert "already exists" in capsys.readouterr().err
    main(["--check", str(file)])
    assert "all: 1500 of 300 tasks" in capsys.readouterr().out


def test_bare_names_are_written_for_ambiguity_scheme_ii(tmp_path, capsys):
    file = tmp_path / "bare.csv"
    main(["--bare-names", "--out", str(file)])
    assert "all: 300 of 300 tasks" in capsys.readouterr().out
    sentences = read_instructions(file)
    assert sentences[4] == ("Put smushed dumbbell in green bin.",)
    assert sentences[132] == (get_task(132).instruction,)
    assert len(set(sentences.values())) == N_TASKS


@pytest.mark.parametrize(
    ("content", "status", "message"),
    [
        (five_each(299), 200, "has 1495 in all, and 0 for task 299"),
        (five_each() + b"\n1500,1000,words", 200, "for task 1000. The authors' tasks are 0 to 299."),
        (b"<html>", 200, "must begin with a line that names the columns"),
        (b"\xff\xfe\x00", 200, "is no text in UTF-8"),
        (b"gone", 404, "the server answers 404 Not Found"),
        (b" " * 2000, 200, "over 1,000 bytes"),
    ],
    ids=["too few", "another task", "a page", "no text", "gone", "too large"],
)
def test_what_is_no_such_file_is_not_written(serve, tmp_path, capsys, monkeypatch, content, status, message):
    if "bytes" in message:
        monkeypatch.setattr(authors_instructions, "MAX_BYTES", 1000)
    with pytest.raises(SystemExit) as exit_:
        main(["--url", serve(content, status), "--out", str(tmp_path / "human.csv")])
    assert exit_.value.code == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("url", ["http://127.0.0.1:1/file.csv", "http://no such host/", "gopher"])
def test_without_a_network_the_way_out_is_named(tmp_path, capsys, url):
    with pytest.raises(SystemExit) as exit_:
        main(["--url", url, "--out", str(tmp_path / "human.csv")])
    assert exit_.value.code == 1
    error = capsys.readouterr().err
    assert "cannot be downloaded" in error
    assert "Traceback" not in error
