"""Arrays as large as those of an evaluation find their memory in the process, not at the system.

NumPy's arrays and not tensors, whose small parts lie between the large ones and at times hold the heap's end in place.
"""

import platform
import subprocess
import sys

import pytest

_COUNT_FAULTS = """
import resource, sys, numpy
from torchmask.memory import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
def evaluate():
    arrays = [numpy.ones(100_000) for _ in range(40)]
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
    pages = 20 * 40 * 100_000 * 8 // 4096  # of all arrays together
    assert count_faults("keep") < pages / 100
    assert count_faults("leave") > pages / 10  # what there is to gain
