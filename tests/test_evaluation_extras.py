"""Beside a record: where the policy looked, videos by outcome; any number of processes and demonstrations."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from gym_deltaco.tasks import get_task
from lerobot_deltaco.commands import evaluate as evaluate_command
from lerobot_deltaco.common.run_folder import RunError, checkpoints
from lerobot_deltaco.evaluation import processes
from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.evaluation.evaluate import Evaluation, evaluate
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.processes import EvaluationError, default_processes, run_batches
from lerobot_deltaco.evaluation.record import read_record, record_path

CHECKPOINT = Path(__file__).parents[1] / "checkpoints" / "pick_place"
STEP = 8_000
TASKS = "24,26,35"


@pytest.fixture(scope="module")
def loaded():
    return load_policy(CHECKPOINT)


def command(out, *options, tasks=TASKS):
    evaluate_command.main([str(CHECKPOINT), "--tasks", tasks, "--trials", "2", "--out", str(out), *options])
    return read_record(record_path(out, STEP))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """A folder, and the record of the checkpoint in it, made by one process."""
    out = tmp_path_factory.mktemp("evaluated")
    return out, command(out, "--processes", "1")


# A checkpoint without its run


def test_a_checkpoint_alone_is_evaluated_into_another_folder(evaluated, capsys):
    _, record = evaluated
    assert (record.experiment, record.run_seed, record.step) == ("pick_place", 0, STEP)
    assert not (CHECKPOINT / "evaluations").exists()
    with pytest.raises(SystemExit):
        evaluate_command.main([str(CHECKPOINT), "--tasks", TASKS])
    assert "is a checkpoint, not the folder of a training run" in capsys.readouterr().err


def test_its_step_is_that_of_its_folder_or_of_its_weights(tmp_path):
    assert [item.step for item in checkpoints(CHECKPOINT)] == [STEP]
    copy = shutil.copytree(CHECKPOINT, tmp_path / "000700" / "pretrained_model")
    assert [item.step for item in checkpoints(copy)] == [700]
    damaged = shutil.copytree(CHECKPOINT, tmp_path / "damaged")
    (damaged / "model.safetensors").write_bytes(b"0" * 50)
    with pytest.raises(RunError, match=r"model.safetensors is damaged"):
        checkpoints(damaged)


# Processes


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"instruction": "Put the jar in the green bin."},
        {"counterfactual": "instruction"},
        {"counterfactual": "demo", "trials": 1},
    ],
    ids=str,
)
def test_episodes_are_the_same_with_any_number_of_processes(loaded, settings):
    plan = EvaluationPlan(TASKS, **{"trials": 2, **settings})
    expected = evaluate(*loaded, plan, STEP)
    with Evaluation(*loaded, plan, STEP) as evaluation:
        assert len(evaluation.batches) >= 3
        assert [outcome.result for outcome in run_batches(evaluation, 2)] == expected


def test_the_record_is_the_same_with_any_number_of_processes(evaluated, tmp_path):
    out, one = evaluated
    three = command(tmp_path, "--processes", "3")
    assert replace(one, seconds=0, command="") == replace(three, seconds=0, command="")
    texts = [
        [
            line
            for line in record_path(folder, STEP).read_text().splitlines()
            if not line.startswith((' "seconds"', ' "command"'))
        ]
        for folder in (out, tmp_path)
    ]
    assert texts[0] == texts[1]


def test_batches_may_be_run_in_any_order(loaded):
    plan = EvaluationPlan(TASKS, trials=2, counterfactual="instruction")
    expected = evaluate(*loaded, plan, STEP)
    with Evaluation(*loaded, plan, STEP) as evaluation:
        numbers = range(len(evaluation.batches))
        assert len(numbers) >= 3
        outcomes = [outcome for number in reversed(numbers) for outcome in evaluation.run(number)]
        assert [outcome.result for outcome in evaluation.in_task_order(outcomes)] == expected


def test_an_error_in_a_process_is_the_commands(loaded):
    # Task 0 has no demonstration in the checkpoint.
    with Evaluation(*loaded, EvaluationPlan("0,24", trials=1), STEP) as evaluation:
        assert len(evaluation.batches) == 2
        with pytest.raises(ValueError, match="There is no demonstration of the task"):
            run_batches(evaluation, 2)


def test_a_process_that_dies_is_reported(loaded, monkeypatch):
    import os

    monkeypatch.setattr(processes.Evaluation, "run", lambda self, number: os._exit(9))
    with (
        Evaluation(*loaded, EvaluationPlan(TASKS, trials=1), STEP) as evaluation,
        pytest.raises(EvaluationError, match="fewer --processes"),
    ):
        run_batches(evaluation, 2)


def test_the_default_is_all_cores_or_this_runs_share(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert default_processes("cpu") == 3
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert default_processes("cpu") >= 1
    assert default_processes("cuda") == 1
    with pytest.raises(ValueError, match="Only a policy on the CPU.*on 'cuda'"):
        processes.check_processes(2, "cuda")
    with pytest.raises(ValueError, match="at least 1. Got 0"):
        processes.check_processes(0, "cpu")


@pytest.mark.parametrize("option", ["--processes=0", "--n-demonstrations=0", "--videos=-1", "--explain=-1"])
def test_numbers_that_are_too_small_are_refused(tmp_path, capsys, option):
    with pytest.raises(SystemExit):
        command(tmp_path, option)
    assert f"{option.partition('=')[0]} must be at least" in capsys.readouterr().err


# Numbers of demonstrations


def test_the_number_of_demonstrations_is_overridden_and_recorded(tmp_path, capsys):
    record = command(tmp_path, "--n-demonstrations", "1", "--processes", "1", tasks="24")
    assert record.policy["n_demonstrations"] == 1
    with pytest.raises(SystemExit):
        command(tmp_path / "more", "--n-demonstrations", "2", tasks="24")
    error = capsys.readouterr().err
    assert "`n_demonstrations` is 2, but there is a smaller number" in error
    assert "--n-demonstrations to at most 1" in error
    with pytest.raises(SystemExit):
        evaluate_command.main([str(CHECKPOINT), "--tasks", "24", "--n-demonstrations", "2"])
    assert "other demonstrations" in capsys.readouterr().err


def test_several_demonstrations_need_a_policy_that_combines_them(tmp_path, capsys):
    copy = shutil.copytree(CHECKPOINT, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    other = {"demo_encoder": "attention", "pretrained_matching": False, "demo_dropout": 0.0}
    (copy / "config.json").write_text(json.dumps({**config, **other, "instruction_dropout": 0.0}))
    with pytest.raises(SystemExit):
        evaluate_command.main(
            [str(copy), "--tasks", "24", "--n-demonstrations", "3", "--out", str(tmp_path / "out")]
        )
    assert "`n_demonstrations` has no effect with `demo_encoder=attention`" in capsys.readouterr().err


def test_the_demonstration_or_the_instruction_is_left_out(tmp_path, capsys):
    for modality, demonstration in (("demo", None), ("instruction", get_task(24).instruction)):
        out = tmp_path / modality
        record = command(out, "--leave-out", modality, "--processes", "1", tasks="24")
        assert record.policy["leave_out"] == modality
        assert record.experiment == f"pick_place_without_{modality}"
        assert {episode.demonstration for episode in record.episodes} == {demonstration}
        with pytest.raises(SystemExit):
            command(out, tasks="24")
        assert "belongs to another" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        evaluate_command.main([str(CHECKPOINT), "--tasks", "24", "--leave-out", "demo"])
    assert "with something left out" in capsys.readouterr().err


def test_what_a_policy_cannot_do_without_is_not_left_out(tmp_path, capsys):
    copy = shutil.copytree(CHECKPOINT, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "demo_dropout": 0.0}))
    with pytest.raises(SystemExit):
        evaluate_command.main(
            [str(copy), "--tasks", "24", "--leave-out", "demo", "--out", str(tmp_path / "out")]
        )
    assert "this policy was not trained without it: `demo_dropout` is 0" in capsys.readouterr().err


def test_several_demonstrations_are_taken_from_a_dataset(tmp_path):
    from lerobot_deltaco.data.collection import collect
    from lerobot_deltaco.data.collection_plan import CollectionPlan

    root = tmp_path / "demonstrations"
    collect(root, CollectionPlan("24", 3), 1)
    record = command(
        tmp_path,
        *("--n-demonstrations", "3", "--processes", "1"),
        *("--policy.demo_repo_id", "test/data", "--policy.demo_root", str(root)),
        tasks="24",
    )
    assert record.policy["n_demonstrations"] == 3
    assert [episode.demonstration_episodes for episode in record.episodes] == [[0, 1, 2]] * 2
