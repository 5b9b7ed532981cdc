"""Speed of the policy: `python benchmarks/policy.py [--json FILE]` prints a table.

Latency: `select_action` for one observation, after the first step of an episode, on one core (and on the GPU,
where there is one), in milliseconds. Training: forward, backward and optimizer, in samples per second, on all
cores. Times are of one machine; compare figures of one run. Run it while nothing else uses the processor.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.options import BACKBONES, DTYPES

TASKS = [f"task {n}" for n in range(16)]
EPISODES_PER_TASK = 4
# The paper's D for MiniLM; what the embeddings are does not matter here.
EMBEDDING_DIM = 384


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch-size", type=int, default=128, help="of the training steps (%(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each figure (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.batch_size < 1 or options.seconds <= 0:
        parser.error("--batch-size must be at least 1, and --seconds greater than 0.")

    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    n_threads = torch.get_num_threads()
    results: dict[str, float] = {}
    for device in devices:
        for backbone in BACKBONES:
            for dtype in DTYPES:
                name = f"{device}, {backbone}, {dtype}"
                policy = make_policy(device, backbone, dtype)
                torch.set_num_threads(1)
                results[f"{name}: select_action, ms"] = 1e3 * measure_latency(policy, options.seconds)
                torch.set_num_threads(n_threads)
                rate = measure_training(policy, options.batch_size, options.seconds)
                results[f"{name}: training, samples/s"] = rate
    for device in devices:
        for dtype in DTYPES:
            paper, strided = (
                results[f"{device}, {name}, {dtype}: training, samples/s"] for name in ("paper", "strided")
            )
            results[f"{device}, {dtype}: strided is faster to train by"] = strided / paper
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:10.2f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def make_policy(device: str, backbone: str, dtype: str) -> DeltacoPolicy:
    """DeL-TaCo for the benchmark's observations, with random demonstrations and instructions."""
    config = DeltacoConfig(device=device, backbone=backbone, dtype=dtype, gripper="3")
    config.input_features = {
        "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
        "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
    }
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    policy = DeltacoPolicy(config)
    n_episodes = len(TASKS) * EPISODES_PER_TASK
    frames = torch.randint(0, 256, (n_episodes, 2, 3, 48, 48), dtype=torch.uint8)
    tasks = [task for task in TASKS for _ in range(EPISODES_PER_TASK)]
    policy.set_train_demonstrations(DemonstrationSet(frames, tasks, range(n_episodes)))
    vectors = torch.nn.functional.normalize(torch.randn(len(TASKS), EMBEDDING_DIM), dim=-1)
    policy.instructions.put(TASKS, vectors)
    return policy.to(device)


def make_batch(policy: DeltacoPolicy, batch_size: int) -> dict[str, object]:
    """A random batch of as many samples of each task, as near as it gets."""
    device = policy.config.device
    episodes = torch.arange(batch_size) % (len(TASKS) * EPISODES_PER_TASK)
    return {
        "observation.image": torch.rand(batch_size, 3, 48, 48, device=device),
        "observation.state": torch.randn(batch_size, 10, device=device),
        "action": torch.rand(batch_size, 4, device=device) * 2 - 1,
        "episode_index": episodes.to(device),
        "task": [TASKS[int(episode) // EPISODES_PER_TASK] for episode in episodes],
    }


def measure_latency(policy: DeltacoPolicy, seconds: float) -> float:
    """Seconds of one `select_action`, the median."""
    policy.eval()
    batch = make_batch(policy, 1)
    policy.reset()
    # The first step of an episode encodes the demonstration and the instruction.
    policy.select_action(batch)
    times: list[float] = []
    while len(times) < 10 or sum(times) < seconds:
        start = time.perf_counter()
        policy.select_action(batch).cpu()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure_training(policy: DeltacoPolicy, batch_size: int, seconds: float) -> float:
    """Samples per second of training steps on one batch."""
    policy.train()
    batch = make_batch(policy, batch_size)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    device = torch.device(policy.config.device)

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=policy.config.dtype == "bfloat16"):
            loss, _ = policy(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    def wait() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize()

    for _ in range(3):
        step()
    wait()
    start, n_steps = time.perf_counter(), 0
    while n_steps < 3 or time.perf_counter() - start < seconds:
        step()
        n_steps += 1
        if n_steps % 10 == 0:
            wait()
    wait()
    return batch_size * n_steps / (time.perf_counter() - start)


if __name__ == "__main__":
    main()
