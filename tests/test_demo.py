"""The demo: its recipe makes sense, each step is done once, and it leaves a page and a summary."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from importlib import import_module
from importlib.util import find_spec

import pytest
import torch
from PIL import Image
from small_policies import REPO_ID, TASKS, use_fake_encoder, write_dataset

from gym_deltaco.tasks import get_task
from lerobot_deltaco.demo import commands, machine, preloaded, recipe
from lerobot_deltaco.demo import steps as demo_steps
from lerobot_deltaco.demo.commands import Command, deltaco, lerobot, run
from lerobot_deltaco.demo.machine import seconds_per_step
from lerobot_deltaco.demo.page import write_page
from lerobot_deltaco.demo.steps import Demo, DemoError


def test_new_combinations_are_of_trained_objects_and_containers():
    trained = [get_task(index) for index in recipe.TRAINED_TASKS]
    assert set(recipe.NEW_COMBINATIONS).isdisjoint(recipe.TRAINED_TASKS)
    assert len(trained) == 9
    for index in recipe.NEW_COMBINATIONS:
        task = get_task(index)
        assert any(task.row == other.row for other in trained)
        assert any(task.container == other.container for other in trained)


@pytest.fixture
def demo(tmp_path, monkeypatch):
    """A demo on a machine whose faster number format is known, since measuring it takes seconds."""
    monkeypatch.setattr(demo_steps, "fast_dtype", lambda: "float32")
    return Demo(tmp_path / "demo")


@pytest.fixture
def greet(tmp_path, monkeypatch):
    """Makes commands that greet, each time they run, on their output and in a file, and end with a status."""
    (tmp_path / "greeting.py").write_text(
        "import sys\n"
        "def main():\n"
        "    print('hello')\n"
        "    with open(sys.argv[1], 'a') as file:\n"
        "        file.write('x')\n"
        "    sys.exit(int(sys.argv[2]))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    return lambda file, status=0: Command("greeting", (str(file), str(status)))


def test_a_command_has_an_output_and_a_status_of_its_own(greet, tmp_path):
    log = tmp_path / "log.txt"
    assert run(greet(tmp_path / "file", 3), log) == 3
    assert log.read_text() == "hello\n"
    assert str(greet("a file")) == "python -m greeting 'a file' 0"


def test_a_command_has_a_number_of_threads(tmp_path, monkeypatch):
    program = (
        "import os, torch\ndef main():\n    print(torch.get_num_threads(), os.environ['OMP_NUM_THREADS'])\n"
    )
    (tmp_path / "count_threads.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    log = tmp_path / "log.txt"
    assert run(Command("count_threads", ()), log, threads=3) == 0
    assert log.read_text() == "3 3\n"


def test_commands_that_run_in_several_threads_each_have_their_own_status(greet, tmp_path):
    statuses = [status % 3 for status in range(48)]
    with ThreadPoolExecutor(4) as threads:
        runs = [
            threads.submit(run, greet(tmp_path / "file", status), tmp_path / f"{number}.txt")
            for number, status in enumerate(statuses)
        ]
        assert [each.result() for each in runs] == statuses


def test_a_command_that_a_signal_ends_or_that_does_not_exist_has_failed(tmp_path, monkeypatch):
    (tmp_path / "killed.py").write_text(
        "import os, signal\ndef main(): os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    log = tmp_path / "log.txt"
    assert run(Command("killed", ()), log) == -signal.SIGKILL
    assert run(Command("no_such_command", ()), log) == 1
    assert "No module named 'no_such_command'" in log.read_text()


@pytest.fixture
def interrupted(tmp_path):
    """Interrupts a demo, as Ctrl-C does, that runs a command, once a file is there; returns its errors."""

    def interrupt(preloaded, command, file):
        (tmp_path / "preloaded.py").write_text(preloaded)
        (tmp_path / "command.py").write_text(command)
        program = (
            "import signal, sys\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            "sys.path.insert(0, '.')\n"
            "from lerobot_deltaco.demo import commands\n"
            "commands._PRELOADED = 'preloaded'\n"
            "commands.start_imports()\n"
            "commands.run(commands.Command('command', ()))\n"
        )
        options = {"cwd": tmp_path, "start_new_session": True, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen([sys.executable, "-c", program], **options) as demo:
            end = time.monotonic() + 60
            while not (tmp_path / file).exists():
                assert time.monotonic() < end
                assert demo.poll() is None
                time.sleep(0.05)
            os.killpg(demo.pid, signal.SIGINT)
            # To the end of all processes that have it.
            return demo.communicate(timeout=60)[1]

    return interrupt


def test_an_interrupted_command_has_time_to_clean_up(tmp_path, interrupted):
    command = (
        "import time\n"
        "from pathlib import Path\n"
        "def main():\n"
        "    try:\n"
        "        Path('running').touch()\n"
        "        time.sleep(60)\n"
        "    except KeyboardInterrupt:\n"
        "        time.sleep(0.5)\n"
        "        Path('clean').touch()\n"
        "        raise SystemExit(130)\n"
    )
    errors = interrupted("", command, "running")
    assert (tmp_path / "clean").exists()
    assert errors.count("Traceback") == 1  # the demo's own


def test_no_command_starts_after_an_interrupt_during_the_imports(tmp_path, interrupted):
    preloaded = "import time\nfrom pathlib import Path\nPath('importing').touch()\ntime.sleep(2)\n"
    command = "from pathlib import Path\ndef main():\n    Path('running').touch()\n"
    errors = interrupted(preloaded, command, "importing")
    assert not (tmp_path / "running").exists()
    assert errors.count("Traceback") == 1


def test_what_is_imported_beforehand_exists():
    # Imports that fail there are left to the commands, so that a wrong name would go unnoticed.
    assert all(find_spec(name) is not None for name in preloaded.NAMES)
    assert find_spec(commands._PRELOADED) is not None


def test_the_demos_commands_have_a_function_that_runs_them():
    for command in (deltaco("collect"), deltaco("train"), deltaco("evaluate"), lerobot("eval")):
        assert callable(import_module(command.module).main)


def test_a_step_is_done_once(demo, greet, tmp_path, capsys):
    file = tmp_path / "greetings"
    for again in (demo, Demo(demo.folder)):
        again._do("greet", "Greeting", greet(file))
    assert file.read_text() == "x"
    assert "Greeting: done before" in capsys.readouterr().out
    assert demo.seconds()["greet"] > 0


def test_a_failed_step_is_named_and_done_again(demo, greet, tmp_path):
    with pytest.raises(DemoError, match="(?s)Greeting failed .exit status 3.*it continues from here"):
        demo._do("greet", "Greeting", greet(tmp_path / "greetings", 3))
    first = demo.seconds()
    assert "greet" not in first
    demo._do("greet", "Greeting", greet(tmp_path / "greetings"))
    # The time of the attempt that failed is counted too.
    assert demo.seconds()["greet"] > first["greet_so_far"]


def test_steps_that_run_together_are_done_once_and_each_has_a_log(demo, greet, tmp_path):
    file = tmp_path / "greetings"
    commands = {"greet": greet(file), "fail": greet(tmp_path / "others", 3)}
    with pytest.raises(DemoError, match="(?s)fail failed .exit status 3.*logs/fail.txt.*continues from here"):
        demo._do_together("both", "Both", commands)
    assert "both" not in demo.seconds()
    commands["fail"] = greet(tmp_path / "others")
    for again in (demo, Demo(demo.folder)):
        again._do_together("both", "Both", commands)
    assert demo.seconds()["both"] > demo.seconds()["greet"]
    assert file.read_text() == "x"
    assert (demo.folder / "logs" / "greet.txt").read_text().startswith("hello")


def test_a_demo_with_other_settings_is_not_mixed_with_this_one(demo):
    with pytest.raises(DemoError, match="other settings. Move that folder away"):
        Demo(demo.folder, {"steps": 1})


def test_the_number_format_is_measured(monkeypatch):
    monkeypatch.setattr(machine, "_BATCH_SIZE", 2)
    assert machine.fast_dtype() in ("float32", "bfloat16")
    for seconds, chosen in ((0.5, "bfloat16"), (0.95, "float32"), (2, "float32")):
        times = {torch.float32: 1, torch.bfloat16: seconds}
        monkeypatch.setattr(machine, "_seconds", times.__getitem__)
        assert machine.fast_dtype() == chosen


def test_the_number_format_is_chosen_once(demo, monkeypatch):
    assert demo.settings["policy"]["dtype"] == "float32"
    monkeypatch.setattr(demo_steps, "fast_dtype", lambda: "bfloat16")
    assert Demo(demo.folder).settings["policy"]["dtype"] == "float32"
    assert Demo(demo.folder.with_name("new")).settings["policy"]["dtype"] == "bfloat16"


@pytest.mark.parametrize(
    ("seconds", "steps"),
    [(0.05, recipe.TRAINING_SECONDS * 20), (9.0, recipe.LEAST_STEPS), (1e-3, recipe.MOST_STEPS)],
)
def test_the_number_of_training_steps_fits_the_machine_and_is_chosen_once(demo, monkeypatch, seconds, steps):
    done = []
    monkeypatch.setattr(Demo, "_do", lambda self, name, what, command: done.append(command))
    monkeypatch.setattr(demo_steps, "seconds_per_step", lambda *arguments: seconds)
    demo.train()
    monkeypatch.setattr(demo_steps, "seconds_per_step", lambda *arguments: 12345.0)
    again = Demo(demo.folder)
    again.train()
    assert again.settings["steps"] == steps
    assert done[0] == done[1]
    assert f"--steps={steps}" in done[0].arguments


class Page(HTMLParser):
    """What a page refers to."""

    def __init__(self, text):
        super().__init__()
        self.files = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.files += [value for name, value in attrs if name in ("src", "href")]


def test_a_step_of_the_training_is_timed(tmp_path, monkeypatch):
    use_fake_encoder(monkeypatch)
    dataset = write_dataset(tmp_path / "data", [task for task in TASKS for _ in range(2)])
    options = {"type": "deltaco", "device": "cpu", "image_size": 16, "backbone": "strided"}
    assert 0 < seconds_per_step(REPO_ID, dataset.root, options, 6) < 60


@pytest.mark.slow
def test_the_whole_demo_at_a_tiny_size(tmp_path):
    settings = {
        "tasks": [34, 36, 82],
        "new_combinations": [84],
        "episodes_per_task": 2,
        "steps": 4,
        "save_every": 2,
        "batch_size": 6,
        "trials": {"trained": 1, "new": 2},
        "counterfactual_trials": 1,
    }
    demo = Demo(tmp_path / "demo", settings)
    for step in (demo.collect, demo.train, demo.evaluate):
        step()
    page = write_page(demo)
    summary = json.loads((demo.folder / "summary.json").read_text())
    assert set(summary) == {
        *("success_rate", "success_rate_new_combinations", "chance", "episodes", "minutes")
    }
    assert summary["episodes"] == 5
    assert summary["chance"] == pytest.approx(1 / 6)
    assert 0 <= summary["success_rate"] <= 1
    assert summary["minutes"] > 0
    files = Page(page.read_text()).files
    assert len(files) == 2 * 4 + 1
    for name in files:
        assert (demo.folder / name).is_file()
        if name.endswith(".png"):
            assert Image.open(demo.folder / name).width > 600
    # Everything is done: nothing runs again.
    before = demo.seconds()
    for step in (demo.collect, demo.train, demo.evaluate):
        step()
    assert demo.seconds() == before
