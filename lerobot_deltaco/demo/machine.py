"""Measurements of this machine: its faster precision, and its training speed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from torch.utils.data import DataLoader

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.networks import FilmResNet
from lerobot_deltaco.policy.options import BACKBONES

# bfloat16 is chosen only if it is clearly faster.
_MIN_GAIN = 1.15
_BATCH_SIZE, _N_STEPS = 48, 5
_N_TRIED_STEPS = 40


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
    """Seconds of a step of `lerobot-train`, from reading the batch to the optimizer, measured on a few.

    Args:
        repo_id: Repository id of the training dataset.
        root: Folder of the dataset.
        policy: Options of the policy.
        batch_size: Batch size of the training.
    """
    dataset = LeRobotDataset(repo_id, root=root)
    config = DeltacoConfig(**{name: value for name, value in policy.items() if name != "type"})
    network = make_policy(config, ds_meta=dataset.meta)
    network.train()
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = config.get_optimizer_preset().build(network.get_optim_params())
    batches = iter(DataLoader(dataset, batch_size, shuffle=True))
    times = []
    for _ in range(min(_N_TRIED_STEPS, len(dataset) // batch_size)):
        start = time.perf_counter()
        batch = preprocessor(next(batches))
        with torch.autocast("cpu", torch.bfloat16, enabled=config.dtype == "bfloat16"):
            loss, _ = network(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), float("inf"))
        optimizer.step()
        optimizer.zero_grad()
        times.append(time.perf_counter() - start)
    # The first also read the demonstrations.
    return statistics.mean(times[1:])
