"""The number that a refusal for want of memory calls the largest is the largest."""

import re

import pytest

from torchmask import memory
from torchmask.memory import require_memory


@pytest.mark.parametrize("power", [1, 2, 3])
def test_the_whole_number_that_is_told_fits_and_the_next_does_not(monkeypatch, power):
    """Arrays of 8 n^power bytes on a machine that holds those of n = 1000.5."""
    monkeypatch.setattr(memory, "_machine_memory", lambda: 8.0 * 1000.5**power)

    def require(n):
        require_memory("n_pixels", n, 8.0 * n**power, power)

    with pytest.raises(ValueError, match="enough for") as refused:
        require(3000)
    most = int(re.search(r"enough for (\d+) at most", str(refused.value))[1])
    require(most)
    with pytest.raises(ValueError, match=f"n_pixels is {most + 1}"):
        require(most + 1)
