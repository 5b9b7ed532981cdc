"""`envhub/` works with LeRobot's own loader of environments on the Hub."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from fake_hub import USER, FakeHub, Repo
from huggingface_hub import ModelCard
from lerobot.envs import close_envs
from lerobot.envs.utils import _call_make_env, _load_module_from_path, _normalize_hub_result

from gym_deltaco.tasks import TASK_SETS, TASKS
from lerobot_deltaco.envs.configuration_env import DeltacoEnv

FOLDER = Path(__file__).parents[1] / "envhub"
FILES = sorted(FOLDER.glob("*.py"))


def load(path, tmp_path, n_envs=1, cfg=None):
    """What LeRobot makes of a file, of which it has a copy elsewhere."""
    copy = tmp_path / path.name
    copy.write_bytes(path.read_bytes())
    module = _load_module_from_path(str(copy))
    return _normalize_hub_result(_call_make_env(module, n_envs, False, cfg))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_makes_the_tasks_that_it_is_named_after(path, tmp_path):
    envs = load(path, tmp_path)
    try:
        assert all(TASKS[index].kind == kind for kind, group in envs.items() for index in group)
        made = {index for group in envs.values() for index in group}
        assert made == set(TASK_SETS["scenario_a_test" if path.stem == "env" else path.stem])
    finally:
        close_envs(envs)


def test_an_environment_from_the_hub_runs(tmp_path):
    envs = load(FOLDER / "env.py", tmp_path, n_envs=2)
    try:
        env = envs["name"][24]
        observation, _ = env.reset(seed=0)
        assert observation["pixels"].shape == (2, 48, 48, 3)
        assert env.call("task_description") == (TASKS[24].instruction,) * 2
        _, rewards, _, _, info = env.step(env.action_space.sample())
        assert rewards.shape == (2,)
        assert not info["is_success"].any()
    finally:
        close_envs(envs)


def test_a_configuration_takes_precedence_over_the_file(tmp_path):
    envs = load(FOLDER / "env.py", tmp_path, cfg=DeltacoEnv(task="4", image_size=32))
    try:
        assert {kind: list(group) for kind, group in envs.items()} == {"name": [4]}
        assert envs["name"][4].single_observation_space["pixels"].shape == (32, 32, 3)
    finally:
        close_envs(envs)


def test_less_than_one_environment_is_refused(tmp_path):
    with pytest.raises(ValueError, match="`n_envs` must be at least 1. Got 0"):
        load(FOLDER / "env.py", tmp_path, n_envs=0)


@pytest.mark.slow  # a process that imports LeRobot
def test_lerobot_loads_a_file_by_the_repositorys_id(tmp_path):
    with FakeHub() as hub:
        repo = hub.repos["model", f"{USER}/deltaco"] = Repo("public")
        repo.commit("main", {path.name: path.read_bytes() for path in FOLDER.iterdir() if path.is_file()})
        code = (
            "from lerobot.envs import close_envs, make_env; "
            f"envs = make_env('{USER}/deltaco:scenario_b_test.py', trust_remote_code=True); "
            "print({kind: len(group) for kind, group in envs.items()}); close_envs(envs)"
        )
        result = subprocess.run(
            [sys.executable, "-c", code], env=hub.environment(tmp_path), capture_output=True, text=True
        )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "{'color': 24, 'shape': 30}"


def test_the_card_lists_every_file_and_is_tagged():
    card = ModelCard.load(FOLDER / "README.md")
    assert {"lerobot", "envhub", "robotics"} <= set(card.data.tags)
    assert set(re.findall(r"^\| `(\w+\.py)` \|", card.text, re.MULTILINE)) == {path.name for path in FILES}
    assert "lerobot_policy_deltaco[sim]" in (FOLDER / "requirements.txt").read_text()
