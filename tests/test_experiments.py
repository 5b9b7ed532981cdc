"""Every experiment builds its policy and takes a training step; all that it names is valid."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from lerobot.configs.train import TrainPipelineConfig
from small_policies import (
    TASKS,
    batch_of,
    small_policy,
    use_fake_encoder,
    use_fake_vision_encoder,
    write_dataset,
)

from lerobot_deltaco.commands import experiment as experiment_command
from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.data.finished_dataset import UNFINISHED
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import read_record
from lerobot_deltaco.experiments import command_runner, gpus, side_by_side
from lerobot_deltaco.experiments.command_runner import CommandRunner, ExperimentError
from lerobot_deltaco.experiments.config import ExperimentConfigError, experiment_names, read_experiment
from lerobot_deltaco.experiments.run import ExperimentRun, dataset_folder, run_folder
from lerobot_deltaco.experiments.side_by_side import run_side_by_side
from lerobot_deltaco.reporting.paper_results import PAPER_RESULTS

FOLDER = Path(__file__).parents[1] / "experiments"
EXPERIMENTS = experiment_names(FOLDER)
TRAINING_OPTIONS = {field.name for field in dataclasses.fields(TrainPipelineConfig)}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    episodes = [task for task in TASKS for _ in range(8)]
    return write_dataset(tmp_path_factory.mktemp("data") / "foreign", episodes)


@pytest.mark.usefixtures("short_fit")
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_row_builds_its_policy_and_takes_a_training_step(dataset, monkeypatch, tmp_path, name):
    use_fake_encoder(monkeypatch)
    use_fake_vision_encoder(monkeypatch)
    config = read_experiment(FOLDER, name)
    options = {key: value for key, value in config.policy.items() if value is not None}
    if "instructions" in options:
        # Those of the benchmark's tasks, which the small dataset does not have.
        (tmp_path / "sentences.csv").write_text("task_id,instruction\n4,put it there\n")
        options |= {"instructions": str(tmp_path / "sentences.csv"), "instructions_templates": True}
    if "goal_image_size" in options:
        options["goal_image_size"] = 16  # the images are too small for more
    policy, before, _ = small_policy(dataset, **{**options, "device": "cpu", "dtype": "float32"})
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    weights = [parameter.clone() for parameter in policy.parameters()]
    loss, _ = policy(before(batch_of(dataset, [0, 9, 12, 20])))
    loss.backward()
    optimizer.step()
    assert torch.isfinite(loss)
    assert any(not torch.equal(old, new) for old, new in zip(weights, policy.parameters(), strict=True))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_what_a_row_names_is_valid(name):
    config = read_experiment(FOLDER, name)
    plan, demos = CollectionPlan(**config.data), CollectionPlan(**config.demonstrations)
    evaluation = EvaluationPlan(**config.evaluation)
    assert plan.split == "train"
    assert demos.split == "validation"
    assert plan.ambiguity == demos.ambiguity == evaluation.ambiguity
    assert set(config.training) <= TRAINING_OPTIONS
    assert config.training["batch_size"] % config.policy["tasks_per_batch"] == 0
    if config.start_from is not None:
        assert config.start_from in EXPERIMENTS


def test_the_papers_rows_are_there():
    # Fine-tuned on no episodes, it is demo_only.
    assert set(PAPER_RESULTS) - {"scenario_a/demo_only_finetuned_0"} <= set(EXPERIMENTS)


def test_rows_share_what_their_folders_say(tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "shared.yaml").write_text("policy: {seed: 1, dtype: float32}\ntraining: {steps: 5}\n")
    (tmp_path / "one" / "shared.yaml").write_text("policy: {seed: 2}\ndata: {tasks: '4'}\n")
    (tmp_path / "one" / "config.yaml").write_text("policy: {method: one_hot}\n")
    config = read_experiment(tmp_path, "one/config")
    assert config.policy == {"seed": 2, "dtype": "float32", "method": "one_hot"}
    assert (config.training, config.data, config.evaluation) == ({"steps": 5}, {"tasks": "4"}, {})


def test_a_folder_extends_another(tmp_path):
    shared = {
        "": "policy: {seed: 1, dtype: float32}\ntraining: {steps: 5}\n",
        "one": "policy: {seed: 2}\ndata: {tasks: '4'}\n",
        "two": "extends: one\ntraining: {steps: 3}\n",
        "three": "extends: two\npolicy: {method: mcil}\n",
    }
    for name, text in shared.items():
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "shared.yaml").write_text(text)
    (tmp_path / "three" / "config.yaml").write_text("policy: {method: one_hot}\n")
    config = read_experiment(tmp_path, "three/config")
    assert config.policy == {"seed": 2, "dtype": "float32", "method": "one_hot"}
    assert (config.training, config.data) == ({"steps": 3}, {"tasks": "4"})
    for name, message in (("three", "extends itself"), ("four", "does not exist")):
        (tmp_path / "one" / "shared.yaml").write_text(f"extends: {name}\n")
        with pytest.raises(ExperimentConfigError, match=f"extends '{name}'.*{message}"):
            read_experiment(tmp_path, "three/config")


def test_unknown_rows_and_sections_are_refused(tmp_path):
    with pytest.raises(ExperimentConfigError, match="no experiment 'scenario_c/deltaco'.*scenario_a/deltaco"):
        read_experiment(FOLDER, "scenario_c/deltaco")
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "config.yaml").write_text("model: {}\n")
    with pytest.raises(ExperimentConfigError, match="unknown section 'model'. Valid are data"):
        read_experiment(tmp_path, "one/config")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data: [", "config.yaml is no YAML"),
        ("- data", "config.yaml must be a mapping of sections"),
        ("data: 3", "The section 'data' of .*config.yaml must be a mapping of options. Got 3"),
    ],
)
def test_files_that_say_nothing_are_named(tmp_path, text, message):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "config.yaml").write_text(text)
    with pytest.raises(ExperimentConfigError, match=message):
        read_experiment(tmp_path, "one/config")


def test_a_setting_that_is_no_yaml_is_named():
    with pytest.raises(ExperimentConfigError, match=r"The setting 'training.steps=\[1' is no YAML"):
        read_experiment(FOLDER, "scenario_a/bc_z", ["training.steps=[1"])


def test_what_is_null_is_left_out(tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "shared.yaml").write_text("data: {tasks: '4', objects: all}\npolicy: {seed: 1}\n")
    (tmp_path / "one" / "config.yaml").write_text("data: {objects: null}\npolicy:\n")
    config = read_experiment(tmp_path, "one/config")
    assert (config.data, config.policy, config.evaluation) == ({"tasks": "4"}, {"seed": 1}, {})


def test_settings_come_before_the_files():
    config = read_experiment(
        FOLDER, "scenario_a/bc_z", ["training.steps=7", "policy.device=cuda", "data.tasks=4,14"]
    )
    assert (config.training["steps"], config.policy["device"], config.data["tasks"]) == (7, "cuda", "4,14")
    assert config.policy["method"] == "bc_z"
    for wrong in ("steps=7", "training.steps", "model.size=3", "training=7"):
        with pytest.raises(ExperimentConfigError, match="SECTION.NAME=VALUE"):
            read_experiment(FOLDER, "scenario_a/bc_z", [wrong])


def test_a_run_does_not_go_on_with_other_settings(tmp_path, monkeypatch):
    monkeypatch.setattr(CommandRunner, "run", lambda *_: None)
    ExperimentRun(read_experiment(FOLDER, "scenario_a/deltaco"), 0, tmp_path).run()
    other = read_experiment(FOLDER, "scenario_a/deltaco", ["training.steps=7"])
    with pytest.raises(ExperimentError, match="started with other settings: training was.*'steps': 800000"):
        ExperimentRun(other, 0, tmp_path).run()
    ExperimentRun(other, 1, tmp_path).run()
    ExperimentRun(read_experiment(FOLDER, "scenario_a/deltaco"), 0, tmp_path).run()


def test_a_first_start_that_fails_leaves_the_settings_free(tmp_path, monkeypatch):
    name = "small_a/demo_only_finetuned_10"
    with pytest.raises(ExperimentError, match="Run that experiment first"):
        ExperimentRun(read_experiment(FOLDER, name), 0, tmp_path).train_and_evaluate(CommandRunner())

    def fail(runner, command, arguments):
        raise ExperimentError("unknown option")

    monkeypatch.setattr(CommandRunner, "run", fail)
    wrong = ExperimentRun(read_experiment(FOLDER, "small_a/deltaco", ["policy.sed=1"]), 0, tmp_path)
    with pytest.raises(ExperimentError, match="unknown option"):
        wrong.train_and_evaluate(CommandRunner())
    assert list(tmp_path.rglob("*.json")) == []
    # What has a folder has begun.
    wrong.folder.mkdir(parents=True)
    monkeypatch.setattr("lerobot_deltaco.experiments.run.shutil.rmtree", lambda *_, **__: None)
    with pytest.raises(ExperimentError, match="unknown option"):
        wrong.train_and_evaluate(CommandRunner())
    (file,) = tmp_path.rglob("*.json")
    file.write_text("{}")
    with pytest.raises(ExperimentError, match="started with other settings: data was None"):
        wrong.check_settings()


def test_a_row_that_starts_from_another_needs_it(tmp_path, monkeypatch):
    monkeypatch.setattr(CommandRunner, "run", lambda *_: None)
    config = read_experiment(FOLDER, "scenario_a/demo_only_finetuned_10")
    with pytest.raises(ExperimentError, match="starts from scenario_a/demo_only.*Run that experiment first"):
        ExperimentRun(config, 3, tmp_path).run()


def test_fine_tuning_starts_from_the_seed_with_the_highest_success(tmp_path):
    name = "small_a/demo_only_finetuned_10"
    run = ExperimentRun(read_experiment(FOLDER, name), 0, tmp_path)
    with pytest.raises(ExperimentError, match="not trained and evaluated with any seed"):
        run.train_and_evaluate(CommandRunner())
    records = Path(__file__).parents[1] / "results/small_a/records/demo_only"
    for seed in (0, 1, 2):
        finish_training(tmp_path, "small_a/demo_only", seed, 24_000)
        if seed < 2:  # the third is trained, but not evaluated
            shutil.copytree(
                records / f"seed_{seed}", run_folder(tmp_path, "small_a/demo_only", seed), dirs_exist_ok=True
            )
    rates = [read_record(records / f"seed_{seed}/evaluations/0024000.json").success_rate for seed in (0, 1)]
    assert rates[1] > rates[0]
    (train,) = (command for command in run.commands() if command.name == "train")
    assert any(f"{Path('small_a/demo_only/seed_1/checkpoints')}" in option for option in train.arguments)
    # Each of the seeds is waited for, and no other experiment's.
    assert run.may_start_from(run_folder(tmp_path, "small_a/demo_only", 2))
    assert not run.may_start_from(run_folder(tmp_path, "small_a/deltaco", 0))
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "config.yaml").write_text("start_from_seed: 3\n")
    with pytest.raises(ExperimentConfigError, match="must be 'same' or 'best'. Got 3"):
        read_experiment(tmp_path, "one/config")


def test_rows_share_their_data(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(CommandRunner, "run", lambda _, *call: calls.append(call))
    for name in ("scenario_a/deltaco", "scenario_a/language_only"):
        ExperimentRun(read_experiment(FOLDER, name), 0, tmp_path).run()
    first, second = calls[:4], calls[4:]
    assert [command for command, _ in first] == ["collect", "collect", "train", "evaluate"]
    assert first[:2] == second[:2]
    assert f"--output_dir={tmp_path}/scenario_a/deltaco/seed_0" in first[2][1]
    assert "--policy.method=language_only" in second[2][1]


# Several at a time


class _Commands:
    """In the place of the commands: notes which began and ended, and how many there were at once."""

    def __init__(self, fails: str = "", until: threading.Event | None = None) -> None:
        self.fails = fails  # the config whose commands fail; the others' go on ...
        self.until = until  # ... until then
        self.events: list[tuple[str, str, str]] = []  # began or ended, command, config
        self.runners: dict[str, CommandRunner] = {}  # of each config
        self.at_once = self.most_at_once = 0
        self.lock = threading.Lock()

    def run(self, runner: CommandRunner, command: str, arguments: list[str]) -> None:
        about = re.search(r"(\w+)/seed_\d+$", "\n".join(arguments), re.M)
        config = about[1] if about else ""
        with self.lock:
            self.events.append(("began", command, config))
            self.runners[config] = runner
            self.at_once += 1
            self.most_at_once = max(self.most_at_once, self.at_once)
        if config and config == self.fails:
            raise ExperimentError(f"{command} failed")
        if config and self.until is not None:
            assert self.until.wait(60)
        else:
            time.sleep(0.05)
        with self.lock:
            self.at_once -= 1
            self.events.append(("ended", command, config))

    def began(self, command: str) -> list[str]:
        return [config for what, name, config in self.events if (what, name) == ("began", command)]


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """Experiments whose commands are in the hands of a test."""
    monkeypatch.setattr(side_by_side, "SECONDS_BETWEEN_LOOKS", 0.01)

    def asked(commands, *names, seeds=(0,)):
        monkeypatch.setattr(CommandRunner, "run", lambda self, *call: commands.run(self, *call))
        configs = [read_experiment(FOLDER, f"scenario_a/{name}") for name in names]
        return [ExperimentRun(config, seed, tmp_path) for seed in seeds for config in configs]

    return asked


def test_runs_side_by_side_are_all_done_in_their_logs_with_their_share_of_the_cores(asked):
    commands, reported = _Commands(), []
    experiments = asked(commands, "deltaco", "language_only", "one_hot", seeds=(0, 1))
    run_side_by_side(experiments, 2, reported.append)
    assert [event[:2] for event in commands.events[:4]] == [("began", "collect"), ("ended", "collect")] * 2
    assert len(commands.began("collect")) == 2  # all share their data
    assert len(commands.began("train")) == len(commands.began("evaluate")) == 6
    assert sorted(reported) == sorted(experiment.folder for experiment in experiments)
    assert commands.most_at_once == 2
    for config in ("deltaco", "language_only", "one_hot"):
        assert commands.runners[config].log.parent.name == config
        assert commands.runners[config].n_threads == max(1, available_cores() // 2)


def test_fewer_runs_than_jobs_take_all_cores(asked):
    commands = _Commands()
    run_side_by_side(asked(commands, "deltaco"), 100, lambda run: None)
    assert commands.runners["deltaco"].n_threads == available_cores()


@pytest.mark.parametrize(("listed", "expected"), [("2,3", ["2", "3"]), ("", []), ("1,-1,2", ["1"])])
def test_the_gpus_are_those_that_the_environment_lists(monkeypatch, listed, expected):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", listed)
    assert gpus.visible_gpus() == expected


def test_without_a_list_all_gpus_are_visible(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    assert gpus.visible_gpus() == ["0", "1", "2"]


def test_each_of_several_runs_gets_a_gpu_of_its_own(asked, monkeypatch):
    """No GPU has two runs while another one has none, also after some have ended."""
    monkeypatch.setattr(side_by_side, "visible_gpus", lambda: ["5", "7", "GPU-1c"])
    at_once, most = Counter(), Counter()

    class Commands(_Commands):
        def run(self, runner, command, arguments):
            at_once[runner.gpu] += command != "collect"
            for gpu in at_once:
                most[gpu] = max(most[gpu], at_once[gpu])
            super().run(runner, command, arguments)
            at_once[runner.gpu] -= command != "collect"

    run_side_by_side(
        asked(Commands(), "deltaco", "language_only", "one_hot", seeds=(0, 1, 2)), 3, lambda run: None
    )
    assert most == {None: 0, "5": 1, "7": 1, "GPU-1c": 1}
    most.clear()
    run_side_by_side(asked(Commands(), "deltaco", seeds=range(10, 15)), 5, lambda run: None)
    assert sorted(most[gpu] for gpu in ("5", "7", "GPU-1c")) == [1, 2, 2]


@pytest.mark.parametrize(("gpus", "device"), [(["0"], "cuda"), (["0", "1"], "cpu"), (["0", "1"], "cuda:1")])
def test_a_run_sees_all_gpus_where_it_has_no_choice(asked, monkeypatch, tmp_path, gpus, device):
    monkeypatch.setattr(side_by_side, "visible_gpus", lambda: gpus)
    commands = _Commands()
    asked(commands)
    config = read_experiment(FOLDER, "scenario_a/deltaco", [f"policy.device={device}"])
    run_side_by_side([ExperimentRun(config, seed, tmp_path) for seed in (0, 1)], 2, lambda run: None)
    assert {runner.gpu for runner in commands.runners.values()} == {None}


# One step alone


@pytest.fixture
def called(monkeypatch, tmp_path):
    """Runs `deltaco-experiment`, and returns the commands that it ran."""
    calls = []
    monkeypatch.setattr(CommandRunner, "run", lambda _, *call: calls.append(call))

    def called(*arguments):
        calls.clear()
        experiment_command.main(
            [*arguments, "--experiments", str(FOLDER), "--out", str(tmp_path), "--seed", "0", "1"]
        )
        return [command for command, _ in calls]

    return called


def finish_data(outputs, name):
    config = read_experiment(FOLDER, name)
    for plan in (config.data, config.demonstrations):
        info = dataset_folder(outputs, plan) / "meta/info.json"
        info.parent.mkdir(parents=True)
        info.write_text('{"codebase_version": "v3.0"}')


def finish_training(outputs, name, seed, step):
    last = run_folder(outputs, name, seed) / "checkpoints/last"
    for path, text in (
        ("pretrained_model/train_config.json", "{}"),
        ("training_state/training_step.json", f'{{"step": {step}}}'),
    ):
        (last / path).parent.mkdir(parents=True, exist_ok=True)
        (last / path).write_text(text)


def test_a_step_alone_runs_nothing_else(called, tmp_path):
    names = ("small_a/deltaco", "small_a/language_only")
    # Both experiments and seeds share the datasets.
    assert called(*names, "--only", "collect") == ["collect"] * 2
    finish_data(tmp_path, names[0])
    for jobs in ("1", "2"):
        assert called(*names, "--only", "train", "--jobs", jobs) == ["train"] * 4
    steps = read_experiment(FOLDER, names[0]).training["steps"]
    for name in names:
        for seed in (0, 1):
            finish_training(tmp_path, name, seed, steps)
    assert called(*names, "--only", "train") == []
    for jobs in ("1", "2"):
        assert called(*names, "--only", "evaluate", "--jobs", jobs) == ["evaluate"] * 4


def test_a_step_alone_says_what_it_lacks(called, tmp_path, capsys):
    def refusal(*arguments):
        with pytest.raises(SystemExit):
            called("small_a/deltaco", *arguments)
        return capsys.readouterr().err

    assert "is missing. Collect it first: deltaco-experiment small_a/deltaco --only collect" in refusal(
        "--only", "train"
    )
    finish_data(tmp_path, "small_a/deltaco")
    info = next((tmp_path / "data").glob("*/meta/info.json"))
    info.write_text(f'{{"codebase_version": "{UNFINISHED}"}}')
    assert f"{info.parents[1]}, which is not finished" in refusal("--only", "train")
    assert "has no checkpoint. Finish it first: deltaco-experiment small_a/deltaco --seed 0" in refusal(
        "--only", "evaluate"
    )
    finish_training(tmp_path, "small_a/deltaco", 0, 7)
    assert "stands at step 7 of" in refusal("--only", "evaluate")
    assert "--only report needs --report" in refusal("--only", "report")
    assert (
        "no record of an evaluation of small_a/deltaco with seed 0, small_a/deltaco with seed 1"
        in refusal("--only", "report", "--report", str(tmp_path / "report"))
    )


def test_a_dry_run_prints_the_commands_of_a_step_alone(called, capsys):
    assert called("small_a/deltaco", "--dry-run", "--only", "collect") == []
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["deltaco-collect"] * 2


def test_the_draw_of_distractors_is_passed_on_to_all_commands(called, capsys):
    settings = {
        "data.adversarial_draw": "scene",
        "demonstrations.adversarial_draw": "scene",
        "evaluation.adversarial_draw": "scene",
        "training.env_eval_freq": "1",
    }
    changes = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    called("small_a/deltaco", "--dry-run", *changes)
    commands = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {command[0] for command in commands} == {"deltaco-collect", "deltaco-train", "deltaco-evaluate"}
    for command in commands:
        option = "--env.adversarial_draw" if command[0] == "deltaco-train" else "--adversarial-draw"
        assert f"{option}=scene" in command


def test_shards_are_passed_on_to_the_collections(called, monkeypatch, capsys):
    arguments = []
    monkeypatch.setattr(CommandRunner, "run", lambda _, *call: arguments.append(call[1]))
    called("small_a/deltaco", "--only", "collect", "--shard", "2/5")
    called("small_a/deltaco", "--only", "collect", "--join")
    assert [call[-1] for call in arguments] == ["--shard=2/5"] * 2 + ["--join"] * 2
    with pytest.raises(SystemExit):
        called("small_a/deltaco", "--join")
    assert "--shard and --join need --only collect" in capsys.readouterr().err


def test_a_row_waits_for_the_one_that_it_starts_from(asked, monkeypatch):
    commands = _Commands()
    experiments = asked(commands, "demo_only_finetuned_10", "demo_only", "deltaco")
    monkeypatch.setattr(
        ExperimentRun,
        "train_and_evaluate",
        lambda self, runner, step: commands.run(runner, "train", [f"--output_dir={self.folder}"]),
    )
    run_side_by_side(experiments, 3, lambda run: None)
    began = commands.events.index(("began", "train", "demo_only_finetuned_10"))
    assert commands.events.index(("ended", "train", "demo_only")) < began


def test_after_a_failure_what_has_begun_is_completed_and_nothing_else_begins(asked, monkeypatch):
    said = threading.Event()
    commands, reported = _Commands("language_only", until=said), []
    experiments = asked(commands, "deltaco", "language_only", "one_hot")

    def write(text):
        if "language_only 0: train failed" in text:
            said.set()

    monkeypatch.setattr(side_by_side._Progress, "write", staticmethod(write))
    with pytest.raises(ExperimentError, match="train failed"):
        run_side_by_side(experiments, 2, reported.append)
    assert reported == [experiments[0].folder]
    assert sorted(commands.began("train")) == ["deltaco", "language_only"]
    # What never began may be asked for with other settings.
    other = read_experiment(FOLDER, "scenario_a/one_hot", ["training.steps=7"])
    ExperimentRun(other, 0, experiments[0].outputs).check_settings()


def test_a_report_that_fails_does_not_take_the_other_runs_along(asked):
    commands = _Commands()

    def report(run):
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        run_side_by_side(asked(commands, "deltaco", "language_only"), 2, report)
    assert sorted(commands.began("evaluate")) == ["deltaco", "language_only"]


def test_an_interrupt_stops_what_runs(asked, monkeypatch):
    stopped = threading.Event()
    commands = _Commands(until=stopped)
    experiments = asked(commands, "deltaco", "language_only")
    monkeypatch.setattr(CommandRunner, "stop", lambda self: stopped.set())

    def show(self, running):
        raise KeyboardInterrupt

    monkeypatch.setattr(side_by_side._Progress, "show", show)
    with pytest.raises(KeyboardInterrupt):
        run_side_by_side(experiments, 2, lambda run: None)
    assert stopped.is_set()


def test_a_row_that_is_named_twice_is_run_once(asked, tmp_path):
    commands = _Commands()
    asked(commands)
    experiment_command.main(
        ["scenario_a/deltaco"] * 2
        + ["--seed", "0", "0", "--jobs", "2", "--experiments", str(FOLDER), "--out", str(tmp_path)]
    )
    assert commands.began("train") == ["deltaco"]


@pytest.mark.parametrize("jobs", ["0", "-1"])
def test_there_is_at_least_one_job(jobs, capsys):
    with pytest.raises(SystemExit):
        experiment_command.main(["scenario_a/deltaco", "--jobs", jobs])
    assert "--jobs must be at least 1" in capsys.readouterr().err


def test_the_last_progress_bar_of_a_log_is_found(tmp_path):
    log = tmp_path / "log"
    assert side_by_side.last_progress(log) == ""
    log.write_text("Collecting: 100%|##| 4/4 [00:01<00:00, 4.0it/s]\nno bar here\n")
    assert side_by_side.last_progress(log) == "100%, 00:00 left"
    with log.open("a", encoding="utf-8") as file:
        file.write("x" * 5000 + "\rTraining:  70%|███   | 7/10 [00:20<1:00:08, 2.8step/s]INFO step:7")
    assert side_by_side.last_progress(log) == "70%, 1:00:08 left"
    log.write_text("Training:   0%|   | 0/10 [00:00<?, ?step/s]")
    assert side_by_side.last_progress(log) == "0%, ? left"


# Commands


def test_a_command_prints_to_its_log_with_its_share_of_the_cores(tmp_path, monkeypatch):
    started = {}

    class Process:
        def __init__(self, words, **options):
            started.update(options, words=words)
            options["stdout"].write("what it says\n")

        def wait(self):
            return 0

    monkeypatch.setattr(subprocess, "Popen", Process)
    log = tmp_path / "log"
    log.write_text("of before\n")
    CommandRunner(log, n_threads=3, gpu="2").run("train", ["--steps=5"])
    assert log.read_text() == "of before\n\ndeltaco-train --steps=5\nwhat it says\n"
    assert started["words"][-2:] == ["lerobot_deltaco.commands.train", "--steps=5"]
    assert started["stderr"] == subprocess.STDOUT
    assert started["env"]["OMP_NUM_THREADS"] == "3"
    assert started["env"]["CUDA_VISIBLE_DEVICES"] == "2"


def test_a_command_that_fails_names_its_log_which_says_why(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(ExperimentError, match=re.escape(f"exit status 2); see {log}")):
        CommandRunner(log).run("embed", ["--no-such-option"])
    assert "usage: deltaco-embed" in log.read_text()


def test_a_command_can_be_stopped_and_no_other_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(command_runner, "SECONDS_TO_END", 0.2)
    monkeypatch.setattr(sys, "executable", _sleeper(tmp_path))
    runner = CommandRunner(tmp_path / "log")
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(runner.run, "train", [])
        while "asleep" not in ((tmp_path / "log").read_text() if (tmp_path / "log").exists() else ""):
            time.sleep(0.01)
        runner.stop()
        with pytest.raises(ExperimentError, match="train failed"):
            running.result(timeout=60)
    with pytest.raises(ExperimentError, match="evaluate was not begun"):
        runner.run("evaluate", [])


def _sleeper(folder):
    """A program that sleeps until it is killed: an interrupt does not wake it."""
    program = folder / "sleeper"
    program.write_text("#!/bin/sh\ntrap '' INT\necho asleep\nexec sleep 600\n")
    program.chmod(0o755)
    return str(program)


@pytest.mark.slow
def test_a_row_runs_from_its_data_to_its_evaluation_and_goes_on(tmp_path, capsys):
    folder = tmp_path / "experiments" / "tiny"
    folder.mkdir(parents=True)
    (folder / "deltaco.yaml").write_text(
        """
data: {tasks: "4,14,55", episodes_per_task: 2}
demonstrations: {tasks: "4,14", split: validation, episodes_per_task: 1}
policy: {language_encoder: all-MiniLM-L6-v2, backbone: strided, device: cpu, tasks_per_batch: 3}
training: {batch_size: 6, steps: 9, save_freq: 2, env_eval_freq: 1}
evaluation: {tasks: "4,14", trials: 1, seed: 0}
"""
    )
    out = tmp_path / "out"
    arguments = ["tiny/deltaco", "--experiments", str(folder.parent), "--out", str(out), "--seed", "3", "4"]
    arguments += ["--set", "training.steps=4", "--report", str(tmp_path / "report")]
    experiment_command.main([*arguments, "--jobs", "2"])
    records = sorted((out / "tiny/deltaco").glob("seed_*/evaluations/*.json"))
    assert [path.stem for path in records] == ["0000001", "0000002", "0000003", "0000004"] * 2
    assert "| deltaco | 3, 4 |" in (tmp_path / "report" / "report.md").read_text()
    times = [path.stat().st_mtime_ns for path in records]
    experiment_command.main(arguments)
    assert [path.stat().st_mtime_ns for path in records] == times


@pytest.mark.slow
@pytest.mark.skipif(not (FOLDER.parent / ".venv/.installed").exists(), reason="not the environment of `make`")
def test_the_command_for_a_gpu_runs_without_one_at_a_tiny_size(tmp_path):
    settings = {
        "data.tasks": "4,14",
        "data.episodes_per_task": 2,
        "demonstrations.tasks": "4,14",
        "demonstrations.split": "validation",
        "policy.compile": "false",
        "policy.backbone": "strided",
        "policy.language_encoder": "all-MiniLM-L6-v2",
        "policy.tasks_per_batch": 2,
        "training.batch_size": 4,
        "evaluation.tasks": "4,14",
        "evaluation.trials": 1,
    }
    variables = {
        "STEPS": 2,
        "EVALUATE_EVERY": 1,
        "DEVICE": "cpu",
        "OUT": tmp_path / "out",
        "REPORT": tmp_path / "report",
        "SETTINGS": " ".join(f"--set {name}={value}" for name, value in settings.items()),
    }
    arguments = [f"{name}={value}" for name, value in variables.items()]
    command = ["make", "-C", str(FOLDER.parent), "gpu-scenario-a", *arguments]
    subprocess.run(command, check=True, env={**os.environ, "HF_HUB_OFFLINE": "1"}, timeout=900)
    report = (tmp_path / "report" / "report.md").read_text()
    assert all(f"scenario_a/{config}" in report for config in ("deltaco", "language_only", "demo_only"))
