"""Recipes, and the steps of experiments, which are faked here: what is called, and when."""

import json
import re
from contextlib import nullcontext

import pytest
from fake_steps import FakeSteps, fake_steps

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.experiments.recipes import (
    RECIPES,
    expand_families,
    experiment_names,
    make_policy_config,
    read_recipe,
)
from lerobot_deltaco.experiments.run import TrainingRun, last_step, run_experiments

SMALL = ("training.steps=20", "training.save_freq=10")


@pytest.fixture
def steps(monkeypatch):
    """Steps that are fake and succeed."""
    return fake_steps(monkeypatch, FakeSteps())


def _run(out, *names, settings=SMALL, **options):
    return run_experiments(names or ("scenario_a/deltaco",), out=out, settings=settings, **options)


def test_all_recipes_are_valid_and_configure_their_trainings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "human_instructions.csv").write_text("task_id,instruction\n4,first\n4,second\n")
    for name in experiment_names():
        recipe = read_recipe(name)
        run = TrainingRun(recipe, 3, tmp_path)
        assert [step.name for step in run.steps()] == ["collect", "collect", "train", "evaluate"]
        options = dict(recipe.policy)
        config = make_policy_config(options)
        options.pop("precision", None)  # depends on the CPU
        assert {option: getattr(config, option) for option in options} == options
        if recipe.start_from is None:
            training = run.training_config()
            assert (training.seed, training.policy.seed) == (3, 3)
            assert training.policy.demo_root == str(run.dataset(recipe.demonstrations))
            assert training.dataset.root == str(run.dataset(recipe.data))
            assert (training.steps, training.save_freq) == (recipe.training.steps, recipe.training.save_freq)


@pytest.mark.parametrize("family", ["scenario_a", "scenario_a_finetuned", "scenario_b", "ambiguity_object"])
def test_rows_of_the_paper_are_there_at_its_scale(family):
    recipes = [read_recipe(name, "paper") for name in experiment_names() if name.startswith(f"{family}/")]
    assert {recipe.training.steps for recipe in recipes} <= {800_000, 300_000}
    assert {recipe.evaluation.trials for recipe in recipes} == {2}
    assert all("backbone" not in recipe.policy for recipe in recipes if "paper_arch" not in recipe.name)


def test_a_family_stands_for_its_experiments():
    assert expand_families(["folds", "folds/fold_0", "scenario_a/mcil"]) == [
        *("folds/fold_0", "folds/fold_1", "folds/fold_2", "folds/meshes"),
        "scenario_a/mcil",
    ]
    assert expand_families(["fold"]) == ["fold"]  # which read_recipe refuses


def test_layers_add_up():
    small, paper = (read_recipe("scenario_b/oracle", scale) for scale in ("small", "paper"))
    assert (small.data.episodes_per_task, paper.data.episodes_per_task) == (228, 750)
    assert (small.evaluation.trials, paper.evaluation.trials) == (8, 2)
    assert "upsampled_tasks" in read_recipe("scenario_b/deltaco").policy
    assert "upsampled_tasks" not in small.policy  # taken back by a null
    assert read_recipe("ambiguity_object/deltaco").evaluation.scene.ambiguity == "object"
    settings = [
        "data.scene.objects=random:200",
        "policy.optimizer_lr=1.0e-4",
        "policy.training_episodes=[1, 2]",
    ]
    own = read_recipe("random_objects/deltaco_match", settings=settings)
    assert (own.data.scene.objects, own.data.tasks) == ("random:200", "random_train")
    changed = {"optimizer_lr": 1e-4, "training_episodes": [1, 2]}
    of_type = {"device": "cpu", "paraphrases": "grammar", "grasp_height_bias": 0.5}
    assert own.policy == {"type": "deltaco_match", **of_type, **changed}


def test_a_wrong_setting_is_refused():
    for setting, message in [
        ("training.stepz=3", "`stepz` are not valid...batch_size, steps"),
        ("training.steps=many", "steps"),
        ("training.steps=0", "at least 1"),
        ("data.episodes_per_task=1.5", "episodes_per_task"),
        ("data.tasks=T199", "T199"),
        ("data.scene.objets=all", "`scene`: The fields `objets` are not valid"),
        ("data.scene=3", "value='3' into field...scene"),
        ("data.scene.objects=chairs", "`objects` must be one of"),
        ("evaluation.tasks=T198", "T198"),
        ("policy.methud=bc_z", "`methud` are not valid...method"),
        ("policy.method=[bc_z]", "`method` must be one of"),
        ("policy.language_head=wide", "language_head"),
        ("policy.type=act", "deltaco: paper, small; deltaco_match: small"),
        ("training.steps=[1,", "Cannot read"),
        ("steps=3", "must have the mappings data, ...Got 'steps': 3"),
        ("training.steps", "SECTION.NAME=VALUE"),
    ]:
        with pytest.raises(UserError, match=".*".join(map(re.escape, message.split("...")))):
            read_recipe("scenario_a/deltaco", settings=[setting])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("deltaco: {}", "deltaco: {polisy: {}}", "Got 'polisy': {}"),
        ("deltaco: {}", "deltaco: {policy: 3}", "Got 'policy': 3"),
        ("deltaco: {}", "deltaco: 3", "must have the mappings"),
        ("deltaco: {}", "deltaco: {start_from: scenario_a/nothing}", "is not an experiment"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, old, new, message):
    path = tmp_path / "recipes.yaml"
    path.write_text(RECIPES.read_text().replace(old, new, 1))
    with pytest.raises(UserError, match=re.escape(message)):
        read_recipe("scenario_a/deltaco", path=path)


def test_unknown_names_and_scales_are_refused():
    with pytest.raises(UserError, match="no experiment 'deltaco'. Valid are scenario_a/deltaco"):
        read_recipe("deltaco")
    with pytest.raises(UserError, match="no scale 'paper'"):
        read_recipe("random_objects/deltaco_match", "paper")


def test_steps_run_once(tmp_path, steps, capsys):
    page = _run(tmp_path, "scenario_a/deltaco", "scenario_a/language_only", seed=[0, 1])
    # Both datasets are shared.
    assert steps.names == ["collect"] * 2 + ["train", "evaluate"] * 4 + ["report"]
    assert page == tmp_path / "report" / "report.md"
    assert capsys.readouterr().out.count("50.0 % succeeded.\n") == 4
    steps.names.clear()
    _run(tmp_path, "scenario_a/deltaco")
    assert steps.names == ["report"]


def test_an_interrupted_run_continues(tmp_path, steps):
    expected = {
        "collect": ["collect"],
        "train": ["collect", "collect", "train"],
        "evaluate": ["resume_training", "evaluate"],
        None: ["evaluate", "report"],
    }
    for failing, names in expected.items():
        steps.names.clear()
        steps.failing = failing
        with pytest.raises(UserError) if failing else nullcontext():
            _run(tmp_path)
        assert steps.names == names


def test_training_resumes_from_its_last_checkpoint(tmp_path, steps):
    run = TrainingRun(read_recipe("scenario_a/deltaco", settings=SMALL), 0, tmp_path)
    run.folder.mkdir(parents=True)  # left by a training that stopped before its first checkpoint
    steps.failing = "train"
    with pytest.raises(UserError):
        _run(tmp_path)
    assert last_step(run.folder) == 10
    steps.failing = None
    _run(tmp_path)
    assert last_step(run.folder) == 20
    assert run.unevaluated_steps() == []
    # Another plan evaluates the checkpoints again.
    run = TrainingRun(
        read_recipe("scenario_a/deltaco", settings=(*SMALL, "evaluation.trials=1")), 0, tmp_path
    )
    assert run.unevaluated_steps() == [10, 20]
    assert [step.name for step in run.steps()] == ["evaluate"]


def test_other_settings_are_refused(tmp_path, steps):
    _run(tmp_path)
    steps.names.clear()
    with pytest.raises(UserError, match="begun with other settings: policy was"):
        _run(tmp_path, settings=(*SMALL, "policy.method=bc_z"))
    assert steps.names == []
    _run(tmp_path / "elsewhere", settings=(*SMALL, "policy.method=bc_z"))


def test_fine_tuning_starts_from_the_best_seed(tmp_path, steps):
    names = ("scenario_a_finetuned/episodes_10", "scenario_a/demo_only")
    with pytest.raises(UserError, match="no evaluated run"):
        _run(tmp_path, names[0])
    assert steps.names == []
    _run(tmp_path, *names, seed=[0, 2, 1])
    starts = [config.policy.pretrained_path for config in steps.configs]
    best = tmp_path / "small" / "scenario_a" / "demo_only" / "seed_2"
    assert starts == [None] * 3 + [best / "checkpoints" / "last" / "pretrained_model"] * 3


def test_a_dry_run_returns_the_remaining_steps(tmp_path, steps):
    lines = _run(tmp_path, dry_run=True).splitlines()
    names = [line.partition(":")[0] for line in lines]
    assert names == ["collect", "collect", "train", "evaluate", "report"]
    assert steps.names == []


@pytest.mark.slow
def test_a_small_experiment_runs_and_resumes(tmp_path, capfd):
    small = {
        "data.tasks": "24,32",
        "data.episodes_per_task": 2,
        "demonstrations.tasks": "24,32",
        "training.steps": 4,
        "training.save_freq": 2,
        "training.batch_size": 4,
        "policy.tasks_per_batch": 2,
        "evaluation.tasks": "24,32",
        "evaluation.trials": 1,
    }
    settings = [f"{name}={json.dumps(value)}" for name, value in small.items()]
    page = _run(tmp_path, settings=settings)
    assert "scenario" in page.read_text()
    run = TrainingRun(read_recipe("scenario_a/deltaco", settings=settings), 0, tmp_path)
    assert last_step(run.folder) == 4
    # A training that was interrupted after its first checkpoint continues from there.
    checkpoints = run.folder / "checkpoints"
    (checkpoints / "last").unlink()
    (checkpoints / "last").symlink_to("000002")
    capfd.readouterr()
    _run(tmp_path, settings=settings)
    assert "from step 2 to 4" in capfd.readouterr().out
    assert last_step(run.folder) == 4
