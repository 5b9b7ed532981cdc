"""Without PyBullet, tasks and layouts work, and the environment says what to install."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import sys
{before}
import gymnasium, gym_deltaco
from gym_deltaco import chance, layout, object_sets, scene_config, seeding, tasks, workspace
assert not {{"torch", "lerobot", "pybullet"}} & {{name for name, module in sys.modules.items() if module}}
try:
    gymnasium.make(gym_deltaco.ENV_ID)
except ImportError as error:
    assert error.name == "pybullet", error.name
    print(error)
"""


@pytest.mark.parametrize(
    ("before", "message"),
    [
        (
            "sys.modules['pybullet'] = None",
            'not installed. Install it with `pip install "lerobot_policy_deltaco[sim]"`',
        ),
        ("", "is installed, but does not load: libfoo.so is missing. Build it again"),
    ],
)
def test_missing_or_broken_pybullet_is_an_error_that_says_what_to_do(tmp_path, before, message):
    (tmp_path / "pybullet.py").write_text("raise ImportError('libfoo.so is missing')")
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    command = [sys.executable, "-c", PROGRAM.format(before=before)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert message in result.stdout
