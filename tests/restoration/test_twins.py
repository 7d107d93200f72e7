"""The twins of an object behind a mask: what common pistons hide, and how a restoration leaves a wrong one."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.calibration import fit_of_frames
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.twins import twin_of

PISTONS = torch.tensor([2.0, -1.0, 0.5, 0.0, -2.5], dtype=torch.float64)


def test_pistons_leave_all_other_modes_alone(five_hole_basis):
    found = five_hole_basis.coefficients(five_hole_basis.parameters_of_pistons(PISTONS))
    torch.testing.assert_close(found[:, 0], PISTONS - PISTONS.mean())  # the mean piston cannot be seen
    assert float(found[:, 1:].abs().max()) < 1e-12


def test_common_modes_keep_out_of_it(five_holes):
    basis = turbulent_basis(five_holes, 3, 2, 0.2, 20.0)
    found = basis.parameters_of_pistons(PISTONS)
    assert len(found) == basis.n_parameters
    assert not found[basis.n_own :].any()
    torch.testing.assert_close(basis.coefficients(found)[:, 0], PISTONS - PISTONS.mean())


@pytest.mark.parametrize("isolated", [True, False])
def test_pistons_turn_the_phases_of_isolated_baselines_and_nothing_else(isolated):
    """Where baselines do not overlap, which is what makes twins; where they do, the modulus changes too."""
    apart, in_a_row = [[-0.3, -0.25], [0.35, -0.2], [0.05, 0.35]], [[-0.3, 0.0], [0.05, 0.0], [0.35, 0.0]]
    mask = SparseAperture(apart if isolated else in_a_row, 0.08 if isolated else 0.2, 1.0)
    grid = Grid.nyquist(1.0, 550e-9, 64, oversampling=1.2)
    basis = turbulent_basis(mask, 3, 0, 0.2, 20.0)
    model = ExposureModel(mask, grid, basis)
    z = torch.randn(2, basis.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pistons = torch.tensor([1.0, -0.7, 0.2], dtype=torch.float64)
    before, after = (torch.fft.fft2(model.psf(one)) for one in (z, z + basis.parameters_of_pistons(pistons)))
    off = (before.abs() - after.abs()).abs().max() / before.abs().max()
    if not isolated:
        assert off > 0.01
        return
    assert off < 1e-12
    bright = before[0].abs() > 1e-3 * before[0].abs().max()
    turns = {0.0} | {float(a - b) for a in pistons for b in pistons if a is not b}
    seen = torch.angle(after[0] / before[0])[bright]
    nearest = torch.stack([(seen - turn).abs() for turn in turns]).min(0)
    assert float(nearest.values.max()) < 1e-9
    assert set(nearest.indices.tolist()) == set(range(len(turns)))


def test_a_twin_keeps_what_each_frame_has_found(explained):
    objective, state = explained
    turned = twin_of(objective, state, 30.0, seed=3)
    change = objective.model.aberrations.coefficients(turned.z - state.z)
    torch.testing.assert_close(change, change[:1].expand_as(change))  # alike in all frames
    assert float(change[:, :, 1:].abs().max()) < 1e-12
    assert 1 < float(change[0, :, 0].std()) < math.pi
    assert turned.calibration.noise_inflation.unique().tolist() == [30.0]
    assert float(turned.image.min()) >= 0
    assert torch.equal(twin_of(objective, state, 30.0, seed=3).z, turned.z)
    assert not torch.equal(twin_of(objective, state, 30.0, seed=4).z, turned.z)
    with torch.device("meta"):  # another default device
        assert torch.equal(twin_of(objective, state, 30.0, seed=3).z, turned.z)


def test_the_object_of_a_twin_suits_its_pistons(explained):
    """Better than the object of the state does."""
    objective, state = explained
    turned = twin_of(objective, state, 1.0, seed=3)
    fits = [fit_of_frames(objective, one)[1].mean() for one in (turned, replace(turned, image=state.image))]
    assert fits[0] < fits[1]
