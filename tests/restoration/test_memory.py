"""Arrays as large as those of an evaluation find their memory in the process, not at the system."""

import platform
import subprocess
import sys

import pytest

_COUNT_FAULTS = """
import resource, sys, torch
from torchmask.restoration.memory import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
def evaluate():
    arrays = [torch.ones(200_000) for _ in range(40)]
evaluate()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    evaluate()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def count_faults(how: str) -> int:
    return int(subprocess.run([sys.executable, "-c", _COUNT_FAULTS, how], capture_output=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators have other rules")
def test_freed_memory_stays_with_the_process():
    pages = 20 * 40 * 200_000 * 4 // 4096  # of all arrays together
    assert count_faults("keep") < pages / 100
    assert count_faults("leave") > pages / 10  # what there is to gain
