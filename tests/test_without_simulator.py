"""Without PyBullet, a policy trains and acts, and what needs the simulator says what to install."""

import os
import subprocess
import sys
from pathlib import Path

from fresh_python import run_python

PROGRAM = """
import sys

sys.modules["pybullet"] = None  # as if it were not installed
import gymnasium, pytest, torch
from small_policies import TASKS, batch_of, fake_encoder, observation, small_policy, write_dataset

import gym_deltaco, lerobot_policy_deltaco
from gym_deltaco import layout, object_sets, tasks, workspace
from gym_deltaco.errors import SimulatorMissingError
from lerobot_deltaco.commands import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.training.frames import FramesInMemory

instruction_table.load_language_encoder, fake_encoder.calls = fake_encoder, []
folder = sys.argv[1]
dataset = write_dataset(f"{folder}/foreign", [task for task in TASKS for _ in range(2)])
policy, before, after = small_policy(dataset, demo_repo_id="test/foreign", demo_root=f"{folder}/foreign")
assert len(FramesInMemory(dataset)) == len(dataset)
policy(before(batch_of(dataset, [0, 7, 12])))[0].backward()
policy.save_pretrained(f"{folder}/policy")
loaded = DeltacoPolicy.from_pretrained(f"{folder}/policy")
assert loaded.select_action(before(observation(dataset, TASKS))).shape == (3, 3)

CollectionPlan("4", 1)
for make in (lambda: DeltacoEnv().create_envs(1), lambda: gymnasium.make(gym_deltaco.ENV_ID)):
    with pytest.raises(SimulatorMissingError, match=r"pip install .lerobot_policy_deltaco\\[sim\\]"):
        make()
collect.main(["--tasks", "4", "--episodes-per-task", "1", "--root", f"{folder}/new"])
"""


def test_a_policy_needs_no_simulator_and_what_does_says_so(tmp_path):
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    result = run_python(PROGRAM, tmp_path, cwd=tmp_path.parent, env=environment)
    *_, last = result.stderr.strip().splitlines()
    assert result.returncode == 1, result.stderr
    assert last.startswith("deltaco-collect: The environment needs PyBullet")
    assert not (tmp_path / "new").exists()


def test_a_pybullet_that_does_not_load_is_told_from_one_that_is_missing(tmp_path):
    (tmp_path / "pybullet.py").write_text("raise ImportError('libfoo.so is missing')")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", "import gym_deltaco.simulation"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    last = result.stderr.splitlines()[-1]
    assert "PyBullet, which is installed, but does not load: libfoo.so is missing. Build it again" in last


def test_the_simulator_is_imported_without_a_standard_error():
    """As of a service that closes it."""
    program = "import gym_deltaco.quiet_pybullet as q; print(q.pybullet.isNumpyEnabled())"
    for closing in ("2>&-", "2>/dev/null"):
        command = ["sh", "-c", f'"$0" -c "$1" {closing}', sys.executable, program]
        result = subprocess.run(command, capture_output=True, text=True)
        assert (result.returncode, result.stdout) == (0, "1\n")
    program = "import sys; sys.stderr.close(); import gym_deltaco.quiet_pybullet"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
