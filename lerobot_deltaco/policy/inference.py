"""Faster networks for acting, whose batch norms are folded into the preceding convolutions."""

from __future__ import annotations

import copy

from torch import nn
from torch.nn.utils import fuse_conv_bn_eval

from lerobot_deltaco.policy.networks import ConditionedPolicy, FilmBlock


class FoldedPolicy:
    """A copy of a policy's network for acting, which is renewed when the network's weights change.

    It is not a module, so that it is neither trained nor saved.
    """

    def __init__(self, network: ConditionedPolicy) -> None:
        self._network = network
        self._copy: ConditionedPolicy | None = None
        self._version: tuple[tuple[int, int], ...] = ()

    def network(self) -> ConditionedPolicy:
        """The copy, in evaluation mode. Its outputs equal the network's up to rounding.

        (Between two equally likely modes, rounding may decide.)
        """
        tensors = (*self._network.parameters(), *self._network.buffers())
        version = tuple((tensor.data_ptr(), tensor._version) for tensor in tensors)
        if self._copy is None or version != self._version:
            self._copy = folded(self._network)
            self._version = version
        return self._copy


def folded(network: ConditionedPolicy) -> ConditionedPolicy:
    """A copy in evaluation mode, without batch norms."""
    network = copy.deepcopy(network).eval().requires_grad_(False)
    _fold(network.backbone.stem, "0", "1")
    for block in network.backbone.blocks:
        assert isinstance(block, FilmBlock)
        _fold(block, "conv1", "norm1")
        _fold(block, "conv2", "norm2")
        if isinstance(block.shortcut, nn.Sequential):
            _fold(block.shortcut, "0", "1")
    return network


def _fold(parent: nn.Module, convolution: str, norm: str) -> None:
    before, after = parent.get_submodule(convolution), parent.get_submodule(norm)
    assert isinstance(before, nn.Conv2d)
    assert isinstance(after, nn.BatchNorm2d)
    fused = fuse_conv_bn_eval(before, after)
    setattr(parent, convolution, fused)
    setattr(parent, norm, nn.Identity())
