"""The light that holes spread beyond the field, against the Airy pattern and in the brightness of restored objects."""

import math

import pytest
import torch
from scipy.special import j1

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.light_beyond import light_beyond
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation


def mask_of(n, fill=0.15):
    return SparseAperture.random(n, 1.0, fill, torch.Generator().manual_seed(n))


def share_on_pixels(mask, grid, row, column):
    """The light of a point on the pixel (row, column) that falls on all pixels: its PSF is an Airy pattern times the
    interference of the holes, of unit sum over an endless field."""
    rows, columns = (torch.arange(n, dtype=torch.float64) - at for n, at in zip(grid.shape, (row, column), strict=True))
    y, x = rows[:, None], columns
    per_metre = grid.pixel_scale / grid.wavelength  # [cycles per pixel and m]
    u = math.pi * per_metre * mask.subaperture_diameter * torch.hypot(y, x)
    airy = torch.where(u > 0, 2 * torch.from_numpy(j1(u.numpy())) / u.where(u > 0, 1), 1) ** 2
    phase = 2 * math.pi * per_metre * (mask.centers[:, 0, None, None] * x + mask.centers[:, 1, None, None] * y)
    fringes = torch.exp(1j * phase).sum(0).abs() ** 2 / len(mask.centers)
    return float((math.pi / 4 * (per_metre * mask.subaperture_diameter) ** 2 * airy * fringes).sum())


def point(model, row, column):
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[row, column] = 3.0
    return image


@pytest.mark.parametrize("n", [48, 64, 128])
@pytest.mark.parametrize("holes", [3, 6, 11])
@pytest.mark.parametrize("middle", [True, False])
def test_frames_hold_the_share_of_the_airy_pattern(n, holes, middle):
    """What is left is of second order in the cells across a hole, as its rim passes through cells; tighter in larger
    fields, and always much less than what is mended."""
    mask, grid = mask_of(holes), Grid.nyquist(1.0, 550e-9, n)
    model = ExposureModel(mask, grid, 3)
    row, column = (n // 2, n // 2) if middle else (n // 5, 3 * n // 4)
    z = torch.zeros(2, model.aberrations.n_parameters, dtype=torch.float64)
    image = point(model, row, column)
    in_model = float(model(image, z).sum()) / (2 * 3.0)
    expected = share_on_pixels(mask, grid, row, column)
    found = (1 - light_beyond(model, image, z)) * in_model
    assert abs(found - expected) < 0.2 / (n * mask.subaperture_diameter) ** 2
    assert abs(found - expected) < 0.05 * (in_model - expected)


def test_light_of_a_margin_lies_on_the_side_where_it_is():
    """A point a little above the first row sends as much light into the frames as one as little below the last."""
    mask, grid = mask_of(6), Grid.nyquist(1.0, 550e-9, 48)
    model = ExposureModel(mask, grid, 3)
    z = torch.zeros(1, model.aberrations.n_parameters, dtype=torch.float64)
    for row in (-2, 49):
        image = point(model, row, 20)
        in_model = float(model(image, z).sum()) / 3.0
        expected = share_on_pixels(mask, grid, row, 20)
        assert (1 - light_beyond(model, image, z)) * in_model == pytest.approx(
            expected, abs=0.2 / (48 * mask.subaperture_diameter) ** 2
        )


def test_the_mean_of_many_frames_is_that_of_some():
    model = ExposureModel(mask_of(3), Grid.nyquist(1.0, 550e-9, 32), 3)
    z = 0.3 * torch.randn(1, model.aberrations.n_parameters, generator=torch.Generator().manual_seed(0)).double()
    image = point(model, 16, 16)
    assert light_beyond(model, image, z.expand(100, -1)) == pytest.approx(light_beyond(model, image, z), rel=1e-9)


@pytest.mark.parametrize("pupil", [mask_of(5), FullAperture(1.0)], ids=["mask", "full pupil"])
@pytest.mark.parametrize("width", [0.0, 60e-9])
def test_a_restored_object_has_all_its_light(pupil, width):
    """But for what PSFs that end at the field do to its shape: half of what they do to its brightness at most.

    Of 5e5 photons in three frames 0.1 % are noise.
    """
    grid, band = Grid.nyquist(1.1, 550e-9, 48), Band.top_hat(550e-9, width, 3) if width else Band.of((550e-9,))
    scene = torch.zeros(48, 48, dtype=torch.float64)
    scene[18:28, 20:25] = 1e4
    conditions = Conditions(band=band)
    draw = torch.Generator().manual_seed(1)
    seen = simulate_observation(scene, pupil, grid, None, Detector(2.0), 3, draw, conditions=conditions)
    known = torch.zeros(3, pupil.n_subapertures, 3, dtype=torch.float64)
    method = MyopicDeconvolution(pupil, grid, 3, readout_noise=2.0, wavelengths=band.wavelengths, max_iterations=300)
    result = method.restore(seen.frames, coefficients=known)
    flux = float(result.object.sum() / scene.sum())
    faint = flux * (1 - result.light_beyond)  # as PSFs of unit sum on the field have it
    assert faint < 0.99
    assert abs(flux - 1) < 0.5 * (1 - faint)
    assert torch.equal(result.object, result.extended_object[:48, :48])
