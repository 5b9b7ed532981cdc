"""The README and the documentation agree with the code: commands, links, snippets and tables."""

import ast
import functools
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gym_deltaco.tasks import OBJECTS, TASK_SETS
from lerobot_deltaco import cli
from lerobot_deltaco.experiments.recipes import expand_families, read_recipe

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "NOTEBOOK.md")),
    *(ROOT / folder / "README.md" for folder in ("results", "checkpoints/pick_place")),
    *sorted(DOCS.glob("*.md")),
]


def page_name(path):
    return path.relative_to(ROOT).as_posix()


def fences(path, language):
    """Yields the fenced blocks of a page in a language, without the indentation of a list."""
    pattern = rf"(?ms)^( *)```{language}\n(.*?)^ *```$"
    for indent, block in re.findall(pattern, path.read_text()):
        yield "\n".join(line.removeprefix(indent) for line in block.splitlines())


def commands(path):
    """Yields the commands in a page's bash blocks, as words."""
    for block in fences(path, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):  # environment variables
                words.pop(0)
            if words:
                yield words


LEROBOT_CONFIGURATIONS = {
    "lerobot-train": ("lerobot.configs.train", "TrainPipelineConfig"),
    "lerobot-eval": ("lerobot.configs.eval", "EvalPipelineConfig"),
    "lerobot-edit-dataset": ("lerobot.scripts.lerobot_edit_dataset", "EditDatasetConfig"),
    "lerobot-record": ("lerobot.scripts.lerobot_record", "RecordConfig"),
    "lerobot-rollout": ("lerobot.scripts.lerobot_rollout", "RolloutConfig"),
}


@functools.cache
def draccus_parser(configuration):
    from draccus.argparsing import ArgumentParser

    return ArgumentParser(configuration)


def parse_lerobot(command, arguments, monkeypatch):
    """Parses a command's configuration with draccus, as LeRobot does, but reads no checkpoint."""
    from lerobot.configs import PreTrainedConfig

    own = ("lerobot_policy_deltaco", "lerobot_policy_example", "metaworld_small", "other_environments")
    for module in ("lerobot.policies", "lerobot.envs", *own, "simulated_robot"):
        importlib.import_module(module)
    arguments = [word for word in arguments if ".discover_packages_path=" not in word]
    module, name = LEROBOT_CONFIGURATIONS[command]
    configuration = getattr(importlib.import_module(module), name)
    if any(word.startswith("--policy.path=") for word in arguments):
        # A checkpoint's configuration comes from its file, over which these options are laid.
        own = [word.replace("--policy.", "--") for word in arguments if word.startswith("--policy.")]
        own = [word for word in own if not word.startswith("--path=")]
        draccus_parser(PreTrainedConfig.get_choice_class("deltaco_match")).parse_args(own)
        arguments = [word for word in arguments if not word.startswith("--policy.")]
        if command == "lerobot-rollout":
            arguments.append("--policy.type=deltaco_match")
    arguments = [word for word in arguments if not word.startswith("--config_path=")]
    if "--resume=true" in arguments:
        arguments.append("--dataset.repo_id=USER/NAME")
    # Some configurations look for the policy's path in the command line.
    monkeypatch.setattr(sys, "argv", [command, *arguments])
    draccus_parser(configuration).parse_args(arguments)


def check(words, monkeypatch):
    """Checks that a command parses."""
    command, *arguments = words
    if command == "deltaco":
        name, *arguments = arguments
        if name == "--version":
            return
        if name == "train":
            parse_lerobot("lerobot-train", arguments, monkeypatch)
            return
        call = cli.parse_arguments(name, arguments)
        if name == "experiment":
            parsed = call.keywords
            for experiment in expand_families(parsed["names"]):
                read_recipe(experiment, parsed["scale"], parsed["settings"])
    elif command in LEROBOT_CONFIGURATIONS and arguments != ["--help"]:
        parse_lerobot(command, arguments, monkeypatch)
    elif command == "make":
        makefile = (ROOT / "Makefile").read_text()
        for word in arguments:
            pattern = rf"^{word.split('=')[0]} \?=" if "=" in word else rf"^{word}:"
            assert re.search(pattern, makefile, re.MULTILINE), word
    elif command == "python" and arguments[0] == "-m":
        importlib.import_module(arguments[1])
    for extras in re.findall(r"\.\[([\w,]+)\]", " ".join(words)):
        assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_the_commands_of_a_page_parse(path, monkeypatch):
    mistakes = {}
    for words in commands(path):
        try:
            check(words, monkeypatch)
        except (SystemExit, Exception) as error:
            mistakes[shlex.join(words)] = str(error)
    assert mistakes == {}


def test_the_quick_start_lists_every_command():
    text = (DOCS / "quickstart.md").read_text()
    assert all(f"`deltaco {name}`" in text for name in cli.COMMANDS)


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_the_imports_of_snippets_exist(path):
    for snippet in fences(path, "python"):
        for node in ast.walk(ast.parse(snippet)):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), node.module


def test_the_gymnasium_snippet_of_the_readme_runs():
    snippet = next(block for block in fences(ROOT / "README.md", "python") if "gymnasium.make" in block)
    result = subprocess.run([sys.executable, "-c", snippet], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] in ("True", "False")


def slugs(path):
    """Returns the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in headings}


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_internal_links_resolve(path):
    text = re.sub(r"^ *```.*?^ *```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        linked = (path.parent / file).resolve() if file else path
        assert linked.exists(), target
        assert not anchor or anchor in slugs(linked), target


def test_the_tables_of_the_benchmark_are_those_of_the_code():
    benchmark = (DOCS / "benchmark.md").read_text()
    for label in OBJECTS:
        assert f"| {label.index} | {label.name} | {label.shape} | {label.color} |" in benchmark
    for name, tasks in TASK_SETS.items():
        assert re.search(rf"^\| `{name}` \| .* \| {len(tasks)} \|$", benchmark, re.MULTILINE), name
