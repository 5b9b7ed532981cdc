"""The precision in which networks compute."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch


def autocast(dtype: str, device: torch.device) -> AbstractContextManager:
    """A context in which networks compute in a precision.

    Args:
        dtype: Precision, "float32" or "bfloat16".
        device: Device of the networks.
    """
    return nullcontext() if dtype == "float32" else torch.autocast(device.type, torch.bfloat16)
