"""Several stacks side by side: each as it would be by itself, in order, and none harmed by another."""

import math
import os
import signal

import pytest
import torch

from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.many import restore_many
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.structure import smooth

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)


def stack(seed):
    frames = torch.full((3, 32, 32), 20.0)
    frames[:, 12:20, 10 : 18 + seed] = 1000.0
    return torch.poisson(smooth(frames, 1.5), generator=torch.Generator().manual_seed(seed))


def method(**options):
    return MyopicDeconvolution(MASK, GRID, 3, max_iterations=4, **options)


@pytest.mark.parametrize("n_workers", [1, 2])
def test_each_is_what_it_would_be_by_itself_and_failures_stay_where_they_are(n_workers):
    stacks = [stack(0), torch.zeros(3, 32, 32), stack(1), stack(2)[:, :16]]
    records = []
    found = restore_many(method(), stacks, n_workers=n_workers, callback=records.append)
    for number in (0, 2):
        assert torch.equal(found[number].object, method().restore(stacks[number]).object)
    assert "hold no light" in str(found[1])
    assert "the grid needs" in str(found[3])
    assert all(isinstance(found[number], ValueError) for number in (1, 3))
    assert [record.step for record in records] == [1, 2, 3, 4]
    assert {record.n_steps for record in records} == {4}
    scalars = {int(record.scalars["stack"]): record.scalars for record in records}
    assert scalars[2]["chi_square"] == float(found[2].chi_square.mean())
    assert math.isnan(scalars[1]["chi_square"])


def test_observations_bring_their_valid_pixels_and_errors_and_each_stack_may_have_its_method():
    valid = torch.ones(32, 32, dtype=torch.bool)
    valid[14, 14] = False
    frames = torch.where(valid, stack(0), math.nan)
    errors = 8 + 4 * torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(0))
    seen = Observation(frames, MASK, GRID, readout_noise=None, valid=valid, errors=errors)
    found = restore_many([method(), method(r0=0.2)], [seen, stack(1)], n_workers=1, n_samples=2, seed=3)
    assert torch.equal(found[0].object, method().restore(frames, valid=valid, errors=errors, seed=3).object)
    assert found[0].object_std is not None
    assert torch.equal(found[1].object, method(r0=0.2).restore(stack(1), seed=3).object)


def test_posterior_samples_do_not_depend_on_the_seed():
    """Of known aberrations, which no search finds by another way."""
    known = torch.zeros(3, 3, 3)
    deviations = [method().restore(stack(0), coefficients=known, n_samples=2, seed=seed).object_std for seed in (0, 1)]
    assert torch.equal(*deviations)


class Deadly(torch.nn.Module):
    """A prior whose process dies."""

    def forward(self, image):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.filterwarnings("ignore")  # of the pool whose process has died
def test_a_process_that_dies_is_an_exception_of_its_stack():
    found = restore_many([method(prior=Deadly()), method()], [stack(0), stack(1)], n_workers=2)
    assert isinstance(found[0], Exception)
    assert len(found) == 2


def test_refuses_before_any_work():
    with pytest.raises(ValueError, match="one tensor"):
        restore_many(method(), stack(0))
    with pytest.raises(ValueError, match=r"one array of shape \(3, 32, 32\): give a list of stacks"):
        restore_many(method(), stack(0).numpy())
    with pytest.raises(TypeError, match=r"one Observation: give a list of them, such as \[observation\]"):
        restore_many(method(), Observation(stack(0), MASK, GRID, readout_noise=None))
    for wrong in (None, [None, method()]):
        with pytest.raises(TypeError, match="method is a NoneType: it must be a MyopicDeconvolution, or a list of"):
            restore_many(wrong, [stack(0), stack(1)])
    with pytest.raises(ValueError, match="1 methods are given for 2 stacks"):
        restore_many([method()], [stack(0), stack(1)])
    with pytest.raises(ValueError, match="backend is 'threads'"):
        restore_many(method(), [stack(0)], backend="threads")
    assert restore_many(method(), []) == []
