"""The example for a Slurm cluster: by datatrove's local executor, and submitted to a fake `sbatch`."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

from lerobot_deltaco.commands import experiment as experiment_command
from lerobot_deltaco.experiments.command_runner import CommandRunner

pytest.importorskip("datatrove", reason="datatrove is missing: pip install '.[slurm]'")

EXAMPLE = Path(__file__).parents[1] / "examples" / "slurm_experiments.py"
TINY = """
data: {tasks: "4,14", episodes_per_task: 2}
demonstrations: {tasks: "4,14", split: validation, episodes_per_task: 1}
training: {steps: 4}
evaluation: {tasks: "4,14", trials: 1}
"""
STAGES = ("collect", "join", "train", "finetune", "evaluate", "report")


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("slurm_experiments", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def arguments(tmp_path):
    folder = tmp_path / "experiments" / "tiny"
    folder.mkdir(parents=True)
    (folder / "one.yaml").write_text(TINY)
    (folder / "two.yaml").write_text(TINY + "start_from: tiny/one\n")
    words = ["tiny/one", "tiny/two", "--seed", "0", "1", "--shards", "2"]
    places = {"experiments": folder.parent, "out": tmp_path / "out", "logs": tmp_path / "logs"}
    places["report"] = tmp_path / "report"
    return [*words, *(f"--{name}={place}" for name, place in places.items())]


def test_the_local_executor_runs_all_stages_and_goes_on(example, arguments, tmp_path, monkeypatch):
    """Collections, trainings and evaluations only leave what the next stage looks for."""
    begun = []

    def run(_, command, words):
        if command == "experiment":
            begun.append([word for word in words if re.match(r"tiny/|--seed=|--only=|--shard=|--join", word)])
            experiment_command.main(words)
        elif command == "collect":
            if words[-1] == "--join":
                info = Path(words[-2].removeprefix("--root=")) / "meta/info.json"
                info.parent.mkdir(parents=True)
                info.write_text('{"codebase_version": "v3.0"}')
        elif command == "train":
            options = dict(word.removeprefix("--").split("=", 1) for word in words)
            last = Path(options["output_dir"]) / "checkpoints/last"
            for folder in ("pretrained_model", "training_state"):
                (last / folder).mkdir(parents=True)
            (last / "pretrained_model/train_config.json").touch()
            (last / "training_state/training_step.json").write_text(json.dumps({"step": 4}))
        else:
            record = Path(words[0]) / "evaluations/0000004.json"
            record.parent.mkdir()
            record.touch()

    reported = []
    monkeypatch.setattr(CommandRunner, "run", run)
    monkeypatch.setattr(
        "lerobot_deltaco.reporting.report.write_report", lambda runs, folder: reported.append((runs, folder))
    )
    example.main([*arguments, "--local"])
    steps = [next(word for word in words if word.startswith("--only")) for words in begun]
    expected = {"collect": 3, "train": 4, "evaluate": 4, "report": 1}
    assert steps == [f"--only={step}" for step, n_jobs in expected.items() for _ in range(n_jobs)]
    both = ["tiny/one", "tiny/two", "--only=collect"]
    assert begun[:3] == [[*both, "--shard=1/2"], [*both, "--shard=2/2"], [*both, "--join"]]
    # Fine-tuning comes after all of what is fine-tuned.
    assert [words[0] for words in begun[3:7]] == ["tiny/one"] * 2 + ["tiny/two"] * 2
    runs = [tmp_path / "out" / name / f"seed_{seed}" for seed in (0, 1) for name in ("tiny/one", "tiny/two")]
    assert reported == [(runs, tmp_path / "report")]
    # What has ended well is not begun again.
    example.main([*arguments, "--local"])
    assert len(begun) == 12


def test_slurm_gets_arrays_that_wait_for_each_other(example, arguments, tmp_path, monkeypatch):
    sbatch = tmp_path / "bin" / "sbatch"
    sbatch.parent.mkdir()
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    sbatch.write_text(
        f'#!/bin/sh\nnumber=$(ls {jobs} | wc -l)\nfor script; do :; done\ncp "$script" {jobs}/$number\n'
        f'echo "$@" >> {jobs}/$number\necho Submitted batch job $number\n'
    )
    sbatch.chmod(0o755)
    monkeypatch.setenv("PATH", f"{sbatch.parent}:/usr/bin:/bin")
    more = ["--cpus-per-task=4", "--sbatch=comment=a=b", "--sbatch=exclusive="]
    example.main([*arguments, "--partition=cpu", "--gpu-partition=gpu", *more])
    # After each array there is a job of datatrove's own.
    found = {path.name: path.read_text() for path in sorted(jobs.iterdir(), key=lambda path: int(path.name))}
    arrays = {number: script for number, script in found.items() if "merge_stats" not in script}

    def option(name):
        return [re.search(rf"--{name}=(\S+)", script)[1] for script in arrays.values()]

    assert option("job-name") == [f"deltaco_{stage}" for stage in STAGES]
    assert [value.split("%")[0] for value in option("array")] == ["0-1", "0-0", "0-1", "0-1", "0-3", "0-0"]
    assert option("partition") == ["cpu", "cpu", "gpu", "gpu", "gpu", "cpu"]
    assert [re.findall(r"--gpus=(\d)", script) for script in arrays.values()] == [[]] * 2 + [["1"]] * 3 + [[]]
    for before, script in zip(arrays, list(arrays.values())[1:], strict=False):
        assert f"afterok:{before}" in script
    for script in arrays.values():
        assert {"#SBATCH --comment=a=b", "#SBATCH --exclusive"} <= set(script.splitlines())


def test_an_argument_of_sbatch_without_a_value_is_refused(example, arguments, capsys):
    with pytest.raises(SystemExit):
        example.main([*arguments, "--dry-run", "--local", "--sbatch", "exclusive"])
    assert "--sbatch must be NAME=VALUE, or NAME= for one without" in capsys.readouterr().err


def test_without_partitions_slurm_is_refused(example, arguments, capsys):
    with pytest.raises(SystemExit):
        example.main(arguments)
    assert "Slurm needs --partition and --gpu-partition" in capsys.readouterr().err


def test_a_dry_run_prints_the_commands(example, arguments, capsys, tmp_path):
    example.main([*arguments, "--dry-run", "--local"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 12
    assert lines[0].startswith("collect: deltaco-experiment tiny/one tiny/two --experiments=")
    assert not (tmp_path / "out").exists()
