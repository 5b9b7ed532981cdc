"""The commands answer quickly, and end with one line when something is wrong."""

import argparse
import re
import subprocess
import sys
from importlib.metadata import distribution

import pytest

from gym_deltaco.errors import SimulatorMissingError
from lerobot_deltaco.commands.command_errors import exit_on_error

# Packages that take a second or more to import; `benchmarks/minute.py` measures how long each command takes.
SLOW_PACKAGES = {
    *("av", "datasets", "lerobot", "matplotlib", "pandas", "pyarrow", "pybullet", "scipy"),
    *("sentence_transformers", "sklearn", "torch", "torchvision", "transformers"),
}
# `deltaco-train --help` is LeRobot's, which takes 10 s.
COMMANDS = sorted(
    (script.name, script.value.partition(":")[0])
    for script in distribution("lerobot_policy_deltaco").entry_points
    if script.group == "console_scripts" and script.name != "deltaco-train"
)
HELP = """
import runpy, sys
sys.argv = [{name!r}, "--help"]
try:
    runpy.run_module({module!r}, run_name="__main__")
except SystemExit:
    pass
print("SLOW", *sorted({packages} & set(sys.modules)))
"""


@pytest.mark.parametrize(("name", "module"), COMMANDS, ids=[name for name, _ in COMMANDS])
def test_help_is_quick_and_complete(name, module):
    result = subprocess.run(
        [sys.executable, "-c", HELP.format(name=name, module=module, packages=SLOW_PACKAGES)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"usage: {name}" in result.stdout
    assert result.stderr == ""
    assert re.search(r"^SLOW$", result.stdout, re.MULTILINE)
    # Every argument is explained.
    options = result.stdout.partition("options:")[2].partition("SLOW")[0]
    for paragraph in re.split(r"\n(?=  -)", options)[1:]:
        assert re.search(r"\S  +\S|\n {10,}\S", paragraph.strip()), paragraph


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (ValueError("wrong"), 1, "deltaco: wrong\n"),
        (SimulatorMissingError("no simulator"), 1, "deltaco: no simulator\n"),
        (KeyboardInterrupt(), 130, "\ndeltaco: Interrupted. Run the same command again to continue.\n"),
    ],
    ids=["an error", "no simulator", "an interrupt"],
)
def test_an_error_that_a_user_can_act_on_is_one_line(error, status, message, capsys):
    with pytest.raises(SystemExit) as caught, exit_on_error(argparse.ArgumentParser("deltaco"), ValueError):
        raise error
    assert caught.value.code == status
    assert capsys.readouterr().err == message


def test_a_bug_shows_its_traceback():
    with pytest.raises(TypeError), exit_on_error(argparse.ArgumentParser("deltaco"), ValueError):
        raise TypeError


def test_a_system_without_file_locks_is_told_so(tmp_path):
    code = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from lerobot_deltaco.commands.collect import main\n"
        "main(['--tasks', '4', '--episodes-per-task', '1', '--root', 'new'])"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1
    assert result.stderr.startswith("deltaco-collect: Collecting datasets needs file locks of POSIX systems")
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "new").exists()
