"""What this machine is good at."""

from __future__ import annotations

import time

import torch

from lerobot_deltaco.configuration_deltaco import BACKBONES
from lerobot_deltaco.policy.networks import FilmResNet

# bfloat16 is taken only where it is surely faster.
_MIN_GAIN = 1.15
_BATCH_SIZE, _N_STEPS = 48, 5


def fast_dtype() -> str:
    """The `dtype` in which this processor trains faster; some have instructions for bfloat16."""
    seconds = {dtype: _seconds(dtype) for dtype in (torch.float32, torch.bfloat16)}
    return "bfloat16" if seconds[torch.float32] > _MIN_GAIN * seconds[torch.bfloat16] else "float32"


def _seconds(dtype: torch.dtype) -> float:
    """Of a training step of the strided network, the least of a few."""
    channels, stem_stride = BACKBONES["strided"]
    network = FilmResNet(0, channels, stem_stride)
    images = torch.rand(_BATCH_SIZE, 3, 48, 48)
    times = []
    for _ in range(_N_STEPS):
        start = time.perf_counter()
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            loss = network(images, None).float().square().mean()
        loss.backward()
        times.append(time.perf_counter() - start)
    return min(times)
