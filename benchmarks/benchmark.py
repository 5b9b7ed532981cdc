"""Speed of the environment, of training and of the policies. `deltaco collect` prints its own.

    python benchmarks/benchmark.py env|train|policy|latency|video|contention

Times are of one machine: compare figures of one run, made while nothing else uses the processor.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

N_TASKS = 16  # of the datasets that are collected for training


def main() -> None:
    """Runs the benchmark that the command line names, and prints its table."""
    import tyro

    commands: dict[str, Callable[..., dict[str, float]]] = {"env": env, "train": train, "policy": policy}
    commands |= {"latency": latency, "video": video, "contention": contention}
    results = tyro.extras.subcommand_cli_from_dict(commands, description=(__doc__ or "").partition("\n")[0])
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:12.3f}\n" for name, value in results.items())


def seconds_of(
    action: Callable[[], object], seconds: float = 1.0, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Returns the median duration of an action, s, over as many calls as fit into some seconds."""
    action()  # warms up
    times: list[float] = []
    while len(times) < 3 or sum(times) < seconds:
        start = clock()
        action()
        times.append(clock() - start)
    return statistics.median(times)


# The environment


def env(episodes: int = 100, seconds: float = 1.0) -> dict[str, float]:
    """Measures the parts of an episode, and episodes of the expert, on one core.

    Args:
        episodes: Number of episodes of the expert.
        seconds: Duration of the measurement of each part.
    """
    from gym_deltaco.env import PickPlaceEnv
    from gym_deltaco.expert import expert_episode
    from gym_deltaco.robot import kinematics

    pick_place = PickPlaceEnv()
    pick_place.reset(seed=0)
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
    start = time.perf_counter()
    # 7 and 300 have no common divisor, so that 300 episodes meet every task once.
    ends = [list(expert_episode(pick_place, 7 * number % 300, number))[-1] for number in range(episodes)]
    results["expert, episodes/s"] = episodes / (time.perf_counter() - start)
    results["expert, success, %"] = 100 * float(np.mean([end.info["is_success"] for end in ends]))
    pick_place.close()
    return results


# Training


def train(policy_type: str = "deltaco", batch_size: int = 256, steps: int = 10) -> dict[str, float]:
    """Compares `deltaco train` with `lerobot-train`, in samples per second.

    Args:
        policy_type: deltaco or deltaco_match.
        batch_size: Size of the batches, a multiple of 16.
        steps: Number of steps of each training, at least 3, of which the first third is not counted.
    """
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        root = make_dataset(Path(folder) / "dataset", 12)
        for name, in_memory in (("lerobot-train", False), ("deltaco train", True)):
            options = {
                "policy.type": policy_type,
                "policy.tasks_per_batch": N_TASKS if in_memory else 0,
                "policy.device": device(),
                "dataset.repo_id": "benchmark/data",
                "dataset.root": root,
                "batch_size": batch_size,
                "steps": steps,
                "num_workers": 0 if in_memory else 2,
                "save_checkpoint": "false",
                "log_freq": 1000,
                "output_dir": f"{folder}/{in_memory}",
            }
            results[f"{name}, samples/s"] = batch_size / seconds_of_steps(options, in_memory)
    stock, ours = results.values()
    return {**results, "ratio": ours / stock}


def device() -> str:
    """Returns the device that the policies run on."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def make_dataset(root: Path, episodes_per_task: int) -> Path:
    """Collects episodes of some tasks, and returns their folder."""
    from lerobot_deltaco.collection.collect import CollectionPlan, collect

    collect(root, CollectionPlan(f"0-{N_TASKS - 1}", episodes_per_task))
    return root


def seconds_of_steps(options: dict[str, Any], in_memory: bool) -> float:
    """Returns the mean duration of a training step, s, after the first third of them."""
    from lerobot.scripts import lerobot_train

    from lerobot_deltaco.training.train import train as train_in_memory

    ends: list[float] = []
    update = lerobot_train.update_policy

    def noted(*arguments: Any, **keywords: Any) -> Any:
        result = update(*arguments, **keywords)
        ends.append(time.perf_counter())
        return result

    with (
        patch.object(sys, "argv", ["train", *(f"--{name}={value}" for name, value in options.items())]),
        patch.object(lerobot_train, "update_policy", noted),
    ):
        train_in_memory() if in_memory else lerobot_train.main()
    return float(np.diff(ends[len(ends) // 3 :]).mean())


# The policies


def policy(batch_size: int = 128, seconds: float = 5.0) -> dict[str, float]:
    """Measures an action, in ms, and training steps without the data, in samples per second.

    Args:
        batch_size: Number of samples of a training step.
        seconds: Duration of each measurement.
    """
    import torch
    from lerobot.datasets import LeRobotDataset
    from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
    from torch.utils.data import default_collate

    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

    variants: dict[str, dict[str, Any]] = {
        "deltaco, paper": {"policy_type": "deltaco"},
        "deltaco, strided": {"policy_type": "deltaco", "backbone": "strided"},
        "deltaco_match": {"policy_type": "deltaco_match"},
    }
    results: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        dataset = LeRobotDataset("benchmark/data", root=make_dataset(Path(folder) / "dataset", 3))
        samples = default_collate([dataset[7 * n % len(dataset)] for n in range(batch_size)])
        seen = {name: value[:1] for name, value in samples.items() if name.startswith("observation.")}
        seen["task"] = samples["task"][:1]
        for name, options in variants.items():
            config = make_policy_config(**options, device=device(), precision="float32")
            made: Any = make_policy(config, ds_meta=dataset.meta).train()
            before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
            optimizer = config.get_optimizer_preset().build(made.get_optim_params())
            batch = before(samples)

            def step(made: Any = made, batch: Any = batch, optimizer: Any = optimizer) -> None:
                made(batch)[0].backward()
                optimizer.step()
                optimizer.zero_grad()
                if device() == "cuda":
                    torch.cuda.synchronize()

            def act(made: Any = made, before: Any = before, after: Any = after) -> None:
                after(made.select_action(before(dict(seen)))).cpu()

            step()  # reads the demonstrations
            results[f"{name}: training, samples/s"] = batch_size / seconds_of(step, seconds)
            made.eval()
            results[f"{name}: action, ms"] = 1e3 * seconds_of(act, seconds)
    return results


def latency(checkpoint: Path = Path("checkpoints/pick_place"), seconds: float = 5.0) -> dict[str, float]:
    """Measures what `deltaco_match` takes of one core before and between movements, in ms.

    An action is `select_action` with the processors around it; finding is the first one of an episode. The
    processor's time is measured, so that other processes hardly matter.

    Args:
        checkpoint: Folder of a policy with demonstrations.
        seconds: Duration of each measurement.
    """
    import torch

    from lerobot_deltaco.evaluation.checkpoints import load_policy
    from lerobot_deltaco.lerobot_versions import action_of

    torch.set_num_threads(1)
    loaded = load_policy(checkpoint, ["--device=cpu"])
    made: Any = loaded.policy
    demonstration = made.demonstrations[0]
    results: dict[str, float] = {}
    for height, width in ((48, 48), (480, 640)):
        # A scene of the benchmark, scaled; in noise, everything would stand out.
        scene = demonstration.frames[:1].float() / 255
        scene = torch.nn.functional.interpolate(scene, (height, width), mode="bilinear", antialias=True)[0]
        seen: dict[str, Any] = dict.fromkeys(made.config.image_features, scene)
        seen |= {"observation.state": torch.zeros(made.config.state_dim), "task": demonstration.task}

        def act(seen: dict[str, Any] = seen) -> None:
            with torch.inference_mode():
                loaded.postprocessor(action_of(made.select_action(loaded.preprocessor(dict(seen)))))

        def find(act: Callable[[], None] = act) -> None:
            made.reset()
            act()

        camera = f"camera of {width} x {height} px"
        results[f"{camera}: find, ms"] = 1e3 * seconds_of(find, seconds, time.process_time)
        made.config.n_action_steps = 1  # a network's prediction at every step
        results[f"{camera}: act, ms"] = 1e3 * seconds_of(act, seconds, time.process_time)
    return results


# Videos


def video(episodes: int = 6, frames: int = 100, size: int = 480, repeats: int = 3) -> dict[str, float]:
    """Compares reading all frames of a dataset of videos with PyAV, which decodes each file from end to end.

    Args:
        episodes: Number of episodes.
        frames: Number of frames of each.
        size: Height and width of the images, px.
        repeats: Number of measurements, whose medians are taken.
    """
    import av
    import torch
    from lerobot.datasets import LeRobotDataset

    from lerobot_deltaco.data.images import read_images

    camera, rng = "observation.images.front", np.random.default_rng(0)
    feature = {"dtype": "video", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    background = np.kron(rng.integers(0, 256, (size // 16, size // 16, 3)), np.ones((16, 16, 1)))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        dataset = LeRobotDataset.create("benchmark/video", 30, {camera: feature}, root, use_videos=True)
        for _ in range(episodes):
            for n in range(frames):
                dataset.add_frame({camera: np.roll(background, n, axis=1).astype(np.uint8), "task": "move"})
            dataset.save_episode()
        dataset.finalize()
        dataset = LeRobotDataset("benchmark/video", root=root, return_uint8=True)

        def sequence() -> None:
            images = torch.empty(len(dataset), 3, size, size, dtype=torch.uint8)
            row = 0
            for path in sorted(root.glob("videos/**/*.mp4")):
                with av.open(path) as container:
                    for row, frame in enumerate(container.decode(video=0), row):  # noqa: B020
                        images[row] = torch.from_numpy(frame.to_ndarray(format="rgb24")).permute(2, 0, 1)
                row += 1

        actions = {
            "PyAV in sequence": sequence,
            "read_images": lambda: read_images(dataset, camera, range(len(dataset))),
            "read_images, every third": lambda: read_images(dataset, camera, range(0, len(dataset), 3)),
        }
        times: dict[str, list[float]] = {name: [] for name in actions}
        for _ in range(repeats):  # in turns, since other processes may begin or end
            for name, action in actions.items():
                start = time.perf_counter()
                action()
                times[name].append(time.perf_counter() - start)
    medians = {name: statistics.median(values) for name, values in times.items()}
    results = {f"{name}, ms per frame": 1e3 * value / episodes / frames for name, value in medians.items()}
    return {**results, "ratio": medians["read_images"] / medians["PyAV in sequence"]}


# Beside other processes


def contention(seconds: float = 5.0) -> dict[str, float]:
    """Compares training steps alone and beside a busy process, if idle threads spin and if they wait.

    Args:
        seconds: Duration of each of the four measurements.
    """
    results: dict[str, float] = {}
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))
    }
    for name, setting in (("spinning", {}), ("passive", {"OMP_WAIT_POLICY": "PASSIVE"})):
        command = [sys.executable, "-c", _CONVOLUTIONS, str(seconds)]
        for where in ("alone", "beside a busy process"):
            with busy_process() if where != "alone" else contextlib.nullcontext():
                output = subprocess.check_output(command, env=environment | setting, text=True)
            results[f"{name}, {where}, ms"] = 1e3 * float(output)
    alone, beside = results["passive, alone, ms"], results["passive, beside a busy process, ms"]
    results["passive, alone / spinning, alone"] = alone / results["spinning, alone, ms"]
    results["passive, beside / alone"] = beside / alone
    return results


# Median duration of a training step of a small network, with as many threads as cores
_CONVOLUTIONS = """
import statistics, sys, time
import torch
from torch import nn
torch.manual_seed(0)
widths = [3, 16, 32, 32, 32, 32]
layers = [(nn.Conv2d(a, b, 3, padding=1), nn.ReLU()) for a, b in zip(widths, widths[1:])]
network = nn.Sequential(*(layer for pair in layers for layer in pair))
optimizer = torch.optim.AdamW(network.parameters())
images, times = torch.rand(32, 3, 48, 48), []
while sum(times) < float(sys.argv[1]) or len(times) < 3:
    start = time.perf_counter()
    network(images).square().mean().backward()
    optimizer.step()
    optimizer.zero_grad()
    times.append(time.perf_counter() - start)
print(statistics.median(times[len(times) // 4 :]))
"""


@contextlib.contextmanager
def busy_process() -> Iterator[None]:
    """Keeps one core busy."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        try:
            yield
        finally:
            process.kill()


if __name__ == "__main__":
    main()
