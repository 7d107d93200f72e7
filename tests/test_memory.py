"""Arrays as large as those of an evaluation find their memory in the process, not at the system.

NumPy's arrays and not tensors, whose small parts lie between the large ones and at times hold the heap's end in place.
"""

import platform
import subprocess
import sys

import pytest

from torchmask import memory
from torchmask.memory import require_memory

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


def test_what_exceeds_the_memory_is_refused_with_the_most_that_fits(monkeypatch):
    monkeypatch.setattr(memory, "_machine_memory", lambda: 8.0 * 2**30)
    require_memory("n_pixels", 2**15, 8.0 * 2**30, power=2)
    with pytest.raises(
        ValueError,
        match=r"n_pixels is 65536: that takes at least 32 GiB of memory, and this machine has 8 GiB, enough for 32768",
    ):
        require_memory("n_pixels", 2**16, 8.0 * 2**32, power=2)
    with pytest.raises(ValueError, match=r"the separation \[arcsec\] is 2\.5: .* enough for 1\.249 at most"):
        require_memory("the separation [arcsec]", 2.5, 2.0**34)


def test_a_machine_tells_its_memory():
    assert memory._machine_memory() > 2**28
