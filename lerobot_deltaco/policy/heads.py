"""Fully connected layers after a frozen encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_deltaco.policy.networks import multilayer_perceptron


class UnitHead(nn.Module):
    """From the features of a frozen encoder to a task embedding, a unit vector.

    Args:
        feature_dim: Size of the features.
        hidden_dims: Sizes of the hidden layers, with a ReLU after each; None for no layers at all, so that
            the features are only scaled to unit length.
        embedding_dim: Size of the embedding; without layers, that of the features.
    """

    def __init__(self, feature_dim: int, hidden_dims: Sequence[int] | None, embedding_dim: int) -> None:
        super().__init__()
        self.layers: nn.Module = nn.Identity()
        if hidden_dims is not None:
            self.layers = multilayer_perceptron([feature_dim, *hidden_dims, embedding_dim])
        elif feature_dim != embedding_dim:
            raise ValueError(
                f"Without layers, an embedding has the size of the features, {feature_dim}. Got "
                f"{embedding_dim}."
            )

    def forward(self, features: Tensor) -> Tensor:
        """From (batch, feature_dim) to unit vectors (batch, embedding_dim)."""
        return F.normalize(self.layers(features), dim=-1)
