"""Speed of training: `python benchmarks/train.py [--json FILE]` prints a table.

Side by side: stock `lerobot-train`, which reads each frame from the disk, and `deltaco-train`. For both:
samples per second of the data path alone and of training, and where the time of a training goes. The dataset,
of random images, is made beforehand in a temporary folder. Times are of one machine; compare figures of one
run. Run it while nothing else uses the processor.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from accelerate import Accelerator
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.scripts import lerobot_train

from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.policy.options import BACKBONES
from lerobot_deltaco.training.frames import FramesInMemory
from lerobot_deltaco.training.loop import InMemoryTraining
from lerobot_deltaco.training.task_batches import TaskBatchSampler

REPO_ID = "benchmark/random"
N_TASKS, EPISODES_PER_TASK, EPISODE_LENGTH = 16, 12, 30
IMAGE_AXES = ["height", "width", "channels"]
PARTS = ("data", "forward", "backward", "optimizer")


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch-size", type=int, default=1024, help="a multiple of 16 (%(default)s)")
    parser.add_argument("--steps", type=int, default=10, help="of each training (%(default)s)")
    parser.add_argument("--backbone", choices=BACKBONES, default="paper", help="(%(default)s)")
    parser.add_argument("--dtype", default="float32", help="float32 or bfloat16 (%(default)s)")
    parser.add_argument("--compile", action="store_true", help="compile the networks")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.batch_size < N_TASKS or options.batch_size % N_TASKS or options.steps < 3:
        parser.error(f"--batch-size must be a multiple of {N_TASKS}, and --steps at least 3.")

    device = "cuda" if torch.cuda.is_available() else "cpu"
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(instruction_table, "load_language_encoder", lambda name: _random_encoder),
    ):
        root = Path(folder) / "dataset"
        make_dataset(root)
        results = measure_data(root, device, options.batch_size)
        for name, in_memory in (("lerobot-train", False), ("deltaco-train", True)):
            results |= measure_training(name, in_memory, root, Path(folder) / name, device, options)
    for what in ("data path alone", "training"):
        stock, ours = (results[f"{name}: {what}, samples/s"] for name in ("lerobot-train", "deltaco-train"))
        results[f"{what}: deltaco-train is faster by"] = ours / stock
    width = max(map(len, results))
    sys.stdout.write(f"On {device}, batches of {options.batch_size}.\n")
    sys.stdout.writelines(f"{name:{width}}  {value:12.2f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def make_dataset(root: Path) -> None:
    """A dataset with the benchmark's features; noise, so that images are as large as they get."""
    names = ["delta_x", "delta_y", "delta_z", "gripper"]
    features = {
        "observation.image": {"dtype": "image", "shape": (48, 48, 3), "names": IMAGE_AXES},
        "observation.state": {"dtype": "float32", "shape": (10,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": names},
    }
    dataset = LeRobotDataset.create(REPO_ID, 24, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for number in range(N_TASKS * EPISODES_PER_TASK):
        for _ in range(EPISODE_LENGTH):
            dataset.add_frame(
                {
                    "observation.image": rng.integers(0, 256, (48, 48, 3), dtype=np.uint8),
                    "observation.state": rng.normal(size=10).astype(np.float32),
                    "action": rng.uniform(-1, 1, 4).astype(np.float32),
                    "task": f"task {number % N_TASKS}",
                }
            )
        dataset.save_episode()
    dataset.finalize()


def measure_data(root: Path, device: str, batch_size: int) -> dict[str, float]:
    """Samples per second until a batch is on the device, with nothing done with it."""
    dataset = LeRobotDataset(REPO_ID, root=root, return_uint8=True)
    bounds = dataset.meta.episodes["dataset_from_index"], dataset.meta.episodes["dataset_to_index"]
    stock = torch.utils.data.DataLoader(
        dataset, batch_size=batch_size, sampler=EpisodeAwareSampler(*bounds, shuffle=True), drop_last=True
    )
    results = {}
    with_workers = torch.utils.data.DataLoader(
        dataset,
        batch_size=batch_size,
        sampler=EpisodeAwareSampler(*bounds, shuffle=True),
        drop_last=True,
        num_workers=2,
    )
    for name, loader in (("no workers", stock), ("two workers", with_workers)):
        batches = itertools.chain.from_iterable(itertools.repeat(loader))
        key = "lerobot-train: data path alone" + (", two workers" if "two" in name else "")
        results[f"{key}, samples/s"] = _rate(
            lambda batches=batches: {
                name: value.to(device) for name, value in next(batches).items() if torch.is_tensor(value)
            },
            batch_size,
            n_calls=4,
        )
    frames = FramesInMemory(dataset, device)
    sampler = TaskBatchSampler(frames.tasks, batch_size, N_TASKS)

    def places() -> Iterator[torch.Tensor]:
        while True:
            order = iter(sampler)
            while batch := list(itertools.islice(order, batch_size)):
                yield torch.tensor(batch)

    stream = places()
    results["deltaco-train: data path alone, samples/s"] = _rate(
        lambda: frames.batch(next(stream)), batch_size, n_calls=50
    )
    return results


def measure_training(
    name: str, in_memory: bool, root: Path, output: Path, device: str, options: argparse.Namespace
) -> dict[str, float]:
    """Samples per second of LeRobot's loop, and where its time goes."""
    arguments = {
        "policy.type": "deltaco",
        "policy.device": device,
        "policy.backbone": options.backbone,
        "policy.dtype": options.dtype,
        "policy.compile": options.compile,
        "policy.tasks_per_batch": N_TASKS if in_memory else 0,
        "dataset.repo_id": REPO_ID,
        "dataset.root": root,
        "batch_size": options.batch_size,
        "steps": options.steps,
        "num_workers": 0 if in_memory else 2,
        "save_checkpoint": "false",
        "log_freq": 1000,
        "output_dir": output,
    }
    seconds: Counter[str] = Counter()
    ends: list[float] = []
    with ExitStack() as stack:
        argv = [name, *(f"--{key}={value}" for key, value in arguments.items())]
        stack.enter_context(patch.object(sys, "argv", argv))
        if in_memory:
            stack.enter_context(InMemoryTraining().active())
        stack.enter_context(_measured(seconds, ends, device))
        lerobot_train.main()
    # The first steps warm up: caches, kernels and worker processes.
    n_measured = len(ends) - 1 - len(ends) // 3
    elapsed = ends[-1] - ends[len(ends) // 3]
    results = {f"{name}: training, samples/s": options.batch_size * n_measured / elapsed}
    total = ends[-1] - ends[0]
    for part in PARTS:
        results[f"{name}: share of {part}, %"] = 100 * seconds[part] / total
    results[f"{name}: share of the loop itself, %"] = 100 * (1 - sum(seconds.values()) / total)
    return results


@contextmanager
def _measured(seconds: Counter[str], ends: list[float], device: str) -> Iterator[None]:
    """Notes when each step of LeRobot's loop ends, and how long its parts take, after the first."""

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **keywords)
            finally:
                if device == "cuda":
                    torch.cuda.synchronize()
                if ends:
                    seconds[part] += time.perf_counter() - start

        return run

    update = lerobot_train.update_policy
    cycle = lerobot_train.cycle
    build = lerobot_train.make_optimizer_and_scheduler

    def noted(*arguments: Any, **keywords: Any) -> Any:
        result = update(*arguments, **keywords)
        ends.append(time.perf_counter())
        return result

    def fetched(loader: Any) -> Iterator[Any]:
        batches = cycle(loader)
        fetch = timed("data", lambda: next(batches))
        while True:
            yield fetch()

    def built(*arguments: Any, **keywords: Any) -> Any:
        optimizer, scheduler = build(*arguments, **keywords)
        optimizer.step = timed("optimizer", optimizer.step)
        return optimizer, scheduler

    with (
        patch.object(lerobot_train, "update_policy", noted),
        patch.object(lerobot_train, "cycle", fetched),
        patch.object(lerobot_train, "make_optimizer_and_scheduler", built),
        patch.object(DeltacoPolicy, "forward", timed("forward", DeltacoPolicy.forward)),
        patch.object(Accelerator, "backward", timed("backward", Accelerator.backward)),
    ):
        yield


def _rate(call: Callable[[], Any], batch_size: int, n_calls: int) -> float:
    call()
    start = time.perf_counter()
    for _ in range(n_calls):
        call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return batch_size * n_calls / (time.perf_counter() - start)


def _random_encoder(sentences: list[str]) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(len(sentences), 384, generator=generator), dim=-1)


if __name__ == "__main__":
    main()
