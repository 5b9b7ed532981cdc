"""Memory that is freed stays with the process."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

# Large tensors come and go: how often does the system have to give memory anew?
SCRIPT = """
import resource, torch
from lerobot_deltaco.policy.memory import keep_freed_memory
if {keep}:
    assert keep_freed_memory()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def step():
    tensors = [torch.ones(2_000_000) for _ in range(3)] + [torch.ones(10_000_000)]
    return sum(tensor.sum() for tensor in tensors)
for _ in range(3):
    step()
before = faults()
for _ in range(5):
    step()
print(faults() - before)
"""


HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@pytest.mark.slow
@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc"
    or "LD_PRELOAD" in os.environ
    or (HUGE_PAGES.exists() and "[always]" in HUGE_PAGES.read_text()),
    reason="memory does not come from glibc, in pages of 4 kB",
)
def test_freed_memory_is_used_again_without_the_system():
    faults = {
        keep: int(subprocess.check_output([sys.executable, "-c", SCRIPT.format(keep=keep)], text=True))
        for keep in (False, True)
    }
    # 64 MB in pages of 4 kB, five times; kept memory may be asked for once more, where it has gaps.
    assert faults[False] > 10_000
    assert faults[True] < 0.5 * faults[False]
