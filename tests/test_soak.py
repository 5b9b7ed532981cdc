"""A soak: collect, train and evaluate with kills at random moments, and compare with the undisturbed.

`DELTACO_SOAK_MINUTES` and `DELTACO_SOAK_CONFIGURATIONS` set how long it takes (20 minutes, and 300).
"""

import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lerobot.policies import make_policy_config
from safetensors.torch import load_file
from small_policies import (
    REPO_ID,
    TASKS,
    batch_of,
    observation,
    small_policy,
    use_fake_encoder,
    write_dataset,
)

from gym_deltaco.tasks import get_task
from lerobot_deltaco.common.typed_fields import type_hints
from lerobot_deltaco.evaluation.record import read_record, record_path
from lerobot_deltaco.policy.goals.calibration import MIN_EPISODES
from lerobot_deltaco.policy.options import METHODS
from lerobot_deltaco.policy.task_file import TaskFile, write_task_file

pytestmark = pytest.mark.slow

MINUTES = float(os.environ.get("DELTACO_SOAK_MINUTES", "20"))
N_CONFIGURATIONS = int(os.environ.get("DELTACO_SOAK_CONFIGURATIONS", "300"))
TASK_IDS = (4, 55, 90)
N_STEPS = 30
COMMAND_TIMEOUT = 900  # s


# Kills


def command(name, arguments):
    code = f"from lerobot_deltaco.commands.{name} import main; main()"
    return [sys.executable, "-c", code, *map(str, arguments)]


def run(name, *arguments):
    result = subprocess.run(
        command(name, arguments), capture_output=True, text=True, timeout=COMMAND_TIMEOUT, check=False
    )
    assert result.returncode == 0, result.stderr[-3000:]


def run_and_kill(name, arguments, progress, rng):
    """Starts a command, and kills it and its children a moment after something new is stored.

    Args:
        name: Of the command.
        arguments: Its arguments.
        progress: Gives what is stored so far.
        rng: Source of the moments.

    Returns:
        Whether it was killed; else it has ended well by itself.
    """
    before, wanted = len(progress()), rng.randint(1, 4)
    process = subprocess.Popen(
        command(name, arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    end = time.monotonic() + COMMAND_TIMEOUT
    while process.poll() is None and len(progress()) < before + wanted:
        assert time.monotonic() < end, f"{name} stores nothing."
        time.sleep(0.02)
    time.sleep(rng.uniform(0, 0.5))
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    _, errors = process.communicate()
    if process.returncode == -signal.SIGKILL:
        return True
    assert process.returncode == 0, errors[-3000:]
    return False


def contents(root):
    """The bytes of a dataset's files."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for folder in ("data", "meta")
        for path in sorted((root / folder).rglob("*"))
        if path.is_file()
    }


def collect_with_kills(root, arguments, rng):
    def stored():
        return [path for path in root.rglob("*") if path.suffix in (".arrow", ".parquet")]

    n_kills = 0
    while n_kills < 5 and run_and_kill("collect", arguments, stored, rng):
        n_kills += 1
    run("collect", *arguments)
    return n_kills


def train_with_kills(folder, arguments, rng):
    checkpoints = folder / "checkpoints"

    def stored():
        return list(checkpoints.glob("*/training_state/training_step.json"))

    n_kills = 0
    while True:
        last = checkpoints / "last" / "pretrained_model" / "train_config.json"
        if last.exists():
            now = [f"--config_path={last}", "--resume=true"]
        else:  # killed before the first checkpoint was whole
            shutil.rmtree(folder, ignore_errors=True)
            now = arguments
        if n_kills == 4:
            run("train", *now)
            return n_kills
        if not run_and_kill("train", now, stored, rng):
            return n_kills
        n_kills += 1


def embeddings_file(path):
    """Embeddings of the instructions, so that no language model is needed."""
    torch.manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.randn(len(TASK_IDS), 384), dim=-1)
    instructions = [get_task(task_id).instruction for task_id in TASK_IDS]
    write_task_file(path, TaskFile("paraphrase-MiniLM-L3-v2", instructions, vectors, None))
    return path


def test_killed_again_and_again_it_comes_to_the_same(tmp_path):
    end = time.monotonic() + 60 * MINUTES
    embeddings = embeddings_file(tmp_path / "embeddings.safetensors")
    tasks = ",".join(map(str, TASK_IDS))
    n_rounds = n_kills = 0
    while n_rounds == 0 or time.monotonic() < end:
        rng, folder = random.Random(n_rounds), tmp_path / str(n_rounds)
        collect = ["--tasks", tasks, "--episodes-per-task", 4, "--seed", n_rounds, "--workers", 2]
        run("collect", *collect, "--root", folder / "data")
        n_kills += collect_with_kills(
            folder / "killed_data", [*collect, "--root", folder / "killed_data"], rng
        )
        assert contents(folder / "killed_data") == contents(folder / "data")

        train = [
            *("--policy.type=deltaco", "--policy.device=cpu", "--policy.backbone=strided"),
            f"--policy.method={rng.choice(list(METHODS))}",
            f"--policy.tasks_per_batch={rng.choice([0, 3])}",
            f"--policy.instruction_embeddings={embeddings}",
            *("--dataset.repo_id=soak/data", f"--dataset.root={folder / 'data'}"),
            *("--policy.demo_repo_id=soak/data", f"--policy.demo_root={folder / 'data'}"),
            # 360 frames are 15 batches: two epochs.
            *("--batch_size=24", f"--steps={N_STEPS}", "--save_freq=2", f"--seed={n_rounds}"),
            "--job_name=soak",
        ]
        run("train", *train, f"--output_dir={folder / 'run'}")
        killed = folder / "killed_run"
        n_kills += train_with_kills(killed, [*train, f"--output_dir={killed}"], rng)
        states = [
            {
                file: load_file(path / "checkpoints" / f"{N_STEPS:06d}" / file)
                for file in (
                    "pretrained_model/model.safetensors",
                    "training_state/optimizer_state.safetensors",
                )
            }
            for path in (folder / "run", killed)
        ]
        for file, tensors in states[0].items():
            assert tensors.keys() == states[1][file].keys()
            different = [name for name in tensors if not torch.equal(tensors[name], states[1][file][name])]
            assert different == [], file

        records = []
        for path in (folder / "run", killed):
            run("evaluate", path, "--tasks", tasks, "--trials", 1, "--steps", "last")
            records.append(read_record(record_path(path, N_STEPS)))
        assert records[0].episodes == records[1].episodes
        shutil.rmtree(folder)
        n_rounds += 1
    assert n_kills > 0


# Random configurations


NAMED = re.compile(r"`([\w=]+)`")
# For each option, values that are valid on their own, and others.
VALUES = {
    "method": [*METHODS, "best", None],
    "film": [None, "none", "demo", "language", "demo+language", "x"],
    "concat": [None, "none", "demo", "language", "demo+language", 3],
    "encoder_loss": [None, "contrastive", "cosine", "none", "triplet"],
    "demo_encoder": ["cnn", "attention", "correspondence", "vit"],
    "demo_rows": [1, 2, 3, 0, 1.5, 2**31],
    "demo_columns": [2, 1, 3, -1, "2"],
    "image_size": [16, 17, 24, 40, 15, 2**31, math.inf, None],
    "backbone": ["strided", "paper", "vit"],
    "motion_modes": [1, 2, 5, 0, True],
    "gripper": ["auto", "none", "0", "1", "2", "3", 1, "left"],
    "gripper_loss": ["squared_error", "cross_entropy", "hinge"],
    "gripper_weight": [None, 0.0, 3, 1e9, math.nan, "3"],
    "encoder_loss_weight": [10.0, 0, -1.0, math.inf],
    "temperature": [0.1, 1, 1e-40, 0.0, -1.0, math.nan],
    "crop_padding": [0, 4, 20, -1, 2.0],
    "demo_crop_padding": [0, 4, 1000, None],
    "instructions_split": ["train", "held_out", "x"],
    "instructions_templates": [False, True, 1],
    "language_head": [None, [8], [0], [2**31], 8],
    "normalize_language": [True, False, None],
    "vision_image_size": [None, 32, 0],
    "vision_input": ["published", "x"],
    "demo_variants": [1, 8, 0],
    "demo_head": [None, [8], [-1]],
    "demo_crop": ["array", "frame", "x"],
    "demo_frames_between": ["spread", "any", "x"],
    "initial_weights": [None, "authors", "torch", "x"],
    "optimizer_l2": [0.0, 1e-4, -1.0],
    "demo_camera": [None, "observation.images.wrist", "observation.images.none", 3],
    "n_demonstrations": [1, 2, 0, None],
    "pretrained_matching": [False, False, True, "yes"],
    "goal_image_size": [None, 16, 32, 48, 96, 15, 2**31, "48"],
    "goal_noise": [0.0, 0.04, -1.0, math.nan],
    "grasp_depth": [True, False, 1],
    "depth_margin": [0.0, 0.75, math.inf],
    "depth_noise": [0.0, 0.1, -1.0],
    "locator_share": [0.25, 1, 0.0, 2.0],
    "demo_dropout": [0.0, 0.3, 1.0],
    "instruction_dropout": [0.0, 0.3, -1.0],
    "leave_out": [None, "demo", "instruction", "x"],
    "recolor_share": [0.0, 0.5, 1.5],
    "color_blind_tasks": [None, "wave", "("],
    "frames_after_release": [None, 2, -1],
    "demos_per_task": [0, 2, 3, 1, -2],
    "demo_episodes": [None, [0, 1, 2, 3, 4, 5], [99], [], [0, 0]],
    "drop_n_last_frames": [0, 1, -1],
    "tasks_per_batch": [0, 2, -2],
    "upsampled_tasks": [None, "wave", "("],
    "upsampled_share": [0.5, 0.0, 1.5, None],
    "seed": [0, 2**63 - 1, 2**63, -1, 0.5],
    "dtype": ["float32", "bfloat16", "int8"],
    "optimizer_lr": [3e-4, 0.0, math.inf, "fast"],
    "optimizer_weight_decay": [0.0, 0.2, -1.0],
    "scheduler_name": ["constant", "cosine", "linear"],
    "scheduler_warmup_steps": [0, 5, -1],
    "grad_clip_norm": [0.0, 1, -1.0],
    "compile": [False, "yes"],
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        # As many as `demo_encoder=correspondence` needs.
        episodes = [task for task in TASKS for _ in range(MIN_EPISODES // len(TASKS) + 1)]
        yield write_dataset(tmp_path_factory.mktemp("data") / "foreign", episodes)


def test_every_option_is_tried():
    config = make_policy_config("deltaco", device="cpu")
    elsewhere = {"language_encoder", "instruction_embeddings", "demo_repo_id", "demo_root", "demo_episode"}
    elsewhere |= {"push_to_hub", "normalization_mapping", "one_hot_tasks", "demo_feature_dim", "demo_task"}
    elsewhere |= {"instructions", "vision_encoder", "vision_encoder_weights", "demo_features_dir"}  # files
    assert set(VALUES) == set(type_hints(type(config))) - elsewhere


@settings(
    max_examples=N_CONFIGURATIONS,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_random_configuration_works_or_is_refused_by_name(dataset, data):
    names = data.draw(st.lists(st.sampled_from(sorted(VALUES)), unique=True, max_size=4), label="names")
    options = {name: data.draw(st.sampled_from(VALUES[name]), label=name) for name in names}
    demos = {"demo_repo_id": REPO_ID, "demo_root": str(dataset.root)}
    refusal = None
    try:
        policy, before, after = small_policy(dataset, **demos, **options)
        # The first batch reads the training episodes, which can be too few.
        loss, _ = policy(before(batch_of(dataset, [0, 7, 16, 22, 29])))
    except ValueError as error:
        refusal = str(error)
    if refusal is not None:
        refused = {name.partition("=")[0] for name in NAMED.findall(refusal)}
        assert refused & set(options), f"{refusal} names none of {options}"
        return
    loss.backward()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    optimizer.step()
    assert torch.isfinite(loss)
    policy.eval()
    action = after(policy.select_action(before(observation(dataset, TASKS))))
    assert action.shape == (len(TASKS), 3)
    assert torch.isfinite(action).all()
