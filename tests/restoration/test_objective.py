"""The objective and its fast gradients against automatic differentiation, finite differences and known parts."""

import copy

import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.background import Background
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import EdgePreserving
from torchmask.restoration.state import LEAST_TRANSMISSION, Calibration
from torchmask.restoration.variation import TotalVariation

GRID = Grid((12, 15), 2.3e-7, 550e-9)
THERE = [[0.05, 0.28], [0.21, -0.27], [-0.33, 0.02]]
CALM = Calibration(torch.ones(2).double(), torch.ones(2).double(), 1.0)
BAND = Band.of((500e-9, 550e-9, 610e-9), (1.0, 2.0, 3.0))


def test_gradient_of_common_aberrations_is_that_of_one_variable(three_holes, random_exposures):
    """Central differences in one common aberration of all frames against the sum over frames; the prior counts once."""
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common=4)
    model, image, _, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis))
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    generator = torch.Generator().manual_seed(4)
    z = 0.3 * torch.randn(3, 12, dtype=torch.float64, generator=generator)
    z = basis.with_common_of(z, z[:1])
    ones = torch.ones(3, dtype=torch.float64)
    calibration = Calibration(ones, ones, 0.7)

    def cost(at):
        return float(objective.value_and_gradients(image, at, calibration).value)

    gradient = objective.value_and_gradients(image, z, calibration).aberration_gradient
    assert torch.equal(gradient[:, 8:], gradient[:1, 8:].expand(3, -1))
    for k in range(8, 12):
        step = torch.zeros_like(z)
        step[:, k] = 1e-5
        assert float(gradient[:, k].sum()) == pytest.approx((cost(z + step) - cost(z - step)) / 2e-5, rel=1e-6)
    misfits = [float(data_fidelity(model, image, at, frames, precision).value.sum()) for at in (z, z - z)]
    weight = (cost(z) - misfits[0]) - (cost(z - z) - misfits[1])
    assert weight == pytest.approx(0.5 * float(0.7 * (z[:, :8] ** 2).sum() + (z[0, 8:] ** 2).sum()), rel=1e-9)


@pytest.mark.parametrize("background", [Background.NONE, Background.PER_FRAME, Background.COMMON])
@pytest.mark.parametrize("band", [None, BAND])
def test_an_evaluation_stays_on_its_device(background, band, three_holes, random_exposures, monkeypatch):
    """The meta device stands for any other: it refuses to be mixed with the CPU, and has no values to copy to it."""
    mask = copy.deepcopy(three_holes)  # it moves with the model
    model, image, z, frames, precision = random_exposures(ExposureModel(mask, GRID, 4, band))
    objective = MyopicObjective(model.beside(background), frames, precision, TotalVariation()).to("meta")
    each = torch.ones(3, dtype=torch.float64, device="meta")
    calibration = Calibration(each, each, 0.7)
    image, z = image.to("meta"), z.to("meta")
    monkeypatch.setattr(torch, "equal", lambda one, other: True)  # whether centres have changed, asked once a descent
    found = objective.evaluator(calibration)
    for parts in (found(image, z), objective.object_quadratic(image, z, calibration)):
        assert all(part is None or part.device.type == "meta" for part in parts)
    assert objective.frame_costs(image, z, calibration).device.type == "meta"
    assert objective(image, z, calibration).device.type == "meta"


# --- one value and its gradients, two ways


def calibration_of(n_frames, weight=0.7):
    generator = torch.Generator().manual_seed(6)
    transmission, inflation = (0.5 + torch.rand(n_frames, dtype=torch.float64, generator=generator) for _ in range(2))
    return Calibration(transmission, 1 + inflation, weight)


@pytest.mark.parametrize("band", [None, BAND])
@pytest.mark.parametrize("n_common", [0, 4])
@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-11), (torch.float32, 2e-4)])
def test_forward_and_the_fast_gradients_are_one_function(
    band, n_common, dtype, rounding, three_holes, random_exposures
):
    """With everything that enters: another centre, calibration, pixels left out, several copies of the prior."""
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common)
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis, band, dtype=dtype))
    z = basis.with_common_of(z, z[:1])
    precision[0, :3] = 0
    centre = 0.3 * torch.ones_like(z)
    objective = MyopicObjective(model, frames, precision, TotalVariation(0.5), centre=centre, prior_copies=3)
    for calibration in (None, calibration_of(3), calibration_of(3, weight=0.0)):
        found = objective.value_and_gradients(image, z, calibration)
        leaves = image.clone().requires_grad_(), z.clone().requires_grad_()
        value = objective(*leaves, calibration)
        by_image, by_z = torch.autograd.grad(value, leaves)
        assert value.ndim == 0
        assert value.dtype == torch.float64
        assert float(value.detach()) == pytest.approx(float(found.value), rel=rounding)
        assert float((found.object_gradient - by_image).abs().max()) < rounding * float(by_image.abs().max())
        by_z = basis.mean_common(by_z)  # as of a function of their mean, which keeps them equal
        assert float((found.aberration_gradient - by_z).abs().max()) < rounding * float(by_z.abs().max())


@pytest.mark.parametrize("rows", [1, 2])
def test_a_row_of_aberrations_for_each_frame_is_needed(rows, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    with pytest.raises(ValueError, match=rf"z has shape \({rows}, \d+\) for 3 frames: it must have a row for each"):
        objective(image, z[:rows])


def test_without_a_calibration_it_is_neutral(three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    neutral = objective.neutral_calibration()
    brightness = frames.mean((1, 2))
    torch.testing.assert_close(neutral.transmission, brightness / brightness.mean())
    assert neutral.noise_inflation.tolist() == [1.0] * 3
    assert neutral.aberration_weight == 1
    assert torch.equal(objective(image, z), objective(image, z, neutral))


@pytest.mark.parametrize("light", [0.0, -0.1])
def test_a_frame_of_background_alone_has_the_least_transmission(light, three_holes, random_exposures):
    """None, and noise or a subtracted background may make it negative."""
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    frames[1] = light
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    neutral = objective.neutral_calibration()
    assert float(neutral.transmission[1]) == LEAST_TRANSMISSION
    assert bool(objective.value_and_gradients(image, z).value.isfinite())


def test_the_value_is_the_sum_of_its_parts(three_holes, random_exposures):
    """As the class says, written down once more."""
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    centre, calibration = torch.full_like(z, 0.2), calibration_of(3)
    objective = MyopicObjective(model, frames, precision, TotalVariation(0.5), centre=centre, prior_copies=2)
    transmission, inflation = (
        values[:, None, None] for values in (calibration.transmission, calibration.noise_inflation)
    )
    misfit = (precision / inflation * (transmission * model(image, z) - frames) ** 2).sum() / 2
    hold = 0.7 / 2 * ((z - centre) ** 2).sum()
    expected = misfit + hold + 2 * TotalVariation(0.5)(image)
    torch.testing.assert_close(objective(image, z, calibration), expected, rtol=1e-12, atol=0)
    costs = objective.frame_costs(image, z, calibration)
    assert costs.shape == (3,)
    torch.testing.assert_close(costs.sum(), misfit + hold, rtol=1e-12, atol=0)


def test_of_frames_is_the_objective_of_those(three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    centre, calibration = torch.full_like(z, 0.2), calibration_of(3)
    objective = MyopicObjective(model, frames, precision, TotalVariation(), centre=centre)
    every = objective.frame_costs(image, z, calibration)
    order = torch.tensor([2, 0, 2])
    part = objective.of_frames(order, free=Free.ABERRATIONS)
    assert part.free is Free.ABERRATIONS
    torch.testing.assert_close(part.frame_costs(image, z[order], calibration.of_frames(order)), every[order])
    one_precision = MyopicObjective(model, frames, precision[:1], TotalVariation()).of_frames(slice(1, None))
    assert one_precision.precision.shape == (1, *GRID.shape)
    assert len(one_precision.frames) == len(one_precision.centre) == 2


def test_the_quadratic_in_the_object_is_exact_in_its_gradient_and_over_a_full_field(three_holes, random_exposures):
    """Without a margin the misfit is quadratic in the object, diagonal in frequency: one step reaches any other one."""
    grid = Grid((16, 18), 2.3e-7, 550e-9)
    model = ExposureModel(three_holes, grid, 4, margin=0.0)
    assert model.window.field.shape == grid.shape
    model, image, z, frames, _ = random_exposures(model)
    calibration = calibration_of(3)
    precision = torch.rand(3, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    objective = MyopicObjective(model, frames, precision, TotalVariation(), free=Free.OBJECT)

    def misfit(at):
        return objective.frame_costs(at, z, calibration).sum()

    slope, power = objective.object_quadratic(image, z, calibration)
    change = torch.randn(grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    curved = torch.fft.irfft2(torch.fft.rfft2(change) * power, s=grid.shape)
    expected = misfit(image) + (change * (slope + 0.5 * curved)).sum()
    torch.testing.assert_close(misfit(image + change), expected, rtol=1e-11, atol=0)


def test_what_is_not_free_has_no_gradient(three_holes, random_exposures):
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common=4)
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis))
    z = basis.with_common_of(z, z[:1])
    whole = MyopicObjective(model, frames, precision, TotalVariation())
    everything = whole.value_and_gradients(image, z)
    for free in (Free.OBJECT, Free.ABERRATIONS, Free.COMMON, Free.ABERRATIONS | Free.COMMON):
        found = whole.with_changes(free=free).value_and_gradients(image, z)
        assert float(found.value) == pytest.approx(float(everything.value), rel=1e-14)
        parts = ((Free.OBJECT, 0, slice(None)), (Free.ABERRATIONS, 1, slice(0, 8)), (Free.COMMON, 1, slice(8, 12)))
        for which, place, columns in parts:
            gradient = found[1 + place][:, columns]
            if which in free:
                torch.testing.assert_close(gradient, everything[1 + place][:, columns], rtol=1e-12, atol=1e-12)
            else:
                assert float(gradient.abs().max()) == 0


# --- differentiation by autograd, in the mask too

WIDE = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
SAMPLE = 2.4 / 40  # of the pupil raster [m]: the object's field has 40 pixels
CENTRES = [[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]]
ON_SAMPLES = [[0.0, 5 * SAMPLE], [5 * SAMPLE, -3 * SAMPLE], [-5 * SAMPLE, -2 * SAMPLE]]


def trainable(centers=CENTRES, band=None, prior=None):
    """An objective of 32 x 32 pixels and two frames, with a few coordinates to vary: (function, start).

    Of six pixels of the object, six aberrations and all centres; the rest stays.
    """
    aperture = SparseAperture(nn.Parameter(torch.tensor(centers, dtype=torch.float64)), 0.3, 1.0)
    model = ExposureModel(aperture, WIDE, 3, band)
    generator = torch.Generator().manual_seed(3)
    frames = torch.rand(2, 32, 32, dtype=torch.float64, generator=generator)
    precision = 10 * torch.rand(2, 32, 32, dtype=torch.float64, generator=generator)
    objective = MyopicObjective(model, frames, precision, prior or TotalVariation(1.0, 0.3))
    pixels = torch.tensor([3, 400, 657, 658, 700, 1599])

    def value(some_pixels, some_z, moved, image, z):
        image = image.flatten().index_copy(0, pixels, some_pixels).view(image.shape)
        z = torch.cat([some_z, z[:, 3:]], dim=1)
        return torch.func.functional_call(objective, {"model.pupil.aperture.centers": moved}, (image, z))

    def at(image, z):
        start = image.flatten()[pixels], z[:, :3].clone(), aperture.centers.detach().clone()
        return lambda *some: value(*some, image, z), tuple(part.requires_grad_() for part in start)

    image = torch.rand(model.window.field.shape, dtype=torch.float64, generator=generator)
    z = 0.5 * torch.randn(2, 9, dtype=torch.float64, generator=generator)
    return objective, image, z, at


def test_gradcheck_in_object_aberrations_and_centres():
    _, image, z, at = trainable()
    assert torch.autograd.gradcheck(*at(image, z))


@pytest.mark.parametrize("band", [None, BAND])
def test_gradcheck_in_every_pixel_and_aberration(band):
    """Along random directions, which costs little."""
    objective, image, z, _ = trainable(band=band)
    objective.requires_grad_(False)
    assert torch.autograd.gradcheck(objective, (image.requires_grad_(), z.requires_grad_()), fast_mode=True)


def test_gradcheck_in_the_centres_in_a_broad_band():
    _, image, z, at = trainable(band=BAND)
    assert torch.autograd.gradcheck(*at(image, z), fast_mode=True)


@pytest.mark.parametrize("what", ["zero object", "zero aberrations", "centres on samples", "all of it"])
def test_gradcheck_where_something_is_degenerate(what):
    """Edge-preserving slopes have no direction in a flat object, and a hole's middle none on a sample."""
    centers = ON_SAMPLES if what in ("centres on samples", "all of it") else CENTRES
    _, image, z, at = trainable(centers, prior=EdgePreserving())
    if what in ("zero object", "all of it"):
        image = torch.zeros_like(image)
    if what in ("zero aberrations", "all of it"):
        z = torch.zeros_like(z)
    function, start = at(image, z)
    assert torch.autograd.gradcheck(function, start, fast_mode=True)
    assert all(bool(torch.isfinite(part).all()) for part in torch.autograd.grad(function(*start), start))


def test_gradgradcheck():
    _, image, z, at = trainable()
    assert torch.autograd.gradgradcheck(*at(image, z), fast_mode=True)


# --- a mask that moves


def moved_to(aperture, centers):
    with torch.no_grad():
        aperture.centers.copy_(torch.tensor(centers, dtype=torch.float64))


@pytest.mark.parametrize("trains", [False, True])
def test_a_moved_mask_is_the_objective_built_there(trains):
    """The whitening stays what it was made as; everything else is as if built where the mask is now."""
    centers = torch.tensor(CENTRES, dtype=torch.float64)
    aperture = SparseAperture(nn.Parameter(centers.clone()) if trains else centers.clone(), 0.3, 1.0)
    basis = turbulent_basis(aperture, 3, 0, 0.2, 20.0)
    generator = torch.Generator().manual_seed(3)
    frames = torch.rand(2, 32, 32, dtype=torch.float64, generator=generator)
    image = torch.rand(40, 40, dtype=torch.float64, generator=generator)
    z = torch.randn(2, basis.n_parameters, dtype=torch.float64, generator=generator)

    def objective_of(aperture):
        model = ExposureModel(aperture, WIDE, basis)
        return MyopicObjective(model, frames, torch.ones(1, 1, 1).double(), TotalVariation())

    objective = objective_of(aperture)
    before = objective.value_and_gradients(image, z)
    for move in (
        lambda: moved_to(aperture, ON_SAMPLES),
        lambda: aperture.load_state_dict({"centers": torch.tensor(THERE, dtype=torch.float64)}),
    ):
        move()
        fresh = objective_of(SparseAperture(aperture.centers.detach().clone(), 0.3, 1.0))
        expected = fresh.value_and_gradients(image, z)
        for one, other in zip(objective.value_and_gradients(image, z)[:3], expected[:3], strict=True):
            assert torch.equal(one, other)
        assert torch.equal(objective(image, z), fresh(image, z))
        assert abs(float(expected.value - before.value)) > 1e-6 * float(before.value)  # far above rounding
        assert torch.equal(objective.frame_costs(image, z, CALM), fresh.frame_costs(image, z, CALM))


def test_an_objective_loads_another_ones_mask():
    here, image, z, _ = trainable()
    there, _, _, _ = trainable(THERE)
    before = here(image, z)
    here.load_state_dict(there.state_dict())
    assert torch.equal(here(image, z), there(image, z))
    assert torch.equal(here.value_and_gradients(image, z).value, there.value_and_gradients(image, z).value)
    assert not torch.equal(here(image, z), before)
