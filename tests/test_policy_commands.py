"""The policy in LeRobot's commands: trained, resumed and evaluated on the benchmark."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from safetensors.torch import load_file

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.policy.options import METHODS

TASK_IDS = "4,50"
STEPS = 4
HALF = STEPS // 2
TRAIN, EVALUATE = (("-m", f"lerobot.scripts.lerobot_{name}") for name in ("train", "eval"))
EVALUATION = ("--env.type=deltaco", f"--env.task={TASK_IDS}", "--eval.use_async_envs=false")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of the runs, with a training dataset, and another one with a demonstration of each task."""
    folder = tmp_path_factory.mktemp("commands")
    collect(folder / "train", CollectionPlan(TASK_IDS, 3), n_workers=1)
    collect(folder / "demos", CollectionPlan(TASK_IDS, 1, split="validation"), n_workers=1)
    return folder


def start(*words, folder):
    """Runs Python. One thread, so that sums are taken in the same order each time."""
    settings = {
        "OMP_NUM_THREADS": "1",
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder / "cache"),
        "GLOO_SOCKET_IFNAME": "lo",  # where several processes find each other, without a network
    }
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        timeout=600,
    )


def run(*words, folder):
    result = start(*words, folder=folder)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout + result.stderr


def training(folder, output, *more):
    """Arguments of a short training that evaluates in its middle and at its end."""
    return [
        *("--policy.type=deltaco", "--policy.language_encoder=all-MiniLM-L6-v2", "--policy.backbone=strided"),
        *("--policy.device=cpu", "--dataset.repo_id=me/train", f"--dataset.root={folder / 'train'}"),
        *("--policy.demo_repo_id=me/demos", f"--policy.demo_root={folder / 'demos'}"),
        *(f"--steps={STEPS}", f"--save_freq={HALF}", f"--env_eval_freq={HALF}", "--log_freq=1"),
        *("--batch_size=3", "--num_workers=0", f"--output_dir={folder / output}", "--wandb.enable=false"),
        *(*EVALUATION, "--eval.n_episodes=1", "--eval.batch_size=1", *more),
    ]


def checkpoint(folder, output, step):
    return folder / output / "checkpoints" / f"{step:06}"


@pytest.fixture(scope="module")
def trained(folder):
    """The checkpoint of a training that nothing interrupted."""
    run(*TRAIN, *training(folder, "whole"), folder=folder)
    return checkpoint(folder, "whole", STEPS) / "pretrained_model"


def assert_same_tensors(path, other):
    tensors, others = load_file(path), load_file(other)
    assert tensors.keys() == others.keys()
    for name, value in tensors.items():
        assert value.equal(others[name]), name


@pytest.mark.slow
def test_a_resumed_training_ends_as_one_that_was_not_interrupted(folder, trained):
    # What is left of a training that was killed after its first half.
    shutil.copytree(folder / "whole", folder / "halved", symlinks=True)
    half = checkpoint(folder, "halved", HALF)
    shutil.rmtree(checkpoint(folder, "halved", STEPS))
    (folder / "halved/checkpoints/last").unlink()
    config = half / "pretrained_model/train_config.json"
    words = [f"--config_path={config}", "--resume=true", f"--output_dir={folder / 'halved'}"]
    run(*TRAIN, *words, folder=folder)
    whole, resumed = checkpoint(folder, "whole", STEPS), checkpoint(folder, "halved", STEPS)
    assert_same_tensors(
        whole / "pretrained_model/model.safetensors", resumed / "pretrained_model/model.safetensors"
    )
    state = "training_state/optimizer_state.safetensors"
    assert_same_tensors(whole / state, resumed / state)
    # It had learned something in between.
    first, last = (load_file(path / "pretrained_model/model.safetensors") for path in (half, whole))
    assert any(not value.equal(last[name]) for name, value in first.items() if name != "step")


@pytest.mark.slow
def test_two_processes_train_alike_from_the_disk_and_from_memory(folder):
    together = ("-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2")
    for name, module in (
        ("disk", "lerobot.scripts.lerobot_train"),
        ("memory", "lerobot_deltaco.commands.train"),
    ):
        arguments = training(folder, name, "--steps=3", "--save_freq=3", "--env_eval_freq=0")
        said = run(*together, "-m", module, *arguments, folder=folder)
        assert "effective batch size: 6" in said
    disk, memory = (checkpoint(folder, name, 3) for name in ("disk", "memory"))
    assert_same_tensors(
        disk / "pretrained_model/model.safetensors", memory / "pretrained_model/model.safetensors"
    )
    alone = training(folder, "alone", "--steps=3", "--save_freq=3", "--env_eval_freq=0")
    run("-m", "lerobot_deltaco.commands.train", *alone, folder=folder)
    one = load_file(checkpoint(folder, "alone", 3) / "pretrained_model/model.safetensors")
    two = load_file(memory / "pretrained_model/model.safetensors")
    assert any(not value.equal(two[name]) for name, value in one.items())


@pytest.mark.slow
def test_a_checkpoint_is_evaluated_by_itself(folder, trained):
    # Nothing but the checkpoint is left.
    moved = shutil.copytree(trained, folder / "moved")
    hidden = [(folder / name).rename(folder / f"hidden_{name}") for name in ("train", "demos")]
    try:
        results = []
        for more in ([], ["--env.max_parallel_tasks=2"]):
            output = folder / f"eval{len(results)}"
            arguments = [*EVALUATION, "--eval.n_episodes=2", "--eval.batch_size=2", *more]
            run(*EVALUATE, f"--policy.path={moved}", *arguments, f"--output_dir={output}", folder=folder)
            results.append(json.loads((output / "eval_info.json").read_text()))
    finally:
        for path in hidden:
            path.rename(folder / path.name.removeprefix("hidden_"))
    for info in results:
        assert info["overall"]["n_episodes"] == 4
        assert {task["task_id"] for task in info["per_task"]} == {4, 50}
    one, other = (
        {task["task_id"]: task["metrics"]["sum_rewards"] for task in info["per_task"]} for info in results
    )
    assert one == other


@pytest.mark.slow
def test_the_checkpoint_knows_its_tasks(trained):
    config = json.loads((trained / "config.json").read_text())
    assert config["demo_repo_id"] is None
    assert config["gripper"] == "3"
    known = load_file(trained / "tasks.safetensors")
    assert known["frames"].shape == (2, 2, 3, 48, 48)
    assert known["embeddings"].shape[1] == 384


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["paraphrase-MiniLM-L3-v2", "all-distilroberta-v1"])
def test_another_language_encoder_is_refused(folder, trained, encoder):
    words = [f"--policy.path={trained}", f"--policy.language_encoder={encoder}", *EVALUATION]
    result = start(*EVALUATE, *words, "--eval.n_episodes=1", "--eval.batch_size=1", folder=folder)
    assert result.returncode != 0
    assert "was made with the language encoder all-MiniLM-L6-v2" in result.stderr.splitlines()[-1]


@pytest.mark.slow
def test_a_task_that_nothing_shows_is_named(folder, trained):
    words = [f"--policy.path={trained}", "--env.type=deltaco", "--env.task=7", "--eval.use_async_envs=false"]
    result = start(*EVALUATE, *words, "--eval.n_episodes=1", "--eval.batch_size=1", folder=folder)
    assert result.returncode != 0
    missing = re.escape(f"There is no demonstration of the task {TASKS[7].instruction!r}")
    assert re.search(rf"^ValueError: {missing}.+--policy.demo_repo_id", result.stderr, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("module", ["lerobot.scripts.lerobot_train", "lerobot_deltaco.commands.train"])
def test_episodes_can_be_held_back(folder, module):
    """Their loss is computed with demonstrations of other episodes."""
    words = [word for word in training(folder, module) if not word.startswith(("--env", "--eval."))]
    printed = run("-m", module, *words, "--dataset.eval_split=0.3", "--eval_steps=2", folder=folder)
    assert printed.count("eval_loss=") == 2


# Importing LeRobot takes longer than these trainings.
TRAIN_EACH = """
import json, sys
from lerobot.scripts import lerobot_train

for words in json.loads(sys.argv[1]):
    sys.argv = ["lerobot-train", *words]
    lerobot_train.main()
"""


@pytest.mark.slow
def test_every_other_method_trains(folder):
    methods = [method for method in METHODS if method != "deltaco"]
    common = [word for word in training(folder, "") if not word.startswith(("--env", "--eval.", "--output"))]
    trainings = [
        [*common, f"--policy.method={method}", f"--output_dir={folder / method}"] for method in methods
    ]
    run("-c", TRAIN_EACH, json.dumps(trainings), folder=folder)
    for method in methods:
        saved = checkpoint(folder, method, STEPS) / "pretrained_model"
        assert json.loads((saved / "config.json").read_text())["method"] == method
        assert (saved / "tasks.safetensors").exists()
