"""LeRobot finds the installed project, and imports within it go one way."""

import ast
import re
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from fresh_python import run_python

from lerobot_deltaco.common import shipped

ROOT = Path(__file__).parents[1]
GYM_FILES = sorted((ROOT / "envs" / "gym_deltaco").rglob("*.py"))
LEROBOT_FILES = [*sorted((ROOT / "lerobot_deltaco").rglob("*.py")), ROOT / "lerobot_policy_deltaco.py"]
DISTRIBUTION = "lerobot_policy_deltaco"


# One process imports LeRobot, which takes 10 s, and nothing of this project. Each command runs in a fork.
PROGRAM = """
import os, sys

os.dup2(1, 2)  # errors stand among the output
from lerobot.scripts import lerobot_eval, lerobot_train

MISSING = "lerobot_deltaco.policy.optimization"

for name, main, words, missing in (
    ("train --help", lerobot_train.main, ["--help"], None),
    ("eval --help", lerobot_eval.main, ["--help"], None),
    ("eval without a module", lerobot_eval.main, ["--env.type=deltaco"], MISSING),
):
    print(f"OUTPUT OF {name}", flush=True)
    if os.fork():
        os.wait()
        continue
    if missing is not None:
        sys.modules[missing] = None
    sys.argv = [name, *words]
    main()
    sys.exit()
"""


@pytest.fixture(scope="module")
def lerobot_outputs():
    """What LeRobot's commands print, by command."""
    result = run_python(PROGRAM)
    _, *parts = re.split("^OUTPUT OF (.+)$", result.stdout, flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_lerobot_requires_the_distribution_name_to_have_underscores():
    assert distribution(DISTRIBUTION).metadata["Name"] == DISTRIBUTION


@pytest.mark.parametrize("command", ["train", "eval"])
def test_lerobot_help_lists_the_environment(lerobot_outputs, command):
    output = lerobot_outputs[f"{command} --help"]
    type_choices = output[output.index("--env.type") :].split("}")[0]
    assert "deltaco" in type_choices


def test_a_broken_import_ends_in_one_clear_sentence(lerobot_outputs):
    last_line = lerobot_outputs["eval without a module"].strip().splitlines()[-1]
    assert "LeRobot does not know the type 'deltaco'" in last_line
    assert "lerobot_deltaco.policy.optimization" in last_line
    assert "README" in last_line


def test_what_is_shipped_lies_in_the_package_or_beside_it(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "clone/package/common/shipped.py"))
    assert shipped.shipped_folder("inside", "beside") == tmp_path / "clone/beside"
    installed = tmp_path / "clone/package/inside"
    installed.mkdir(parents=True)
    assert shipped.shipped_folder("inside", "beside") == installed


def imported_modules(path):
    """Absolute names of the modules that a file imports anywhere, `from package import module` included."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", GYM_FILES, ids=lambda path: path.name)
def test_the_benchmark_knows_nothing_of_torch_and_lerobot(path):
    packages = {name.split(".")[0] for name in imported_modules(path)}
    assert packages.isdisjoint({"torch", "lerobot", "lerobot_deltaco", "lerobot_policy_deltaco"})


# What each part may not import, so that imports go one way.
FORBIDDEN = {
    "lerobot_deltaco/data": {"torch", "lerobot_deltaco.policy", "lerobot_deltaco.modeling_deltaco"},
    "lerobot_deltaco/policy": {
        "gym_deltaco",
        "pybullet",
        "lerobot_deltaco.configuration_deltaco",
        "lerobot_deltaco.modeling_deltaco",
        "lerobot_deltaco.cards",
        "lerobot_deltaco.data",
        "lerobot_deltaco.training",
    },
    "lerobot_deltaco/policy/language": {"lerobot_deltaco.policy.goals"},
    "lerobot_deltaco/policy/language/encoder_names.py": {"torch", "lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/vision_encoders.py": {"torch", "lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/options.py": {"torch", "lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/configuration_deltaco.py": {
        "torch",
        "lerobot_deltaco.modeling_deltaco",
        "lerobot_deltaco.policy.language.instruction_table",
        "lerobot_deltaco.training",
    },
    "lerobot_deltaco/modeling": {"lerobot_deltaco.modeling_deltaco", "gym_deltaco", "pybullet"},
    "lerobot_deltaco/policy/networks.py": {"lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/losses.py": {"lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/demo_encoders.py": {"lerobot", "lerobot_deltaco.modeling_deltaco"},
    "lerobot_deltaco/policy/memory.py": {"lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/goals/efficientnet_lite.py": {"lerobot", "lerobot_deltaco"},
    "lerobot_deltaco/policy/goals/words.py": {"lerobot", "lerobot_deltaco"},
    # Reports are quick, and need no machine that could train.
    **{
        f"lerobot_deltaco/{part}.py": {"torch", "lerobot", "pybullet", "lerobot_deltaco.evaluate"}
        for part in ("records", "statistics", "report_tables", "report", "paper_results", "leaderboard")
    },
}


@pytest.mark.parametrize("part", FORBIDDEN)
def test_imports_go_one_way(part):
    path = ROOT / part
    paths = [path] if path.suffix else sorted(path.rglob("*.py"))
    assert paths
    for path in paths:
        for name in imported_modules(path):
            parents = {name, *(name.rsplit(".", n)[0] for n in range(1, name.count(".") + 1))}
            assert parents.isdisjoint(FORBIDDEN[part]), f"{path.name} imports {name}"


@pytest.mark.parametrize(
    ("name", "importers"),
    [("pybullet", {"pybullet_import.py"}), ("gym_deltaco.pybullet_import", {"simulation.py"})],
)
def test_one_file_imports_the_simulator(name, importers):
    assert {path.name for path in GYM_FILES if name in imported_modules(path)} == importers
    assert not any(name in imported_modules(path) for path in LEROBOT_FILES)


def test_importing_the_benchmark_loads_neither_torch_nor_lerobot():
    check = "import sys, gym_deltaco; print({'torch', 'lerobot', 'lerobot_deltaco'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize("path", [*GYM_FILES, *LEROBOT_FILES], ids=lambda path: path.name)
def test_nothing_imports_the_command_line(path):
    command_line = {script.module for script in distribution(DISTRIBUTION).entry_points}
    assert command_line.isdisjoint(imported_modules(path))
