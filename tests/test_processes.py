"""Processes of their own: results, errors, and an end with their parent."""

import os
import subprocess
import sys
import time

import psutil
import pytest

from lerobot_deltaco.atomic_files import only_writer
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.processes import call_in_new_process

PARENT = """
import time
from lerobot_deltaco.processes import call_in_new_process

if __name__ == "__main__":
    call_in_new_process(time.sleep, 100)
"""


def test_results_and_errors_come_back():
    assert call_in_new_process(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call_in_new_process(divmod, 7, 0)
    with pytest.raises(UserError, match="was killed; the memory may be full"):
        call_in_new_process(os._exit, 9)


def test_a_process_ends_when_its_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, script])
    children = wait_until(
        lambda: [
            child
            for child in psutil.Process(parent.pid).children()
            if "spawn_main" in " ".join(child.cmdline())
        ]
    )
    time.sleep(2)  # the process has begun to sleep
    parent.kill()
    parent.wait()
    assert wait_until(lambda: not any(map(psutil.Process.is_running, children)))


def wait_until(condition, seconds=60):
    """Waits until a condition holds, and returns it."""
    end = time.monotonic() + seconds
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.1)
    return value


def test_a_folder_has_one_writer_until_it_ends_in_whatever_way(tmp_path):
    program = (
        "import sys, time; from pathlib import Path; from lerobot_deltaco.atomic_files import only_writer"
    )
    program += "\nwith only_writer(Path(sys.argv[1])): print(flush=True); time.sleep(100)"
    writer = subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE)
    writer.stdout.readline()
    with pytest.raises(UserError, match=f"Another process is writing to {tmp_path}"), only_writer(tmp_path):
        pass
    writer.kill()
    writer.wait()
    with only_writer(tmp_path):
        assert not list(tmp_path.iterdir())
