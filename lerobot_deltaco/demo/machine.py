"""Measurements of this machine: its faster precision, and its training speed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.networks import FilmResNet
from lerobot_deltaco.policy.options import BACKBONES
from lerobot_deltaco.training.frames import FramesInMemory

# bfloat16 is chosen only if it is clearly faster.
_MIN_GAIN = 1.15
_BATCH_SIZE, _N_STEPS = 48, 5
_N_TRIED_STEPS, _N_EPISODES = 40, 100


def fast_dtype() -> str:
    """The `dtype` in which this processor trains faster; some have instructions for bfloat16."""
    seconds = {dtype: _seconds(dtype) for dtype in (torch.float32, torch.bfloat16)}
    return "bfloat16" if seconds[torch.float32] > _MIN_GAIN * seconds[torch.bfloat16] else "float32"


def _seconds(dtype: torch.dtype) -> float:
    """Of a training step of the strided network, the least of a few."""
    backbone = BACKBONES["strided"]
    network = FilmResNet(0, backbone.channels, backbone.stem_stride)
    images = torch.rand(_BATCH_SIZE, 3, 48, 48)
    times = []
    for _ in range(_N_STEPS):
        start = time.perf_counter()
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            loss = network(images, None).float().square().mean()
        loss.backward()
        times.append(time.perf_counter() - start)
    return min(times)


def seconds_per_step(repo_id: str, root: Path, policy: Mapping[str, Any], batch_size: int) -> float:
    """Seconds of a step of `deltaco-train`, from gathering the batch to the optimizer, measured on a few.

    Args:
        repo_id: Repository id of the training dataset.
        root: Folder of the dataset.
        policy: Options of the policy.
        batch_size: Batch size of the training.
    """
    n_episodes = LeRobotDatasetMetadata(repo_id, root=root).total_episodes
    # A part of it, since all images are decoded.
    episodes = list(range(0, n_episodes, max(1, n_episodes // _N_EPISODES)))
    dataset = LeRobotDataset(repo_id, root=root, episodes=episodes, return_uint8=True)
    frames = FramesInMemory(dataset)
    config = DeltacoConfig(**{name: value for name, value in policy.items() if name != "type"})
    network = make_policy(config, ds_meta=dataset.meta)
    assert isinstance(network, DeltacoPolicy)
    if config.uses_demo:
        network.set_train_demonstrations(
            frames.demonstrations(config.cameras[0], config.demo_image_size, config.n_demo_frames), None
        )
    network.train()
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = config.get_optimizer_preset().build(network.get_optim_params())
    times = []
    for places in torch.randperm(len(frames)).split(batch_size)[:_N_TRIED_STEPS]:
        start = time.perf_counter()
        batch = frames.batch(places)
        # As LeRobot's loop does.
        batch |= {camera: batch[camera].to(torch.float32) / 255 for camera in dataset.meta.camera_keys}
        batch = preprocessor(batch)
        with torch.autocast("cpu", torch.bfloat16, enabled=config.dtype == "bfloat16"):
            loss, _ = network(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), float("inf"))
        optimizer.step()
        optimizer.zero_grad()
        times.append(time.perf_counter() - start)
    # The first also makes what later ones use again.
    return statistics.mean(times[1:])
