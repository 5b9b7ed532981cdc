"""The README and the documentation agree with the code: commands, links, snippets and generated tables."""

import argparse
import ast
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stderr
from dataclasses import fields
from functools import cache
from io import StringIO
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))

import api_pages  # noqa: E402
import docstrings  # noqa: E402
import generated_sections  # noqa: E402


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "results/README.md")),
    *sorted(path for path in DOCS.rglob("*.md") if not {"_build", "generated"} & set(path.parts)),
]


def page_name(path):
    return path.relative_to(ROOT).as_posix()


def fences(path: Path, language: str) -> Iterator[str]:
    """The fenced blocks of a page in a language, without the indentation of a list."""
    for indent, block in re.findall(
        rf"^( *)```{language}\n(.*?)^ *```$", path.read_text(), re.MULTILINE | re.DOTALL
    ):
        yield "\n".join(line.removeprefix(indent) for line in block.splitlines())


def commands(path: Path) -> Iterator[list[str]]:
    """The commands in a page's bash blocks, as words."""
    for block in fences(path, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield words


# Each once, with the first page that has it.
ALL_COMMANDS: dict[str, str] = {}
for path in PAGES:
    for words in commands(path):
        ALL_COMMANDS.setdefault(shlex.join(words), page_name(path))


# Commands


class ParsedError(Exception):
    """A command's arguments are valid."""


def parse_with_argparse(main, arguments, monkeypatch):
    """Lets a command parse its arguments, and nothing else."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse_and_stop(self, words=None, namespace=None):
        raise ParsedError(parse_args(self, words, namespace))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    errors = StringIO()
    with redirect_stderr(errors):
        try:
            main(arguments)
        except ParsedError as parsed:
            return parsed.args[0]
        except SystemExit:
            pass
    raise AssertionError(errors.getvalue())


def check_deltaco(words, monkeypatch):
    module, function = PROJECT["scripts"][words[0]].split(":")
    main = getattr(importlib.import_module(module), function)
    options = parse_with_argparse(main, words[1:], monkeypatch)
    if words[0] == "deltaco-collect" and "--verify" not in words:
        from lerobot_deltaco.data.collection_plan import CollectionPlan

        known = {field.name for field in fields(CollectionPlan)}
        CollectionPlan(**{name: value for name, value in vars(options).items() if name in known})
    if words[0] == "deltaco-experiment":
        for name in words[1 : next((n for n, word in enumerate(words) if word.startswith("--")), None)]:
            assert (ROOT / "experiments" / f"{name}.yaml").is_file(), name


# The configurations that LeRobot's commands parse, by command.
LEROBOT_CONFIGURATIONS = {
    "lerobot-train": ("lerobot.configs.train", "TrainPipelineConfig"),
    "deltaco-train": ("lerobot.configs.train", "TrainPipelineConfig"),
    "lerobot-eval": ("lerobot.configs.eval", "EvalPipelineConfig"),
    "lerobot-edit-dataset": ("lerobot.scripts.lerobot_edit_dataset", "EditDatasetConfig"),
    "lerobot-record": ("lerobot.scripts.lerobot_record", "RecordConfig"),
    "lerobot-rollout": ("lerobot.scripts.lerobot_rollout", "RolloutConfig"),
}


@cache
def draccus_parser(configuration):
    """The parser of a configuration, which takes seconds to make."""
    from draccus.argparsing import ArgumentParser

    return ArgumentParser(configuration)


def check_lerobot(words, monkeypatch):
    """Parses a command's configuration with draccus, as LeRobot does, but reads no checkpoint."""
    from lerobot.configs import PreTrainedConfig

    # These register the policies and environments, before the first parser is made.
    for module in ("lerobot.policies", "lerobot.envs", "lerobot_policy_deltaco"):
        importlib.import_module(module)
    command, *arguments = words
    if command == "lerobot-dataset-viz":
        from lerobot.scripts.lerobot_dataset_viz import main

        monkeypatch.setattr(sys, "argv", words)
        parse_with_argparse(lambda _: main(), None, monkeypatch)
        return
    if arguments == ["--help"]:
        return
    module, name = LEROBOT_CONFIGURATIONS[command]
    configuration = getattr(importlib.import_module(module), name)
    # A checkpoint's configuration comes from its file, over which these options are laid.
    if any(word.startswith("--policy.path=") for word in arguments):
        overrides = [word.replace("--policy.", "--") for word in arguments if word.startswith("--policy.")]
        overrides = [word for word in overrides if not word.startswith("--path=")]
        draccus_parser(PreTrainedConfig.get_choice_class("deltaco")).parse_args(overrides)
        arguments = [word for word in arguments if not word.startswith("--policy.")]
        if command == "lerobot-rollout":
            arguments.append("--policy.type=deltaco")
    arguments = [word for word in arguments if not word.startswith("--config_path=")]
    if "--resume=true" in arguments:
        arguments.append("--dataset.repo_id=USER/NAME")
    monkeypatch.setattr(sys, "argv", [command, *arguments])
    errors = StringIO()
    with redirect_stderr(errors):
        try:
            draccus_parser(configuration).parse_args(arguments)
        except SystemExit:
            raise AssertionError(errors.getvalue()) from None


def check_make(words, monkeypatch):
    text = (ROOT / "Makefile").read_text()
    for word in words[1:]:
        if "=" in word:
            name = word.partition("=")[0]
            assert re.search(rf"^{name} \?=", text, re.MULTILINE), f"the Makefile has no variable {name}"
        else:
            assert re.search(rf"^{word}:", text, re.MULTILINE), f"the Makefile has no target {word}"


def check_pip(words, monkeypatch):
    assert "install" in words
    for word in words:
        if extras := re.fullmatch(r"\.\[(.+)\]", word):
            assert set(extras[1].split(",")) <= set(PROJECT["optional-dependencies"])


def check_torchrun(words, monkeypatch):
    module = words[words.index("-m") + 1]
    (command,) = [name for name, script in PROJECT["scripts"].items() if script == f"{module}:main"]
    check_lerobot([command, *words[words.index(module) + 1 :]], monkeypatch)


def check_python(words, monkeypatch):
    if words[1] == "-c":
        ast.parse(words[2])
    else:
        assert (ROOT / words[1]).is_file()


CHECKS = {
    "make": check_make,
    "pip": check_pip,
    "python": check_python,
    "torchrun": check_torchrun,
    "uv": check_pip,
    **dict.fromkeys(PROJECT["scripts"], check_deltaco),
    **dict.fromkeys([*LEROBOT_CONFIGURATIONS, "lerobot-dataset-viz"], check_lerobot),
}
# Commands of other projects, without a parser here.
UNCHECKED = {"pre-commit", "source", "sudo"}


@pytest.mark.parametrize(("command", "page"), ALL_COMMANDS.items())
def test_a_documented_command_parses(command, page, monkeypatch):
    words = shlex.split(command)
    while re.fullmatch(r"[A-Z_]+=.*", words[0]):  # environment variables
        words.pop(0)
    if words[0] in UNCHECKED:
        return
    assert words[0] in CHECKS, f"{page}: no parser is known for {words[0]}"
    CHECKS[words[0]](words, monkeypatch)


def test_the_command_check_finds_mistakes(monkeypatch):
    with pytest.raises(AssertionError, match="--episodes-per-task"):
        check_deltaco(shlex.split("deltaco-collect --tasks 4 --episode-number 3 --root data"), monkeypatch)
    with pytest.raises(AssertionError, match="no target"):
        check_make(["make", "tests"], monkeypatch)
    with pytest.raises(ValueError, match="of which the objects 'random:500' have none"):
        check_deltaco(
            shlex.split("deltaco-collect --tasks all --episodes-per-task 1 --root data --objects random:500"),
            monkeypatch,
        )
    with pytest.raises(Exception, match="colour"):
        check_lerobot(["lerobot-eval", "--env.type=deltaco", "--env.colour=1"], monkeypatch)


@pytest.mark.parametrize("command", PROJECT["scripts"])
def test_every_command_is_documented(command):
    assert f"`{command}`" in (DOCS / "quickstart.md").read_text()


# Python


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_python_snippets_compile_and_their_imports_exist(path):
    for snippet in fences(path, "python"):
        for node in ast.walk(ast.parse(snippet)):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    importlib.import_module(alias.name)
            elif isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"


def test_the_gymnasium_snippet_of_the_readme_runs():
    (snippet,) = fences(ROOT / "README.md", "python")
    result = subprocess.run([sys.executable, "-c", snippet], capture_output=True, text=True, check=True)
    instruction, success = result.stdout.strip().splitlines()[-2:]
    assert instruction.startswith("Put black and white colored, chalice shaped smushed dumbbell")
    assert success in ("True", "False")


# Pages and links


def test_the_readme_fits_on_a_page():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def slugs(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    anchors = re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in headings} | set(
        anchors
    )


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_internal_links_resolve(path):
    text = re.sub(r"^ *```.*?^ *```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        linked = (path.parent / file).resolve() if file else path
        assert linked.is_file(), f"{page_name(path)} links to {target}"
        assert linked.is_relative_to(ROOT)
        if anchor:
            assert anchor in slugs(linked), f"{page_name(path)} links to {target}"


FOLDERS = "benchmarks|datasets_cards|docs|envhub|envs|experiments|lerobot_deltaco|results|scripts|space|tests"


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_paths_in_the_repository_exist(path):
    for name in re.findall(rf"`((?:{FOLDERS})/[\w./-]*)`", path.read_text()):
        assert "_build" in name or (ROOT / name).exists(), f"{page_name(path)} names {name}"


def test_every_page_is_in_the_table_of_contents():
    contents = "\n".join(block for block in fences(DOCS / "index.md", r"\{toctree\}"))
    listed = {line for line in contents.splitlines() if line and not line.startswith(":")}
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in PAGES if DOCS in path.parents}
    # Sphinx wants these in no table of contents.
    pages -= {name for name in pages if "\norphan: true\n" in (DOCS / f"{name}.md").read_text()}
    assert listed == pages - {"index"}


def test_the_datasets_page_lists_the_data_sets():
    from lerobot_deltaco.data.collection_plan import DATA_SETS

    text = (DOCS / "datasets.md").read_text()
    assert all(f"`{name}`" in text for name in DATA_SETS)


def test_the_experiments_page_lists_the_folders():
    text = (DOCS / "experiments.md").read_text()
    folders = {path.parent.name for path in (ROOT / "experiments").glob("*/*.yaml")}
    assert all(f"| `{name}` |" in text for name in folders)


# Generated sections and pages


def test_every_policy_option_is_documented():
    spec = generated_sections.documented(generated_sections.POLICY_OPTIONS)
    # LeRobot's own, and what the policy finds out by itself.
    assert set(spec.types) - set(spec.arguments) == {
        "push_to_hub",
        "normalization_mapping",
        "one_hot_tasks",
        "demo_feature_dim",
    }
    text = generated_sections.options(generated_sections.POLICY_OPTIONS, "--policy.")
    assert "`--policy.motion_modes` (int, default `1`)" in text
    assert "`--policy.compile` (bool, default `false`)" in text
    assert "`--policy.film` (str, not set by default)" in text


def test_environment_options_show_the_values_of_constants():
    text = generated_sections.options(generated_sections.ENVIRONMENT_OPTIONS, "--env.")
    assert "`--env.episode_length` (int, default `30`)" in text


def test_the_specification_has_every_observation_action_and_info():
    text = generated_sections.environment()
    for heading in ("Observation", "Action", "Reward and success", "Info", "Arguments"):
        assert f"### {heading}\n" in text
    for name in ("pixels", "agent_pos", "is_success", "right_container", "render_size"):
        assert f"`{name}`" in text


def test_generated_tables_add_up():
    assert generated_sections.objects_table().count("\n") == 2 + 32
    scenarios = generated_sections.scenarios_table()
    assert "| `scenario_a_train` | 0 to 23, 36 to 44 | 198 |" in scenarios
    assert "| `scenario_a_test` | 24 to 35, 45 to 49 | 102 |" in scenarios
    assert "| color | 32 to 39 | 48 |" in generated_sections.tasks_table()


def test_the_api_reference_has_every_public_module_but_the_commands():
    text = "\n".join(api_pages.api_pages().values())
    for module in ("gym_deltaco.tasks", "lerobot_deltaco.modeling_deltaco", "lerobot_deltaco.policy.losses"):
        assert f".. automodule:: {module}\n" in text
    assert "lerobot_deltaco.commands" not in text


def test_pages_are_written_once_and_stale_ones_removed(tmp_path):
    stale = tmp_path / api_pages.FOLDER / "stale.md"
    stale.parent.mkdir(parents=True)
    stale.touch()
    paths = api_pages.write(tmp_path)
    assert not stale.exists()
    written = [path.stat().st_mtime_ns for path in paths]
    assert [path.stat().st_mtime_ns for path in api_pages.write(tmp_path)] == written


@pytest.mark.parametrize("name", generated_sections.SECTIONS)
def test_the_pages_have_the_sections_that_the_code_gives(name):
    page = (DOCS / name).read_text()
    assert generated_sections.updated(page, name) == page, "Write them anew: python scripts/update_docs.py"


def test_a_page_without_a_place_for_a_section_is_named():
    with pytest.raises(ValueError, match="From the code: the environment"):
        generated_sections.updated("# A page", "benchmark.md")


def test_markdown_docstrings_become_restructured_text():
    lines = [
        "Does `x`s and 2 * y_ | z.",
        "",
        "    a diagram",
        "",
        "| key | what |",
        "|---|---|",
        "| `a` | b |",
        "",
        "Args:",
        "    name: What it is.",
    ]
    docstrings.to_restructured_text(None, "class", "X", None, None, lines)
    assert lines == [
        r"Does ``x``\ s and 2 \* y\_ \| z.",
        "",
        ".. code-block:: text",
        "",
        "    a diagram",
        "",
        "",
        ".. list-table::",
        "   :header-rows: 1",
        "",
        "   * - key",
        "     - what",
        "   * - ``a``",
        "     - b",
        "",
        "",
        "Args:",
        "    name: What it is.",
    ]
