"""The initial weights of the authors' code, where they are not PyTorch's."""

from __future__ import annotations

import math

import torch
from torch import nn

from lerobot_deltaco.policy.networks import MAX_LOG_STD, MIN_LOG_STD, ConditionedPolicy

POLICY_BOUND, ENCODER_BOUND = 1e-3, 1e-4
INITIAL_STD = 0.05


@torch.no_grad()
def initialize_policy(model: ConditionedPolicy) -> None:
    """Sets the weights of the policy's network as the authors' code does.

    Fully connected layers are uniform within 1e-3; the convolutions are as in torchvision's ResNet (Kaiming);
    the standard deviation of a motion is 0.05. FiLM is close to the identity, as it was.
    """
    for layers in (model.motion, model.gripper):
        if layers is not None:
            _uniform(layers, POLICY_BOUND)
    for module in model.backbone.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    share = (math.log(INITIAL_STD) - MIN_LOG_STD) / (MAX_LOG_STD - MIN_LOG_STD)
    model.raw_log_std.fill_(math.log(share / (1 - share)))


def initialize_demo_encoder(encoder: nn.Module) -> None:
    """Makes the fully connected layers of the paper's demonstration encoder uniform within 1e-4."""
    _uniform(encoder, ENCODER_BOUND)


@torch.no_grad()
def _uniform(network: nn.Module, bound: float) -> None:
    for module in network.modules():
        if isinstance(module, nn.Linear):
            module.weight.uniform_(-bound, bound)
            module.bias.uniform_(-bound, bound)
