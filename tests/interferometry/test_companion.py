"""Images of a star and its companion against closed forms and finer sums; exposures from observations."""

import dataclasses
import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.companion import CompanionModel, Exposures, Parameters
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band

GRID = Grid.nyquist(1.0, 550e-9, 24, oversampling=1.2)
RED = 600e-9
PIXELS = torch.eye(2, dtype=torch.float64)  # an offset of (east, north) is one of (y, x)
NO_BLUR = torch.zeros(2, dtype=torch.float64)


@pytest.fixture(scope="module")
def mask():
    return SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)


@pytest.fixture(scope="module")
def model(mask):
    return CompanionModel(mask, GRID, 4, Band.of([550e-9]), radius=9.0)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def aberrations(seed=0):
    return 0.3 * torch.randn(12, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def observation(mask, n, header, **changes):
    frames = torch.rand(n, 24, 24, generator=torch.Generator().manual_seed(n))
    seen = Observation(frames, mask, GRID, None, valid=frames[0] > 0.1, errors=frames.sqrt(), header=header)
    return dataclasses.replace(seen, **changes)


# --- exposures


def test_exposures_are_the_frames_of_observations_with_their_north(mask, sky_cards, sky_matrix):
    pytest.importorskip("astropy")
    north = [sky_cards(angle, GRID.pixel_scale) for angle in (0.5, 3.0)]
    parts = [observation(mask, 2, north[0]), observation(mask, 3, north[1], valid=None)]
    exposures = Exposures.from_observations(parts)
    assert torch.equal(exposures.frames, torch.cat([part.frames for part in parts]).double())
    assert torch.equal(exposures.errors, torch.cat([part.errors for part in parts]).double())
    assert torch.equal(exposures.valid[:2], parts[0].valid.expand(2, -1, -1))
    assert exposures.valid[2:].all()
    for t, angle in enumerate((0.5, 0.5, 3.0, 3.0, 3.0)):
        # three pixels along x and minus one along y, said as east and north and back
        sky = torch.from_numpy(sky_matrix(angle, GRID.pixel_scale)) @ tensor(3.0, -1.0)
        torch.testing.assert_close(exposures.to_pixels[t] @ sky, tensor(-1.0, 3.0), rtol=1e-11, atol=0)
    chosen = exposures[[4, 0]]
    for name in ("frames", "errors", "valid", "to_pixels"):
        values = getattr(exposures, name)
        assert torch.equal(getattr(chosen, name), torch.stack([values[4], values[0]]))
        assert torch.equal(getattr(exposures[1::2], name), values[1::2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": {}}, "observation 1 has no CD matrix in its header, which tells where north is"),
        ({"errors": None}, "observation 1 has no errors, such as an ERR extension gives"),
    ],
)
def test_observations_that_lack_something_are_refused(mask, sky_cards, changes, message):
    pytest.importorskip("astropy")
    north = sky_cards(0.0, GRID.pixel_scale)
    parts = [observation(mask, 1, north), observation(mask, 1, **{"header": north} | changes)]
    with pytest.raises(ValueError, match=message):
        Exposures.from_observations(parts)
    with pytest.raises(ValueError, match="observations is empty: give at least one"):
        Exposures.from_observations([])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"frames": torch.ones(24, 24)},
            r"frames has shape \(24, 24\): it must be \(24, 24, 24\), for frames \(T, H, W\)",
        ),
        ({"errors": torch.ones(24, 24)}, r"errors has shape \(24, 24\): it must be \(2, 24, 24\)"),
        ({"valid": torch.ones(1, 24, 24)}, r"valid has shape \(1, 24, 24\): it must be \(2, 24, 24\)"),
        ({"to_pixels": torch.eye(2)}, r"to_pixels has shape \(2, 2\): it must be \(2, 2, 2\)"),
        ({"frames": torch.full((2, 24, 24), math.nan)}, "frames holds values that are not finite: mark those pixels"),
    ],
)
def test_exposures_of_parts_that_disagree_are_refused(changes, message):
    ones = torch.ones(2, 24, 24)
    parts = {"frames": ones, "errors": ones, "valid": ones > 0, "to_pixels": torch.eye(2).expand(2, 2, 2)}
    with pytest.raises(ValueError, match=message):
        Exposures(**parts | changes)


def test_parameters_of_some_exposures_keep_what_is_shared():
    whole = Parameters(aberrations(), NO_BLUR, torch.rand(5, 13), torch.rand(3))
    part = whole.of_exposures(slice(1, None, 2))
    assert torch.equal(part.own, whole.own[[1, 3]])
    assert part.static is whole.static
    assert part.companion is whole.companion


# --- the image


def test_a_companion_is_the_star_dimmed_and_moved(model):
    place, companion = tensor(1e6, 7.0, 11.0, 12.5), tensor(0.03, 2.0, -3.5)
    both = model.image(aberrations(), NO_BLUR, place, companion, PIXELS)
    star = model.image(aberrations(), NO_BLUR, place, tensor(0, 0, 0), PIXELS)
    beside = model.image(aberrations(), NO_BLUR, tensor(0.03e6, 0.0, 13.0, 9.0), tensor(0, 0, 0), PIXELS)
    torch.testing.assert_close(both, star + beside, rtol=1e-12, atol=1e-9)
    turned = tensor([0.0, 2.0], [-1.0, 0.0])  # (east, north) = (3.5, 1): y is 2, x is -3.5
    again = model.image(aberrations(), NO_BLUR, place, tensor(0.03, 3.5, 1.0), turned)
    torch.testing.assert_close(again, both, rtol=1e-12, atol=1e-9)


def test_a_pixel_holds_the_light_that_falls_on_its_square(model):
    """The image at points, averaged over a square pixel by the midpoint rule with 32 x 32 points."""
    n, star = 32, tensor(0, 0, 0)
    places = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    nu_y = torch.fft.fftfreq(72, dtype=torch.float64)[:, None]
    nu_x = torch.fft.rfftfreq(72, dtype=torch.float64)
    across, along = (torch.exp(-2j * math.pi * nu[..., None] * (places + 12)).mean(-1) for nu in (nu_y, nu_x))
    expected = torch.fft.irfft2(torch.fft.rfft2(model.psf(aberrations())) * across * along, s=(72, 72))[:24, :24]
    image = model.image(aberrations(), NO_BLUR, tensor(1.0, 0.0, 12.0, 12.0), star, PIXELS)
    rule = math.pi**2 / 24 / n**2  # of the midpoint, at the highest frequency along an axis
    torch.testing.assert_close(image, expected, rtol=0, atol=2 * rule * float(image.max()))


def test_charge_spreads_as_a_gaussian(model):
    """Its variance along y and x; sampled on pixels, so wide that the samples' own spectrum does not overlap."""
    blur = tensor(2.0, 3.0)
    reach = torch.arange(-11, 12, dtype=torch.float64)
    kernels = [torch.exp(-(reach**2) / (2 * width)) for width in blur]
    kernel = torch.outer(*(values / values.sum() for values in kernels))
    sharp, blurred = (
        model.image(aberrations(), width, tensor(1.0, 0.0, 12.0, 12.0), tensor(0, 0, 0), PIXELS)
        for width in (NO_BLUR, blur)
    )
    expected = torch.nn.functional.conv2d(sharp[None, None], kernel[None, None])[0, 0]  # (2, 2), light from all around
    overlap = 2 * math.exp(-(math.pi**2) * 2.0 / 2)  # at half a cycle per pixel, the worst
    torch.testing.assert_close(blurred[11:13, 11:13], expected, rtol=overlap, atol=0)


def test_a_broad_band_is_the_sum_of_its_colours(mask):
    """The same path differences at each wavelength, whose coefficients in radians are theirs over the wavelength."""
    broad = CompanionModel(mask, GRID, 4, Band.of([550e-9, RED], [3.0, 1.0]), radius=9.0)
    place, companion, coefficients = tensor(1e6, 0.0, 12.2, 11.7), tensor(0.1, 1.0, 2.0), aberrations()
    expected = 0.0
    for wavelength, share in ((550e-9, 0.75), (RED, 0.25)):
        single = CompanionModel(mask, Grid(24, GRID.pixel_scale, wavelength), 4, Band.of([wavelength]), radius=9.0)
        here = coefficients * 550e-9 / wavelength
        expected = expected + share * single.image(here, NO_BLUR, place, companion, PIXELS)
    image = broad.image(coefficients, NO_BLUR, place, companion, PIXELS)
    torch.testing.assert_close(image, expected, rtol=1e-11, atol=1e-9)


def test_a_flat_wavefront_brings_the_whole_pupil_into_phase(mask, model):
    """Its peak is the squared sum of the pupil's open fractions, over the sum of their squares."""
    weights = mask.samples(GRID, 3).weights
    peak = float(weights.sum() ** 2 / weights.square().sum() / 72**2)
    assert float(model.psf(torch.zeros(12, dtype=torch.float64))[0, 0]) == pytest.approx(peak, rel=1e-12)


def test_derivatives_of_an_image(model):
    """By autograd against differences, in everything that is fitted."""
    place = tensor(1.0, 0.1, 12.3, 11.6)
    values = (aberrations(), tensor(0.1, 0.2), place, tensor(0.2, 1.3, -0.7))
    inputs = [value.requires_grad_() for value in values]
    near = model.near & (torch.arange(24) % 3 == 0)  # some of the pixels
    assert torch.autograd.gradcheck(lambda *parts: model.image(*parts, PIXELS)[near], inputs, atol=1e-7)


def test_images_of_all_exposures_have_static_and_own_aberrations(model):
    own = torch.zeros(2, 13, dtype=torch.float64)
    own[:, :4] = tensor([1e6, 1.0, 12.0, 12.0], [2e6, 2.0, 12.5, 11.5])
    own[1, 4:] = 0.1 * torch.arange(9)  # piston, tip and tilt, hole by hole
    sky = torch.stack([PIXELS, 2 * PIXELS])
    parameters = Parameters(aberrations(), tensor(0.1, 0.2), own, tensor(0.1, 1.0, 0.5))
    images = model.images(parameters, sky)
    total = aberrations().view(3, 4).clone()
    assert torch.equal(
        images[0], model.image(total.flatten(), parameters.blur, own[0, :4], parameters.companion, sky[0])
    )
    total[:, :3] += 0.1 * torch.arange(9).view(3, 3)
    expected = model.image(total.flatten(), parameters.blur, own[1, :4], parameters.companion, sky[1])
    torch.testing.assert_close(images[1], expected, rtol=1e-12, atol=1e-9)


def test_moved_images_are_dark_where_they_came_from(model):
    image = torch.zeros(24, 24, dtype=torch.float64)
    image[20, 3] = 5.0
    moved = model.moved(image, tensor([-4.0, 2.0], [6.0, 0.0]))
    expected = torch.zeros(2, 24, 24, dtype=torch.float64)
    expected[0, 16, 5] = 5.0  # the second has left the field
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-13)


def test_weights_of_pixels(mask):
    model = CompanionModel(mask, GRID, 3, Band.of([550e-9]), radius=5.0, flux_error=0.1)
    frames, valid = torch.full((1, 24, 24), 100.0).double(), torch.ones(1, 24, 24, dtype=torch.bool)
    valid[0, 12, 13], frames[0, 12, 14] = False, -50.0
    weights = model.root_weights(Exposures(frames, torch.full_like(frames, 3.0), valid, PIXELS[None]))
    assert float(weights[0, 12, 12]) == pytest.approx(1 / math.hypot(3, 0.1 * 100))
    assert float(weights[0, 12, 14]) == pytest.approx(1 / 3)  # no flux, no error of it
    assert float(weights[0, 12, 13]) == 0  # not valid
    assert float(weights[0, 12, 17]) > 0
    assert float(weights[0, 12, 18]) == 0  # six pixels away
    assert int((weights > 0).sum()) == 81 - 1  # points of the lattice within a circle of radius 5


def test_too_few_modes_are_refused(mask):
    with pytest.raises(ValueError, match="n_modes is 2: at least 3, piston, tip and tilt, are needed"):
        CompanionModel(mask, GRID, 2, Band.of([550e-9]), radius=9.0)
