"""Geometry and transmissions of a mask from frames of a star, with their errors."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.calibration import _variance, calibrate_mask
from torchmask.interferometry.star_fit import StarFit, require_all_holes, start_frame
from torchmask.interferometry.star_model import Shared, StarModel
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import SquarePixel
from torchmask.simulation.exposures import simulate_observation

GRID = Grid.nyquist(1.1, 550e-9, 64)
TOLD = SparseAperture([[0.02, 0.38], [-0.35, -0.2], [0.3, -0.28], [0.31, 0.2], [-0.22, 0.15]], 0.2, 1.0)
TRUE = MaskGeometry(math.radians(1.3), 1.006, 0.997, 0.002)
LIGHT = torch.tensor([1.1, 0.9, 1.05, 1.0, 0.95], dtype=torch.float64)
REACH = 18  # pixels from the star that are compared: 1.6 wavelengths over the diameter of a hole


def bench(geometry=TRUE, n_frames=1, electrons=1e6, light=LIGHT, pixel=None, at=(32, 32)):
    """Frames of a pinhole that expect so many electrons, with piston, tilt and focus of their own in every hole."""
    model = StarModel(TOLD, GRID, 31, 4, pixel)
    generator = torch.Generator().manual_seed(5)
    frames = torch.zeros(n_frames, *GRID.shape, dtype=torch.float64)
    shared = Shared(geometry.matrix, (light / light.mean()).log())
    for frame in frames:
        modes = torch.randn(5, 4, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 0.3, 0.3, 0.1])
        own = torch.cat([modes.new_zeros(2), modes.flatten()])
        image = model.image(own, shared, model.kernels(shared.matrix)).view(63, 63)
        rows, columns = (slice(max(0, middle - 31), middle + 32) for middle in (at[1], at[0]))
        cut = tuple(slice(max(0, 31 - middle), max(0, 31 - middle) + 64) for middle in (at[1], at[0]))
        part = image[cut][: frame[rows, columns].shape[0], : frame[rows, columns].shape[1]]
        frame[rows, columns] = electrons * part / image.sum()
    return frames


def parameters(geometry):
    return torch.tensor(
        [geometry.rotation, geometry.magnification_x, geometry.magnification_y, geometry.shear], dtype=torch.float64
    )


def test_a_noise_free_star_is_recovered_to_rounding():
    found = calibrate_mask(bench(), TOLD, GRID)
    # The last step promised to lower the weighted squares by less than 0.01, a tenth of one standard error.
    assert bool(((parameters(found.geometry) - parameters(TRUE)).abs() < 0.1 * found.geometry_errors).all())
    torch.testing.assert_close(found.transmissions, LIGHT, rtol=0, atol=1e-4)
    assert found.mirror_seen
    assert not found.geometry.mirrored
    assert float(found.explained.min()) > 1 - 1e-6
    expected = TRUE.apply(TOLD)
    torch.testing.assert_close(found.aperture.centers, expected.centers, rtol=0, atol=1e-5)
    assert found.aperture.subaperture_diameter == pytest.approx(expected.subaperture_diameter, rel=1e-4)


def test_errors_of_a_bench_are_right():
    """Photon noise alone: pulls of all estimates over seeds have the variance 1 of their errors."""
    grid, pulls = replace(GRID, n_pixels=32), []
    expected = bench(n_frames=3, electrons=3e5)[:, 16:48, 16:48]  # most of the light, in less time
    for seed in range(6):
        frames = torch.poisson(expected, generator=torch.Generator().manual_seed(seed))
        frames += 2 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        found = calibrate_mask(frames, TOLD, grid, readout_noise=2.0, n_modes=4)
        by_geometry = (parameters(found.geometry) - parameters(TRUE)) / found.geometry_errors
        pulls.append(torch.cat([by_geometry, (found.transmissions - LIGHT) / found.transmission_errors]))
    square = torch.stack(pulls).square()
    # 6 seeds of 9 estimates, 8 of them independent: the mean square has the standard deviation (2 / 48)^(1/2) = 0.2.
    # Errors are the larger of two, the second from three frames only, which lowers it: chi-square with two degrees of
    # freedom over two, or 1 if that is less, has the mean inverse 0.85.
    assert 0.85 - 3 * 0.2 < float(square.mean()) < 1 + 3 * 0.2


@pytest.mark.parametrize("geometry", [MaskGeometry(math.radians(-40)), MaskGeometry(0.3, 0.98, 0.98, mirrored=True)])
def test_any_turn_and_a_mirror_are_found(geometry):
    found = calibrate_mask(bench(geometry), TOLD, GRID, n_modes=4)
    assert found.geometry.mirrored == geometry.mirrored
    assert bool(((parameters(found.geometry) - parameters(geometry)).abs() < 0.1 * found.geometry_errors).all())


def test_a_mask_of_symmetric_baselines_cannot_tell_that_it_is_mirrored():
    mask = SparseAperture.from_catalog("golay3", 1.0, 0.15)
    star = torch.zeros(GRID.shape, dtype=torch.float64)
    star[32, 32] = 1e7
    seen = simulate_observation(star, mask, GRID, None, Detector(), n_frames=1)
    found = calibrate_mask(seen.frames, mask, GRID)
    assert not found.mirror_seen
    assert not found.geometry.mirrored
    assert abs(found.geometry.rotation) < 1e-3
    assert "cannot be seen" in str(found)


def test_a_star_in_turbulence_anywhere_in_the_field():
    """End to end, with modes that the fit lacks: geometry within four of its errors, which are small enough."""
    true = MaskGeometry(math.radians(1.2), 1.006, 1.006)
    star = torch.zeros(GRID.shape, dtype=torch.float64)
    star[35, 28] = 1e6
    turbulence = TurbulencePhase(r0=0.2, outer_scale=20.0)
    generator = torch.Generator().manual_seed(1)
    seen = simulate_observation(star, true.apply(TOLD), GRID, turbulence, Detector(2.0), 8, generator)
    found = calibrate_mask(seen.frames, TOLD, GRID, readout_noise=2.0)
    difference = (parameters(found.geometry) - parameters(true)).abs()
    assert bool((difference < 4 * found.geometry_errors).all())
    assert bool((difference < torch.tensor([math.radians(0.1), 2e-3, 2e-3, 2e-3])).all())
    assert bool((found.offset - torch.tensor([-4.0, 3.0])).abs().max() < 4 * found.offset_errors.max())


def test_the_place_of_a_star_that_moves_has_the_error_of_a_mean():
    """The same frame three times, moved by whole pixels: the scatter of the frames over the root of their number."""
    moves = torch.tensor([[0.0, 1.0], [3.0, 0.0], [-2.0, 2.0]], dtype=torch.float64)  # (x, y)
    (frame,) = bench(electrons=1e7)
    frames = torch.stack([frame.roll((int(y), int(x)), (0, 1)) for x, y in moves.tolist()])
    still, found = (calibrate_mask(some, TOLD, GRID, n_modes=4) for some in (frame[None], frames))
    torch.testing.assert_close(found.offset, still.offset + moves.mean(0), rtol=0, atol=0.01)
    # photons leave a place uncertain by 1e-3 pixels or so
    torch.testing.assert_close(found.offset_errors, moves.std(0) / math.sqrt(3), rtol=0.01, atol=0)
    assert float(still.offset_errors.max()) < 0.01


def test_what_is_left_beyond_the_noise_counts_the_parameters_that_were_fitted():
    """Residuals of n pixels about a fit of p parameters sum to n - p variances."""
    n, p, variance = 200, 22, 50.0
    images = 9.0 + torch.rand(2, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    residual = torch.randn(2, n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    counted = torch.ones(2, n, dtype=torch.float64)
    counted[1, :50] = 0.0
    residual *= ((counted.sum(1) - p) * variance / (counted * residual**2).sum(1)).sqrt()[:, None]
    shared = Shared(torch.eye(2, dtype=torch.float64), torch.zeros(5, dtype=torch.float64))
    fit = StarFit(torch.zeros(2, p, dtype=torch.float64), shared, images)
    found = _variance(images + residual, counted, fit, readout_noise=2.0)
    mean = (counted * found).sum(1) / counted.sum(1)
    torch.testing.assert_close(mean, torch.full_like(mean, variance), rtol=1e-12, atol=0)
    torch.testing.assert_close(found - mean[:, None], images - (counted * images).sum(1, True) / counted.sum(1, True))
    # less than the noise alone, 9.5 photons and 2 electrons of read-out, is chance
    quiet = _variance(images + 0.1 * residual, counted, fit, readout_noise=2.0)
    torch.testing.assert_close(quiet, images + 4.0, rtol=1e-12, atol=0)


def test_pixels_that_are_told_are_taken_out():
    frames = bench(n_frames=1, pixel=SquarePixel())
    found = calibrate_mask(frames, TOLD, GRID, pixel=SquarePixel(), n_modes=4)
    # The model blurs its square of pixels as if it were periodic, which errs at its border, where 1e-3 of the light is.
    assert bool(((parameters(found.geometry) - parameters(TRUE)).abs() < 5e-4).all())
    torch.testing.assert_close(found.transmissions, LIGHT, rtol=0, atol=0.02)


def test_pixels_are_estimated_with_their_error():
    """4 frames of 2.5e6 photons: pulls over seeds, and what it costs the geometry."""
    expected, fill, pulls = bench(n_frames=4, electrons=2.5e6, pixel=SquarePixel(0.6)), 0.6, []
    for seed in range(3):
        frames = torch.poisson(expected, generator=torch.Generator().manual_seed(seed))
        found = calibrate_mask(frames, TOLD, GRID, n_modes=4, estimate_pixel=True)
        assert 0.001 < found.fill_factor_error < 0.005
        pulls.append((found.fill_factor - fill) / found.fill_factor_error)
        difference = (parameters(found.geometry) - parameters(TRUE)).abs()
        assert bool((difference < 4 * found.geometry_errors).all())
    # of three pulls the sum of squares is below 16.3 in 999 of 1000 trials
    assert sum(pull**2 for pull in pulls) < 16.3
    assert found.pixel == SquarePixel(found.fill_factor)
    assert f"{found.fill_factor:.4f} +- {found.fill_factor_error:.4f}" in str(found)


def test_points_are_told_from_pixels():
    found = calibrate_mask(bench(), TOLD, GRID, n_modes=4, estimate_pixel=True)
    assert abs(found.fill_factor) < 0.1 * found.fill_factor_error
    known = calibrate_mask(bench(), TOLD, GRID, n_modes=4)
    assert (known.fill_factor, known.fill_factor_error, known.pixel) == (None, None, None)
    with pytest.raises(ValueError, match="leave one of them out"):
        calibrate_mask(bench(), TOLD, GRID, pixel=SquarePixel(), estimate_pixel=True)


def test_pixels_that_are_not_valid_do_no_harm():
    frames, valid = bench(), torch.ones(GRID.shape, dtype=torch.bool)
    valid[30, 33] = valid[40, 20] = False
    frames[:, ~valid] = math.nan
    found = calibrate_mask(frames, TOLD, GRID, valid=valid, n_modes=4)
    assert bool(((parameters(found.geometry) - parameters(TRUE)).abs() < 0.1 * found.geometry_errors).all())


def test_the_fringes_of_a_frame_tell_its_pistons():
    model, n = StarModel(TOLD, GRID, REACH, 3), 5
    shared = Shared(torch.eye(2, dtype=torch.float64), torch.zeros(n, dtype=torch.float64))
    kernels = model.kernels(shared.matrix)
    pistons = torch.tensor([0.0, 2.0, -1.0, 3.0, 1.0], dtype=torch.float64)
    own = torch.zeros(2 + 3 * n, dtype=torch.float64)
    own[0], own[2::3] = 2.0, pistons
    frame = model.image(own, shared, kernels)
    start = start_frame(model, frame, torch.ones_like(frame), shared, kernels)
    away = torch.exp(1j * (start[2::3] - pistons))
    assert float((away / away[0] - 1).abs().max()) < 0.2  # fringes overlap a little in this field


def extended():
    object = torch.zeros(GRID.shape, dtype=torch.float64)
    object[20:44, 20:44] = torch.rand(24, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return simulate_observation(1e6 * object / object.sum(), TOLD, GRID, None, Detector(), n_frames=2).frames


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (extended, "point source"),
        (lambda: torch.poisson(torch.full((1, 64, 64), 9.0)), "point source"),
        (lambda: torch.zeros(2, 64, 64), "no light"),
        (lambda: torch.ones(2, 60, 64), "shape"),
    ],
    ids=["extended", "sky", "dark", "shape"],
)
def test_frames_without_a_star_are_refused(frames, message):
    with pytest.raises(ValueError, match=message):
        calibrate_mask(frames(), TOLD, GRID)


def test_a_fit_with_its_light_through_one_hole_is_refused():
    """As of a wide object, which the blob of one hole fits best; dust on a third of the holes is none."""
    with pytest.raises(ValueError, match="has 95 % of the light through one of 7 holes: the object is no point"):
        require_all_holes(torch.tensor([0.123, 0.043, 0.011, 6.636, 0.099, 0.021, 0.066]))
    require_all_holes(torch.tensor([1.0, 0.0, 1.2, 0.0, 0.9, 1.0, 1.1]))
    with pytest.raises(ValueError, match="has 80 % of the light through one of 5 holes: the object is no point"):
        calibrate_mask(bench(light=torch.tensor([4.0, 0.25, 0.25, 0.25, 0.25]).double()), TOLD, GRID, n_modes=4)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"n_modes": 2}, "n_modes"),
        ({"n_modes": 100_000}, r"n_modes is 100000: a frame has \d+ pixels around the star, .* take at most \d+, or"),
        ({"readout_noise": -1.0}, "readout_noise"),
    ],
)
def test_numbers_out_of_range_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        calibrate_mask(bench(), TOLD, GRID, **keywords)


def test_a_pixel_scale_in_milliarcseconds_is_told_as_such():
    """It was said to leave too few pixels for the modes."""
    with pytest.raises(ValueError, match=r"pixel_scale .* undersamples an aperture"):
        calibrate_mask(bench(), TOLD, replace(GRID, pixel_scale=1000 * GRID.pixel_scale))


def test_a_population_and_two_holes_are_refused():
    for centers in (TOLD.centers[None], TOLD.centers[:2]):
        with pytest.raises(ValueError, match="at least 3 holes"):
            calibrate_mask(bench(), TOLD.replace(centers), GRID)
