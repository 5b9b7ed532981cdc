"""Two processes that train together, by gloo on a CPU: equal weights, disjoint batches, an exact resume."""

import json
import os
import socket
import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from accelerate.data_loader import BatchSamplerShard
from safetensors.torch import load_file
from small_policies import REPO_ID, TASKS, write_dataset
from torch.utils.data import BatchSampler

from lerobot_deltaco.training.loop import ResumableSampler
from lerobot_deltaco.training.task_batches import TaskBatchSampler

EPISODES = [task for task in TASKS for _ in range(8)]  # of 5 frames each
STEPS, INTERRUPTED_AT = 5, 2
# 120 frames make 5 batches: two processes begin the second epoch with the fourth step.
ENCODERS = {
    "cnn": {"batch_size": 24},
    "attention": {"policy.demo_encoder": "attention", "batch_size": 24, "policy.tasks_per_batch": 2},
    "correspondence": {
        "policy.demo_encoder": "correspondence",
        "policy.image_size": 32,
        "batch_size": 24,
        "policy.tasks_per_batch": 3,
    },
}


def batches(sampler, batch_size, rank, n_batches):
    """The batches that accelerate gives to one of two processes, epoch after epoch."""
    shard = BatchSamplerShard(BatchSampler(sampler, batch_size, drop_last=False), 2, rank)

    def endless():
        while True:
            yield from shard

    return list(islice(endless(), n_batches))


@pytest.mark.parametrize("kind", ["frames", "tasks"])
@pytest.mark.parametrize("steps", range(1, 9))
def test_batches_go_on_where_they_were_interrupted(kind, steps):
    """Also in an epoch whose batches the processes cannot share evenly."""
    batch_size, n_frames = 4, 27

    def sampler():
        if kind == "tasks":
            return TaskBatchSampler(np.arange(n_frames) % 5, batch_size, 2, seed=3, n_processes=2)
        return ResumableSampler([0, 12], [12, 27], shuffle=True, seed=3, samples_per_turn=2 * batch_size)

    for rank in (0, 1):
        whole = batches(sampler(), batch_size, rank, 12)
        resumed = sampler()
        epoch, turns = divmod(steps, -(-len(resumed) // (2 * batch_size)))
        resumed.load_state_dict({"epoch": epoch, "start_index": turns * 2 * batch_size})
        assert batches(resumed, batch_size, rank, 12 - steps) == whole[steps:]


def test_an_epoch_is_filled_up_as_accelerate_does():
    def sampler(samples_per_turn):
        return ResumableSampler([0], [27], shuffle=True, seed=3, samples_per_turn=samples_per_turn)

    for rank in (0, 1):
        assert batches(sampler(8), 4, rank, 12) == batches(sampler(1), 4, rank, 12)
    assert sorted(sampler(1)) == list(range(27))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """What two processes end with, for each encoder of demonstrations, uninterrupted and resumed."""
    out = tmp_path_factory.mktemp("together")
    dataset = write_dataset(out / "data", EPISODES)
    jobs = []
    for name, options in ENCODERS.items():
        shared = {
            "policy.type": "deltaco",
            "policy.device": "cpu",
            "policy.image_size": 16,
            "policy.backbone": "strided",
            "dataset.repo_id": REPO_ID,
            "dataset.root": str(dataset.root),
            "steps": STEPS,
            "save_freq": 1,
            "log_freq": 1,
        }
        jobs.append((name, {**shared, **options}, INTERRUPTED_AT))
    (out / "jobs.json").write_text(json.dumps(jobs))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = Path(__file__).with_name("several_processes.py")
    started = []
    for rank in range(2):
        settings = {
            **{"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"},
            **{"MASTER_ADDR": "127.0.0.1", "FIRST_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"},
            "OMP_NUM_THREADS": "1",
        }
        log = (out / f"log_{rank}").open("w")
        started.append(
            subprocess.Popen(
                [sys.executable, str(script), str(out)],
                env={**os.environ, **settings},
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        )
    try:
        codes = [process.wait(600) for process in started]
    finally:
        for process in started:
            process.kill()
    assert codes == [0, 0], "".join((out / f"log_{rank}").read_text()[-3000:] for rank in range(2))
    return out


def assert_equal(one, other):
    assert one.keys() == other.keys()
    assert [name for name in one if not one[name].equal(other[name])] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ENCODERS)
def test_two_processes_end_with_the_same_weights(trained, name):
    first, second = (load_file(trained / f"{name}_{rank}.safetensors") for rank in (0, 1))
    assert_equal(first, second)
    before = load_file(trained / name / "checkpoints/000001/pretrained_model/model.safetensors")
    # All that can be trained has changed since the first step.
    assert [key for key, value in first.items() if value.equal(before[key])] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ENCODERS)
def test_two_processes_go_on_where_they_were_interrupted(trained, name):
    for rank in (0, 1):
        whole, resumed = (np.load(trained / f"{run}_{rank}.npy") for run in (name, f"{name}_resumed"))
        np.testing.assert_array_equal(resumed, whole[INTERRUPTED_AT : INTERRUPTED_AT + len(resumed)])
    files = ("pretrained_model/model.safetensors", "training_state/optimizer_state.safetensors")
    for file in files:
        assert_equal(
            *(
                load_file(trained / run / f"checkpoints/{STEPS:06}" / file)
                for run in (name, f"{name}_resumed")
            )
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ENCODERS)
def test_two_processes_train_on_different_frames(trained, name):
    first, second = (np.load(trained / f"{name}_{rank}.npy") for rank in (0, 1))
    turns = slice(0, 2)  # of the first epoch, before it is filled up
    both = np.concatenate([first[turns].ravel(), second[turns].ravel()])
    if name == "cnn":
        assert len(set(both.tolist())) == len(both)
    else:  # tasks may come up again, with the same frames
        assert not np.array_equal(np.sort(first), np.sort(second))
