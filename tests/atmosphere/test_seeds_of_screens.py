"""Seeds of screens are so many that no two of a long run are alike."""

import torch

from torchmask.atmosphere.screens import draw_seed


def test_a_thousand_seeds_differ_and_fill_their_range():
    """Of 2^62 numbers: two of 1000 are equal with a chance of 1e-13, and none is above 2^60 with one of 0.25^1000."""
    generator = torch.Generator().manual_seed(0)
    seeds = [draw_seed(generator) for _ in range(1000)]
    assert len(set(seeds)) == 1000
    assert 2**60 < max(seeds) < 2**62
    assert min(seeds) >= 0
