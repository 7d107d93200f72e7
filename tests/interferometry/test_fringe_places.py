"""Places of light that moves from frame to frame, and what a motion does to |V|^2."""

import math
import warnings

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringe_fit import FringeModel, PixelNoise
from torchmask.interferometry.fringe_places import _light_and_errors, find_places
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

SIDE, READOUT = 48, 1.5
GRID = Grid.nyquist(1.0, 550e-9, SIDE)
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.15)
UNIT = GRID.period / MASK.subaperture_diameter  # wavelength / (hole diameter) [pixel]


def exposures(places, electrons=1e6, seed=0):
    """Frames (T, H, W) of a star at places (T, 2) through holes of random pistons, with photon and read-out noise."""
    model, generator = FringeModel(MASK, GRID), torch.Generator().manual_seed(seed)
    frames = []
    for x, y in places:
        pistons = 2 * math.pi * torch.rand(MASK.n_subapertures, generator=generator, dtype=torch.float64)
        phases = pistons[model.pairs[:, 1]] - pistons[model.pairs[:, 0]]
        fringes = torch.cat([phases.cos(), phases.sin()]) / MASK.n_subapertures
        light = electrons * torch.cat([torch.ones(1, dtype=torch.float64), fringes]) @ model.columns(x, y)
        photons = torch.poisson(light.clamp(min=0), generator)
        frames.append(photons + READOUT * torch.randn(photons.shape, generator=generator, dtype=torch.float64))
    return torch.stack(frames).view(-1, SIDE, SIDE)


def places_of(frames, valid=None):
    valid = torch.ones_like(frames, dtype=torch.bool) if valid is None else valid
    noise = PixelNoise(frames + READOUT**2, is_own=True, light=frames)
    return find_places(frames, valid, noise, FringeModel(MASK, GRID), stacklevel=1)


@pytest.mark.parametrize("pattern", ["dither", "drift"])
def test_a_star_that_moves_has_the_fringes_of_one_that_stays(pattern):
    """|V|^2 of a point is 1, to four of its errors of 0.006 and what steps of its place leave; it was 0.9 to 1.01."""
    steps = [(-1) ** frame if pattern == "dither" else frame / 4.5 - 1 for frame in range(10)]
    frames = exposures([(0.4 * UNIT * step, 0.3) for step in steps])
    observables = frame_observables(Observation(frames, MASK, GRID, readout_noise=READOUT))
    assert float((observables.vis2 - 1).abs().max()) < 4 * float(observables.vis2_errors.max()) + 2e-3
    assert float(observables.vis2_errors.max()) < 0.01


def test_places_are_those_of_the_light_in_steps():
    """They lie on a lattice around the middle one, a tenth of wavelength / (hole diameter) apart."""
    true = torch.tensor([[-6.0, 2.0], [5.2, -3.0], [0.0, 4.0], [1.5, 1.5]], dtype=torch.float64)
    valid = torch.ones(4, SIDE, SIDE, dtype=torch.bool)
    valid[1, 17:23, 20:40] = False
    frames = exposures(true.tolist()).masked_fill(~valid, torch.nan)
    found = places_of(frames, valid)
    assert float((found - true).abs().max()) < 0.05 * UNIT + 0.1
    steps = (found - found[0]) / (0.1 * UNIT)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("rms", "is_own"), [(0.035, False), (0.065, True)])
def test_light_that_hardly_moves_has_one_place(rms, is_own):
    frames = exposures([(rms * UNIT * (-1) ** frame, 0.0) for frame in range(4)])
    assert (len(places_of(frames).unique(dim=0)) > 1) == is_own


@pytest.mark.parametrize("electrons", [2e3, 2e4])
def test_errors_of_places_are_their_scatter(electrons):
    """Of 60 frames, whose scatter is known to a tenth; fringes that are fitted too make it up to a half larger."""
    frames, model = exposures([(0.0, 0.0)] * 60, electrons), FringeModel(MASK, GRID)
    valid, columns = torch.ones_like(frames, dtype=torch.bool), model.columns(0.0, 0.0)
    noise = PixelNoise(frames + READOUT**2, is_own=True, light=frames)
    light, errors = _light_and_errors(frames, valid, noise, model, torch.zeros(2, dtype=torch.float64))
    seen = valid[0].double()
    found = torch.tensor(
        [model.place_beside_fringes(frame, seen, model.norm(seen), columns) for frame in frames], dtype=torch.float64
    )
    scatter = float(found.square().mean(0).amax().sqrt())
    assert 0.7 < scatter / float(errors.mean()) < 1.8
    assert abs(float(light.mean()) / electrons - 1) < 0.1


def test_frames_too_faint_for_places_of_their_own_are_told_if_the_light_drifts():
    frames = exposures([(0.4 * UNIT * (frame / 9.5 - 1), 0.0) for frame in range(20)], 300)
    with pytest.warns(UserWarning, match="they are too faint to be fitted each around its own light, so") as told:
        found = places_of(frames)
    assert len(found.unique(dim=0)) == 1
    assert told[0].filename == __file__
    still = exposures([(0.0, 0.0)] * 20, 300)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        places_of(still)
        places_of(still[:1])


def test_a_single_faint_frame_stands_where_the_mean_frame_does():
    """As behind a cloud: it has no place of its own, and does not keep others from theirs."""
    frames = exposures([(0.4 * UNIT * (-1) ** frame, 0.0) for frame in range(6)])
    frames[2] = exposures([(0.4 * UNIT, 0.0)], 100.0)[0]
    found = places_of(frames)
    model, valid = FringeModel(MASK, GRID), torch.ones_like(frames, dtype=torch.bool)
    assert found[2].tolist() == list(model.centre(frames, valid))
    assert float((found[[0, 4]] - found[[1, 3]]).abs().amax(0)[0]) > 0.7 * UNIT
