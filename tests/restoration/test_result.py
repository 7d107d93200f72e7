"""What a restoration hands back, on disk and for people."""

import dataclasses

import numpy as np
import pytest
import torch

from torchmask.restoration.result import RestorationResult


def test_result_survives_the_disk(restored, tmp_path):
    path = tmp_path / "result.npz"
    restored.save(path)
    again = RestorationResult.load(path)
    for item in dataclasses.fields(restored):
        one, other = getattr(restored, item.name), getattr(again, item.name)
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other, item.name
    with pytest.raises(ValueError, match="not overwritten"):
        restored.save(path)
    np.savez(tmp_path / "foreign.npz", object=np.zeros(3))
    with pytest.raises(ValueError, match="has no"):
        RestorationResult.load(tmp_path / "foreign.npz")
    for words in ("48 x 48", "8 frames", "converged", "chi-square"):
        assert words in restored.summary()
