"""The sampled pupil: where its samples lie, and that they follow an aperture that moves or trains, never stale."""

import math

import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import plain_basis
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.pupil import SampledPupil

GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
BANDS = [None, Band.of((500e-9, 600e-9), (1.0, 3.0))]
HERE = [[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]]
THERE = [[0.05, 0.28], [0.21, -0.27], [-0.33, 0.02]]
OTHER_DTYPE = {torch.float32: torch.float64, torch.float64: torch.float32}


def mask(centers=HERE, dtype=torch.float64, trains=False):
    centers = torch.tensor(centers, dtype=dtype)
    return SparseAperture(nn.Parameter(centers) if trains else centers, 0.3, 1.0)


def aberrations(seed=0):
    return 0.5 * torch.randn(2, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.pupil.samples(), other.pupil.samples(), strict=True))


def test_samples_are_those_of_the_aperture():
    aperture, field = mask(), Grid.nyquist(1.0, 550e-9, 40, oversampling=1.2)
    samples = SampledPupil(aperture, field, Band.of([field.wavelength]), plain_basis(aperture, 3)).samples()
    of_aperture = aperture.samples(field)
    is_open = of_aperture.weights > 0
    assert len(samples.weights) == int(is_open.sum())
    assert torch.equal(samples.index, of_aperture.index[is_open])
    ratio = samples.weights / of_aperture.weights[is_open]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-13, atol=0)
    assert float(samples.weights.square().sum()) * math.prod(field.shape) == pytest.approx(1, rel=1e-13)  # Parseval
    assert bool((samples.chromaticity == 1).all())
    # A sample's place as a frequency is that of its raster point, up to whole periods.
    rows, columns = field.shape
    index = samples.index.double()
    place = torch.stack([index % columns / columns, (index / columns).floor() / rows], dim=1)
    away = samples.positions - place
    assert float((away - away.round()).abs().max()) < 1e-12


def test_phase_and_field():
    aperture, field = mask(), Grid.nyquist(1.0, 550e-9, 40, oversampling=1.2)
    samples = SampledPupil(aperture, field, Band.of([field.wavelength]), plain_basis(aperture, 3)).samples()
    z = aberrations()
    torch.testing.assert_close(samples.phase(z), torch.einsum("pk,tk->tp", samples.basis, z), rtol=0, atol=1e-13)
    expected = samples.weights * torch.exp(1j * samples.phase(z))
    torch.testing.assert_close(samples.field(samples.phase(z)), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("band", BANDS)
@pytest.mark.parametrize("trains", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_mask_that_has_moved_is_followed(band, trains, dtype):
    """In place, by a new tensor and by loading another mask's state; what comes out is as if built there."""
    moves = {
        "in place": lambda aperture: aperture.centers.copy_(torch.tensor(THERE, dtype=dtype)),
        "loaded": lambda aperture: aperture.load_state_dict(mask(THERE, dtype).state_dict()),
    }
    if not trains:
        moves["replaced"] = lambda aperture: setattr(aperture, "centers", torch.tensor(THERE, dtype=dtype))
    fresh = ExposureModel(mask(THERE, dtype), GRID, 3, band)
    for move in moves.values():
        aperture = mask(dtype=dtype, trains=trains)
        model = ExposureModel(aperture, GRID, 3, band)
        with torch.no_grad():
            before = model.psf(aberrations())
            move(aperture)
            assert same(model, fresh)
            assert torch.equal(model.psf(aberrations()), fresh.psf(aberrations()))
            assert not torch.allclose(before, model.psf(aberrations()), atol=1e-4)
            aperture.centers.copy_(torch.tensor(HERE, dtype=dtype))  # and back again
            assert torch.equal(model.psf(aberrations()), before)


def test_an_aperture_at_rest_is_sampled_once():
    model = ExposureModel(mask(), GRID, 3)
    assert model.pupil.samples().basis is model.pupil.samples().basis


def test_a_training_aperture_has_a_gradient_and_one_at_rest_has_not():
    aperture = mask(trains=True)
    model = ExposureModel(aperture, GRID, 3)
    model.psf(aberrations()).square().sum().backward()
    assert float(aperture.centers.grad.abs().min()) > 0
    with torch.no_grad():
        assert not model.psf(aberrations()).requires_grad
    assert not ExposureModel(mask(), GRID, 3).psf(aberrations()).requires_grad


def test_samples_with_a_gradient_are_those_without():
    model = ExposureModel(mask(trains=True), GRID, 3)
    training = model.pupil.samples()
    with torch.no_grad():
        for one, other in zip(training, model.pupil.samples(), strict=True):
            assert torch.equal(one, other)


@pytest.mark.parametrize("band", BANDS)
def test_closed_samples_change_nothing_and_are_as_many_everywhere(band):
    model = ExposureModel(mask(), GRID, 3, band)
    places = (torch.tensor(centers, dtype=torch.float64) for centers in (HERE, THERE))
    here, there = (model.pupil.samples_at(centers, with_closed=True) for centers in places)
    assert len(here.weights) == len(there.weights) > len(model.pupil.weights)
    open_samples, z = model.pupil.samples(), aberrations()
    is_open = here.weights > 0
    for of_all, of_open in zip(here, open_samples, strict=True):
        torch.testing.assert_close(of_all[is_open], of_open, rtol=1e-14, atol=0)
    torch.testing.assert_close(model.psf(z, here), model.psf(z), rtol=0, atol=1e-14 * float(model.psf(z).max()))


def test_closed_samples_add_nothing_to_a_gradient():
    """Nor does the weight of 0 by which it has to be divided spoil it."""
    model, z = ExposureModel(mask(), GRID, 3), aberrations()
    image = torch.rand(model.window.field.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    frames, precision = torch.zeros(2, *GRID.shape, dtype=torch.float64), torch.ones(1, 1, 1, dtype=torch.float64)

    def slope(with_closed):
        centers = model.pupil.aperture.centers.clone().requires_grad_()
        samples = model.pupil.samples_at(centers, with_closed=with_closed)
        still = type(samples)(*(values.detach() for values in samples))
        found = data_fidelity(model, image, z, frames, precision, samples=still, want_samples=True)
        given = (found.weight_gradient, found.basis_gradient)
        return torch.autograd.grad((samples.weights, samples.basis), centers, given)[0]

    expected = slope(with_closed=False)
    torch.testing.assert_close(slope(with_closed=True), expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("trains", [False, True])
def test_a_model_that_loads_another_is_that_one(trains):
    """Its mask and its aberration basis; the samples follow, of which nothing is stored."""
    basis = plain_basis(mask(), 3)
    other = ExposureModel(mask(THERE), GRID, type(basis)(torch.linspace(0.5, 2, 9).double().diag(), 3))
    model = ExposureModel(mask(trains=trains), GRID, 3)
    assert set(model.state_dict()) == {"pupil.aperture.centers", "pupil.aberrations.mixing"}
    with torch.no_grad():
        model.psf(aberrations())
        model.load_state_dict(other.state_dict())
        assert same(model, other)
        assert torch.equal(model.psf(aberrations()), other.psf(aberrations()))


def test_another_basis_alone_is_loaded_too():
    """The mask stays where it is, so nothing but the loading itself can tell."""
    model, other = (ExposureModel(mask(), GRID, 3) for _ in range(2))
    other.aberrations.mixing.mul_(2.0)
    model.load_state_dict(other.state_dict())
    torch.testing.assert_close(model.pupil.samples().basis, 2 * ExposureModel(mask(), GRID, 3).pupil.samples().basis)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_precision_of_the_model_is_its_own(dtype):
    """Of a mask in another one, at rest, moved or training."""
    for trains in (False, True):
        aperture = mask(dtype=OTHER_DTYPE[dtype], trains=trains)
        model = ExposureModel(aperture, GRID, 3, dtype=dtype)
        assert model.psf(aberrations()).dtype == dtype
        with torch.no_grad():
            aperture.centers.add_(0.01)
            assert model.psf(aberrations()).dtype == dtype
        expected = ExposureModel(aperture, GRID, 3, dtype=dtype).psf(aberrations())
        torch.testing.assert_close(model.psf(aberrations()), expected)


def test_a_pupil_too_coarse_or_aliased_is_refused():
    with pytest.raises(ValueError, match="spans"):
        ExposureModel(mask(), Grid.nyquist(1.0, 550e-9, 8), 3)
    with pytest.raises(ValueError, match="undersamples an aperture"):
        ExposureModel(mask(), GRID, 3, Band.of((300e-9, 550e-9)))


def test_a_restoration_is_not_advised_to_oversample_which_it_cannot():
    """Its samples are those of a field somewhat wider than the frames: more of them come from wider frames alone."""
    thin = mask().replace(subaperture_diameter=0.07)
    with pytest.raises(ValueError, match=r"at least 2 are needed, so take an image at least 1\.72 times as wide$"):
        ExposureModel(thin, GRID, 3)
    ExposureModel(thin, Grid(math.ceil(1.72 * 32), GRID.pixel_scale, GRID.wavelength), 3)
