"""Fits and searches: exact ones without noise, and a binary made with finer optics than the model's own."""

import math

import numpy as np
import pytest
import torch

from torchmask.grid import ARCSEC, Grid
from torchmask.interferometry.companion import CompanionModel, Exposures, Parameters
from torchmask.interferometry.companion_equations import LeastSquares
from torchmask.interferometry.companion_errors import injection_errors, measured_companion
from torchmask.interferometry.companion_fit import fit_companion, search_companions, unexplained_flux
from torchmask.interferometry.companion_limits import detection_limits, search_offsets
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS, Band

GRID = Grid.nyquist(1.0, 550e-9, 24)
TRUTH = torch.tensor([0.05, 2.0, -1.5], dtype=torch.float64)  # offsets in pixels


@pytest.fixture(scope="module")
def small():
    mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25], [-0.1, 0.0]], 0.15, 1.0)
    return CompanionModel(mask, GRID, 4, Band.of([550e-9]), radius=10.0, flux_error=0.0)


def draw(model, companion, n=2, error=10.0, noise=0.0):
    """Exposures of the model itself, with aberrations, and their parameters; east is y and north x, in pixels."""
    generator = torch.Generator().manual_seed(0)
    own = 0.01 * torch.randn(n, 16, dtype=torch.float64, generator=generator)
    own[:, :4] = torch.tensor([1e6, 5.0, 12.0, 12.0], dtype=torch.float64)
    own[:, 2:4] += 0.1 * torch.arange(2 * n).view(n, 2)
    static = 0.1 * torch.randn(16, dtype=torch.float64, generator=generator)
    truth = Parameters(static, torch.tensor([0.12, 0.08], dtype=torch.float64), own, companion)
    sky = torch.eye(2, dtype=torch.float64).expand(n, 2, 2)
    frames = model.images(truth, sky)
    frames = frames + noise * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    return Exposures(frames, torch.full_like(frames, error), torch.ones_like(frames, dtype=torch.bool), sky), truth


def test_without_noise_the_truth_is_found_to_the_strength_of_what_is_expected(small):
    """The prior pulls by its own weight over that of the frames: their errors of 0.01 electrons leave it none."""
    exposures, truth = draw(small, TRUTH, error=0.01)
    start = TRUTH * torch.tensor([0.7, 1.1, 0.9], dtype=torch.float64)
    records = []
    found = fit_companion(small, exposures, start, callback=records.append)
    torch.testing.assert_close(found.companion, TRUTH, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.parameters.blur, truth.blur, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.images, exposures.frames, rtol=0, atol=0.1)
    assert found.chi_square.max() < 1
    assert [record.step for record in records] == list(range(1, len(records) + 1))
    costs = [record.scalars["cost"] for record in records]
    assert costs == sorted(costs, reverse=True)
    assert {record.stage for record in records} == {"fit"}


def test_a_star_alone_has_no_companion(small):
    exposures, _ = draw(small, torch.zeros(3, dtype=torch.float64))
    star = fit_companion(small, exposures)
    assert torch.equal(star.companion, torch.zeros(3, dtype=torch.float64))
    assert torch.equal(star.covariance, torch.zeros(3, 3, dtype=torch.float64))
    assert torch.equal(star.jackknife, torch.zeros(2, 3, dtype=torch.float64))
    again = fit_companion(small, exposures, start=star.parameters, steps=1)
    torch.testing.assert_close(again.images, star.images, rtol=0, atol=1.0)


def test_errors_of_a_companion_are_those_of_its_scatter(small):
    """Of 40 fits to frames with noise; the mean square over the variance is 1 within the scatter of a chi-square."""
    squares, n = [], 40
    exposures, truth = draw(small, TRUTH, error=100.0)
    generator = torch.Generator().manual_seed(1)
    for _ in range(n):
        noise = 100 * torch.randn(exposures.frames.shape, dtype=torch.float64, generator=generator)
        noisy = Exposures(exposures.frames + noise, exposures.errors, exposures.valid, exposures.to_pixels)
        found = fit_companion(small, noisy, TRUTH, truth, steps=1)  # the first is nearly all
        away = found.companion - TRUTH
        squares.append(float(away @ torch.linalg.solve(found.covariance, away)) / 3)
    # residuals may count with more than their size, so the ratio lies a little below 1; aberrations are held
    assert 0.7 - 4 * math.sqrt(2 / (3 * n)) < np.mean(squares) < 1 + 4 * math.sqrt(2 / (3 * n))


def test_summary_of_a_fit_is_that_of_its_equations(small):
    exposures, truth = draw(small, TRUTH, error=10.0, noise=30.0)
    found = fit_companion(small, exposures, TRUTH, truth, steps=0)
    normal = LeastSquares(small, exposures, True).normal_equations(found.parameters)
    matrix = normal.matrices.sum(0) + normal.prior_matrix
    scale = matrix.diagonal().rsqrt()
    inverse = torch.linalg.inv(matrix * scale * scale[:, None]) * scale * scale[:, None]
    size = float(found.chi_square.mean())
    assert size == pytest.approx(9, rel=0.2)  # three times the errors
    torch.testing.assert_close(found.covariance, inverse[-3:, -3:] * size, rtol=1e-6, atol=0)
    steps = torch.stack([normal.solve(leave_out=t)[-3:] for t in range(2)])
    torch.testing.assert_close(found.jackknife, TRUTH + steps, rtol=1e-12, atol=0)
    near = exposures.frames[:, small.near] - found.images[:, small.near]
    torch.testing.assert_close(found.chi_square, near.square().mean(1) / 100)


def test_chi_square_is_a_mean_over_the_pixels_that_count(small):
    exposures, truth = draw(small, TRUTH, error=10.0, noise=10.0)
    valid = torch.ones_like(exposures.valid)
    valid[0, 8:14] = valid[1, :, 10:14] = False
    spoilt = Exposures(torch.where(valid, exposures.frames, 1e9), exposures.errors, valid, exposures.to_pixels)
    found = fit_companion(small, spoilt, TRUTH, truth, steps=0)
    for t, chi_square in enumerate(found.chi_square.tolist()):
        counted = valid[t] & small.near
        assert int(counted.sum()) < 0.9 * int(small.near.sum())
        residual = (exposures.frames[t] - found.images[t])[counted] / 10.0
        assert chi_square == pytest.approx(float(residual.square().mean()), rel=1e-12)


@pytest.mark.parametrize("steps", [40, 2])
def test_search_is_the_first_step_of_a_fit(small, steps):
    """Its contrast is that of a fit that may only change linearly, its error that with the position known.

    After two steps the fit of the star is not at its end: what it still has to move is no light of a companion.
    """
    exposures, _ = draw(small, TRUTH, error=100.0, noise=100.0)
    star = fit_companion(small, exposures, steps=steps)
    place = torch.tensor([[2.0, -2.0], [-3.0, 1.0]], dtype=torch.float64)
    contrast, error = search_companions(small, exposures, star, place)
    for offset, here, sure in zip(place, contrast, error, strict=True):
        start = torch.cat([torch.tensor([1e-9], dtype=torch.float64), offset])
        at = Parameters(star.parameters.static, star.parameters.blur, star.parameters.own, start)
        normal = LeastSquares(small, exposures, True).normal_equations(at)
        keep = torch.arange(len(normal.vectors[0]) - 2)  # all but east and north
        matrix = (normal.matrices.sum(0) + normal.prior_matrix)[keep][:, keep]
        vector = (normal.vectors.sum(0) + normal.prior_vector)[keep]
        scale = matrix.diagonal().rsqrt()
        scaled = matrix * scale * scale[:, None]
        step = scale[-1] * torch.linalg.solve(scaled, vector * scale)[-1]
        expected = (torch.linalg.inv(scaled)[-1, -1] * scale[-1] ** 2 * max(1.0, float(star.chi_square.mean()))).sqrt()
        # the search moves the image within the field, of whose light some percent lies outside
        assert abs(float(here - step)) < 0.1 * float(expected + abs(step))
        assert float(sure) == pytest.approx(float(expected), rel=0.1)


def test_flux_that_no_model_explains_is_measured(small):
    """The root mean square of n residuals that are noise is known to 1 / sqrt(2 n)."""
    exposures, truth = draw(small, TRUTH, error=1.0)
    fit = fit_companion(small, exposures, TRUTH, truth, steps=0)
    share = 0.03 * torch.randn(fit.images.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    worse = Exposures(fit.images * (1 + share), exposures.errors, exposures.valid, exposures.to_pixels)
    n = int(small.near.sum()) * len(fit.images)
    assert unexplained_flux(small, worse, fit) == pytest.approx(0.03, rel=4 / math.sqrt(2 * n) + 0.01)
    assert unexplained_flux(small, exposures, fit) < 1e-9  # below the noise


def test_exposures_must_fit_the_model(small):
    exposures, _ = draw(small, TRUTH)
    cut = Exposures(*(values[:, :20, :20] for values in vars(exposures).values()))
    with pytest.raises(ValueError, match=r"the exposures have \(20, 20\) pixels and the model \(24, 24\)"):
        fit_companion(small, cut)


# --- a binary through NIRISS's mask, made with a pupil twice as fine and an image twice as wide as the model's

FILTER = FILTERS[("NIRISS", "F480M")]
NIRISS = Grid(40, 0.0655 * ARCSEC, FILTER.wavelength)


def wavelengths(n):
    return [FILTER.wavelength + FILTER.width * ((i + 0.5) / n - 0.5) for i in range(n)]


@pytest.fixture(scope="module")
def model():
    mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
    return CompanionModel(mask, NIRISS, 6, Band.of(wavelengths(2)), radius=15.0, flux_error=0.006)


@pytest.fixture(scope="module")
def expose_stack(expose_binary, sky_matrix):
    """n exposures through the whole filter, the star not quite on one place, north not quite in one direction."""

    def expose(companion, n=2):
        mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
        skies = [sky_matrix(math.radians(172 + 0.4 * t), NIRISS.pixel_scale) for t in range(n)]
        shots = [
            expose_binary(mask, NIRISS, skies[t], companion, (20.1 - 0.07 * t, 19.9 + 0.1 * t), wavelengths(5), t + 1)
            for t in range(n)
        ]
        frames, errors = (torch.stack(values) for values in zip(*shots, strict=True))
        valid = torch.ones(n, 40, 40, dtype=torch.bool)
        valid[:, 21, 24] = valid[1, 12, 20] = False
        frames[~valid] = 1e9
        to_pixels = torch.from_numpy(np.stack([np.linalg.inv(sky)[::-1] for sky in skies]))
        return Exposures(frames, errors, valid, to_pixels)

    return expose


@pytest.fixture(scope="module")
def single(model, expose_stack):
    exposures = expose_stack(np.zeros(3))
    return exposures, fit_companion(model, exposures)


def test_companion_is_found_within_its_errors(model, single, expose_stack, static_aberrations):
    """Broad band, aberrations, dithers, bad pixels; 5 mag fainter; from search to fit, with the errors of `single`."""
    angle = math.radians(250.0)
    truth = np.array([0.01, 0.31 * ARCSEC * math.sin(angle), 0.31 * ARCSEC * math.cos(angle)])
    exposures = expose_stack(truth)
    star = fit_companion(model, exposures, steps=3)
    offsets = search_offsets(0.05)
    contrast, error = search_companions(model, exposures, star, offsets)
    best = int((contrast / error).argmax())
    start = torch.cat([contrast[best, None], offsets[best]])
    errors, rows = injection_errors(model, *single, start, 4, 0.05)
    floor = errors.square().mean(0).sqrt()
    assert len(rows) == 4
    found = fit_companion(model, exposures, start, star.parameters)
    measured = measured_companion(found, floor)
    total = measured["total_error"]
    assert abs(measured["separation"] - 310) < 3.5 * total["separation"] < 25
    assert abs(measured["position_angle"] - 250) < 3.5 * total["position_angle"] < 5
    assert abs(measured["magnitude_difference"] - 5) < 3.5 * total["magnitude_difference"] < 0.35
    assert found.chi_square.max() < 1.5  # as without companion, see below
    assert star.chi_square.min() > 1.5 * found.chi_square.max()
    # It went on until going on changes nothing.
    further = fit_companion(model, exposures, found.companion, found.parameters)
    assert ((further.companion - found.companion).abs() < 0.3 * found.covariance.diagonal().sqrt()).all()
    # With the companion taken out nothing as bright is left.
    rest, _ = search_companions(model, exposures, found, offsets)
    assert rest.abs().max() < 0.25 * contrast.max()
    # Aberrations common to all exposures come out as well, but for piston, tip and tilt, which exposures share.
    wrong = (found.parameters.static.view(7, 6) - static_aberrations)[:, 3:]
    assert wrong.std() < 0.4 * static_aberrations[:, 3:].std()


def test_single_star_has_no_companion_at_that_level(model, single):
    exposures, star = single
    offsets = search_offsets(0.1)
    contrast, _ = search_companions(model, exposures, star, offsets)
    assert star.chi_square.max() < 1.5  # half a percent of the flux is left by the sampling of the holes
    assert contrast.abs().max() < 0.003
    limits = detection_limits(offsets, contrast)
    assert (contrast.abs() < limits(offsets)).all()
    assert limits(offsets).max() < 0.008
