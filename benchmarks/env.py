"""Speed of the environment: `python benchmarks/env.py [--json FILE]` prints a table.

Times are of one machine; compare figures of one run. Run it while nothing else uses the processor.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import psutil
from tqdm import tqdm

from gym_deltaco import EPISODE_STEPS, kinematics
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import N_TASKS

N_MEMORY_ENVS = 8
EPISODES_PER_CHUNK = 5


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--episodes", type=int, default=300, help="episodes of the expert for each of two runs"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes of the second run")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.episodes < 1 or options.workers < 1:
        parser.error("--episodes and --workers must be at least 1.")

    results = {**measure_parts(), "memory_mb_per_env": measure_memory()}
    one_process, steps = measure_episodes(options.episodes, 1)
    all_cores, _ = measure_episodes(options.episodes, options.workers)
    results |= {
        "episodes_per_s_one_process": one_process,
        "episodes_per_s_all_cores": all_cores,
        "workers": options.workers,
        "expert_success": float(np.isfinite(steps).mean()),
        # Of all episodes: one that fails counts as never released.
        "release_step_median": float(np.median(steps)),
        "release_step_p95": float(np.percentile(steps, 95)),
    }
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:10.3f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def measure_parts() -> dict[str, float]:
    """Milliseconds of what an episode consists of."""
    env = PickPlaceEnv()
    env.reset(seed=0)
    scene = env.scene
    seeds = iter(range(10**6))
    signs = iter(np.resize([1.0, -1.0], 10**6))

    def step(gripper: Callable[[float], float]) -> None:
        sign = next(signs)
        env.step(np.array([0.5 * sign, 0.3 * sign, 0.2 * sign, gripper(sign)], dtype=np.float32))

    parts = {
        "control_step_ms": (lambda: step(lambda _: 1.0), 200),
        "gripper_step_ms": (lambda: step(lambda sign: sign), 100),
        "physics_of_a_control_step_ms": (lambda: scene.command(scene.arm.position, scene.arm.is_open), 200),
        "inverse_kinematics_ms": (lambda: kinematics.inverse(scene.arm.position), 1000),
        "render_48_px_ms": (lambda: scene.render(48), 200),
        "render_96_px_ms": (lambda: scene.render(96), 100),
        "render_256_px_ms": (lambda: scene.render(256), 50),
        "reset_ms": (lambda: env.reset(seed=next(seeds)), 50),
    }
    results = {name: _milliseconds(action, n) for name, (action, n) in parts.items()}
    env.close()
    return results


def _milliseconds(action: Callable[[], object], n: int) -> float:
    action()
    start = time.perf_counter()
    for _ in range(n):
        action()
    return (time.perf_counter() - start) / n * 1e3


def measure_memory() -> float:
    """Megabytes of this process for each further environment."""
    process = psutil.Process()
    envs = [PickPlaceEnv() for _ in range(N_MEMORY_ENVS)]
    before = process.memory_info().rss
    for env in envs:
        env.reset(seed=0)
    after = process.memory_info().rss
    for env in envs:
        env.close()
    return (after - before) / N_MEMORY_ENVS / 1e6


def measure_episodes(n_episodes: int, n_workers: int) -> tuple[float, np.ndarray]:
    """Episodes of the expert, every frame rendered at 48 px, over as many tasks as there are episodes.

    Returns:
        Episodes per second, and the step at which each had succeeded (infinity: it had not), (n_episodes,).
    """
    numbers = range(n_episodes)
    chunks = [numbers[i : i + EPISODES_PER_CHUNK] for i in numbers[::EPISODES_PER_CHUNK]]
    with get_context("spawn").Pool(n_workers) as pool:
        # Starting the processes, and their first scene, is not counted.
        pool.map(_run_episodes, [range(1)] * (4 * n_workers), chunksize=1)
        start = time.perf_counter()
        with tqdm(total=n_episodes, desc=f"{n_workers} process(es)", unit="episode") as progress:
            steps = []
            for chunk in pool.imap(_run_episodes, chunks):
                steps += chunk
                progress.update(len(chunk))
        return n_episodes / (time.perf_counter() - start), np.array(steps)


_env: PickPlaceEnv | None = None


def _run_episodes(numbers: range) -> list[float]:
    global _env
    _env = _env or PickPlaceEnv()
    steps = []
    for number in numbers:
        # 7 and 300 have no common divisor, so 300 episodes meet every task once.
        task_id = 7 * number % N_TASKS
        episode = list(
            expert_episode(_env, task_id, episode_seed(0, "evaluation", task_id, number // N_TASKS))
        )
        assert len(episode) == EPISODE_STEPS
        steps.append(next((n for n, step in enumerate(episode, start=1) if step.info["is_success"]), np.inf))
    return steps


if __name__ == "__main__":
    main()
