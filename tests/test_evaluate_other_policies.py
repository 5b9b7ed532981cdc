"""Policies of LeRobot's own are evaluated as this project's are: same scenes, same records."""

import json
import shutil
import sys
from dataclasses import replace

import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config
from lerobot.scripts import lerobot_train

from gym_deltaco.tasks import get_task
from lerobot_deltaco.commands import collect as collect_command
from lerobot_deltaco.commands import evaluate as evaluate_command
from lerobot_deltaco.commands import report as report_command
from lerobot_deltaco.common.run_folder import RunError, checkpoints
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import check_policy_fits
from lerobot_deltaco.evaluation import checkpoint_policy
from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.evaluation.evaluate import evaluate
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import read_record, record_path, write_record
from lerobot_deltaco.policy.processor_files import ProcessorFileError

SMALL_ACT = {
    "policy.type": "act",
    "policy.device": "cpu",
    "policy.push_to_hub": "false",
    "policy.pretrained_backbone_weights": "null",
    "policy.dim_model": "16",
    "policy.n_heads": "2",
    "policy.dim_feedforward": "16",
    "policy.n_encoder_layers": "1",
    "policy.n_vae_encoder_layers": "1",
    "policy.chunk_size": "8",
    "policy.n_action_steps": "8",
    "batch_size": "2",
    "steps": "2",
    "save_freq": "2",
    "num_workers": "0",
    "job_name": "small/act",
    "seed": "3",
}
RENAMING = {"observation.image": "observation.images.front"}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two tasks, an episode of each."""
    root = tmp_path_factory.mktemp("data") / "data"
    collect_command.main(
        ["--tasks", "4,14", "--episodes-per-task", "1", "--root", str(root), "--workers", "1"]
    )
    return root


def train(root, folder, **more):
    arguments = {
        **SMALL_ACT,
        "dataset.repo_id": "test/data",
        "dataset.root": root,
        "output_dir": folder,
        **more,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *(f"--{key}={value}" for key, value in arguments.items())])
        lerobot_train.main()
    return folder


@pytest.fixture(scope="module")
def run(root, tmp_path_factory):
    """ACT, trained for two steps."""
    return train(root, tmp_path_factory.mktemp("run") / "act")


@pytest.fixture(scope="module")
def record(run):
    evaluate_command.main([str(run), "--tasks", "4,14", "--trials", "2", "--processes", "1"])
    return read_record(record_path(run, 2))


def test_its_record_says_what_ours_does(record):
    assert (record.experiment, record.method, record.run_seed, record.step) == ("small/act", "act", 3, 2)
    assert record.policy["type"] == "act"
    assert record.policy["chunk_size"] == 8
    assert record.policy["pretrained_path"] is None
    assert "language_encoder" not in record.versions
    assert [(item.task_id, item.trial) for item in record.episodes] == [(4, 0), (4, 1), (14, 0), (14, 1)]
    for episode in record.episodes:
        assert episode.instruction == get_task(episode.task_id).instruction
        assert (episode.demonstration, episode.demonstration_episodes) == (None, [])


def test_it_acts_alike_in_one_process_and_in_two(run, record, tmp_path):
    evaluate_command.main(
        [str(run), "--tasks", "4,14", "--trials", "2", "--processes", "2", "--out", str(tmp_path)]
    )
    again = read_record(record_path(tmp_path, 2))
    assert replace(again, seconds=0, command="") == replace(record, seconds=0, command="")


def test_the_report_compares_it_with_this_projects(record, tmp_path, capsys):
    ours = replace(record, experiment="small/deltaco", method="deltaco", policy={"method": "deltaco"})
    for item in (record, ours):
        write_record(item, record_path(tmp_path / item.method, item.step))
    report_command.main([str(tmp_path / "act"), str(tmp_path / "deltaco"), "--out", str(tmp_path / "report")])
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| act |" in text
    assert "| DeL-TaCo |" in text
    assert "- Policy: `type=act`." in text
    assert "optimizer_lr" not in text  # departures from the paper are those of this project's policies


def test_it_gets_another_tasks_instruction_but_no_demonstration(run, tmp_path, capsys):
    arguments = [str(run), "--tasks", "4,14", "--trials", "1", "--processes", "1", "--out", str(tmp_path)]
    evaluate_command.main([*arguments, "--counterfactual", "instruction"])
    for episode in read_record(record_path(tmp_path, 2, "instruction")).episodes:
        assert episode.instruction != get_task(episode.task_id).instruction
    for options, message in (
        (["--counterfactual", "demo"], "`act`) takes no demonstrations"),
        (
            ["--n-demonstrations", "2"],
            "type 'act', which takes no demonstrations. Leave out --n-demonstrations",
        ),
        (["--policy.demo_repo_id", "a/b"], "takes no demonstrations. Leave out --policy.demo_repo_id"),
        (["--explain", "1"], "`type=act`) finds no places"),
    ):
        with pytest.raises(SystemExit):
            evaluate_command.main([*arguments, *options])
        assert message in capsys.readouterr().err


def test_results_in_lerobots_form_lie_beside_the_record(run, record):
    info = json.loads((run / "evaluations/0000002/eval_info.json").read_text())
    assert set(info) == {"per_task", "per_group", "overall"}
    assert [item["task_id"] for item in info["per_task"]] == [4, 14]
    assert [item["metrics"]["successes"] for item in info["per_task"]] == [
        [episode.success for episode in record.episodes if episode.task_id == task_id] for task_id in (4, 14)
    ]
    keys = {"avg_sum_reward", "avg_max_reward", "pc_success", "n_episodes", "video_paths"}
    assert set(info["per_group"]["name"]) == {*keys, "predicted_video_paths"}
    assert set(info["overall"]) == {*keys, "predicted_video_paths", "eval_s", "eval_ep_s"}
    assert info["overall"]["pc_success"] == pytest.approx(100 * record.success_rate)


def test_its_processors_are_checked_before_they_are_loaded(run, tmp_path):
    copy = shutil.copytree(checkpoints(run)[0].folder, tmp_path / "copy")
    path = copy / "policy_preprocessor.json"
    contents = json.loads(path.read_text())
    contents["steps"].insert(0, {"class": "os.system", "config": {"command": f"touch {tmp_path / 'ran'}"}})
    path.write_text(json.dumps(contents))
    with pytest.raises(ProcessorFileError, match="names the class 'os.system'"):
        load_policy(copy)
    assert not (tmp_path / "ran").exists()


def test_a_policy_that_draws_does_so_by_the_scenes_seed(run, monkeypatch):
    # As a diffusion policy does.
    import torch

    loaded = load_policy(checkpoints(run)[0].folder)
    drawn = []

    def select_action(batch):
        drawn.append(torch.randn(len(batch["observation.state"]), 4))
        return drawn[-1]

    monkeypatch.setattr(loaded.policy, "select_action", select_action)
    plan = EvaluationPlan("4,14", trials=2)
    first = evaluate(*loaded, plan, 0)
    n_drawn = len(drawn)
    torch.manual_seed(5)
    state = torch.get_rng_state()
    assert evaluate(*loaded, plan, 0) == first
    assert all(torch.equal(*pair) for pair in zip(drawn[:n_drawn], drawn[n_drawn:], strict=True))
    assert torch.equal(torch.get_rng_state(), state)


def test_names_of_the_training_are_those_of_the_evaluation(run, tmp_path, capsys):
    # As a model is that was fine-tuned with --rename_map: it knows the camera by another name.
    folder = shutil.copytree(checkpoints(run)[0].folder, tmp_path / "renamed")
    for file in ("config.json", "policy_preprocessor.json"):
        contents = json.loads((folder / file).read_text())
        if file == "config.json":
            features = contents["input_features"]
            features["observation.images.front"] = features.pop("observation.image")
        else:
            (step,) = (step for step in contents["steps"] if step["registry_name"].startswith("rename"))
            step["config"]["rename_map"] = RENAMING
        (folder / file).write_text(json.dumps(contents))
    arguments = [str(folder), "--tasks", "4", "--trials", "1", "--processes", "1"]
    evaluate_command.main([*arguments, "--out", str(tmp_path / "out")])
    assert len(read_record(record_path(tmp_path / "out", 0)).episodes) == 1
    wrong = json.dumps({"observation.image": "observation.images.camera1"})
    with pytest.raises(SystemExit):
        evaluate_command.main([*arguments, "--out", str(tmp_path / "wrong"), "--rename_map", wrong])
    assert "which `rename_map` calls observation.images.camera1" in capsys.readouterr().err


def act(cameras=("observation.image",), size=48, state=10, action=4):
    config = make_policy_config("act", device="cpu")
    config.input_features = {name: PolicyFeature(FeatureType.VISUAL, (3, size, size)) for name in cameras}
    config.input_features["observation.state"] = PolicyFeature(FeatureType.STATE, (state,))
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (action,))}
    return config


@pytest.mark.parametrize(
    ("policy", "rename_map", "message"),
    [
        ({"cameras": ["observation.images.front"]}, {}, "has observation.image alone.*--rename_map='"),
        (
            {"cameras": ["observation.images.a", "observation.images.b"]},
            {},
            "images of observation.images.a, ",
        ),
        (
            {"cameras": ["observation.images.a", "observation.images.b"]},
            {"observation.image": "observation.images.a"},
            "has observation.image alone, which `rename_map` calls observation.images.a",
        ),
        ({}, {"observation.wrist": "observation.image"}, "renames observation.wrist, which the environment"),
        ({"size": 64}, {}, "64 x 64 pixels.*--image-size"),
        ({"state": 6}, {}, r"`observation.state` of the shape \(6,\)"),
        ({"action": 7}, {}, r"`action` of the shape \(7,\)"),
    ],
)
def test_a_policy_of_another_robot_is_refused(policy, rename_map, message):
    with pytest.raises(ValueError, match=message):
        check_policy_fits(act(**policy), DeltacoEnv(), rename_map)


def test_a_policy_fits_under_the_name_that_it_knows():
    check_policy_fits(act(), DeltacoEnv())
    check_policy_fits(act(cameras=["observation.images.front"]), DeltacoEnv(), RENAMING)


def test_a_vision_language_action_model_may_lack_cameras_and_scales_images_and_state():
    config = make_policy_config("smolvla", device="cpu")
    names = [f"observation.images.camera{number}" for number in (1, 2, 3)]
    config.input_features = {name: PolicyFeature(FeatureType.VISUAL, (3, 256, 256)) for name in names}
    config.input_features["observation.state"] = PolicyFeature(FeatureType.STATE, (6,))
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    for size in (224, 256):
        check_policy_fits(config, DeltacoEnv(image_size=size), {"observation.image": names[0]})


def test_missing_packages_and_unknown_types_are_named(run, tmp_path, monkeypatch, capsys):
    def missing(name):
        raise ImportError("'somepackage' is required but not installed")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint_policy, "get_policy_class", missing)
        with pytest.raises(RunError, match=r"type 'act'.*'somepackage' is required.*lerobot\[act\]"):
            load_policy(checkpoints(run)[0].folder)
    copy = shutil.copytree(checkpoints(run)[0].folder, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "type": "telepathy"}))
    with pytest.raises(SystemExit):
        evaluate_command.main([str(copy), "--tasks", "4", "--out", str(tmp_path / "out")])
    assert "'telepathy'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["front", "[1]", '{"observation.image": 3}'])
def test_a_rename_map_is_names_in_json(text, capsys):
    with pytest.raises(SystemExit):
        evaluate_command.main(["run", "--rename_map", text])
    assert "must be names in JSON" in capsys.readouterr().err
