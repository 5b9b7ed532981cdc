"""LeRobot finds the project, imports within it go one way, and the wheel holds all that it needs."""

import ast
import os
import runpy
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from fresh_python import run_python
from lerobot.envs import EnvConfig
from lerobot.policies import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GYM_FILES = sorted((ROOT / "envs" / "gym_deltaco").rglob("*.py"))
BASE = "lerobot_deltaco.policies.base"
LEROBOT_FILES = [*sorted((ROOT / "lerobot_deltaco").rglob("*.py")), ROOT / "lerobot_policy_deltaco.py"]


def imported_modules(path):
    """Yields the absolute names of the modules that a file imports, `from package import module` included."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files_of(folder):
    return sorted((ROOT / "lerobot_deltaco" / folder).rglob("*.py"))


def test_imports_go_one_way():
    above = {f"lerobot_deltaco.{name}" for name in ("collection", "training", "evaluation", "reports")}
    above |= {"lerobot_deltaco.experiments", "lerobot_deltaco.pages"}
    both = {"lerobot_deltaco.policies.deltaco", "lerobot_deltaco.policies.deltaco_match"}
    plain = [ROOT / "lerobot_deltaco" / "policies" / "base" / name for name in ("networks.py", "losses.py")]
    for files, forbidden in (
        (GYM_FILES, {"torch", "lerobot", "lerobot_deltaco", "lerobot_policy_deltaco"}),
        ([*GYM_FILES, *LEROBOT_FILES], {"lerobot_deltaco.cli"}),
        (LEROBOT_FILES, {"pybullet", "unittest"}),
        # A policy knows neither the benchmark nor what trains or evaluates it.
        (files_of("policies"), {"gym_deltaco", *above}),
        (files_of("data"), {"gym_deltaco", "lerobot_deltaco.policies", *above}),
        (files_of("policies/deltaco"), {"lerobot_deltaco.policies.deltaco_match"}),
        (files_of("policies/deltaco_match"), {"lerobot_deltaco.policies.deltaco"}),
        (files_of("policies/geometry"), {*both, "lerobot_deltaco.policies.scene"}),
        (files_of("policies/scene"), both),
        (files_of("collection"), {"torch", "lerobot_deltaco.evaluation", "lerobot_deltaco.pages"}),
        # Networks and losses take plain numbers.
        (plain, {"lerobot", f"{BASE}.configuration", f"{BASE}.modeling"}),
    ):
        assert files
        for path in files:
            for name in imported_modules(path):
                parents = {".".join(name.split(".")[:n]) for n in range(1, name.count(".") + 2)}
                assert parents.isdisjoint(forbidden), f"{path} imports {name}"


# Runs programs in processes of their own, of which each has imported LeRobot (10 s, once) and nothing else.
PROGRAMS = """
import os, sys
for name in ("transformers", "sentence_transformers", "onnxruntime", "tokenizers"):
    sys.modules[name] = None  # as if the extra `language` was not installed
import lerobot.envs, lerobot.policies
from lerobot.configs import PreTrainedConfig
for program in sys.argv[1:]:
    if os.fork() == 0:
        exec(program)
        print(*sys.modules, *PreTrainedConfig.get_known_choices(), flush=True)
        os._exit(0)
    assert os.wait()[1] == 0, program
"""
POLICY = "from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy"
ACT = f"""
import torch
from lerobot.policies import make_pre_post_processors
{POLICY}

folder = {str(ROOT / "checkpoints" / "pick_place")!r}
policy = DeltacoMatchPolicy.from_pretrained(folder).eval()
before, after = make_pre_post_processors(policy.config, folder)
seen = {{name: torch.zeros(1, *feature.shape) for name, feature in policy.config.input_features.items()}}
task = next(iter(policy.demonstrations.rows))
assert after(policy.select_action(before({{**seen, "task": [task]}}))).isfinite().all()
"""


def test_nothing_loads_more_than_it_needs_and_deltaco_match_acts_without_language_packages():
    env = "import lerobot_deltaco.evaluation.lerobot_env"
    result = run_python(PROGRAMS, ACT, POLICY, env, "import lerobot_policy_deltaco")
    assert result.returncode == 0, result.stderr
    *_, with_policy, with_env, with_all = (set(line.split()) for line in result.stdout.splitlines())
    assert not {"gym_deltaco", "pybullet"} & with_policy
    # Every command of LeRobot imports the environment's configuration.
    later = {"gym_deltaco.sim", "gym_deltaco.env", "lerobot_deltaco.data", "lerobot_deltaco.policies"}
    assert not {"pybullet", *later} & with_env
    assert {"deltaco", "deltaco_match"} <= with_all


def test_lerobot_finds_the_distribution_and_its_types():
    # With hyphens in its name, it would silently not be found.
    assert PROJECT["name"] == "lerobot_policy_deltaco"
    register_third_party_plugins()
    assert "deltaco" in EnvConfig.get_known_choices()
    assert get_policy_class("deltaco_match").name == "deltaco_match"


def test_a_broken_import_ends_in_one_clear_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot_deltaco.evaluation.lerobot_env", None)
    at_exit = []
    monkeypatch.setattr("atexit.register", at_exit.append)
    message = (
        "could not be imported, so LeRobot does not know its types .*lerobot_deltaco.evaluation.lerobot_env"
    )
    with pytest.raises(ImportError, match=message):
        runpy.run_path(str(ROOT / "lerobot_policy_deltaco.py"))
    assert len(at_exit) == 1


NO_SIMULATOR = """
import sys
sys.modules["pybullet"] = None
import gymnasium, gym_deltaco
from gym_deltaco import chance, env, expert, layout, paraphrases, tasks
from gym_deltaco.objects import object_sets
from gym_deltaco.sim import simulation
from lerobot_deltaco.collection import collect
from lerobot_deltaco.evaluation import records
from lerobot_deltaco.reports import report
assert not {"torch", "lerobot", "transformers", "huggingface_hub"} & set(sys.modules)
try:
    gymnasium.make(gym_deltaco.ENV_ID)
except ImportError as error:
    assert error.name == "pybullet", error.name
    print(error)
"""


def test_what_needs_no_policy_is_quick_to_import_and_the_environment_names_a_missing_simulator():
    result = run_python(NO_SIMULATOR)
    assert result.returncode == 0, result.stderr
    assert '`pip install "lerobot_policy_deltaco[sim]"`' in result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def test_the_wheel_holds_all_that_the_clone_has(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    expected = {name.removeprefix("envs/") for name in tracked.splitlines() if (ROOT / name).is_file()}
    for folder in ("lerobot_deltaco/", "gym_deltaco/"):
        assert {name for name in expected if name.startswith(folder)} <= names
    assert {f"lerobot_deltaco/{name}" for name in expected if name.startswith("checkpoints/")} <= names
    assert "lerobot_policy_deltaco.py" in names
    assert not {name for name in names if name.startswith(("tests/", "docs/", "results/", "envs/"))}


@pytest.mark.slow
def test_the_wheel_works_in_a_fresh_environment(wheel, tmp_path):
    """Its own folder comes first; other packages are those of this environment."""
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--quiet", "--target"]
    subprocess.run([*install, str(site), str(wheel)], check=True)

    def run(command):
        environment = {**os.environ, "PYTHONPATH": str(site)}
        words = [sys.executable, site / "bin" / "deltaco", *command.split()]
        result = subprocess.run(words, cwd=elsewhere, env=environment, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr[-3000:]
        return result.stdout

    assert len(run("experiment").split()) > 10
    assert "1 episodes" in run("collect --tasks 4 --episodes-per-task 1 --root data")
    checkpoint = site / "lerobot_deltaco" / "checkpoints" / "pick_place"
    found = run(f"evaluate {checkpoint} --tasks 24 --trials 2 --out run")
    assert "of 2 episodes of 24 succeeded" in found
