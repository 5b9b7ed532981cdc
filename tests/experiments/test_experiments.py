import itertools
import json
import re
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
from example_records import make_record

from lerobot_deltaco.evaluation import evaluate
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints
from lerobot_deltaco.evaluation.records import write_records
from lerobot_deltaco.experiments import run as experiments
from lerobot_deltaco.experiments.recipes import (
    RECIPES,
    ExperimentError,
    experiment_names,
    experiments_named,
    read_recipe,
)
from lerobot_deltaco.experiments.run import Run, last_step, run_experiments

CONFIG = {"type": "deltaco", "input_features": {"image": {"type": "VISUAL", "shape": [3, 48, 48]}}}
SMALL = ("training.steps=20", "training.save_freq=10")


class FakeCommands:
    """Leaves what the commands would leave. `failing` is the name of one that fails before its end."""

    def __init__(self):
        self.failing, self.called = None, []

    def __call__(self, arguments):
        self.called.append(arguments)
        fails = arguments[0] == self.failing
        getattr(self, f"_{arguments[0]}")(arguments, fails)
        if fails:
            raise ExperimentError("failed")

    @property
    def names(self):
        return [arguments[0] for arguments in self.called]

    def _collect(self, arguments, fails):
        info = Path(_option(arguments, "--root")) / "meta" / "info.json"
        info.parent.mkdir(parents=True, exist_ok=True)
        for file in () if fails else (info, info.with_name("deltaco.json")):
            file.write_text("{}")

    def _train(self, arguments, fails):
        options = dict(word.removeprefix("--").split("=", 1) for word in arguments[1:])
        config = Path(options.get("config_path", Path(options.get("output_dir", "")) / "train_config.json"))
        if "resume" in options:
            options = json.loads(config.read_text())
        run = Path(options["output_dir"])
        for step in range(int(options["save_freq"]), int(options["steps"]) + 1, int(options["save_freq"])):
            contents = {
                "pretrained_model/train_config.json": options,
                "pretrained_model/config.json": CONFIG,
                "pretrained_model/model.safetensors": {},
                "training_state/training_step.json": {"step": step},
            }
            for name, (file, content) in itertools.product((f"{step:06}", "last"), contents.items()):
                path = run / "checkpoints" / name / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(content))
            if fails:
                break

    def _evaluate(self, arguments, fails):
        run = Path(arguments[1])
        experiment, seed = run.parent.relative_to(run.parents[2]), int(run.name.removeprefix("seed_"))
        plan = vars(read_recipe(str(experiment)).evaluation)
        for step in (checkpoint.step for checkpoint in find_checkpoints(run)):
            path = run / "evaluations" / f"{step:06}.parquet"
            if not fails and not path.exists():
                # Later seeds succeed more often.
                record = make_record(str(experiment), seed, step, lambda _, trial: trial < seed, plan=plan)
                write_records(path, [record])

    def _report(self, arguments, fails):
        Path(_option(arguments, "--out")).mkdir(exist_ok=True)


def _option(arguments, name):
    return arguments[arguments.index(name) + 1]


@pytest.fixture
def commands(monkeypatch):
    """Commands that are fake and succeed."""
    fake = FakeCommands()
    monkeypatch.setattr(experiments, "call", fake)
    return fake


def _run(out, *names, settings=SMALL, **options):
    return run_experiments(names or ("scenario_a/deltaco",), out=out, settings=settings, **options)


def test_all_recipes_are_valid_and_make_commands(tmp_path):
    for name in experiment_names():
        recipe = read_recipe(name)
        run = Run(recipe, 3, tmp_path)
        if recipe.start_from is None:
            data, demonstrations, train, evaluate = run.commands()
            assert _option(data, "--tasks") == recipe.data.tasks
            assert _option(demonstrations, "--tasks") == recipe.demonstrations.tasks
            assert train[:2] == ["train", f"--policy.type={recipe.policy['type']}"]
            assert "--seed=3" in train
            assert not any("None" in word for word in train)
            assert evaluate[:2] == ["evaluate", str(run.folder)]


@pytest.mark.parametrize("family", ["scenario_a", "scenario_a_finetuned", "scenario_b", "ambiguity_object"])
def test_rows_of_the_paper_are_there_at_its_scale(family):
    recipes = [read_recipe(name, "paper") for name in experiment_names() if name.startswith(f"{family}/")]
    assert {recipe.training.steps for recipe in recipes} <= {800_000, 300_000}
    assert {recipe.evaluation.trials for recipe in recipes} == {2}
    assert all("backbone" not in recipe.policy for recipe in recipes if "paper_arch" not in recipe.name)


def test_a_family_stands_for_its_experiments():
    assert experiments_named(["folds", "folds/fold_0", "scenario_a/mcil"]) == [
        *("folds/fold_0", "folds/fold_1", "folds/fold_2", "folds/meshes"),
        "scenario_a/mcil",
    ]
    assert experiments_named(["fold"]) == ["fold"]  # which read_recipe refuses


def test_layers_add_up():
    small, paper = (read_recipe("scenario_b/oracle", scale) for scale in ("small", "paper"))
    assert (small.data.episodes_per_task, paper.data.episodes_per_task) == (228, 750)
    assert (small.evaluation.trials, paper.evaluation.trials) == (8, 2)
    assert "upsampled_tasks" in read_recipe("scenario_b/deltaco").policy
    assert "upsampled_tasks" not in small.policy  # taken back by a null
    assert read_recipe("ambiguity_object/deltaco").evaluation.scene.ambiguity == "object"
    settings = ["data.scene.objects=random:200", "policy.optimizer_lr=1e-4", "policy.demo_episodes=[1, 2]"]
    own = read_recipe("random_objects/deltaco_match", settings=settings)
    assert (own.data.scene.objects, own.data.tasks) == ("random:200", "random_train")
    changed = {"optimizer_lr": 1e-4, "demo_episodes": [1, 2]}
    assert own.policy == {"type": "deltaco_match", "device": "cpu", **changed}


def test_a_wrong_setting_is_refused():
    for setting, message in [
        ("training.stepz=3", "`stepz` are not valid...batch_size, steps"),
        ("training.steps=many", "steps"),
        ("training.steps=true", "`steps` must be int"),
        ("training.steps=0", "at least 1"),
        ("data.episodes_per_task=1.5", "episodes_per_task"),
        ("data.tasks=T199", "T199"),
        ("data.scene.objets=all", "`scene`: The fields `objets` are not valid"),
        ("data.scene=3", "value='3' into field...scene"),
        ("data.scene.objects=chairs", "`objects` must be one of"),
        ("evaluation.tasks=T198", "T198"),
        ("policy.methud=bc_z", "`methud` are not valid...method"),
        ("policy.method=[bc_z]", "`method` must be str"),
        ("policy.language_head=wide", "language_head"),
        ("policy.type=act", "deltaco: paper, small; deltaco_match: small"),
        ("training.steps=[1,", "Cannot read"),
        ("steps=3", "must have the mappings data, ...Got 'steps': 3"),
        ("training.steps", "SECTION.NAME=VALUE"),
    ]:
        with pytest.raises(ExperimentError, match=".*".join(map(re.escape, message.split("...")))):
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
    with pytest.raises(ExperimentError, match=re.escape(message)):
        read_recipe("scenario_a/deltaco", path=path)


def test_unknown_names_and_scales_are_refused():
    with pytest.raises(ExperimentError, match="no experiment 'deltaco'. Valid are scenario_a/deltaco"):
        read_recipe("deltaco")
    with pytest.raises(ExperimentError, match="no scale 'paper'"):
        read_recipe("random_objects/deltaco_match", "paper")


def test_steps_run_once(tmp_path, commands):
    _run(tmp_path, "scenario_a/deltaco", "scenario_a/language_only", seed=[0, 1])
    # Both datasets are shared.
    assert commands.names == ["collect"] * 2 + ["train", "evaluate"] * 4 + ["report"]
    commands.called.clear()
    _run(tmp_path, "scenario_a/deltaco")
    assert commands.names == ["report"]


def test_an_interrupted_run_continues(tmp_path, commands):
    expected = {
        "collect": ["collect"],
        "train": ["collect", "collect", "train"],
        "evaluate": ["train", "evaluate"],
        None: ["evaluate", "report"],
    }
    for failing, names in expected.items():
        commands.called.clear()
        commands.failing = failing
        with pytest.raises(ExperimentError) if failing else nullcontext():
            _run(tmp_path)
        assert commands.names == names


def test_training_resumes_from_its_last_checkpoint(tmp_path, commands):
    run = Run(read_recipe("scenario_a/deltaco", settings=SMALL), 0, tmp_path)
    run.folder.mkdir(parents=True)  # left by a training that stopped before its first checkpoint
    commands.failing = "train"
    with pytest.raises(ExperimentError):
        _run(tmp_path)
    assert last_step(run.folder) == 10
    assert "--resume=true" in next(run.commands())
    commands.failing = None
    _run(tmp_path)
    assert last_step(run.folder) == 20
    assert run.unevaluated_steps() == []
    # Another plan evaluates the checkpoints again.
    run = Run(read_recipe("scenario_a/deltaco", settings=(*SMALL, "evaluation.trials=1")), 0, tmp_path)
    assert run.unevaluated_steps() == [10, 20]
    assert run.evaluate_command() == ["evaluate", str(run.folder), "--trials", "1"]


def test_other_settings_are_refused(tmp_path, commands):
    _run(tmp_path)
    commands.called.clear()
    with pytest.raises(ExperimentError, match="begun with other settings: policy was"):
        _run(tmp_path, settings=(*SMALL, "policy.method=bc_z"))
    assert commands.called == []
    _run(tmp_path / "elsewhere", settings=(*SMALL, "policy.method=bc_z"))


def test_fine_tuning_starts_from_the_best_seed(tmp_path, commands):
    names = ("scenario_a_finetuned/episodes_10", "scenario_a/demo_only")
    with pytest.raises(ExperimentError, match="no evaluated run"):
        _run(tmp_path, names[0])
    assert commands.called == []
    _run(tmp_path, *names, seed=[0, 2, 1])
    starts = [word for arguments in commands.called for word in arguments if word.startswith("--policy.path")]
    best = tmp_path / "small" / "scenario_a" / "demo_only" / "seed_2"
    assert starts == [f"--policy.path={best}/checkpoints/last/pretrained_model"] * 3


def test_a_dry_run_returns_the_remaining_commands(tmp_path, commands):
    lines = _run(tmp_path, dry_run=True).splitlines()
    assert [line.split()[:2] for line in lines] == [
        ["deltaco", step] for step in ("collect", "collect", "train", "evaluate", "report")
    ]
    assert commands.called == []


def test_a_command_that_fails_is_named(capfd):
    with pytest.raises(ExperimentError, match=r"`deltaco no_such_command` failed \(exit status 1\)"):
        experiments.call(["no_such_command"])
    assert capfd.readouterr().out.strip() == "deltaco no_such_command"


def test_evaluations_run_in_the_same_process(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", sys.argv)
    given = []

    def evaluate_checkpoints(arguments):
        given.append((arguments, sys.argv))
        return "50.0 % succeeded."

    monkeypatch.setattr(evaluate, "evaluate_checkpoints", evaluate_checkpoints)
    experiments.call(["evaluate", str(tmp_path), "--trials", "1"])
    ((arguments, command),) = given
    assert (arguments.checkpoint, arguments.plan.trials) == (tmp_path, 1)
    assert command == ["deltaco", "evaluate", str(tmp_path), "--trials", "1"]
    assert capsys.readouterr().out.endswith("50.0 % succeeded.\n")


def test_policies_accept_their_options():
    from lerobot.configs import PreTrainedConfig

    import lerobot_policy_deltaco  # noqa: F401  (registers the types)

    for name in experiment_names():
        options = dict(read_recipe(name).policy)
        options.pop("precision", None)  # depends on the CPU
        kind = PreTrainedConfig.get_choice_class(options.pop("type"))
        config = kind(**options)
        assert {option: getattr(config, option) for option in options} == options
