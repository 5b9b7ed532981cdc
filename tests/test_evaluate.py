"""Evaluation sets: which scenes, what the policy is given, and what is recorded."""

import json
import random
import shutil
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from gymnasium.utils import seeding
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.scripts import lerobot_train
from small_policies import use_fake_encoder

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Expert
from gym_deltaco.layout import sample_layout
from gym_deltaco.object_sets import ADVERSARIAL_DRAWS
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task
from lerobot_deltaco.commands import collect as collect_command
from lerobot_deltaco.commands import evaluate as evaluate_command
from lerobot_deltaco.common.run_folder import RunError, checkpoints, describe
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import check_policy_fits
from lerobot_deltaco.evaluation import sets
from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.evaluation.episodes import counterfactual_task, scene_info
from lerobot_deltaco.evaluation.evaluate import Evaluation, evaluate
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import read_record, record_path, write_record
from lerobot_deltaco.training.loop import InMemoryTraining

TASKS = (4, 14, 55)
# For what is decided before the first step. An episode of three steps takes a tenth of the time.
short_plan = partial(EvaluationPlan, episode_length=3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training run of two steps, with checkpoints of both, on a small set of the expert's episodes."""
    folder = tmp_path_factory.mktemp("run")
    root = str(folder / "data")
    collect_command.main(["--tasks", "4,14,55", "--episodes-per-task", "2", "--root", root, "--workers", "1"])
    train(root, folder / "training")
    return folder / "training"


def train(root, folder, **more):
    arguments = {
        "policy.type": "deltaco",
        "policy.device": "cpu",
        "policy.backbone": "strided",
        "policy.demo_repo_id": "test/data",
        "policy.demo_root": root,
        "dataset.repo_id": "test/data",
        "dataset.root": root,
        "batch_size": "6",
        "steps": "2",
        "save_freq": "1",
        "num_workers": "0",
        "job_name": "small/deltaco",
        "seed": "7",
        "output_dir": str(folder),
        **more,
    }
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        patch.setattr(sys, "argv", ["train", *(f"--{key}={value}" for key, value in arguments.items())])
        with InMemoryTraining().active():
            lerobot_train.main()


@pytest.fixture
def loaded(run):
    return load_policy(checkpoints(run)[-1].folder)


def test_an_evaluation_set_is_a_function_of_the_seed_and_the_set(run, loaded):
    plan = EvaluationPlan("4,14", trials=2, seed=3)
    episodes = evaluate(*loaded, plan, set_number=10)
    assert [(episode.task_id, episode.trial) for episode in episodes] == [(4, 0), (4, 1), (14, 0), (14, 1)]
    for episode in episodes:
        assert episode.seed == episode_seed(3, "evaluation", episode.task_id, 10, episode.trial)
        assert episode.instruction == episode.demonstration == get_task(episode.task_id).instruction
        env = PickPlaceEnv()
        _, info = env.reset(seed=episode.seed, options={"task_id": episode.task_id})
        assert episode.objects == info["objects"].tolist()
        assert episode.target_object == info["target_object"]
        assert episode.container_quadrants == info["container_quadrants"].tolist()
        env.close()
    again = evaluate(*load_policy(checkpoints(run)[-1].folder), plan, set_number=10)
    assert again == episodes
    other = evaluate(*loaded, plan, set_number=11)
    assert {episode.seed for episode in other}.isdisjoint(episode.seed for episode in episodes)
    assert evaluate(*loaded, replace(plan, scene_set=10), set_number=11) == episodes


def test_the_demonstrations_of_a_task_take_turns_and_are_recorded(loaded):
    episodes = evaluate(*loaded, short_plan("4,14", trials=3), set_number=0)
    # Two episodes of each of the tasks 4, 14 and 55 were collected, one task after the other.
    assert [episode.demonstration_episodes for episode in episodes] == [[0], [1], [0], [2], [3], [2]]
    assert [episode.demonstrated_objects for episode in episodes] == [[4]] * 3 + [[14]] * 3


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"instruction": "Put it away."}, [[0], [1], [0], [2], [3], [2]]),
        ({"counterfactual": "instruction"}, [[0], [1], [0], [2], [3], [2]]),
        ({"counterfactual": "demo"}, [[2], [3], [2], [0], [1], [0]]),
    ],
    ids=["a sentence for all tasks", "instruction", "demo"],
)
def test_they_take_turns_whatever_the_instruction_and_the_order_of_the_batches(loaded, settings, expected):
    plan = short_plan("4,14", trials=3, **settings)
    with Evaluation(*loaded, plan, 0) as evaluation:
        assert len(evaluation.batches) == 3
        outcomes = [outcome for number in (2, 0, 1) for outcome in evaluation.run(number)]
        found = [outcome.result for outcome in evaluation.in_task_order(outcomes)]
    assert [episode.demonstration_episodes for episode in found] == expected
    assert loaded.policy._episode_tasks.turns is None


def test_distractors_are_drawn_as_the_plan_says(loaded):
    def distractors(**settings):
        episodes = evaluate(*loaded, short_plan("4", trials=12, **settings), set_number=0)
        return [index for item in episodes for index in item.objects if index != 4]

    # Alike to the smushed dumbbell in shape or color are the objects 0, 2 and 7.
    assert set(distractors(adversarial_probability=1.0)) <= {0, 2, 7}
    uniform = distractors(adversarial_probability=0.0)
    assert sum(index in {0, 2, 7} for index in uniform) < 12
    assert max(uniform) >= 24
    assert max(distractors(adversarial_probability=0.0, objects="scenario_a_train")) < 24


@pytest.mark.parametrize("draw", ADVERSARIAL_DRAWS)
def test_distractors_are_drawn_each_or_together_as_the_plan_says(loaded, draw):
    plan = short_plan("4", trials=6, adversarial_draw=draw)
    for episode in evaluate(*loaded, plan, set_number=0):
        rng, _ = seeding.np_random(episode.seed)
        layout = sample_layout(get_task(4), "container", rng, adversarial_draw=draw)
        assert episode.objects == [item.label.index for item in layout.objects]
        assert scene_info(plan, get_task(4), episode.seed)["objects"] == episode.objects


def test_the_outcome_is_that_of_the_scene_at_the_end(loaded, monkeypatch):
    # The policy's place is taken by the expert, which succeeds.
    experts = []
    reset = PickPlaceEnv.reset

    def noted(self, **arguments):
        result = reset(self, **arguments)
        experts.append(Expert(self, np.random.default_rng(0), noise=0.0))
        return result

    monkeypatch.setattr(PickPlaceEnv, "reset", noted)
    monkeypatch.setattr(
        loaded.policy,
        "select_action",
        lambda batch: torch.as_tensor(
            np.stack([expert.act() for expert in experts[-len(batch["task"]) :]]), dtype=torch.float32
        ),
    )
    episodes = evaluate(*loaded, EvaluationPlan("4,14,55", trials=1), set_number=0)
    assert sum(episode.success for episode in episodes) >= 2
    for episode in episodes:
        if episode.success:
            assert episode.object_containers[episode.target_object] == episode.target_container
            assert episode.right_object
            assert episode.right_container


@pytest.mark.parametrize("changed", ["demo", "instruction"])
def test_a_counterfactual_changes_one_of_both(loaded, changed):
    plan = short_plan("4,14,55", trials=2, counterfactual=changed)
    for episode in evaluate(*loaded, plan, set_number=0):
        own = get_task(episode.task_id).instruction
        given = {"demo": episode.demonstration, "instruction": episode.instruction}
        assert given.pop(changed) != own
        assert list(given.values()) == [own]


def test_the_other_task_asks_for_another_object_of_the_scene_and_the_other_container():
    # Objects 4, 14 and 20; the green container is meant, which stands at the right back.
    info = {
        "objects": np.array([4, 14, 20]),
        "target_object": 0,
        "target_container": 0,
        "container_quadrants": np.array([[0, 0], [1, 1]]),
    }
    others = [get_task(index) for index in (5, 14, 64, 55, 214, 100)]
    chosen = {counterfactual_task(others, info, random.Random(seed)).index for seed in range(30)}
    # 64: object 14 into red. 214 is object 14 into left, which is where the red container stands.
    assert chosen == {64, 214}
    # Without such a task, at least the container is another.
    assert counterfactual_task([get_task(5), get_task(55)], info, random.Random(0)).index == 55
    with pytest.raises(ValueError, match="at least two tasks"):
        counterfactual_task([], info, random.Random(0))


def test_the_command_writes_a_record_of_each_checkpoint_once(run, capsys, monkeypatch):
    arguments = [str(run), "--tasks", "4,14", "--trials", "1"]
    evaluate_command.main(arguments)
    paths = [record_path(run, step) for step in (1, 2)]
    record = read_record(paths[-1])
    assert (record.experiment, record.method, record.run_seed) == ("small/deltaco", "deltaco", 7)
    assert (record.step, record.tasks, record.trials, len(record.episodes)) == (2, "4,14", 1, 2)
    assert record.versions["benchmark"] == "gym_deltaco/PickPlace-v0"
    assert record.command == f"deltaco-evaluate {run} --tasks 4,14 --trials 1"
    assert (record.objects, record.adversarial_probability) == ("all", 0.6)
    assert record.adversarial_draw == "each"
    assert capsys.readouterr().out.count("succeeded") == 2

    def must_not_run(*arguments):
        raise AssertionError("evaluated again")

    monkeypatch.setattr(sets, "run_set", must_not_run)
    evaluate_command.main(arguments)
    assert capsys.readouterr().out.count("already evaluated") == 2


def test_checkpoints_of_different_steps_are_evaluated_in_the_same_scenes_on_request(run, tmp_path, capsys):
    arguments = [str(run), "--tasks", "4", "--trials", "2", "--scene-set", "2"]
    evaluate_command.main([*arguments, "--out", str(tmp_path / "same")])
    evaluate_command.main([*arguments[:-2], "--out", str(tmp_path / "own")])
    same, own = (
        [read_record(record_path(tmp_path / name, step)) for step in (1, 2)] for name in ("same", "own")
    )
    seeds = [[episode.seed for episode in record.episodes] for record in (*same, *own)]
    assert seeds[0] == seeds[1] == seeds[3] != seeds[2]
    assert [record.scene_set for record in (*same, *own)] == [2, 2, None, None]
    # By default, the set is the step's, so that this record is there already, and that of step 1 is another.
    capsys.readouterr()
    evaluate_command.main([*arguments, "--out", str(tmp_path / "own"), "--steps", "2"])
    assert "already evaluated" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, "--out", str(tmp_path / "own"), "--steps", "1"])
    assert "belongs to another evaluation" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments[:-1], "-1"])
    assert "`scene_set` must be at least 0" in capsys.readouterr().err


def test_records_of_other_evaluations_are_not_taken_for_this_one(run, capsys):
    evaluate_command.main([str(run), "--tasks", "4,14", "--trials", "1", "--steps", "last"])
    with pytest.raises(SystemExit):
        evaluate_command.main([str(run), "--tasks", "4,14", "--trials", "2", "--steps", "last"])
    assert "belongs to another evaluation" in capsys.readouterr().err
    for changed in (["--adversarial-probability", "0"], ["--adversarial-draw", "scene"]):
        with pytest.raises(SystemExit):
            evaluate_command.main([str(run), "--tasks", "4,14", "--trials", "1", "--steps", "last", *changed])
        assert "belongs to another evaluation" in capsys.readouterr().err


def test_the_record_of_another_policy_is_not_taken_for_this_ones(run, tmp_path, capsys):
    arguments = ["--tasks", "4", "--trials", "1", "--steps", "last", "--out", str(tmp_path / "out")]
    evaluate_command.main([str(run), *arguments])
    path = record_path(tmp_path / "out", 2)
    record = read_record(path)
    assert record.weights is not None
    assert len(record.weights) == 64
    write_record(replace(record, weights="0" * 64), path)
    with pytest.raises(SystemExit):
        evaluate_command.main([str(run), *arguments])
    assert "belongs to another policy" in capsys.readouterr().err
    # Records of earlier versions do not tell.
    write_record(replace(record, weights=None), path)
    evaluate_command.main([str(run), *arguments])
    assert "already evaluated" in capsys.readouterr().out


def test_a_record_with_other_demonstrations_is_another_evaluation(run, tmp_path, capsys):
    arguments = [str(run), "--tasks", "4", "--trials", "1", "--steps", "last", "--out", str(tmp_path / "out")]
    demos = ["--policy.demo_repo_id", "test/others", "--policy.demo_root", str(run.parent / "data")]
    evaluate_command.main([*arguments, *demos])
    assert read_record(record_path(tmp_path / "out", 2)).demonstrations == "test/others"
    capsys.readouterr()
    evaluate_command.main([*arguments, *demos])
    assert "already evaluated" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate_command.main(arguments)
    assert "'demonstrations': 'test/others'" in capsys.readouterr().err
    # Others of the same name are others.
    shutil.copytree(run.parent / "data" / "meta", tmp_path / "renamed" / "meta")
    stats = tmp_path / "renamed" / "meta" / "stats.json"
    stats.write_text(stats.read_text() + " ")
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, *demos[:-1], str(tmp_path / "renamed")])
    assert "SHA-256 of the demonstrations' metadata" in capsys.readouterr().err


def test_other_tasks_are_evaluated_with_other_demonstrations_into_another_folder(run, tmp_path, capsys):
    collect_command.main(["--tasks", "7", "--episodes-per-task", "1", "--root", str(tmp_path / "demos")])
    arguments = [str(run), "--tasks", "7", "--trials", "1", "--steps", "last"]
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, "--out", str(tmp_path / "out")])
    assert "--policy.demo_root" in capsys.readouterr().err
    demos = ["--policy.demo_repo_id", "test/demos", "--policy.demo_root", str(tmp_path / "demos")]
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        evaluate_command.main([*arguments, *demos, "--out", str(tmp_path / "out")])
    (episode,) = read_record(record_path(tmp_path / "out", 2)).episodes
    assert episode.demonstration == episode.instruction == get_task(7).instruction
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, "--experiment", "another", "--out", str(tmp_path / "out")])
    assert "belongs to another run: 'small/deltaco' with seed 7" in capsys.readouterr().err


@pytest.fixture
def sentences(tmp_path):
    """A file with two sentences for each of two tasks."""
    file = tmp_path / "sentences.csv"
    rows = [f"{task},sentence {n} of {task}" for task in TASKS[:2] for n in range(2)]
    file.write_text("\n".join(["task_id,instruction", *rows]))
    return file


@pytest.mark.parametrize(
    ("split", "expected"),
    [("all", [0, 1, 0]), ("held_out", [1, 1, 1]), ("train", [0, 0, 0])],
)
def test_the_policy_receives_a_files_sentences_in_turn(loaded, sentences, monkeypatch, split, expected):
    use_fake_encoder(monkeypatch)
    plan = short_plan("4,14", 3, instructions=str(sentences), instructions_split=split)
    episodes = evaluate(*loaded, plan, 0)
    assert [episode.instruction for episode in episodes] == [
        f"sentence {n} of {task}" for task in (4, 14) for n in expected
    ]
    # The demonstrations and the scenes are those of the tasks.
    plain = evaluate(*loaded, short_plan("4,14", 3), 0)
    assert [(episode.demonstration, episode.objects) for episode in episodes] == [
        (episode.demonstration, episode.objects) for episode in plain
    ]


def test_a_typed_sentence_is_evaluated_in_one_call(loaded, monkeypatch):
    use_fake_encoder(monkeypatch)
    sentence = "putt the speckeld hourglas  in teh green one"
    (episode,) = evaluate(*loaded, short_plan("4", 1, instruction=sentence), 0)
    assert episode.instruction == " ".join(sentence.split())
    assert episode.demonstration == get_task(4).instruction


def test_records_say_whose_words_the_instructions_are(run, sentences, tmp_path, capsys, monkeypatch):
    use_fake_encoder(monkeypatch)
    arguments = [str(run), "--tasks", "4", "--trials", "1", "--steps", "last", "--out", str(tmp_path / "out")]
    evaluate_command.main([*arguments, "--instructions", str(sentences), "--instructions-split", "held_out"])
    record = read_record(record_path(tmp_path / "out", 2))
    assert record.wording.startswith("sentences.csv (held_out), SHA-256 ")
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, "--instructions", str(sentences)])
    assert "belongs to another evaluation" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        evaluate_command.main(arguments)
    assert "'wording': 'templates'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--instruction", "put it there"], "folder for its records with --out"),
        (["--instruction", " ", "--out", "out"], "`instruction` must be a sentence"),
        (["--instructions", "missing.csv", "--out", "out"], "missing.csv cannot be read"),
        (["--policy.demo_root", "data", "--out", "out"], "Give both"),
        (["--policy.demo_repo_id", "USER/NAME"], "folder for its records with --out"),
        (["another_run", "--out", "out"], "the records of a single run. Got 2 runs"),
        (["--tasks", "301"], "301"),
        (["--trials", "0"], "`trials` must be at least 1"),
        (["--objects", "none"], "`objects` must be one of all, scenario_a_train, random:N"),
        (["--tasks", "24", "--objects", "scenario_a_train"], "Task 24 asks for a gray colored"),
        (["--adversarial-probability", "2"], "`adversarial_probability` must be between 0 and 1"),
        (["--adversarial-draw", "both"], "invalid choice: 'both'"),
        (["--steps", "5"], "no checkpoint of step 5. It has those of 1, 2"),
        (["--steps", "first"], "must be 'all', 'last' or steps"),
    ],
)
def test_wrong_arguments_are_explained(run, capsys, arguments, message):
    with pytest.raises(SystemExit):
        evaluate_command.main([str(run), *arguments])
    assert message in capsys.readouterr().err


def test_a_folder_without_checkpoints_is_refused(tmp_path, capsys):
    with pytest.raises(RunError, match="has no checkpoints.*--output_dir"):
        checkpoints(tmp_path)


def test_a_checkpoint_that_is_being_written_is_left_out(tmp_path):
    folder = tmp_path / "checkpoints"
    for step in ("000002", "000004", "000006"):
        (folder / step / "pretrained_model").mkdir(parents=True)
        (folder / step / "pretrained_model" / "model.safetensors").touch()
    assert [checkpoint.step for checkpoint in checkpoints(tmp_path)] == [2, 4, 6]
    (folder / "last").symlink_to("000004")
    assert [checkpoint.step for checkpoint in checkpoints(tmp_path)] == [2, 4]


def test_the_record_is_plain_json(run):
    evaluate_command.main([str(run), "--tasks", "4,14", "--trials", "1", "--steps", "last"])
    content = json.loads(record_path(run, 2).read_text())
    assert content["policy"]["backbone"] == "strided"
    assert "input_features" not in content["policy"]


def test_evaluations_in_training_leave_the_records_that_evaluations_afterwards_do(run, tmp_path):
    environment = {"env.type": "deltaco", "env.task": "4,14", "env_eval_freq": "1", "eval.n_episodes": "2"}
    train(str(run.parent / "data"), tmp_path / "run", **environment)
    during = [read_record(record_path(tmp_path / "run", step)) for step in (1, 2)]
    shutil.rmtree(tmp_path / "run" / "evaluations")
    evaluate_command.main([str(tmp_path / "run"), "--tasks", "4,14"])
    for record in during:
        after = read_record(record_path(tmp_path / "run", record.step))
        assert record.episodes == after.episodes
        assert len(record.episodes) == 4
        assert (record.experiment, record.run_seed, record.tasks) == ("small/deltaco", 7, "4,14")
        assert record.policy == after.policy
        assert record.command.startswith("deltaco-train --policy.type=deltaco")


# The environment's settings


def test_one_draw_for_both_distractors_is_evaluated_in_training_as_afterwards(run, tmp_path):
    environment = {"env.type": "deltaco", "env.task": "4,14", "env_eval_freq": "2", "eval.n_episodes": "2"}
    train(str(run.parent / "data"), tmp_path / "run", **environment, **{"env.adversarial_draw": "scene"})
    during = read_record(record_path(tmp_path / "run", 2))
    assert during.adversarial_draw == "scene"
    arguments = [str(tmp_path / "run"), "--tasks", "4,14", "--steps", "last", "--out", str(tmp_path / "out")]
    evaluate_command.main([*arguments, "--adversarial-draw", "scene"])
    after = read_record(record_path(tmp_path / "out", 2))
    assert (after.adversarial_draw, after.episodes) == ("scene", during.episodes)


def test_image_size_and_episode_length_are_those_of_the_training(tmp_path, monkeypatch, capsys):
    root, folder = str(tmp_path / "data"), tmp_path / "run"
    collect = ["--tasks", "4,14", "--episodes-per-task", "1", "--image-size", "32", "--workers", "1"]
    collect_command.main([*collect, "--root", root])
    environment = {"env.type": "deltaco", "env.task": "4", "env_eval_freq": "1", "eval.n_episodes": "1"}
    environment |= {"env.episode_length": "7", "steps": "1"}
    with pytest.raises(ValueError, match=r"images of 32 x 32 pixels.*have 48 x 48.*--env.image_size=32"):
        train(root, tmp_path / "refused", **environment)

    n_steps = []
    step = PickPlaceEnv.step
    monkeypatch.setattr(PickPlaceEnv, "step", lambda self, action: n_steps.append(1) or step(self, action))
    train(root, folder, **environment, **{"env.image_size": "32"})
    during = read_record(record_path(folder, 1))
    assert (during.image_size, during.episode_length, len(n_steps)) == (32, 7, 7)

    shutil.rmtree(folder / "evaluations")
    n_steps.clear()
    arguments = [str(folder), "--tasks", "4", "--trials", "1"]
    evaluate_command.main(arguments)
    after = read_record(record_path(folder, 1))
    assert (after.image_size, after.episode_length, len(n_steps)) == (32, 7, 7)
    assert after.episodes == during.episodes

    n_steps.clear()
    evaluate_command.main([*arguments, "--episode-length", "3", "--out", str(tmp_path / "short")])
    assert read_record(record_path(tmp_path / "short", 1)).episode_length == len(n_steps) == 3
    for options, message in (
        (["--episode-length", "3"], "belongs to another evaluation"),
        (["--image-size", "48", "--out", str(tmp_path / "large")], "images of 32 x 32 pixels"),
        (["--image-size", "2"], "`image_size` must be at least"),
    ):
        with pytest.raises(SystemExit):
            evaluate_command.main([*arguments, *options])
        assert message in capsys.readouterr().err


def features(image=("observation.image", 48), state=10, action=4):
    name, size = image
    return {
        "input_features": {
            name: PolicyFeature(FeatureType.VISUAL, (3, size, size)),
            "observation.state": PolicyFeature(FeatureType.STATE, (state,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (action,))},
    }


@pytest.mark.parametrize(
    ("trained_on", "message"),
    [
        ({"image": ("observation.image", 64)}, "64 x 64 pixels, but those of the environment have 48 x 48"),
        ({"image": ("observation.images.front", 48)}, "images of observation.images.front, but"),
        ({"state": 6}, r"`observation.state` of the shape \(6,\), but .* is \(10,\)"),
        ({"action": 7}, r"`action` of the shape \(7,\), but .* is \(4,\)"),
    ],
)
def test_a_policy_for_something_else_is_refused(trained_on, message):
    check_policy_fits(DeltacoConfig(device="cpu", **features()), DeltacoEnv())
    with pytest.raises(ValueError, match=message):
        check_policy_fits(DeltacoConfig(device="cpu", **features(**trained_on)), DeltacoEnv())


@pytest.mark.parametrize("damage", ["", "[]", '{"job_name": 3}'])
def test_a_damaged_description_of_a_run_is_named(run, tmp_path, damage):
    folder = shutil.copytree(run, tmp_path / "run")
    checkpoint = checkpoints(folder)[0]
    (checkpoint.folder / "train_config.json").write_text(damage)
    with pytest.raises(RunError, match="train_config.json or config.json is damaged"):
        describe(checkpoint)
