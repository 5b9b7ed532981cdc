"""Both policies in LeRobot's commands: trained and evaluated on the benchmark, offline."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest
from fresh_python import run_python
from safetensors.torch import load_file

from lerobot_deltaco.collect import CollectionPlan, collect

pytestmark = pytest.mark.slow

TASK_IDS = "4,50"
EVALUATION = ["--env.type=deltaco", "--eval.use_async_envs=false", "--eval.batch_size=1"]

# One process for all of it, since importing LeRobot takes 10 s.
COMMANDS = """
import json, sys
from lerobot.scripts import lerobot_eval, lerobot_train
from small_policies import fake_encoder, language

fake_encoder.calls = []
language.load_language_encoder = fake_encoder
for program, *words in json.loads(sys.argv[1]):
    sys.argv = [f"lerobot-{program}", *words]
    {"train": lerobot_train, "eval": lerobot_eval}[program].main()
"""


def run(folder, *commands):
    """Runs LeRobot's commands, one after the other, in a new process."""
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HF_HOME": str(folder / "cache")}
    return run_python(COMMANDS, json.dumps(commands), cwd=folder, env=environment)


def training(folder, *options):
    return [
        *("train", "--dataset.repo_id=me/train", f"--dataset.root={folder / 'train'}", "--policy.device=cpu"),
        *("--steps=4", "--save_freq=2", "--batch_size=4", "--num_workers=0", "--env_eval_freq=0"),
        *("--policy.demo_repo_id=me/demos", f"--policy.demo_root={folder / 'demos'}", *options),
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a training dataset, one with a demonstration of each task, and a trained run."""
    folder = tmp_path_factory.mktemp("commands")
    collect(folder / "train", CollectionPlan(TASK_IDS, 3), workers=1)
    collect(folder / "demos", CollectionPlan(TASK_IDS, 1, split="validation"), workers=1)
    options = ["--policy.type=deltaco", "--policy.backbone=strided", f"--output_dir={folder / 'run'}"]
    result = run(folder, training(folder, *options, "--dataset.eval_split=0.4", "--eval_steps=4"))
    assert result.returncode == 0, result.stderr[-3000:]
    assert (result.stdout + result.stderr).count("eval_loss=") == 1
    return folder


def checkpoint(folder, run, step):
    return folder / run / "checkpoints" / f"{step:06}" / "pretrained_model"


def test_resumed_training_ends_as_one_that_was_not_interrupted(folder):
    # What is left of a training that was killed after its first half.
    shutil.copytree(folder / "run", folder / "halved", symlinks=True)
    shutil.rmtree(checkpoint(folder, "halved", 4).parent)
    (folder / "halved/checkpoints/last").unlink()
    config = checkpoint(folder, "halved", 2) / "train_config.json"
    words = [f"--config_path={config}", "--resume=true", f"--output_dir={folder / 'halved'}"]
    result = run(folder, ["train", *words])
    assert result.returncode == 0, result.stderr[-3000:]
    half, whole, resumed = (
        load_file(checkpoint(folder, name, step) / "model.safetensors")
        for name, step in (("halved", 2), ("run", 4), ("halved", 4))
    )
    assert all(value.equal(resumed[name]) for name, value in whole.items())
    assert any(not value.equal(half[name]) for name, value in whole.items() if name != "step")


def test_checkpoint_is_evaluated_without_its_datasets(folder):
    saved = checkpoint(folder, "run", 4)
    config = json.loads((saved / "config.json").read_text())
    assert (config["demo_repo_id"], config["gripper"]) == (None, "3")
    assert config["normalization_mapping"]["ACTION"] == "IDENTITY"
    moved = shutil.copytree(saved, folder / "elsewhere" / "policy")
    output, task = folder / "evaluation", f"--env.task={TASK_IDS}"
    options = [f"--policy.path={moved}", *EVALUATION, "--env.scene.episode_length=5", "--eval.n_episodes=1"]
    missing = ["eval", *options, "--env.task=7", f"--output_dir={folder / 'missing'}"]
    result = run(moved, ["eval", *options, task, f"--output_dir={output}"], missing)
    assert output.exists(), result.stderr[-3000:]
    assert json.loads((output / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
    # A task without a demonstration is named.
    assert result.returncode != 0
    assert re.search("ValueError: There is no demonstration of the task .*--policy.demo_repo_id", result.stderr)
