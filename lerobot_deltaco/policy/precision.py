"""The precision in which networks compute."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager, nullcontext
from functools import cache

import torch

logger = logging.getLogger(__name__)


def autocast(dtype: str, device: torch.device) -> AbstractContextManager:
    """A context in which networks compute in a precision.

    Args:
        dtype: Precision, "float32" or "bfloat16".
        device: Device of the networks.
    """
    return nullcontext() if dtype == "float32" else torch.autocast(device.type, torch.bfloat16)


@cache
def warn_if_emulated(dtype: str, device_type: str) -> None:
    """Warns, once, of a training in a precision for which this processor has no instructions.

    Args:
        dtype: Precision, "float32" or "bfloat16".
        device_type: Type of the networks' device, such as "cpu".
    """
    if dtype != "bfloat16" or device_type != "cpu" or not torch.backends.mkldnn.is_available():
        return
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        logger.warning(
            "This processor has no instructions for bfloat16, so that a training step takes several times as "
            "long as in float32. Stop, and train with --policy.dtype=float32 (deltaco-experiment: --set "
            "policy.dtype=float32)."
        )
