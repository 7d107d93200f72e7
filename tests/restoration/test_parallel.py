"""Frames on several cores: the same numbers, and torch's own threads as they were."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.parallel import each_on_a_core


@pytest.mark.filterwarnings("ignore:much of the light is even")
def test_restoration_is_the_same_on_any_number_of_cores():
    torch.manual_seed(0)
    frames = torch.poisson(1e3 * torch.ones(6, 32, 32)).double()
    mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, readout_noise=1.0, max_iterations=8)
    n_threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 3):
            torch.set_num_threads(n)
            results.append(method.restore(frames).object)
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(n_threads)
    assert torch.equal(*results)


def fail_on_three_cores():
    with each_on_a_core(torch.device("cpu")) as parallel:
        assert torch.get_num_threads() == 1
        assert list(parallel(lambda number: 2 * number, range(5))) == [0, 2, 4, 6, 8]
        raise RuntimeError("on purpose")


def test_threads_come_back_after_an_error():
    n_threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(RuntimeError, match="on purpose"):
            fail_on_three_cores()
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(n_threads)
