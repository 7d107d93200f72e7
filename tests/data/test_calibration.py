"""From raw images to frames, in closed form: dark and flat, crops, targets, selection, drift."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.data.calibration import (
    best_frames,
    calibrate,
    crop_corner,
    find_target,
    frame_drift,
    frame_flux,
    frame_sharpness,
)
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.psf import PSF


def everywhere(frames):
    return np.ones(frames.shape, dtype=bool)


def test_dark_and_flat_are_undone():
    rng = np.random.default_rng(0)
    truth = rng.uniform(100, 200, (3, 16, 20))
    dark, flat = rng.uniform(10, 20, (16, 20)), rng.uniform(0.5, 1.5, (16, 20))
    bad = np.zeros((16, 20))
    bad[3, 4] = 1
    flat[5, 6], dark[7, 8] = 0.0, np.nan
    good = (bad == 0) & (flat > 0) & np.isfinite(dark)
    flat *= 1 / np.median(flat[good])
    raw = truth * flat + dark
    raw[:, 3, 4], raw[1, 9, 9] = 1e9, np.inf
    valid = np.isfinite(raw)
    # flats are known but for their scale
    values, kept, sensitivity = calibrate(raw, valid, dark, 37 * flat, bad)
    assert np.array_equal(kept, valid & good)
    np.testing.assert_allclose(values[kept], truth[kept], rtol=1e-12)
    np.testing.assert_allclose(sensitivity[good], flat[good], rtol=1e-12)
    assert np.isfinite(values).all()
    assert values[1, 9, 9] == 0


def test_what_does_not_fit_the_frames_is_refused():
    raw = np.ones((3, 16, 20))
    for name in ("dark", "flat", "bad_pixels"):
        with pytest.raises(ValueError, match=rf"{name} has shape \(16, 16\): it must be.*\(16, 20\)"):
            calibrate(raw, everywhere(raw), **{name: np.zeros((16, 16))})
    with pytest.raises(ValueError, match="bad_pixels marks every pixel as bad"):
        calibrate(raw, everywhere(raw), bad_pixels=np.ones((16, 20)))
    with pytest.raises(ValueError, match="flat is positive on no good pixel"):
        calibrate(raw, everywhere(raw), flat=np.zeros((16, 20)))


@settings(derandomize=True, deadline=None)
@given(st.integers(3, 30), st.integers(3, 30), st.data())
def test_the_largest_crop_is_the_largest(rows, columns, data):
    target = (data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1)))

    def fits_in(size):
        try:
            crop_corner((rows, columns), target, size)
        except ValueError as error:
            return int(str(error).split()[-1])
        return None

    largest = fits_in(1000)
    assert largest is not None
    assert largest < 1 or fits_in(largest) is None
    assert fits_in(largest + 1) == largest


@pytest.mark.parametrize("target", [(100, 10), (-1, 10), (10, 20), (16, 0)])
def test_a_target_outside_the_image_is_told_where_the_image_ends(target):
    with pytest.raises(ValueError, match=rf"target is \({target[0]}, {target[1]}\).*rows are 0 to 15.*columns 0 to 19"):
        crop_corner((16, 20), target, 8)


def test_hot_pixels_are_no_target():
    y, x = np.mgrid[:32, :32]
    frames = (1e3 * np.exp(-((y - 20) ** 2 + (x - 11) ** 2) / 8))[None]
    frames[0, 5, 5] = 1e6
    valid = everywhere(frames)
    valid[0, 5, 5] = valid[0, 20, 11] = False
    valid[0, :, :4] = False
    frames[0, :, :4] = 1e6
    assert find_target(frames, valid, 1.0) == (20, 11)


def gaussians():
    """Frames of five widths and fluxes, which are their own."""
    y, x = np.mgrid[:24, :24]
    width = np.array([3.0, 1.5, 2.0, 1.0, 2.5])
    flux = np.array([1.0, 5.0, 2.0, 4.0, 3.0]) * 1e4
    frames = np.exp(-((y - 12) ** 2 + (x - 12) ** 2) / (2 * width[:, None, None] ** 2))
    return frames * (flux / frames.sum((1, 2)))[:, None, None], width, flux


def test_flux_and_sharpness_of_a_gaussian():
    frames, width, flux = gaussians()
    np.testing.assert_allclose(frame_flux(frames, everywhere(frames)), flux, rtol=1e-12)
    # S1 of a Gaussian is 1 / (4 pi width^2); the first is so wide that the field cuts it
    sharpness = frame_sharpness(frames, everywhere(frames))
    np.testing.assert_allclose(sharpness[1:], 1 / (4 * math.pi * width[1:] ** 2), rtol=1e-3)
    valid = everywhere(frames)
    valid[:, 12, 12] = False
    assert (frame_flux(frames, valid) < flux).all()
    assert (frame_sharpness(frames, valid) < sharpness).all()


def test_the_best_frames_keep_their_order():
    frames, _, _ = gaussians()
    valid = everywhere(frames)
    for keep_by in ("flux", "sharpness"):
        assert best_frames(frames, valid, 0.4, keep_by).tolist() == [1, 3]
        assert best_frames(frames, valid, 1.0, keep_by).tolist() == [0, 1, 2, 3, 4]
    assert best_frames(frames, valid, 0.01, "flux").tolist() == [1]
    assert best_frames(frames, valid, 0.01, "sharpness").tolist() == [3]
    for options, message in (((0.0,), "keep is 0.0"), ((1.5,), "keep is 1.5"), ((0.5, "luck"), "keep_by is 'luck'")):
        with pytest.raises(ValueError, match=message):
            best_frames(frames, valid, *options)


def test_drift_is_the_movement_of_the_image():
    # A tilt of 2 pi s x pixel_scale / wavelength moves the image by s pixels exactly; the search's step is 0.01.
    mask = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)
    grid = Grid.nyquist(1.0, 550e-9, 48)
    psf = PSF(mask, grid)
    samples = psf.samples()
    position = samples.offsets + mask.centers[:, None, :]
    shifts = torch.tensor([[0.0, 0.0], [1.25, -2.5], [-0.37, 0.81]], dtype=torch.float64)
    tilt = 2 * math.pi * grid.pixel_scale / grid.wavelength * torch.einsum("npc,tc->tnp", position, shifts)
    frames = psf(tilt).roll((24, 24), (-2, -1)).numpy()
    np.testing.assert_allclose(frame_drift(frames), shifts, atol=0.015)
    valid = everywhere(frames)
    valid[:, 10, 10] = valid[:, 30, 31] = False
    spoilt = np.where(valid, frames, 1.0)  # dead pixels do not move, whatever their value
    np.testing.assert_allclose(frame_drift(spoilt, valid), shifts, atol=0.02)
    np.testing.assert_allclose(frame_drift(spoilt, np.broadcast_to(valid[0], valid.shape)), shifts, atol=0.02)
    assert np.abs(frame_drift(spoilt)).max() < 0.02
