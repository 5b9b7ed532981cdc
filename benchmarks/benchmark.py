"""Speed of the environment, of training and of the policies. `deltaco collect` prints its own.

    python benchmarks/benchmark.py env|train|policy

Times are of one machine: compare figures of one run, made while nothing else uses the processor.
"""

from __future__ import annotations

import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

N_TASKS = 16  # of the datasets that are collected for training


def main() -> None:
    """Runs the benchmark that the command line names, and prints its table."""
    import tyro

    commands: dict[str, Callable[..., dict[str, float]]] = {"env": env, "train": train, "policy": policy}
    results = tyro.extras.subcommand_cli_from_dict(commands, description=(__doc__ or "").partition("\n")[0])
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:12.3f}\n" for name, value in results.items())


def seconds_of(action: Callable[[], object], seconds: float = 1.0) -> float:
    """Returns the median duration of an action, s, over as many calls as fit into some seconds."""
    action()  # warms up
    times: list[float] = []
    while len(times) < 3 or sum(times) < seconds:
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


# The environment


def env(episodes: int = 100, seconds: float = 1.0) -> dict[str, float]:
    """Measures the parts of an episode, and episodes of the expert, on one core.

    Args:
        episodes: Number of episodes of the expert.
        seconds: Duration of the measurement of each part.
    """
    import psutil

    from gym_deltaco import kinematics
    from gym_deltaco.env import PickPlaceEnv
    from gym_deltaco.expert import expert_episode

    before = psutil.Process().memory_info().rss
    pick_place = PickPlaceEnv()
    pick_place.reset(seed=0)
    memory = (psutil.Process().memory_info().rss - before) / 1e6
    scene, seeds = pick_place.scene, itertools.count()
    signs = itertools.cycle([1.0, -1.0])

    def step(switches_gripper: bool) -> None:
        sign = next(signs)
        gripper = sign if switches_gripper else 1.0
        pick_place.step(np.array([0.5 * sign, 0.3 * sign, 0.2 * sign, gripper], dtype=np.float32))

    parts: dict[str, Callable[[], object]] = {
        "control step": lambda: step(switches_gripper=False),
        "step that opens or closes the gripper": lambda: step(switches_gripper=True),
        "inverse kinematics": lambda: kinematics.inverse(scene.arm.position),
        "image of 48 px": lambda: scene.render(48),
        "image of 96 px": lambda: scene.render(96),
        "image of 256 px": lambda: scene.render(256),
        "reset": lambda: pick_place.reset(seed=next(seeds)),
    }
    results = {f"{name}, ms": 1e3 * seconds_of(action, seconds) for name, action in parts.items()}
    results["memory of an environment, MB"] = memory
    start = time.perf_counter()
    # 7 and 300 have no common divisor, so that 300 episodes meet every task once.
    ends = [list(expert_episode(pick_place, 7 * number % 300, number))[-1] for number in range(episodes)]
    results["expert, episodes/s"] = episodes / (time.perf_counter() - start)
    results["expert, success, %"] = 100 * float(np.mean([end.info["is_success"] for end in ends]))
    pick_place.close()
    return results


# Training


def train(
    policy_type: str = "deltaco", batch_size: int = 256, steps: int = 10, options: tuple[str, ...] = ()
) -> dict[str, float]:
    """Compares `deltaco train` with `lerobot-train`: samples per second of the data alone, and of training.

    Args:
        policy_type: deltaco or deltaco_match.
        batch_size: Size of the batches, a multiple of 16.
        steps: Number of steps of each training, of which the first third is not counted.
        options: More options of the policy, such as backbone=strided.
    """
    if batch_size < N_TASKS or batch_size % N_TASKS or steps < 3:
        raise ValueError(f"`batch_size` must be a multiple of {N_TASKS}, and `steps` at least 3.")
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        make_dataset(root)
        for name, in_memory in (("lerobot-train", False), ("deltaco train", True)):
            results[f"{name}: data alone, samples/s"] = _data_rate(root, in_memory, batch_size)
            words: dict[str, Any] = {}
            words |= {f"policy.{word.partition('=')[0]}": word.partition("=")[2] for word in options}
            words |= {"policy.type": policy_type, "policy.tasks_per_batch": N_TASKS if in_memory else 0}
            words |= {"batch_size": batch_size, "steps": steps, "output_dir": f"{folder}/{in_memory}"}
            results[f"{name}: training, samples/s"] = _training_rate(root, in_memory, words)
    for part in ("data alone", "training"):
        stock, ours = (results[f"{name}: {part}, samples/s"] for name in ("lerobot-train", "deltaco train"))
        results[f"ratio: {part}"] = ours / stock
    return results


def make_dataset(root: Path, episodes_per_task: int = 12) -> None:
    """Collects episodes of some tasks."""
    from lerobot_deltaco.collect import CollectionPlan, collect

    collect(root, CollectionPlan(f"0-{N_TASKS - 1}", episodes_per_task))


def _data_rate(root: Path, in_memory: bool, batch_size: int) -> float:
    """Returns samples per second that a data loader gives, with two worker processes or from memory."""
    from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
    from torch.utils.data import DataLoader

    from lerobot_deltaco.frames import FramesInMemory

    dataset = LeRobotDataset("benchmark/data", root=root, return_uint8=True)
    bounds = dataset.meta.episodes["dataset_from_index"], dataset.meta.episodes["dataset_to_index"]
    loader = DataLoader(
        FramesInMemory(dataset) if in_memory else dataset,
        batch_size=batch_size,
        sampler=EpisodeAwareSampler(*bounds, shuffle=True),
        drop_last=True,
        num_workers=0 if in_memory else 2,
    )
    batches = itertools.chain.from_iterable(itertools.repeat(loader))
    next(batches)
    n_batches, start = 50 if in_memory else 8, time.perf_counter()
    for _ in range(n_batches):
        next(batches)
    return batch_size * n_batches / (time.perf_counter() - start)


def _training_rate(root: Path, in_memory: bool, options: dict[str, Any]) -> float:
    """Returns samples per second of a training, after its first third."""
    import torch
    from lerobot.scripts import lerobot_train

    from lerobot_deltaco.train import train as train_in_memory

    words = {
        "policy.device": "cuda" if torch.cuda.is_available() else "cpu",
        "dataset.repo_id": "benchmark/data",
        "dataset.root": root,
        "num_workers": 0 if in_memory else 2,
        "save_checkpoint": "false",
        "log_freq": 1000,
        **options,
    }
    ends: list[float] = []
    update = lerobot_train.update_policy

    def noted(*arguments: Any, **keywords: Any) -> Any:
        result = update(*arguments, **keywords)
        ends.append(time.perf_counter())
        return result

    with (
        patch.object(sys, "argv", ["train", *(f"--{name}={value}" for name, value in words.items())]),
        patch.object(lerobot_train, "update_policy", noted),
    ):
        train_in_memory() if in_memory else lerobot_train.main()
    first = len(ends) // 3
    return options["batch_size"] * (len(ends) - 1 - first) / (ends[-1] - ends[first])


# The policies


def policy(batch_size: int = 128, seconds: float = 5.0) -> dict[str, float]:
    """Measures an action on one core, in ms, and training steps on all cores, in samples per second.

    Args:
        batch_size: Number of samples of a training step.
        seconds: Duration of each measurement.
    """
    import torch

    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    variants: dict[str, dict[str, Any]] = {
        "deltaco, paper": {"type": "deltaco"},
        "deltaco, strided": {"type": "deltaco", "backbone": "strided"},
        "deltaco_match": {"type": "deltaco_match"},
    }
    results: dict[str, float] = {}
    n_threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        make_dataset(root, 3)
        for device, (name, options) in itertools.product(devices, variants.items()):
            for dtype in ("float32", "bfloat16"):
                label = f"{name}, {device}, {dtype}"
                torch.set_num_threads(1)
                act, step = _policy_actions(root, {**options, "device": device, "dtype": dtype}, batch_size)
                if dtype == "float32":  # acting is in float32
                    results[f"{name}, {device}: action, ms"] = 1e3 * seconds_of(act, seconds)
                torch.set_num_threads(n_threads)
                results[f"{label}: training, samples/s"] = batch_size / seconds_of(step, seconds)
    paper, strided = (
        results[f"deltaco, {n}, cpu, float32: training, samples/s"] for n in ("paper", "strided")
    )
    return {**results, "ratio: training of strided to paper": strided / paper}


def _policy_actions(
    root: Path, options: dict[str, Any], batch_size: int
) -> tuple[Callable[[], object], Callable[[], object]]:
    """Returns what chooses the next action of an episode, and what makes a training step."""
    import torch
    from lerobot.datasets import LeRobotDataset
    from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
    from torch.utils.data import default_collate

    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

    dataset = LeRobotDataset("benchmark/data", root=root)
    config = make_policy_config(options.pop("type"), **options)
    made: Any = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    samples = default_collate([dataset[7 * n % len(dataset)] for n in range(batch_size)])
    optimizer = config.get_optimizer_preset().build(made.get_optim_params())
    batch = before(samples)
    made.train()(batch)  # reads the demonstrations

    def step() -> None:
        made.train()
        loss, _ = made(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        if config.device == "cuda":
            torch.cuda.synchronize()

    observation = {name: value[:1] for name, value in samples.items() if name.startswith("observation.")}
    observation["task"] = samples["task"][:1]

    def act() -> None:
        made.eval()
        after(made.select_action(before(dict(observation)))).cpu()

    return act, step


if __name__ == "__main__":
    main()
