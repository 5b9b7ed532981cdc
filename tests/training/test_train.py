"""`deltaco train`: LeRobot's loop over frames in memory, from the command line to the checkpoints."""

import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from small_policies import ACT, DELTACO, MATCH, POLICIES, TASK_IDS, as_options, run_training

from gym_deltaco.tasks import get_task
from lerobot_deltaco import cli
from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy, TrainingDivergedError
from lerobot_deltaco.policies.deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.training import train as train_module

EPISODE_LENGTH = 30


CLASSES = {"deltaco": DeltacoPolicy, "deltaco_match": DeltacoMatchPolicy, "act": ACTPolicy}


@pytest.fixture
def train(benchmark, tmp_path):
    """Trains in this process, and returns the folder of the checkpoints. LeRobot's loop is left as it was."""

    def train(options, name="run", **more):
        names = "make_train_eval_datasets", "make_policy", "EpisodeAwareSampler", "cycle"
        before = [getattr(lerobot_train, name) for name in names]
        checkpoints = run_training(benchmark, tmp_path / name, options, **more)
        assert [getattr(lerobot_train, name) for name in names] == before
        return checkpoints

    return train


@pytest.fixture
def seen(spy):
    """Batches that policies are given: (whether to train on, batch)."""
    batches = []
    for policy in CLASSES.values():
        spy(policy, "forward", lambda self, batch, **_: batches.append((self.training, dict(batch))))
    return batches


def state_of(checkpoints, step):
    """Weights and optimizer state of a checkpoint."""
    files = "pretrained_model/model.safetensors", "training_state/optimizer_state.safetensors"
    return {
        (file, name): tensor
        for file in files
        for name, tensor in load_file(checkpoints / f"{step:06d}" / file).items()
    }


def assert_same(one, other):
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


@pytest.mark.parametrize("policy", POLICIES)
def test_training_equals_that_of_lerobot_train(train, policy):
    # The same seed gives the same weights, samples, and demonstrations; batches of tasks are ours alone.
    options = {**POLICIES[policy]}
    if policy != "act":
        options["policy.tasks_per_batch"] = 0
    if policy == "deltaco_match":
        options["policy.frames_after_release"] = "null"
    stock = train(options, "stock", in_memory=False, steps=2)
    memory = train(options, "memory", steps=2)
    assert_same(state_of(stock, 2), state_of(memory, 2))


# Two episodes, of different tasks, whose 60 frames are 3 batches: a short run has a few epochs.
FEW = {"dataset.episodes": "[0,6]", "batch_size": 20}
RESUMABLE = {
    "tasks": {**DELTACO, **FEW},
    "frames": {**DELTACO, **FEW, "policy.tasks_per_batch": 0},
    "deltaco_match": MATCH,
    # What draws from the global random state, such as dropout, is not repeated.
    "act": {**ACT, **FEW, "policy.use_vae": False, "policy.dropout": 0.0},
}


@pytest.mark.parametrize("name", RESUMABLE)
def test_a_resumed_run_equals_an_uninterrupted_one(train, tmp_path, seen, name):
    whole = train(RESUMABLE[name], "whole", steps=6, save_freq=4)
    indices = [batch["index"].tolist() for _, batch in seen]
    # What is there if the run was killed after step 4, in the second epoch.
    killed = tmp_path / "killed" / "checkpoints"
    shutil.copytree(whole / "000004", killed / "000004")
    seen.clear()
    config = killed / "000004" / "pretrained_model" / "train_config.json"
    train({}, "killed", config_path=config, resume=True, save_freq=6)
    # accelerate 1.15 would begin with the order of the first epoch.
    assert [batch["index"].tolist() for _, batch in seen] == indices[4:]
    assert_same(state_of(whole, 6), state_of(killed, 6))
    if name != "deltaco_match":
        assert indices[:3] != indices[3:]
        for epoch in (indices[:3], indices[3:]):
            assert len(set(sum(epoch, []))) == 60


def test_a_run_does_not_resume_on_other_data(train, benchmark, tmp_path):
    saved = train(DELTACO, steps=2) / "000002" / "pretrained_model" / "train_config.json"
    other = shutil.copytree(benchmark, tmp_path / "other")
    statistics = json.loads((other / "meta" / "stats.json").read_text())
    statistics["observation.state"]["mean"][0] += 0.5
    (other / "meta" / "stats.json").write_text(json.dumps(statistics))
    with pytest.raises(ValueError, match=r"statistics of `observation.state` differ.*--policy\.path"):
        train({}, config_path=saved, resume=True, steps=4, **{"dataset.root": other})


@pytest.mark.parametrize(("policy", "in_memory"), [("deltaco", False), ("deltaco_match", True)])
def test_a_training_evaluates_itself(train, policy, in_memory, capfd):
    options = {**POLICIES[policy], "env.type": "deltaco", "env.task": "4", "env.scene.episode_length": 2}
    train({**options, "eval.n_episodes": 1, "eval.batch_size": 1, "env_eval_freq": 2}, in_memory=in_memory)
    assert "".join(capfd.readouterr()).count("'pc_success': 0.0") >= 2


@pytest.mark.slow
def test_two_processes_train_alike_from_the_disk_and_from_memory(benchmark, tmp_path):
    """Both end with the same weights, by gloo on a CPU, and other ones than a process alone."""
    options = {
        **{**DELTACO, "policy.tasks_per_batch": 0, "policy.device": "cpu"},
        "policy.method": "one_hot",  # needs no language encoder
        **{"dataset.repo_id": "test/small", "dataset.root": benchmark},
        **{"batch_size": 6, "steps": 3, "save_freq": 3, "num_workers": 0},
    }
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    programs = {
        "disk": [*launch, "-m", "lerobot.scripts.lerobot_train"],
        "memory": [*launch, "-m", "lerobot_deltaco.cli", "train"],
        "alone": ["-m", "lerobot_deltaco.cli", "train"],
    }
    for name, words in programs.items():
        command = [sys.executable, *words, *as_options({**options, "output_dir": tmp_path / name})]
        environment = {**os.environ, "GLOO_SOCKET_IFNAME": "lo"}
        result = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr[-3000:]
    disk, memory, alone = (state_of(tmp_path / name / "checkpoints", 3) for name in programs)
    assert_same(disk, memory)
    assert any(not torch.equal(alone[name], tensor) for name, tensor in memory.items())


@pytest.mark.parametrize("policy", ["deltaco", "act"])
def test_episodes_and_the_split_are_respected(train, seen, spy, policy):
    banks = []
    spy(DeltacoPolicy, "fit", lambda _, data: banks.append(data.demonstrations))
    split = {"dataset.episodes": "[1,2,3,7,8,9]", "dataset.eval_split": 0.5, "eval_steps": 2}
    train({**POLICIES[policy], **split}, batch_size=30, steps=2)
    trained, held_back = (
        {index for training, batch in seen if training == wanted for index in batch["episode_index"].tolist()}
        for wanted in (True, False)
    )
    assert trained
    assert held_back
    assert trained | held_back <= {1, 2, 3, 7, 8, 9}
    assert not trained & held_back
    # Demonstrations are drawn from the episodes that are trained on.
    assert [set(bank.episodes.tolist()) for bank in banks] == [trained] * (policy == "deltaco")


def test_batches_hold_the_tasks_that_are_wanted(train, seen):
    instructions = [get_task(task_id).instruction for task_id in TASK_IDS]
    pattern = instructions[1].split(" in ")[0]
    train({**DELTACO, "policy.upsampled_tasks": pattern, "policy.upsampled_fraction": 0.5}, steps=2)
    for _, batch in seen:
        assert batch["task"].count(instructions[1]) == 3
        assert len(set(batch["task"])) == 2
    seen.clear()
    # As many of the four tasks are in a batch as divide it.
    train({**DELTACO, "policy.tasks_per_batch": 16}, "divided", batch_size=9, steps=2)
    assert {len(set(batch["task"])) for _, batch in seen} == {3}


@pytest.mark.parametrize("n_after", [0, 3])
def test_pauses_and_frames_long_after_the_release_are_left_out(train, spy, monkeypatch, n_after):
    used, held = [], []
    spy(train_module, "TaskBatchSampler", lambda *_, use, **__: used.append(use))
    spy(FramesInMemory, "skip", lambda frames, _: held.append(frames))
    step = np.arange(EPISODE_LENGTH)
    monkeypatch.setattr(train_module, "paused_frames", lambda data, fps: np.tile(step == 5, len(data.spans)))
    train({**MATCH, "policy.frames_after_release": n_after, "policy.chunk_size": 2}, steps=1)
    actions = held[0].columns["action"]
    gripper = actions[:, 3].reshape(-1, EPISODE_LENGTH).numpy()
    for opening, use in zip(gripper, used[0].reshape(-1, EPISODE_LENGTH), strict=True):
        release = np.flatnonzero((opening[1:] > 0) & (opening[:-1] <= 0))[-1] + 1
        np.testing.assert_array_equal(use, (step <= release + n_after) & (step != 5))
    assert torch.equal(held[0].batch([4])["action"][0], actions[[4, 6]])


def test_frames_after_the_release_are_as_many_seconds_at_any_rate():
    # Closed from 20 to 40, and open again from 50 on.
    trajectory = np.interp(np.arange(100), [0, 10, 20, 40, 50, 60], [1, 1, 0, 0, 1, 1])
    actions = torch.from_numpy(np.stack([trajectory, trajectory], axis=1))
    policy = SimpleNamespace(frames_after_release=12, gripper_command=Gripper(0))
    last = []
    for fps in (24, 48):
        frames = MagicMock(columns={"action": actions}, spans={0: (0, 99)}, fps=fps)
        frames.__len__.return_value = len(actions)
        last.append(int(np.flatnonzero(train_module._until_release(frames, policy))[-1]))
    assert 48 <= last[0] - 12 <= 50
    assert last[1] - last[0] == 12


def test_a_checkpoint_names_its_policy_and_no_folder_of_the_demonstrations(train, benchmark, capfd):
    demos = {"policy.demo_repo_id": "test/small", "policy.demo_root": benchmark}
    checkpoints = train({**DELTACO, **demos}, steps=1, save_freq=1, job_name="small")
    folder = checkpoints / "000001" / "pretrained_model"
    config = json.loads((folder / "config.json").read_text())
    assert (config["type"], config["gripper"], config["demo_root"]) == ("deltaco", "3", None)
    policy = DeltacoPolicy.from_pretrained(folder)
    assert set(policy.demonstrations.tasks) == {get_task(task_id).instruction for task_id in TASK_IDS}
    printed = "".join(capfd.readouterr())
    assert all(name in printed for name in ("gripper_accuracy", "grdn", "loss"))


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (lambda batch: batch["action"].fill_(torch.inf), "`action` has numbers that are not finite"),
        (lambda batch: None, "lower --policy.optimizer_lr, or limit the gradient"),
    ],
    ids=["data", "divergence"],
)
def test_a_loss_that_is_not_finite_ends_the_training(train, tmp_path, monkeypatch, damage, cause):
    finish = TaskConditionedPolicy._finish_step

    def diverging(self, batch, loss, *arguments):
        if int(self.step) == 2:
            damage(batch)
            loss = loss * torch.inf
        return finish(self, batch, loss, *arguments)

    monkeypatch.setattr(TaskConditionedPolicy, "_finish_step", diverging)
    with pytest.raises(TrainingDivergedError, match="loss of training step 3 is not finite") as error:
        train(DELTACO, steps=8)
    assert cause in str(error.value)
    assert "--resume=true" in str(error.value)
    assert [path.parent.parent.name for path in tmp_path.rglob("model.safetensors")] == ["000002"]


MISTAKES = {
    "is found in no task of the dataset": {**DELTACO, "policy.upsampled_tasks": "dance"},
    "cannot be transformed at random": {**ACT, "dataset.image_transforms.enable": True},
    "use `lerobot-train`": {**ACT, "dataset.streaming": True},
    "--dataset.root is no_data, but there is no dataset": {**DELTACO, "dataset.root": "no_data"},
    "--policy.demo_root is no_data, but there is no dataset": {
        **DELTACO,
        **{"policy.demo_repo_id": "a/b", "policy.demo_root": "no_data"},
    },
    "at least 24 episodes": {**MATCH, "dataset.episodes": "[0,1,2]"},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_ends_the_command_in_one_line(benchmark, tmp_path, monkeypatch, message):
    monkeypatch.chdir(tmp_path)
    train = lambda *_: run_training(benchmark, tmp_path / "run", MISTAKES[message])  # noqa: E731
    monkeypatch.setattr(cli, "_train", train)
    monkeypatch.setattr(sys, "argv", ["deltaco", "train"])
    with pytest.raises(SystemExit, match=f"^deltaco train: .*{message}") as error:
        cli.main()
    assert "\n" not in str(error.value)
    assert not (tmp_path / "no_data").exists()
