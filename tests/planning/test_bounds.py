"""The bound of a blind restoration against dense matrices, and what it tends to."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import OTF
from torchmask.optics.zernike import ZernikePhase
from torchmask.planning.bounds import _columns, _half_plane, myopic_bound
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, (12, 11))
MASK = SparseAperture([[0.0, 0.3], [-0.28, -0.2], [0.28, -0.2]], 0.4, 1.0)
OBJECT, NOISE = PowerLawPSD(1.5, 1e4, knee=1 / 4), NoisePSD(1e4)


def scene(light=1e4):
    image = torch.rand(GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
    return light * image / image.sum()


def bound(n_modes=3, n_frames=3, r0=0.4, seed=0, **changes):
    known = {"image": scene(), "object_psd": OBJECT, "noise_psd": NOISE, "aperture": MASK, "oversampling": 2} | changes
    generator = torch.Generator().manual_seed(seed)
    return myopic_bound(
        **known,
        grid=GRID,
        n_frames=n_frames,
        n_modes=n_modes,
        r0=r0,
        generator=generator,
    )


@pytest.mark.parametrize("n_modes", [1, 3, 6])
def test_it_is_the_inverse_of_the_dense_information(n_modes):
    """Frames and priors by automatic differentiation in pixels and parameters; common tilts held by a stiff prior."""
    n_frames, (height, width) = 3, GRID.shape
    n_pixels = height * width
    basis = turbulent_basis(MASK, n_modes, 0, 0.4, 20.0)
    z = torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    otf, phase = OTF(MASK, GRID, 2), ZernikePhase(MASK, GRID, n_modes, 2)

    def frames(image, z):
        return torch.fft.ifft2(otf(phase(basis.coefficients(z))) * torch.fft.fft2(image)).real.flatten()

    parts = torch.autograd.functional.jacobian(frames, (scene(), z))
    jacobian = torch.cat([part.flatten(1) for part in parts], dim=1)
    variance = float(NOISE(GRID)[0, 0]) / n_pixels
    fourier = torch.fft.fft2(torch.eye(n_pixels, dtype=torch.float64).reshape(-1, height, width)).flatten(1)
    prior = (fourier.conj() @ torch.diag(1 / OBJECT(GRID).flatten()).to(fourier) @ fourier.mT).real
    information = jacobian.mT @ jacobian / variance
    information[:n_pixels, :n_pixels] += prior
    information[n_pixels:, n_pixels:] += torch.eye(z.numel(), dtype=torch.float64)
    if n_modes >= 3:  # pistons alone make no tilt
        x, y = MASK.centers.T
        for slope_x, slope_y in ((1.0, 0.0), (0.0, 1.0)):
            coefficients = torch.zeros(1, 3, n_modes, dtype=torch.float64)
            coefficients[0, :, 0] = slope_x * x + slope_y * y
            coefficients[0, :, 1], coefficients[0, :, 2] = 0.4 / 4 * slope_x, 0.4 / 4 * slope_y
            held = basis.parameters_of(coefficients).expand(n_frames, -1).flatten()
            held = held / held.norm()
            information[n_pixels:, n_pixels:] += 1e7 * torch.outer(held, held)
    covariance = torch.linalg.inv(information)[:n_pixels, :n_pixels]
    dense = float(covariance.trace() / OBJECT(GRID).mean())
    found = bound(n_modes)
    # a prior of 1e7 against an information of at most some 1e4 holds to 1e-3 of the excess
    assert found.unknown - found.known == pytest.approx(dense - found.known, rel=2e-3)
    assert found.ratio > 1.0001


def test_known_aberrations_are_the_wiener_estimate():
    """Their prior shrinks as r0^(-5/6) in amplitude, and the excess as its square."""
    excesses = [bound(r0=r0).ratio - 1 for r0 in (1e3, 1e5)]
    assert 0 < excesses[1] < 1e-7
    assert math.log(excesses[0] / excesses[1]) / math.log(100) == pytest.approx(5 / 3, rel=0.01)


def test_more_modes_cost_more_and_more_light_tells_more():
    assert bound(n_modes=6).ratio > bound(n_modes=3).ratio
    bright = bound(image=scene(1e6), object_psd=PowerLawPSD(1.5, 1e6, knee=1 / 4), noise_psd=NoisePSD(1e6))
    assert bright.unknown < bound().unknown


def test_it_is_computed_in_float64_where_the_aperture_is():
    """Whatever the precision of the mask, which stays as it is, and the default device."""
    rounded = SparseAperture(MASK.centers.float(), 0.4, 1.0)
    assert bound(aperture=rounded) == bound(aperture=SparseAperture(rounded.centers.double(), 0.4, 1.0))
    assert rounded.centers.dtype == torch.float32
    image, expected = scene(), bound()
    with torch.device("meta"):
        assert bound(image=image) == expected


@pytest.mark.filterwarnings("error:Converting a tensor")
def test_power_spectra_that_train_change_nothing():
    psds = {"object_psd": OBJECT(GRID), "noise_psd": NOISE(GRID)}
    trained = {name: psd.clone().requires_grad_() for name, psd in psds.items()}
    assert bound(**trained) == bound(**psds)


def test_whole_numbers_may_be_floats():
    assert bound(n_frames=4.0, n_modes=3.0) == bound(n_frames=4, n_modes=3)


@pytest.mark.parametrize(("diameter", "finer"), [(0.4, 7), (0.3, 9)])
def test_holes_are_14_samples_wide_unless_told(diameter, finer):
    """Samples lie 2/11 m apart, over the oversampling."""
    mask = SparseAperture(MASK.centers, diameter, 1.0)
    assert bound(aperture=mask, oversampling=None) == bound(aperture=mask, oversampling=finer)
    assert bound(aperture=mask, oversampling=None) != bound(aperture=mask, oversampling=finer - 1)


def test_finer_samples_change_the_excess_little():
    """By less than the share that the default allows, which holes of four samples exceed."""
    coarse, default, fine = (bound(oversampling=finer).ratio - 1 for finer in (2, 7, 14))
    assert abs(default / fine - 1) < 0.04 < abs(coarse / fine - 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image": torch.ones(4, 4)}, r"image has shape \(4, 4\)"),
        ({"image": scene() / 0}, "image holds values that are not finite"),
        ({"n_frames": 0}, "n_frames is 0"),
        ({"n_frames": math.inf}, "n_frames is inf"),
        ({"n_modes": 2.5}, r"n_modes is 2\.5: it must be a whole number of at least 1"),
        ({"aperture": FullAperture(1.0), "n_modes": 1}, "n_modes is 1: the piston of .* take at least 3 for its tilts"),
        ({"noise_psd": torch.tensor(-1.0)}, "noise_psd holds negative"),
        ({"noise_psd": torch.tensor(0.0)}, "noise_psd is 0 somewhere"),
    ],
)
def test_what_cannot_be_is_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        bound(**changes)


@pytest.mark.parametrize("shape", [(6, 8), (6, 7), (5, 8)])
def test_half_spectra_have_the_products_of_whole_ones(shape):
    """Of real fields, whatever their sides: columns that stand for two count twice."""
    fields = torch.randn(3, *shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spectra, grid = torch.fft.fft2(fields), Grid(shape, 1e-7, 5e-7)
    columns = _columns(spectra, _half_plane(grid))
    whole = torch.einsum("ahw,bhw->ab", spectra, spectra.conj())
    torch.testing.assert_close(columns @ columns.T, whole.real, rtol=1e-12, atol=1e-12)
