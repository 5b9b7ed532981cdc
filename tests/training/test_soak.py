"""Commands that are killed at random moments, for `DELTACO_SOAK_MINUTES` (10): they come to the same."""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import pytest
import torch
from safetensors.torch import load_file

from lerobot_deltaco.evaluation.records import read_records

pytestmark = pytest.mark.slow

SECONDS = 60 * float(os.environ.get("DELTACO_SOAK_MINUTES", "10"))
N_STEPS = 24
KILLS = 4
COMMAND_TIMEOUT = 600  # s


def start(words):
    """Starts `deltaco`, with its children in a process group; returns it, and the file of its errors."""
    command = [sys.executable, "-m", "lerobot_deltaco.cli", *map(str, words)]
    errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  (progress bars would fill a pipe)
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, process_group=0), errors


def check_code(process, errors, *codes):
    code = process.wait(COMMAND_TIMEOUT)
    errors.seek(0)
    assert code in codes, errors.read()[-3000:]


def run(words):
    check_code(*start(words), 0)


def run_and_kill(words, folder, rng):
    """Kills a command a moment after it has written something new; returns whether it was killed."""
    before, end = set(folder.rglob("*")), time.monotonic() + COMMAND_TIMEOUT
    process, errors = start(words)
    while process.poll() is None and set(folder.rglob("*")) <= before:
        assert time.monotonic() < end, f"{words[0]} writes nothing."
        time.sleep(0.02)
    time.sleep(rng.uniform(0, 1))
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    check_code(process, errors, 0, -signal.SIGKILL)
    return process.returncode != 0


def run_with_kills(words, folder, rng):
    """Runs a command that continues where it was killed."""
    for _ in range(KILLS):
        if not run_and_kill(words, folder, rng):
            break
    run(words)


def train_with_kills(words, folder, rng):
    config = folder / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    for kill in range(KILLS + 1):
        now = ["train", f"--config_path={config}", "--resume=true"] if config.exists() else words
        if now is words:  # killed before the first checkpoint was complete
            shutil.rmtree(folder, ignore_errors=True)
        if kill == KILLS:
            run(now)
        elif not run_and_kill(now, folder, rng):
            break


def contents(root):
    """The bytes of a dataset's files, by path."""
    files = (path for folder in ("data", "meta") for path in (root / folder).rglob("*") if path.is_file())
    return {path.relative_to(root): path.read_bytes() for path in files}


def state_of(run_folder):
    folder = run_folder / "checkpoints" / f"{N_STEPS:06d}"
    files = "pretrained_model/model.safetensors", "training_state/optimizer_state.safetensors"
    return {(file, name): value for file in files for name, value in load_file(folder / file).items()}


def test_commands_that_are_killed_come_to_the_same(tmp_path):
    end, n_rounds = time.monotonic() + SECONDS, 0
    while n_rounds == 0 or time.monotonic() < end:
        rng, folder = random.Random(n_rounds), tmp_path / str(n_rounds)
        collect = ["collect", "--tasks", "4,55,90", "--episodes-per-task", 10, "--seed", n_rounds]
        collect += ["--workers", 2, "--root"]
        run([*collect, folder / "data"])
        (folder / "killed_data").mkdir()
        run_with_kills([*collect, folder / "killed_data"], folder / "killed_data", rng)
        assert contents(folder / "killed_data") == contents(folder / "data")

        policy = rng.choice(["deltaco --policy.backbone=strided", "deltaco_match"])
        train = ["train", *f"--policy.type={policy}".split(), "--policy.device=cpu", "--batch_size=150"]
        train += [f"--policy.tasks_per_batch={rng.choice([0, 3])}", f"--steps={N_STEPS}", "--save_freq=2"]
        train += ["--dataset.repo_id=soak/data", f"--dataset.root={folder / 'data'}", f"--seed={n_rounds}"]
        train += [
            "--policy.demo_repo_id=soak/data",
            f"--policy.demo_root={folder / 'data'}",
            "--job_name=soak",
        ]
        whole, killed = folder / "run", folder / "killed_run"
        run([*train, f"--output_dir={whole}"])
        train_with_kills([*train, f"--output_dir={killed}"], killed, rng)
        expected, found = state_of(whole), state_of(killed)
        assert expected.keys() == found.keys()
        assert [name for name, value in expected.items() if not torch.equal(value, found[name])] == []

        evaluate = ["--tasks", "4,55,90", "--trials", 2, "--steps", "last"]
        run(["evaluate", whole, *evaluate])
        run_with_kills(["evaluate", killed, *evaluate], killed / "checkpoints", rng)
        records = [read_records(path / "evaluations")[0] for path in (whole, killed)]
        assert records[0].episodes.equals(records[1].episodes)
        shutil.rmtree(folder)
        n_rounds += 1
