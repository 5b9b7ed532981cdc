"""The command `deltaco`: quick help that lists everything, and errors in one line."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import fields

import pytest
from fresh_python import run_python

from lerobot_deltaco import cli
from lerobot_deltaco.errors import UserError

# Packages that take a second or more to import.
SLOW_PACKAGES = "datasets,gradio,lerobot,matplotlib,sentence_transformers,torch,transformers"
PROGRAM = """
import sys
from lerobot_deltaco import cli
from lerobot_deltaco.errors import UserError

slow = set(sys.argv.pop().split(","))
for name in sys.argv[1:]:
    before = set(sys.modules)
    sys.argv = ["deltaco", *filter(None, [name]), "--help"]
    try:
        cli.main()
    except SystemExit as end:
        assert not end.code, end.code
    print("END", sorted(slow & (set(sys.modules) - before)))
"""


@pytest.fixture(scope="module")
def helps():
    """What the help of the command, and of each subcommand, prints, and which slow packages it imports."""
    names = ["", *sorted(cli.COMMANDS, key=lambda name: name == "train")]  # which imports LeRobot
    result = run_python(PROGRAM, *names, SLOW_PACKAGES)
    assert result.returncode == 0, result.stderr
    parts = re.findall(r"(.*?)^END (.*?)$\n", result.stdout, re.MULTILINE | re.DOTALL)
    return dict(zip(names, parts, strict=True))


def test_the_help_lists_all_commands(helps):
    text, slow = helps[""]
    assert slow == "[]"
    for name, command in cli.COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(command.description)}$", text, re.MULTILINE)


def test_help_is_quick_and_explains_every_option(helps):
    for name in cli.COMMANDS:
        text, slow = helps[name]
        assert f"usage: deltaco {name}" in text
        if name == "train":  # its options are those of LeRobot's configurations
            continue
        assert slow == "[]", name
        # An option, its values in capitals or braces, its description and its default.
        entries = re.split(r"\n +(?=-{1,2}[a-z])", re.sub(r"[│╭╮╰╯─]", " ", text))[1:]
        assert len(entries) > 1, name
        for entry in entries:
            option, _, described = entry.partition(" ")
            described = re.sub(r"\(default: .*?\)|\(required\)|\{[^}]*\}|--\S+", "", described)
            assert re.search(r"[a-z]{3,}", described), option


def test_the_help_of_training_describes_the_options_of_both_policies(helps):
    from lerobot_deltaco.policies.deltaco.configuration_deltaco import DeltacoConfig
    from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig

    text, _ = helps["train"]
    hidden = {"push_to_hub", "normalization_mapping", "one_hot_tasks", "known_words", "gripper_range"}
    hidden |= {"trained_tasks", "held_out_episodes", "n_dataset_frames"}
    inherited = {field.name for field in fields(DeltacoConfig.__mro__[2])}
    for config in (DeltacoConfig, DeltacoMatchConfig):
        for option in {field.name for field in fields(config)} - inherited - hidden:
            assert re.search(rf"^  --policy\.{option} \(default: .*\)\n +\w", text, re.MULTILINE), option
    assert "--policy.type=deltaco_match" in text
    assert "MISSING" not in text


@pytest.mark.parametrize("chosen", [{}, {"OMP_WAIT_POLICY": "active"}])
def test_idle_threads_wait_passively_unless_the_user_says_otherwise(chosen):
    program = "import sys; sys.argv = ['deltaco']; from lerobot_deltaco import cli; cli.main(); import torch"
    env = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    result = run_python(program, env={**env, **chosen, "OMP_DISPLAY_ENV": "true"})
    # What the OpenMP library has read when PyTorch was loaded
    assert f"OMP_WAIT_POLICY = '{chosen.get('OMP_WAIT_POLICY', 'PASSIVE').upper()}'" in result.stderr


def test_the_version_says_which_types_lerobot_finds(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["deltaco", "--version"])
    cli.main()
    out = capsys.readouterr().out
    assert re.match(r"lerobot_policy_deltaco \d.* LeRobot \d.* finds ", out)
    assert all(
        f"--{kind}" in out for kind in ("policy.type=deltaco,", "policy.type=deltaco_match", "env.type=")
    )


def test_an_unknown_command_names_the_valid_ones(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["deltaco", "trian"])
    with pytest.raises(SystemExit, match="unknown command 'trian'. The commands are collect, check"):
        cli.main()


AGAIN = "Run the same command again to continue."


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (UserError("no record"), "deltaco report: no record"),
        (FileNotFoundError("no file"), "deltaco report: no file"),
        (MemoryError("no room"), "deltaco report: no room"),
        (ImportError("no simulator", name="pybullet"), "deltaco report: no simulator"),
        (KeyboardInterrupt(), f"\nInterrupted. {AGAIN}"),
        # As libraries report it
        (RuntimeError("No space left on device (os error 28)"), "deltaco report: The disk is full (No space"),
        (OSError(28, "No space left on device"), "deltaco report: The disk is full ([Errno 28] No space"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_error_that_a_user_can_act_on_is_one_line(fails_with, error, message):
    fails_with(error)
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert str(caught.value.code).startswith(message)


@pytest.mark.parametrize(
    "error", [ValueError("max() of nothing"), ZeroDivisionError("division by zero"), ImportError("no name")]
)
def test_an_accident_keeps_its_traceback(fails_with, error):
    fails_with(error)
    with pytest.raises(type(error)):
        cli.main()


@pytest.fixture
def fails_with(monkeypatch, tmp_path):
    """Lets `deltaco report` end with an error."""

    def fails_with(error):
        def fail(*paths):
            raise error

        monkeypatch.setattr("lerobot_deltaco.reports.report.read_records", fail)
        monkeypatch.setattr(sys, "argv", ["deltaco", "report", str(tmp_path)])

    return fails_with


def test_after_an_interrupt_training_names_the_command_that_continues(monkeypatch):
    def interrupted(config=None):
        raise KeyboardInterrupt

    monkeypatch.setattr("lerobot_deltaco.training.train.train", interrupted)
    monkeypatch.setattr(sys, "argv", ["deltaco", "train", "--policy.type=deltaco_match"])
    with pytest.raises(SystemExit, match=r"deltaco train --resume=true --config_path=RUN/checkpoints/last/"):
        cli.main()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["report"], "Name files or folders of records"),
        (["evaluate", "run", "--processes", "0"], "`processes` must be at least 1. Got 0"),
        (["evaluate", "run", "--demo-root", "data"], "--demo-root is the folder of .* --demo-repo-id"),
        (["evaluate", "run", "--rename-map", "[1]"], "--rename-map must be a JSON object"),
        (["collect", "--root", "data", "--tasks", "4", "--episodes-per-task", "0"], "must be at least 1"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_a_wrong_argument_is_one_line(monkeypatch, arguments, message):
    monkeypatch.setattr(sys, "argv", ["deltaco", *arguments])
    with pytest.raises(SystemExit, match=f"^deltaco {arguments[0]}: .*{message}"):
        cli.main()


def test_a_mistyped_option_of_json_is_one_line(monkeypatch):
    for text in ("{'a': 'b'}", "[" * 100_000):
        monkeypatch.setattr(sys, "argv", ["deltaco", "evaluate", "checkpoint", "--rename-map", text])
        with pytest.raises(SystemExit, match=r"^deltaco evaluate: --rename-map is not valid JSON: .*\.$"):
            cli.main()


# The command of a dataset's card: a stranger pastes it


@pytest.mark.slow
def test_act_is_trained_and_evaluated_by_the_command_of_a_datasets_card(tmp_path):
    from lerobot_deltaco.collection.collect import CollectionPlan, collect
    from lerobot_deltaco.collection.dataset_card import dataset_card

    root = tmp_path / "data"
    collect(root, CollectionPlan("4", 2))
    blocks = re.findall(r"```bash\n(.*?)```", dataset_card(root), re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    commands = {words[0]: words[1:] for words in map(shlex.split, lines) if words}
    quick = [
        *("--policy.pretrained_backbone_weights=null", "--policy.device=cpu", "--policy.dim_model=32"),
        *("--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1"),
        *("--steps=3", "--batch_size=2", "--num_workers=0", "--log_freq=1", "--env_eval_freq=3"),
        *("--eval.n_episodes=2", "--eval.batch_size=1", "--output_dir=run"),
    ]
    changed = {word.split("=")[0] for word in quick}  # LeRobot takes each option once
    words = [word for word in commands["lerobot-train"] if word.split("=")[0] not in changed]
    words = [word.replace("DIR", str(root)) for word in words]
    module = "lerobot.scripts.lerobot_train"
    command = [sys.executable, "-m", module, *words, *quick]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-3000:]
    assert "'n_episodes': 2" in result.stdout + result.stderr
    assert (tmp_path / "run" / "checkpoints" / "000003").is_dir()
