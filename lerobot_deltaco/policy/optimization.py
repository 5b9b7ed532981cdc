"""The optimizer and the schedule of the learning rate, as configurations of LeRobot."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from torch.optim.lr_scheduler import LambdaLR


@OptimizerConfig.register_subclass("deltaco_fused_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """AdamW (Adam, where `weight_decay` is 0), updated in one pass over the weights.

    On a CPU, LeRobot's Adam, which runs operation by operation, takes a fifth of a small network's step.

    Args:
        l2: Weight of an L2 penalty on the weights, which is added to the gradients: Adam's own weight decay
            instead of AdamW's.
    """

    l2: float = 0.0

    def build(self, params: Any) -> torch.optim.Optimizer:
        """The optimizer of some weights."""
        options = asdict(self)
        options.pop("grad_clip_norm")
        l2 = options.pop("l2")
        if l2:
            return torch.optim.Adam(params, fused=True, **{**options, "weight_decay": l2})
        return torch.optim.AdamW(params, fused=True, **options)


@LRSchedulerConfig.register_subclass("deltaco_cosine")
@dataclass
class CosineSchedulerConfig(LRSchedulerConfig):
    """A cosine schedule that decays to 0 at the end of the training.

    Args:
        num_warmup_steps: Number of steps over which the learning rate rises linearly from 0.
    """

    num_warmup_steps: int = 0

    def build(self, optimizer: torch.optim.Optimizer, num_training_steps: int) -> LambdaLR:
        """The schedule of an optimizer."""

        def factor(step: int) -> float:
            warmup = min(1.0, (step + 1) / (self.num_warmup_steps + 1))
            return warmup * 0.5 * (1 + math.cos(math.pi * min(1.0, step / num_training_steps)))

        return LambdaLR(optimizer, factor)
