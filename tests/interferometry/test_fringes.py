"""Visibilities and closure phases from frames: closed forms, errors, dead pixels, and AB Dor."""

import math

import numpy as np
import pytest
import torch

from torchmask.data.observe import read_observation
from torchmask.grid import ARCSEC, Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pixel import MappedPixel, SquarePixel
from torchmask.optics.psf import psf_from_samples

CENTERS = [[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]]
WAVELENGTH = 550e-9


@pytest.fixture
def mask():
    return SparseAperture(CENTERS, 0.1, 1.0)


@pytest.fixture
def grid(mask):
    return Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


@pytest.mark.parametrize("oversampling", [4, 8, 16])
def test_a_point_source_has_full_visibility_whatever_the_pistons(mask, grid, oversampling, expose_points):
    # The sampled holes differ from discs by the square of sample over diameter.
    observation = Observation(expose_points(mask, grid, n_frames=3, oversampling=oversampling), mask, grid, 0.0)
    observables = frame_observables(observation)
    step = grid.period / (oversampling * grid.shape[0]) / mask.subaperture_diameter
    assert float((observables.vis2 - 1).abs().max()) < step**2
    assert float(observables.closure_phases.abs().max()) < step**2
    assert float((observables.triple_amplitudes - 1).abs().max()) < 1.5 * step**2
    assert step < 0.3


def test_pistons_and_place_are_the_phase_of_a_visibility(mask, grid):
    # V_ij of a point at (x, y) pixels is exp(-2 pi i nu . (x, y)) exp(i (p_i - p_j)).
    shift, pistons = torch.tensor([1.3, -0.6], dtype=torch.float64), torch.tensor([0.3, -0.8, 1.1, 0.2])
    samples = mask.samples(grid, 8)
    tilt = 2 * math.pi * grid.pixel_scale / WAVELENGTH * (samples.offsets + mask.centers[:, None, :]) @ shift
    psf = psf_from_samples(samples, tilt + pistons[:, None].double())
    frame = 1e6 * psf.roll((24, 24), (-2, -1))[None, :48, :48]
    observables = frame_observables(Observation(frame, mask, grid, 0.0))
    i, j = observables.pairs.T
    expected = -2 * math.pi * (mask.centers[j] - mask.centers[i]) / grid.period @ shift + pistons[i] - pistons[j]
    assert float(wrapped(observables.visibilities.angle() - expected).abs().max()) < 0.02


@pytest.mark.parametrize("diameter", [0.12, 0.06, 0.03])
def test_a_binary_has_its_known_visibilities_and_closure_phases(diameter, expose_points, binary):
    mask = SparseAperture(CENTERS, diameter, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 64, 1.1)
    x, y, contrast = 2.0, -1.5, 0.3
    frames = expose_points(mask, grid, ((0, 0, 1), (x, y, contrast)), n_frames=2, oversampling=8)
    observables = frame_observables(Observation(frames, mask, grid, 0.0))
    pair = binary(x * grid.pixel_scale, y * grid.pixel_scale, contrast)
    expected = pair.visibilities(observables.baselines, WAVELENGTH)
    closures = pair.closure_phases(observables.baselines, WAVELENGTH)
    assert np.abs(closures).max() > 0.2
    assert np.ptp(np.abs(expected)) > 0.2
    # Star and companion are dimmed, one or the other, by no more than the companion off centre.
    lost = pair.dimming(grid, diameter)
    step = (grid.period / (8 * 64) / diameter) ** 2
    assert np.abs(observables.vis2.numpy() - np.abs(expected) ** 2).max() < 2 * lost + step
    phases = wrapped(observables.closure_phases.numpy() - closures)
    assert np.abs(phases).max() < (3 * lost + step) / np.abs(expected).min()
    assert lost < 0.02 * (diameter / 0.12) ** 2 + 1e-3


def test_dead_pixels_do_no_harm(mask, grid, expose_points):
    frames = expose_points(mask, grid, oversampling=16)
    valid = torch.ones(grid.shape, dtype=torch.bool)
    valid[24, 25] = valid[20, 21] = valid[:, 30] = False
    spoilt = torch.where(valid, frames, 1e7)
    observables = frame_observables(Observation(spoilt, mask, grid, 0.0, valid=valid))
    assert float((observables.vis2 - 1).abs().max()) < 1e-2
    assert float(observables.closure_phases.abs().max()) < 1e-3


def test_errors_are_the_scatter_of_the_measurements(expose_points):
    # Closure phases of a point source are 0 and |V|^2 is 1: mean square over error^2 is 1. Of the 4 triangles of
    # 4 holes 3 are independent; the larger of two estimates makes errors rather too large.
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose_points(mask, grid, electrons=2e4, n_frames=20, oversampling=8).repeat(30, 1, 1)
    noise = torch.Generator().manual_seed(5)
    noisy = torch.poisson(clean, noise) + 2.0 * torch.randn(clean.shape, generator=noise, dtype=torch.float64)
    for n_frames, low, seen in ((1, 0.8, noisy[:240]), (12, 0.55, noisy)):
        stacks = seen.split(n_frames)
        found = [frame_observables(Observation(stack, mask, grid, 2.0)) for stack in stacks]
        independent = 3 * len(found)
        slack = 5 * math.sqrt(2 / independent)
        phases = torch.stack([(o.closure_phases / o.closure_errors) ** 2 for o in found]).mean()
        squares = torch.stack([((o.vis2 - 1) / o.vis2_errors) ** 2 for o in found]).mean()
        assert low - slack < phases < 1 + slack
        assert low - slack < squares < 1 + slack
        assert slack < 0.6


@pytest.mark.parametrize(
    ("electrons", "readout", "told"), [(1000, 4.0, 4.0), (1000, 4.0, None), (300, 0.5, 0.5), (30, 0.0, 0.0)]
)
def test_observables_of_faint_frames_are_free_of_bias(expose_points, electrons, readout, told):
    # The mean pull over baselines and seeds, whose standard error follows from the covariance. Pixels clipped at zero
    # bias the mean pull by 0.8 (300 electrons), the third moment of photon noise by 2.6 (30 electrons).
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose_points(mask, grid, electrons=electrons, n_frames=50, oversampling=8).repeat(6, 1, 1)
    squares, triples = [], []
    for seed in range(12):
        noise = torch.Generator().manual_seed(seed)
        noisy = torch.poisson(clean, noise) + readout * torch.randn(clean.shape, generator=noise, dtype=torch.float64)
        found = frame_observables(Observation(noisy, mask, grid, told))
        squares.append(mean_pull(found.vis2 - 1, found.vis2_covariance))
        triples.append(mean_pull(found.triple_amplitudes - 1, found.triple_covariance))
    for pulls in (squares, triples):
        mean, error = (torch.stack(values) for values in zip(*pulls, strict=True))
        assert abs(float(mean.mean())) < 3 * float(error.square().mean().sqrt()) / math.sqrt(len(pulls)) < 0.75


def test_photons_whose_errors_are_told_have_a_third_moment_too(expose_points):
    """As above: triple products of 30 electrons and the errors that they are expected to have."""
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose_points(mask, grid, electrons=30, n_frames=50, oversampling=8).repeat(4, 1, 1)
    pulls = []
    for seed in range(4):
        noisy = torch.poisson(clean, torch.Generator().manual_seed(seed))
        found = frame_observables(Observation(noisy, mask, grid, 0.0, errors=(clean + 1e-9).sqrt()))
        pulls.append(mean_pull(found.triple_amplitudes - 1, found.triple_covariance))
    mean, error = (torch.stack(values) for values in zip(*pulls, strict=True))
    assert abs(float(mean.mean())) < 3 * float(error.square().mean().sqrt()) / math.sqrt(len(pulls)) < 1.5


def correlation_of(covariance):
    deviation = covariance.diagonal().sqrt()
    return covariance / deviation[:, None] / deviation


def mean_pull(difference, covariance):
    """Over observables, in units of their errors, and its standard error."""
    return (difference / covariance.diagonal().sqrt()).mean(), correlation_of(covariance).mean().sqrt()


def test_covariances_are_those_of_many_stacks(expose_points):
    # Light is common to all baselines, and baselines to triangles.
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose_points(mask, grid, electrons=1e4, n_frames=4, oversampling=8)
    noise = torch.Generator().manual_seed(3)
    n_stacks = 120
    found = [
        frame_observables(Observation(torch.poisson(clean, noise), mask, grid, 0.0, errors=(clean + 0.1).sqrt()))
        for _ in range(n_stacks)
    ]
    for name, covariance in (("vis2", "vis2_covariance"), ("closure_phases", "closure_covariance")):
        values = torch.stack([getattr(one, name) for one in found])
        told = torch.stack([getattr(one, covariance) for one in found]).mean(0)
        seen = torch.cov(values.T)
        apart = torch.triu_indices(*seen.shape, 1).unbind()
        correlations = [correlation_of(matrix)[apart] for matrix in (seen, told)]
        # the standard error of a correlation over these stacks, which independence would miss
        error = 1 / math.sqrt(n_stacks)
        assert float((correlations[0] - correlations[1]).square().mean().sqrt()) < 1.5 * error
        assert float(correlations[0].square().mean().sqrt()) > 1.5 * error
        # the larger of two estimates, of which that of four frames has a relative rms of (2 / 3)^(1/2)
        ratio = (seen.diagonal() / told.diagonal()).mean()
        assert 0.6 < ratio < 1 + 4 * math.sqrt(2 / n_stacks / 3)


@pytest.mark.parametrize("fill_factor", [1.0, 0.5])
def test_what_pixels_take_off_the_fringes_is_given_back(fill_factor, expose_points):
    # Seen by squares, a point source has |V|^2 of the square of two sincs, 0.57 to 0.92 here.
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)
    fine = 5  # samples per pixel, of which the middle ones make the sensitive square
    dense = Grid((48 * fine, 48 * fine), grid.pixel_scale / fine, WAVELENGTH)
    frames = expose_points(mask, dense, oversampling=4, n_frames=2)
    width = math.sqrt(fill_factor) * fine
    offsets = (torch.arange(fine, dtype=torch.float64) - (fine - 1) / 2).abs()
    weights = ((width / 2 - offsets) + 0.5).clamp(0, 1)
    moved = frames.roll((fine // 2, fine // 2), (-2, -1))  # so that the star stands in the middle of a pixel
    parts = moved.unflatten(2, (48, fine)).unflatten(1, (48, fine))
    seen = torch.einsum("tyaxb,a,b->tyx", parts, weights, weights)
    pixel = MappedPixel(weights[:, None] * weights, fine)
    freed = frame_observables(Observation(seen, mask, grid, 0.0, pixel=pixel))
    plain = frame_observables(Observation(seen, mask, grid, 0.0))
    # The fringes' patches, and that of the light, are as wide as a hole.
    nu, reach = (freed.baselines / grid.period).abs(), grid.cutoff(mask.subaperture_diameter)
    low, high = (SquarePixel(fill_factor).transfer(*(nu + side).clamp(min=0).T) ** 2 for side in (reach, -reach))
    high = high / SquarePixel(fill_factor).transfer(*torch.tensor([reach, reach]).double()) ** 2
    step = grid.period / (4 * 240) / mask.subaperture_diameter
    assert float((freed.vis2 - 1).abs().max()) < 2 * step**2 + 1e-3
    assert float(freed.closure_phases.abs().max()) < 2 * step**2 + 1e-3
    assert bool(((plain.vis2 > low) & (plain.vis2 < high)).all())
    assert float(plain.vis2.min()) < 0.9


def test_readout_noise_that_nothing_tells_is_asked_for(mask):
    coarse = Grid.nyquist(mask.extent, WAVELENGTH, 4)
    frames = torch.rand(2, 4, 4, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"no frequencies beyond the cut-off.*\[electrons rms\]"):
        frame_observables(Observation(frames, mask, coarse, None))


def test_baselines_that_cannot_be_told_apart_are_refused(mask, grid):
    frames = torch.rand(1, *grid.shape, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"give at least two holes"):
        frame_observables(Observation(frames, FullAperture(0.9), grid, 0.0))
    square = SparseAperture([[0.3, 0.3], [0.3, -0.3], [-0.3, -0.3], [-0.3, 0.3]], 0.1, 1.0)
    with pytest.raises(ValueError, match=r"cannot be separated: those of holes .* lie 0 m apart"):
        frame_observables(Observation(frames, square, grid, 0.0))
    with pytest.raises(ValueError, match=r"frames \[0\] hold no light"):
        frame_observables(Observation(0 * frames, mask, grid, 0.0))


def test_closure_phases_of_ab_dor_show_its_companion(niriss):
    # README of the observations: about 0.3 arcsec away, several magnitudes fainter; the calibrator shows none.
    mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
    star, calibrator = (
        frame_observables(read_observation(sorted(niriss.glob(name)), mask, gain=1.62, crop=48))
        for name in ("ab-dor*.fits", "hd-37093*.fits")
    )
    assert float(star.closure_phases.rad2deg().abs().max()) > 2
    assert float(calibrator.closure_phases.rad2deg().abs().max()) < 1
    phases = wrapped(star.closure_phases - calibrator.closure_phases).numpy()
    errors = torch.hypot(star.closure_errors, calibrator.closure_errors).numpy()
    steps = np.arange(-0.5, 0.51, 0.02) * ARCSEC
    u, v = star.baselines.numpy().T / 4.817e-6
    waves = np.exp(-2j * math.pi * (u * steps[:, None, None] + v * steps[:, None]))  # (east, north, baseline)
    first, second, third = (
        [list(map(tuple, star.pairs.tolist())).index(pair) for pair in pairs]
        for pairs in zip(*[((i, j), (j, k), (i, k)) for i, j, k in star.triangles.tolist()], strict=True)
    )
    found = []
    for magnitude in np.arange(2.5, 7, 0.25):
        contrast = 10 ** (-0.4 * magnitude)
        values = (1 + contrast * waves) / (1 + contrast)
        model = np.angle(values[..., first] * values[..., second] * values[..., third].conj())
        chi = ((phases - model) ** 2 / errors**2).mean(-1)
        east, north = np.unravel_index(chi.argmin(), chi.shape)
        found.append((chi.min(), math.hypot(steps[east], steps[north]) / ARCSEC, magnitude))
    chi, separation, magnitude = min(found)
    assert chi < 0.1 * float((phases**2 / errors**2).mean())
    assert 0.25 < separation < 0.4
    assert 3.5 < magnitude < 5.5
