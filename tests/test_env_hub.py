"""`envhub/` works with LeRobot's own loader of environments on the Hub."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_hub import USER, FakeHub, Repo
from huggingface_hub import ModelCard
from lerobot.envs import close_envs
from lerobot.envs.utils import _call_make_env, _load_module_from_path, _normalize_hub_result

from gym_deltaco.tasks import TASK_SETS

FOLDER = Path(__file__).parents[1] / "envhub"


@pytest.mark.parametrize(
    ("cfg", "tasks"), [(None, TASK_SETS["scenario_a_test"]), (SimpleNamespace(task="4,32"), (4, 32))]
)
def test_the_file_makes_the_tasks(cfg, tasks, tmp_path):
    copy = tmp_path / "env.py"
    copy.write_bytes((FOLDER / "env.py").read_bytes())
    module = _load_module_from_path(str(copy))
    envs = _normalize_hub_result(_call_make_env(module, 1, False, cfg))
    assert {task for group in envs.values() for task in group} == set(tasks)
    close_envs(envs)


@pytest.mark.slow
def test_lerobot_loads_it_from_the_hub(tmp_path):
    with FakeHub() as hub:
        repo = hub.repos["model", f"{USER}/deltaco"] = Repo("public")
        repo.commit("main", {path.name: path.read_bytes() for path in FOLDER.iterdir() if path.is_file()})
        code = (
            "from lerobot.envs import close_envs, make_env; "
            f"envs = make_env('{USER}/deltaco', trust_remote_code=True); "
            "print({kind: len(group) for kind, group in envs.items()}); close_envs(envs)"
        )
        result = subprocess.run(
            [sys.executable, "-c", code], env=hub.environment(tmp_path), capture_output=True, text=True
        )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "{'name': 48, 'color': 24, 'shape': 30}"


def test_the_card_is_tagged():
    card = ModelCard.load(FOLDER / "README.md")
    assert {"lerobot", "envhub", "robotics"} <= set(card.data.tags)
    assert "lerobot_policy_deltaco[sim]" in (FOLDER / "requirements.txt").read_text()
