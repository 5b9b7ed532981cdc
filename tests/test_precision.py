"""The precision in which networks compute."""

import pytest
import torch

from lerobot_deltaco.policy.precision import autocast, warn_if_emulated


def test_networks_compute_in_the_precision_that_is_asked_for():
    layer, device = torch.nn.Linear(2, 2), torch.device("cpu")
    with autocast("bfloat16", device):
        assert layer(torch.zeros(1, 2)).dtype == torch.bfloat16
    with autocast("float32", device):
        assert layer(torch.zeros(1, 2)).dtype == torch.float32


@pytest.mark.parametrize(
    ("dtype", "device", "is_supported", "warns"),
    [
        ("bfloat16", "cpu", False, True),
        ("bfloat16", "cpu", True, False),
        ("bfloat16", "cuda", False, False),
        ("float32", "cpu", False, False),
    ],
)
def test_a_training_that_the_processor_has_no_instructions_for_warns_once(
    monkeypatch, caplog, dtype, device, is_supported, warns
):
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: is_supported, raising=False)
    warn_if_emulated.cache_clear()
    for _ in range(2):
        warn_if_emulated(dtype, device)
    warn_if_emulated.cache_clear()
    messages = [record.getMessage() for record in caplog.records if "bfloat16" in record.getMessage()]
    assert len(messages) == warns
    assert all("--policy.dtype=float32" in message for message in messages)
