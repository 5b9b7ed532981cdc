"""Evaluation: which scenes, what the policy receives, and what is recorded."""

import json
import os
import re
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.utils import seeding
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.scripts import lerobot_eval
from small_policies import ACT, DELTACO, TASK_IDS, as_options, run_training, use_fake_encoder

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Expert
from gym_deltaco.layout import sample_layout
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import get_task
from lerobot_deltaco import cli
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation import evaluate as evaluate_module
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints, load_policy
from lerobot_deltaco.evaluation.command import EvaluateArguments, evaluate_checkpoints
from lerobot_deltaco.evaluation.episodes import draw_episodes
from lerobot_deltaco.evaluation.evaluate import Evaluation, evaluate
from lerobot_deltaco.evaluation.lerobot_env import check_policy_fits
from lerobot_deltaco.evaluation.records import EvaluationPlan, read_records, scene_columns
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy
from lerobot_deltaco.policies.deltaco.configuration_deltaco import DeltacoConfig

# The project's own checkpoint. It has a demonstration of each test task, such as these.
CHECKPOINT = Path(__file__).parents[2] / "checkpoints" / "pick_place"
TEST_TASKS = "24,35"
# For what is decided before the first step: an episode of two steps takes a tenth of the time.
SHORT = SceneConfig(episode_length=2)
BRIEFLY = "--scene.episode-length", SHORT.episode_length, "--processes", 1
short_plan = partial(EvaluationPlan, scene=SHORT)


@pytest.fixture(scope="module")
def run(benchmark, tmp_path_factory):
    """A training of two steps with a checkpoint of each."""
    folder = tmp_path_factory.mktemp("run") / "deltaco"
    options = {**DELTACO, "policy.demo_repo_id": "test/small", "policy.demo_root": benchmark}
    run_training(benchmark, folder, options, steps=2, save_freq=1, job_name="small/deltaco", seed=7)
    return folder


@pytest.fixture(scope="module")
def act_checkpoint(benchmark, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "act"
    checkpoints = run_training(benchmark, folder, ACT, steps=1, save_freq=1, job_name="small/act")
    return checkpoints / "000001" / "pretrained_model"


@pytest.fixture(scope="module")
def loaded(run):
    return load_policy(find_checkpoints(run)[-1].folder)


@pytest.fixture(scope="module")
def shipped():
    return load_policy(CHECKPOINT, ["--device=cpu"])


def run_command(*arguments):
    """Runs `deltaco evaluate` in this process."""
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        patch.setattr(sys, "argv", ["deltaco", "evaluate", *map(str, arguments)])
        cli.main()


def test_the_shipped_policy_succeeds_on_novel_tasks(shipped):
    # By name, color and shape, in all containers: about as often as in the protocol, 84.6 %.
    outcomes = evaluate(shipped, EvaluationPlan("24,80,131,182,233,285,45,96,147,198,249,275", trials=2))
    assert outcomes["success"].mean() > 0.7
    assert outcomes["right_object"].mean() > 0.7


def test_outcomes_depend_neither_on_batches_nor_on_processes(shipped, monkeypatch):
    plan = EvaluationPlan(TEST_TASKS, trials=2)
    assert len(Evaluation(shipped, plan).batches) == 4
    alone = evaluate(shipped, plan, processes=2)
    assert list(zip(alone["task_id"], alone["trial"], strict=True)) == [(24, 0), (24, 1), (35, 0), (35, 1)]
    assert alone["success"].any()
    monkeypatch.setattr(evaluate_module, "_MIN_BATCHES", 1)
    assert len(Evaluation(shipped, plan).batches) == 1
    pd.testing.assert_frame_equal(evaluate(shipped, plan), alone, atol=1e-6)


@pytest.mark.parametrize(("policy", "batch_size", "scene"), [("match", 2, SceneConfig()), ("act", 1, SHORT)])
def test_lerobot_eval_has_the_same_scenes_and_successes(
    act_checkpoint, tmp_path, monkeypatch, policy, batch_size, scene
):
    folder = {"act": act_checkpoint, "match": CHECKPOINT}[policy]
    seen = []
    reset = PickPlaceEnv.reset

    def noted(self, **arguments):
        observation, info = reset(self, **arguments)
        seen.append((info["task_id"], tuple(info["objects"]), observation["agent_pos"].tobytes()))
        return observation, info

    monkeypatch.setattr(PickPlaceEnv, "reset", noted)
    options = {
        **{"policy.path": folder, "policy.device": "cpu", "output_dir": tmp_path},
        **{"env.type": "deltaco", "env.task": TEST_TASKS, "env.render_size": 16},
        **{"env.scene.episode_length": scene.n_steps, "eval.n_episodes": 2, "eval.batch_size": batch_size},
    }
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *as_options(options)])
    lerobot_eval.main()
    scenes = set(seen)
    seen.clear()
    plan = EvaluationPlan(TEST_TASKS, trials=2, scene=scene)
    evaluate_checkpoints(EvaluateArguments(folder, plan, out=tmp_path, processes=1, device="cpu"))
    assert scenes == set(seen)
    (record,) = read_records(tmp_path)
    info = json.loads((tmp_path / "eval_info.json").read_text())
    for result in info["per_task"]:
        mine = record.episodes[record.episodes["task_id"] == result["task_id"]].sort_values("trial")
        assert result["metrics"]["successes"] == mine["success"].tolist()
    assert info["overall"]["n_episodes"] == 4


def test_outcomes_are_those_of_the_scene_at_the_end(loaded, monkeypatch):
    # The expert, which succeeds, takes the policy's place.
    experts, layouts = [], []
    reset = PickPlaceEnv.reset

    def noted(self, **arguments):
        result = reset(self, **arguments)
        experts.append(Expert(self, np.random.default_rng(0), noise=0.0))
        layouts.append(self.scene.layout)
        return result

    def act(batch):
        actions = [expert.act() for expert in experts[-len(batch["task"]) :]]
        return torch.as_tensor(np.stack(actions), dtype=torch.float32)

    monkeypatch.setattr(PickPlaceEnv, "reset", noted)
    monkeypatch.setattr(loaded.policy, "select_action", act)
    rows = evaluate(loaded, EvaluationPlan("4,14,55", trials=1))
    assert rows["success"].sum() >= 2
    for row, layout in zip(rows.itertuples(), layouts, strict=True):
        if row.success:
            assert (row.right_object, row.right_container) == (True, True)
            assert row.grasped_object == layout.target_object
            assert row.object_containers[row.grasped_object] == layout.target_container


@pytest.fixture
def given(spy):
    """What `set_tasks` is given, by instruction: tasks of the demonstrations."""
    calls = []

    def note(_, instructions, demonstrations):
        tasks = [[each.task for each in own] for own in demonstrations]
        calls.extend(zip(instructions, tasks, strict=True))

    spy(TaskConditionedPolicy, "set_tasks", note)
    return calls


def test_the_trials_of_a_task_use_its_demonstrations_in_turn(loaded, run, shipped, benchmark, given):
    found = evaluate(loaded, short_plan("4,14", trials=7))
    # Six episodes of each of the tasks 4, 14, 55 and 90 were collected, one task after the other.
    numbers = [0, 1, 2, 3, 4, 5, 0, 6, 7, 8, 9, 10, 11, 6]
    assert found["demonstration_episodes"].tolist() == [[number] for number in numbers]
    assert found["demonstrated_objects"].tolist() == [[4]] * 7 + [[14]] * 7
    assert all(tasks == [instruction] for instruction, tasks in given)
    # One episode may demonstrate every instruction.
    policy = load_policy(find_checkpoints(run)[-1].folder, ["--demo_episode=13"])
    found = evaluate(policy, short_plan("4,14", trials=1))
    assert found["demonstration_episodes"].tolist() == [[13], [13]]
    policy = load_policy(find_checkpoints(run)[-1].folder, ["--demo_episode=99"])
    with pytest.raises(ValueError, match="`demo_episode` is 99, which is not among the demonstrations"):
        evaluate(policy, short_plan("4", trials=1))
    # Several may be combined.
    policy = load_policy(CHECKPOINT, ["--device=cpu", "--demo_repo_id=a/b", f"--demo_root={benchmark}"])
    found = evaluate(policy, short_plan("4", trials=2, n_demonstrations=4))
    assert found["demonstration_episodes"].tolist() == [[0, 1, 2, 3], [4, 5, 0, 1]]
    with pytest.raises(ValueError, match="`n_demonstrations` is 3, but the task .* has 1"):
        evaluate(shipped, short_plan("24", n_demonstrations=3))


@pytest.mark.parametrize("changed", ["demonstration", "instruction"])
def test_a_counterfactual_changes_one_input(loaded, given, changed):
    found = evaluate(loaded, short_plan("4,14,55,90", trials=2, counterfactual=changed))
    own = {get_task(task_id).instruction for task_id in TASK_IDS}
    rows = found.sort_values("trial", kind="stable").itertuples()  # in the order of the batches
    for row, (instruction, (shown,)) in zip(rows, given, strict=True):
        task = get_task(row.task_id)
        changed_text, kept = (shown, instruction) if changed == "demonstration" else (instruction, shown)
        assert kept == task.instruction
        assert changed_text in own - {task.instruction}
        assert get_task(row.demonstration_task).instruction == shown


def test_a_counterfactual_fits_the_scene():
    """It asks for another object that stands there, and for the other container, if there is such a task."""
    plan = EvaluationPlan("all", trials=1, counterfactual="instruction")
    tasks = {get_task(task_id).instruction: get_task(task_id) for task_id in plan.task_ids}
    for episode in draw_episodes(plan)[::10]:
        other, rng = tasks[episode.instruction], seeding.np_random(episode.seed)[0]
        layout = sample_layout(get_task(episode.task_id), plan.scene, rng)
        described = [n for n, item in enumerate(layout.objects) if other.object.describes(item.label)]
        assert len(described) == 1
        assert described != [layout.target_object]
        containers = [n for n, item in enumerate(layout.containers) if item.satisfies(other.container)]
        assert containers == [1 - layout.target_container]
    with pytest.raises(ValueError, match="at least two tasks"):
        draw_episodes(replace(plan, tasks="4"))


@pytest.mark.parametrize("left_out", ["demonstration", "instruction"])
def test_an_input_can_be_left_out(shipped, loaded, given, left_out):
    plan = short_plan(TEST_TASKS, trials=1, without=left_out)
    found = evaluate(shipped, plan)
    for instruction, demonstrations in given:
        assert (instruction == "") == (left_out == "instruction")
        assert (demonstrations == []) == (left_out == "demonstration")
    assert set(found["demonstration_task"] == -1) == {left_out == "demonstration"}
    # The paper's policy was not trained without.
    with pytest.raises(ValueError, match=left_out):
        evaluate(loaded, replace(plan, tasks="4"))


def test_sentences_of_people_are_used_in_turn(shipped, tmp_path, given):
    file = tmp_path / "people.csv"
    file.write_text("task_id,instruction\n24,one\n24,another\n24,last of 24\n35,only\n35,last of 35\n")
    plan = short_plan("24,35", trials=2, paraphrases=str(file), paraphrases_split="train")
    evaluate(shipped, plan)
    assert [instruction for instruction, _ in given] == ["one", "only", "another", "only"]
    assert {tasks[0] for _, tasks in given} == {get_task(24).instruction, get_task(35).instruction}
    given.clear()
    evaluate(shipped, short_plan("24,35", trials=1, instruction="putt it  in teh box"))
    assert [instruction for instruction, _ in given] == ["putt it in teh box"] * 2


def test_mcil_takes_the_instruction_and_the_demonstration_in_turn(benchmark, tmp_path, given):
    demos = {"policy.demo_repo_id": "test/small", "policy.demo_root": benchmark}
    options = {**DELTACO, "policy.method": "mcil", **demos}
    checkpoints = run_training(benchmark, tmp_path / "mcil", options, steps=1, save_freq=1)
    evaluate(load_policy(checkpoints / "000001" / "pretrained_model"), short_plan("4", trials=2))
    task = get_task(4).instruction
    assert given == [(task, []), ("", [task])]


def test_joint_noise_is_a_function_of_the_episode(loaded, spy):
    seen = []
    spy(evaluate_module, "preprocess_observation", lambda stacked: seen.append(stacked["agent_pos"].copy()))

    def first_states(noise, trials):
        seen.clear()
        evaluate(loaded, short_plan("4", trials=trials, joint_noise=noise))
        return seen[0]

    exact, noisy, alone = first_states(0.0, 2), first_states(2.0, 2), first_states(2.0, 1)
    difference = np.abs(noisy - exact)
    assert 0 < difference[:, :6].min() < difference[:, :6].max() < np.radians(10)
    assert not difference[:, 6:].any()
    np.testing.assert_array_equal(noisy[:1], alone)


def test_the_command_records_each_checkpoint_once(run, tmp_path, capsys, monkeypatch):
    arguments = [run, "--tasks", "4,14", "--trials", 1, "--out", tmp_path, *BRIEFLY]
    run_command(*arguments)
    records = read_records(tmp_path)
    assert [record.step for record in records] == [1, 2]
    record = records[-1]
    assert (record.experiment, record.policy_type, record.train_seed) == ("small/deltaco", "deltaco", 7)
    assert record.plan == short_plan("4,14", trials=1)
    assert (record.wording, record.demonstrations) == ("templates", None)
    assert record.versions["benchmark"] == "gym_deltaco/PickPlace-v0"
    assert record.command.startswith("deltaco evaluate ")
    assert record.weights == find_checkpoints(run)[-1].weights_digest
    assert record.policy["backbone"] == "strided"
    assert record.episodes["instruction"].isna().all()
    assert scene_columns(record)["target_object"].between(0, 2).all()
    assert capsys.readouterr().out.count("succeeded. Record: ") == 2

    monkeypatch.setattr(evaluate_module, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    run_command(*arguments)
    assert capsys.readouterr().out.count("succeeded. Record: ") == 2


def test_different_evaluations_are_recorded_side_by_side(run, benchmark, tmp_path):
    arguments = [run, "--tasks", "4", "--steps", "last", "--out", tmp_path, *BRIEFLY]
    evaluations = [
        [],
        ["--scene.adversarial-probability", 0],
        ["--demo-repo-id", "test/others", "--demo-root", benchmark],
        ["--experiment", "another name"],
    ]
    for more in evaluations:
        run_command(*arguments, "--trials", 1, *more)
    records = read_records(tmp_path)
    assert len(records) == len(evaluations)
    assert sorted(str(record.demonstrations) for record in records)[-2:] == ["None", "test/others"]
    assert "another name" in {record.experiment for record in records}
    # A record of the same evaluation of another policy is refused.
    path = tmp_path / "other" / "000002" / "pretrained_model"
    other = shutil.copytree(find_checkpoints(run)[0].folder, path)
    with pytest.raises(SystemExit, match="is the record of another policy: its weights are not those of"):
        run_command(other, *arguments[1:], "--trials", 1)


def test_an_interrupted_evaluation_leaves_no_record(run, loaded, tmp_path, monkeypatch):
    numbers = []

    def interrupted(self, number, run=Evaluation.run):
        numbers.append(number)
        if number == 1:
            raise KeyboardInterrupt
        return run(self, number)

    monkeypatch.setattr(Evaluation, "run", interrupted)
    with pytest.raises(SystemExit, match="Interrupted. Run the same command again"):
        run_command(run, "--tasks", "4,14", "--steps", 1, "--out", tmp_path, *BRIEFLY)
    assert numbers == [0, 1]
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    # A process that is killed is reported.
    monkeypatch.setattr(Evaluation, "run", lambda self, number: os._exit(9))
    with pytest.raises(UserError, match="fewer --processes"):
        evaluate(loaded, short_plan("4,14", trials=1), 2)


MISTAKES = {
    "no demonstration of the task 'Put gray colored": ["--tasks", "7"],
    "no checkpoint of step '9'. Valid are all, last and 1, 2": ["--steps", "9"],
    "`trials` must be at least 1. Got 0": ["--trials", "0"],
    "this policy does not combine any": ["--n-demonstrations", "2"],
    "trained on images of 48 pixels": ["--scene.image-size", "64"],
    "mistyped, but there is no dataset": ["--demo-repo-id", "a/b", "--demo-root", "mistyped"],
    "missing.csv": ["--paraphrases", "missing.csv"],
    "has observation.images.front": ["--rename-map", '{"observation.image": "observation.images.front"}'],
}


def test_a_mistake_ends_the_command_in_one_line(run, tmp_path):
    for message, options in MISTAKES.items():
        with pytest.raises(SystemExit, match=rf"^deltaco evaluate: .*{re.escape(message)}.*$") as error:
            run_command(run, "--out", tmp_path, "--processes", 1, *options)
        assert "\n" not in str(error.value)
    assert not list(tmp_path.rglob("*.parquet"))


def test_checkpoints_are_those_that_are_complete(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "run", symlinks=True)
    last = copy / "checkpoints" / "last"
    last.unlink()
    last.symlink_to("000001")  # set when a checkpoint is complete: 000002 is being written
    assert [checkpoint.step for checkpoint in find_checkpoints(copy)] == [1]
    with pytest.raises(ValueError, match="has no checkpoints. Name the `--output_dir` of a training"):
        find_checkpoints(tmp_path)
    (copy / "checkpoints" / "000001" / "pretrained_model" / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="configuration of the policy in .* cannot be read"):
        find_checkpoints(copy)


def test_act_is_evaluated_with_other_names_of_cameras(act_checkpoint, benchmark, tmp_path):
    arguments = ["--tasks", "4,7", "--trials", 1, *BRIEFLY, "--out"]
    run_command(act_checkpoint, *arguments, tmp_path / "same")
    # The same policy, trained on a dataset that names the camera otherwise.
    copy = tmp_path / "renamed" / "checkpoints" / "000001" / "pretrained_model"
    shutil.copytree(act_checkpoint, copy)
    for path in copy.glob("*.json"):
        path.write_text(path.read_text().replace('"observation.image"', '"observation.images.front"'))
    shutil.copy(act_checkpoint / "policy_preprocessor.json", copy / "policy_preprocessor.json")
    renaming = '{"observation.image": "observation.images.front"}'
    with pytest.raises(SystemExit, match=f"rename it: --rename_map='{renaming}'"):
        run_command(copy, *arguments, tmp_path / "other")
    run_command(copy, *arguments, tmp_path / "other", "--rename-map", renaming)
    (same,), (other,) = (read_records(tmp_path / name) for name in ("same", "other"))
    assert (same.policy_type, same.experiment) == ("act", "small/act")
    assert set(same.episodes["demonstration_task"]) == {-1}
    with pytest.raises(SystemExit, match="such as act, gets the expert's demonstrations without it"):
        run_command(copy, *arguments, tmp_path / "other", "--demo-repo-id", "a/b", "--demo-root", benchmark)
    pd.testing.assert_frame_equal(same.episodes, other.episodes)


def test_draws_of_a_policy_depend_on_the_scene_alone(act_checkpoint, monkeypatch):
    policy = load_policy(act_checkpoint)
    drawn = []

    def draw(batch):
        drawn.append(torch.rand(len(batch["task"]), 4))
        return drawn[-1]

    monkeypatch.setattr(policy.policy, "select_action", draw)
    for _ in range(2):
        torch.rand(3)
        evaluate(policy, short_plan("4,14", trials=1))
    assert torch.equal(torch.stack(drawn[:4]), torch.stack(drawn[4:]))


def policy_config(cameras=("observation.image",), size=48, state=10, action=4):
    inputs = {name: PolicyFeature(FeatureType.VISUAL, (3, size, size)) for name in cameras}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (state,))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (action,))}
    return DeltacoConfig(device="cpu", input_features=inputs, output_features=outputs)


def test_a_policy_for_something_else_is_refused():
    joints = {"cameras": ("observation.images.front", "observation.images.wrist"), "state": 7, "action": 7}
    check_policy_fits(policy_config(), SceneConfig())
    check_policy_fits(policy_config(**joints), SceneConfig(control="joints"))
    for message, options in {
        "trained on images of no camera": {"cameras": ()},
        "observation.images.wrist, but": {"cameras": ("observation.image", "observation.images.wrist")},
        "Set `scene.image_size` to 96": {"size": 96},
        r"`observation.state` of the shape \(7,\)": {"state": 7},
        r"`action` of the shape \(7,\)": {"action": 7},
        "Set `scene.control` to joints": joints,
    }.items():
        with pytest.raises(ValueError, match=message):
            check_policy_fits(policy_config(**options), SceneConfig())


def test_a_vision_language_action_model_may_lack_cameras_and_pad_the_state():
    cameras = {"observation.image": SimpleNamespace(shape=(3, 256, 256)), "observation.images.wrist": None}
    model = SimpleNamespace(image_features=cameras, max_state_dim=32, empty_cameras=1, action_feature=None)
    model.robot_state_feature = SimpleNamespace(shape=(32,))
    check_policy_fits(model, SceneConfig())
    del model.max_state_dim
    with pytest.raises(ValueError, match=r"`observation.state` of the shape \(32,\)"):
        check_policy_fits(model, SceneConfig())
