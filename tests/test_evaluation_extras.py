"""Beside a record: where the policy looked, videos by outcome; any number of processes and demonstrations."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from gym_deltaco.tasks import get_task
from lerobot_deltaco.commands import evaluate as evaluate_command
from lerobot_deltaco.common.run_folder import RunError, checkpoints
from lerobot_deltaco.evaluation import processes
from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.evaluation.episode_videos import KINDS, check_explainable, kind_of, write_videos
from lerobot_deltaco.evaluation.evaluate import Evaluation, evaluate
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.processes import EvaluationError, default_processes, run_batches
from lerobot_deltaco.evaluation.record import EpisodeResult, read_record, record_path

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


# Images and videos


@pytest.fixture(scope="module")
def rendered(evaluated):
    """A folder with two explanations and a video of each kind of outcome, and the record beside it."""
    out, record = evaluated
    evaluate_command.main(
        [
            str(CHECKPOINT),
            "--tasks",
            TASKS,
            "--trials",
            "2",
            "--out",
            str(out),
            "--explain",
            "2",
            "--videos",
            "1",
        ]
    )
    assert read_record(record_path(out, STEP)) == record  # which was there, and is not made again
    return out / "evaluations" / f"{STEP:07d}", record


def test_explanations_are_images_of_episodes_spread_over_the_set(rendered):
    folder, record = rendered
    images = sorted((folder / "explanations").iterdir())
    assert [path.name[:16] for path in images] == ["task_024_trial_0", "task_035_trial_1"]
    for path in images:
        pixels = np.asarray(Image.open(path))
        assert pixels.shape[1] == 688  # the demonstration's two images, and the scene
        for color in ((255, 0, 200), (0, 220, 255)):  # rings at the grasp and at the release
            assert (pixels[-150:] == color).all(axis=-1).any()


def test_a_map_that_was_not_learned_is_not_drawn(rendered, loaded):
    # The release is the instruction's: the attention for it is untrained.
    assert loaded.policy.goals.locator.release_source != "demo"
    folder, _ = rendered
    pixels = np.asarray(Image.open(next((folder / "explanations").iterdir()))).astype(int)
    last_of_demonstration = pixels[40:240, 240:448]
    bluish = last_of_demonstration[..., 2] - last_of_demonstration[..., 0]
    assert np.median(bluish) < 20


def test_videos_are_sorted_by_outcome_with_an_index(rendered):
    folder, record = rendered
    index = json.loads((folder / "videos" / "index.json").read_text())
    counts = {kind: sum(kind_of(item) == kind for item in record.episodes) for kind in KINDS}
    assert index["episodes_by_outcome"] == counts
    assert len(index["videos"]) == sum(count > 0 for count in counts.values())
    page = (folder / "videos" / "index.html").read_text()
    sheet = Image.open(folder / "videos" / "sheet.png")
    assert sheet.height > 300 * len(index["videos"])  # a row for each outcome
    recorded = {(item.task_id, item.trial): item for item in record.episodes}
    for item in index["videos"]:
        assert item["ends_as_recorded"]
        assert kind_of(recorded[item["task_id"], item["trial"]]) == item["outcome"]
        assert item["file"].startswith(f"{item['outcome']}/task_{item['task_id']:03d}")
        assert item["file"] in page
        with av.open(str(folder / "videos" / item["file"])) as video:
            frames = list(video.decode(video=0))
        assert len(frames) == 31 + 10
        assert frames[0].width > frames[0].height  # the demonstration beside the scene


def test_a_run_that_ends_otherwise_is_said_to(rendered, loaded, tmp_path):
    _, record = rendered
    other = [replace(episode, success=not episode.success) for episode in record.episodes]
    record = replace(record, episodes=other)
    page = write_videos(tmp_path, loaded, EvaluationPlan(TASKS, trials=2), record, 1)
    assert "Ended otherwise than recorded" in page.read_text()
    index = json.loads(page.with_name("index.json").read_text())
    assert not any(item["ends_as_recorded"] for item in index["videos"])


def test_what_is_typed_is_no_markup(rendered, loaded, tmp_path):
    _, record = rendered
    sentence = "<script>alert(1)</script> & more"
    episodes = [replace(item, instruction=sentence) for item in record.episodes[:1]]
    page = write_videos(
        tmp_path, loaded, EvaluationPlan(TASKS, trials=2), replace(record, episodes=episodes), 1
    ).read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_a_policy_without_goals_is_not_explained(loaded, monkeypatch):
    monkeypatch.setattr(loaded.policy.config, "demo_encoder", "attention")
    with pytest.raises(ValueError, match=r"`demo_encoder=attention`\) finds no places"):
        check_explainable(loaded)


def episode(**changes):
    plain = EpisodeResult(
        task_id=24,
        trial=0,
        seed=0,
        instruction="",
        demonstration=None,
        success=False,
        objects=[24, 1, 2],
        object_containers=[-1, -1, -1],
        container_quadrants=[[0, 0], [1, 1]],
        target_object=0,
        target_container=0,
        grasped_object=0,
        right_object=True,
        right_container=False,
    )
    return replace(plain, **changes)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"success": True, "object_containers": [0, -1, -1]}, "success"),
        ({"grasped_object": -1, "right_object": False}, "nothing_grasped"),
        ({"grasped_object": 1, "right_object": False}, "wrong_object"),
        ({"object_containers": [1, -1, -1]}, "wrong_container"),
        ({}, "dropped"),
    ],
)
def test_episodes_are_sorted_by_what_came_of_them(changes, kind):
    assert kind_of(episode(**changes)) == kind
