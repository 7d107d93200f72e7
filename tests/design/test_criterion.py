"""MSE_a against a direct loop over its equation, its derivatives, its limits, and what it refuses."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import hyp2f1
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils._python_dispatch import TorchDispatchMode

from torchmask.design import overlap
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.optics.pixel import SquarePixel
from torchmask.optics.round import disc_constants, disc_patches
from torchmask.optics.shapes import Disc
from torchmask.spectra import NoisePSD, PowerLawPSD

WAVELENGTH = 550e-9
DIAMETER = 0.14  # of a sub-aperture; the masks here have 1 m


def grid_of(n_pixels: int | tuple[int, int], diameter: float = 1.0) -> Grid:
    return Grid.nyquist(diameter, WAVELENGTH, n_pixels)


def criterion_of(grid: Grid, n_photons: float = 1e4, n_frames: int = 5) -> AsymptoticMSE:
    return AsymptoticMSE(grid, PowerLawPSD(1.5, n_photons), NoisePSD(n_photons), n_frames)


def mask_of(centers: Tensor, shape: str = "disc", orientation: float = 0.3) -> SparseAperture:
    return SparseAperture(centers, DIAMETER, 1.0, shape, orientation)


def squared_otf(mask: SparseAperture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """|h|^2 at the displacements x, y [m]: the textbook formula, or the overlap of polygons in general."""
    if mask.shape == Disc():
        rho = np.minimum(np.hypot(x, y) / mask.subaperture_diameter, 1)
        otf = 2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))
    else:
        shift = torch.tensor(np.stack(np.broadcast_arrays(x, y), -1))
        otf = mask.shape.otf(shift, mask.subaperture_diameter).numpy()
    return (otf / mask.n_subapertures) ** 2


def loop_mse(mask: SparseAperture, grid: Grid, s_o: Tensor, s_n: Tensor, n_frames: int) -> float:
    """Equation (1), every ordered pair over the whole grid."""
    centers, n = mask.centers.detach().double().numpy(), mask.n_subapertures
    nu_y, nu_x = (nu.numpy() for nu in grid.frequencies(torch.float64))

    def term(baseline: np.ndarray) -> np.ndarray:
        x, y = nu_x + baseline[0] / grid.period, nu_y + baseline[1] / grid.period
        return squared_otf(mask, (x - np.round(x)) * grid.period, (y - np.round(y)) * grid.period)

    transfer = n**2 * term(np.zeros(2))
    for i in range(n):
        for j in range(n):
            if i != j:
                transfer = transfer + term(centers[i] - centers[j])
    so, sn = s_o.double().numpy(), s_n.double().numpy()
    return float(np.mean(so * sn / (n_frames * so * transfer + sn)))


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def layouts() -> dict[str, Tensor]:
    """Centres [m] for a grid of 2 m period and 32 pixels: one pixel is 1/16 m."""
    disc = (uniform(6, 2) - 0.5) * 0.7
    overlapping = (uniform(5, 2, seed=1) - 0.5) * 0.15
    coincident = torch.cat([disc[:4], disc[1:3]])
    return {
        "random": disc,
        "overlapping": overlapping,
        "wrapped": (uniform(6, 2, seed=2) - 0.5) * 5.0,  # baselines beyond the period
        "coincident": coincident,
        "on pixels": torch.tensor([[0.0, 0.0], [0.25, 0.0], [0.0, 0.25], [-0.3125, 0.125]], dtype=torch.float64),
        # pixels exactly on the edge of an OTF: baselines a whole number of pixels and the diameter apart
        "on the edge": torch.tensor([[0.0, 0.0], [0.25 + DIAMETER, 0.0], [0.0, 0.375 - DIAMETER]], dtype=torch.float64),
        "half the torus": torch.tensor([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]], dtype=torch.float64),
        "one": torch.tensor([[0.2, 0.1]], dtype=torch.float64),
        "two": torch.tensor([[0.2, 0.1], [-0.2, -0.3]], dtype=torch.float64),
    }


LAYOUTS = list(layouts())


def psds(kind: str, shape: tuple[int, int], grid: Grid) -> tuple[Tensor, Tensor]:
    if kind == "power law":
        return PowerLawPSD(1.5, 1e4)(grid), NoisePSD(1e4)(grid)
    s_o = 10 ** (8 * uniform(*shape, seed=3))  # neither smooth nor symmetric
    s_o[1, 2] = 0
    return s_o, 10 ** (1 + 3 * uniform(*shape, seed=4))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
@pytest.mark.parametrize("kind", ["power law", "tensors"])
def test_equals_the_loop_over_its_equation(layout: str, shape: str, kind: str) -> None:
    mask = mask_of(layouts()[layout], shape)
    for n_pixels in (32, 33, (24, 35)):
        grid = grid_of(n_pixels)
        s_o, s_n = psds(kind, grid.shape, grid)
        value = float(AsymptoticMSE(grid, s_o, s_n, 5)(mask))
        # the series of the disc is good to 3e-13, and MSE_a grows more slowly than its terms
        assert value == pytest.approx(loop_mse(mask, grid, s_o, s_n, 5), rel=2e-12)


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_largest_subapertures_fill_the_torus(shape: str, n: int) -> None:
    """c = 1/2: the OTF of one sub-aperture touches itself around the torus."""
    for n_pixels in (16, 17):
        mask = mask_of((uniform(n, 2) - 0.5), shape)
        grid = Grid.nyquist(mask.outer_diameter, WAVELENGTH, n_pixels)
        s_o, s_n = psds("tensors", grid.shape, grid)
        value = float(AsymptoticMSE(grid, s_o, s_n, 3)(mask))
        assert value == pytest.approx(loop_mse(mask, grid, s_o, s_n, 3), rel=2e-12)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(
    n=st.integers(1, 7),
    seed=st.integers(0, 2**31),
    n_pixels=st.tuples(st.integers(4, 40), st.integers(4, 40)),
    spread=st.floats(0.01, 6.0),
    period=st.floats(2.4, 20.0),
    orientation=st.floats(-4.0, 4.0),
    shape=st.sampled_from(["disc", "hexagon"]),
    flux=st.floats(0.0, 8.0),
)
def test_equals_the_loop_for_any_mask_and_grid(
    n: int,
    seed: int,
    n_pixels: tuple[int, int],
    spread: float,
    period: float,
    orientation: float,
    shape: str,
    flux: float,
) -> None:
    grid = Grid(n_pixels, WAVELENGTH / (period * DIAMETER), WAVELENGTH)
    mask = mask_of(spread * (uniform(n, 2, seed=seed) - 0.5), shape, orientation)
    s_o, s_n = 10**flux * uniform(*n_pixels, seed=seed), 1 + uniform(*n_pixels, seed=seed + 1)
    value = float(AsymptoticMSE(grid, s_o, s_n, 2)(mask))
    # the reference itself loses digits where the disc's OTF goes to 0, by 1e-16 / OTF; the flux brings them out
    assert value == pytest.approx(loop_mse(mask, grid, s_o, s_n, 2), rel=1e-11)


@settings(max_examples=20, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31), shape=st.sampled_from(["disc", "hexagon"]))
def test_ignores_the_order_of_holes_and_shifts_and_point_reflections_of_the_mask(seed: int, shape: str) -> None:
    criterion, centers = criterion_of(grid_of(32)), uniform(6, 2, seed=seed) - 0.5
    value = float(criterion(mask_of(centers, shape)))
    for same in (centers.flip(0), centers + torch.tensor([0.31, -0.17]), -centers, centers + torch.tensor([2.0, 4.0])):
        assert float(criterion(mask_of(same, shape))) == pytest.approx(value, rel=1e-12)


def test_series_of_the_disc_is_as_exact_as_it_says() -> None:
    rho = torch.linspace(0, 1, 4001, dtype=torch.float64)[:-1]
    v = 1 - rho.numpy()
    # the textbook OTF without its cancellation at the edge
    exact = 8 * math.sqrt(2) / (3 * math.pi) * v**1.5 * hyp2f1(-0.5, 1.5, 2.5, v / 2)
    textbook = 2 / math.pi * (np.arccos(rho.numpy()) - rho.numpy() * np.sqrt(1 - rho.numpy() ** 2))
    np.testing.assert_allclose(exact, textbook, rtol=0, atol=1e-15)
    for dtype, tolerance in ((torch.float64, 5e-13), (torch.float32, 5e-8)):
        x = rho.to(dtype)[None, :]
        y = torch.zeros(1, 1, dtype=dtype)
        value, _ = disc_patches(x, y, False, disc_constants(dtype, torch.device("cpu")))
        # rounding: of 1 - rho, thrice, and some operations more
        rounding = torch.finfo(dtype).eps * (10 + 3 / v)
        assert bool((abs(value[0].double().numpy() / exact**2 - 1) < tolerance + rounding).all())


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
@pytest.mark.parametrize("kind", ["power law", "tensors"])
def test_gradient_passes_gradcheck(layout: str, shape: str, kind: str) -> None:
    """Also where the formulas are singular: the kink of a cone's tip has derivative 0, as its central difference."""
    grid = grid_of(32)
    s_o, s_n = psds(kind, grid.shape, grid)
    criterion, centers = AsymptoticMSE(grid, s_o, s_n, 5), layouts()[layout]
    orientation = 0.0 if layout == "on pixels" else 0.3  # sides along the pixels
    scale = float(criterion(mask_of(centers, shape, orientation)))

    def loss(c: Tensor) -> Tensor:
        return criterion(mask_of(c, shape, orientation)) / scale

    assert torch.autograd.gradcheck(loss, (centers.requires_grad_(),), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_gradient_is_that_of_every_mask_and_of_any_loss() -> None:
    criterion = criterion_of(grid_of((31, 32)))
    centers = (uniform(3, 5, 2) - 0.5).requires_grad_()
    scale = float(criterion(mask_of(centers.detach())).mean())
    assert torch.autograd.gradcheck(lambda c: (criterion(mask_of(c)) / scale) ** 2, (centers,), atol=1e-6, rtol=1e-5)


def test_gradient_at_coincident_holes_is_finite_and_shared() -> None:
    criterion = criterion_of(grid_of(32))
    centers = layouts()["coincident"].requires_grad_()
    criterion(mask_of(centers)).backward()
    assert centers.grad is not None
    torch.testing.assert_close(centers.grad[1:3], centers.grad[4:6], rtol=1e-10, atol=0)
    assert float(centers.grad.sum(0).norm()) < 1e-12 * float(centers.grad.norm())  # a shift changes nothing


def test_derivative_of_the_gradient_is_refused() -> None:
    centers = (uniform(3, 2) - 0.5).requires_grad_()
    criterion = criterion_of(grid_of(16))
    (gradient,) = torch.autograd.grad(criterion(mask_of(centers)), centers, create_graph=True)
    with pytest.raises(RuntimeError, match="first derivative only"):
        gradient[0, 0].backward()
    with pytest.raises(RuntimeError, match="first derivative only"):
        torch.autograd.functional.hessian(lambda c: criterion(mask_of(c)), centers.detach())


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_float32_follows_within_rounding(shape: str) -> None:
    criterion = criterion_of(grid_of(64), n_photons=1e7, n_frames=20)
    single = (uniform(4, 9, 2).float() - 0.5) * 0.8
    double = single.double().requires_grad_()
    exact = criterion(mask_of(double, shape))
    exact.sum().backward()
    single.requires_grad_()
    value = criterion(mask_of(single, shape))
    value.sum().backward()
    assert value.dtype == torch.float32
    assert single.grad is not None
    assert double.grad is not None
    eps = torch.finfo(torch.float32).eps
    # every centre is rounded by about 2 eps of its size, the rest are some ten roundings of what is summed
    slope = double.grad.abs().sum((-2, -1)) * float(double.detach().abs().max())
    tolerance = eps * (2 * slope + 10 * exact.detach())
    assert bool((tolerance < 1e-4 * exact).all())
    assert bool(((value - exact).abs() < tolerance).all())
    # the gradient has slopes of its own: the cone's, of 1 / c, over its height
    error = (single.grad - double.grad).norm() / double.grad.norm()
    assert float(error) < 20 * eps / criterion.grid.cutoff(DIAMETER)


@pytest.mark.parametrize("chunk", [1, 4000, 2**18])
def test_population_equals_its_masks(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overlap, "_CHUNK", AtATime(chunk, chunk))
    criterion = criterion_of(grid_of((32, 24)))
    centers = (uniform(2, 3, 5, 2) - 0.5).requires_grad_()
    values = criterion(mask_of(centers))
    assert values.shape == (2, 3)
    values.sum().backward()
    assert centers.grad is not None
    for i in range(2):
        for j in range(3):
            one = centers[i, j].detach().clone().requires_grad_()
            value = criterion(mask_of(one))
            assert value.shape == ()
            value.backward()
            assert one.grad is not None
            torch.testing.assert_close(values[i, j], value, rtol=1e-13, atol=0)
            torch.testing.assert_close(centers.grad[i, j], one.grad, rtol=1e-9, atol=1e-12 * float(one.grad.norm()))
    assert criterion(mask_of(torch.zeros(0, 5, 2))).shape == (0,)


class _Sizes(TorchDispatchMode):
    """The largest tensor that comes out of any operation."""

    largest = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, (tuple, list)) else [out]:
            if isinstance(tensor, Tensor):
                self.largest = max(self.largest, tensor.numel())
        return out


def test_memory_is_that_of_a_chunk_of_patches() -> None:
    """The full-grid sum over pairs would hold 190 x 128^2 = 3e6 values for each mask."""
    n, side = 20, 128
    criterion = criterion_of(grid_of(side))

    def largest(population: int) -> int:
        centers = (uniform(population, n, 2) - 0.5).requires_grad_()
        with _Sizes() as sizes:
            criterion(SparseAperture(centers, math.sqrt(0.15 / n), 1.0)).sum().backward()
        return sizes.largest

    assert largest(1) < 4 * (n * (n - 1) / 2 + 1) * (math.sqrt(0.15 / n) * side + 1) ** 2  # four arrays of patches
    assert largest(64) <= 4 * overlap._CHUNK.processor


def test_rotation_changes_little_on_the_reference_grid() -> None:
    """The grid must resolve the cones: the spread over angles is below 0.5 % at 256 pixels, and larger at 64."""
    polar = uniform(2, 11)
    radius, angle = 0.44 * polar[0].sqrt(), 2 * math.pi * polar[1]
    centers = torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
    angles = torch.linspace(0, math.pi / 2, 8, dtype=torch.float64)[:-1]
    turn = torch.stack([angles.cos(), -angles.sin(), angles.sin(), angles.cos()], -1).view(-1, 1, 2, 2)
    turned = (turn @ centers[None, :, :, None])[..., 0]

    def spread(n_pixels: int) -> float:
        values = criterion_of(grid_of(n_pixels), 1e7, 20)(SparseAperture(turned, math.sqrt(0.15 / 11), 1.0))
        return float(values.max() / values.min() - 1)

    assert spread(256) < 0.005
    assert spread(256) < spread(64)


def test_wiener_mse_of_drawn_pistons_is_above_and_tends_to_it() -> None:
    """Jensen, and the law of large numbers: E |OTF|^2 is the sum over baselines of MSE_a."""
    grid = grid_of(24)
    centers = (uniform(5, 2, seed=5) - 0.5) * 0.8
    mask, generator = SparseAperture(centers, 0.2, 1.0), torch.Generator().manual_seed(6)
    s_o, s_n = PowerLawPSD(1.5, 1e3)(grid), NoisePSD(1e3)(grid)

    def excess(n_frames: int) -> tuple[float, float]:
        """Relative excess over the limit, and its standard error."""
        limit, draws = AsymptoticMSE(grid, s_o, s_n, n_frames)(mask), 1600 // n_frames
        pistons = 2 * math.pi * torch.rand(draws, n_frames, 5, generator=generator, dtype=torch.float64)
        ratios = wiener_mse(analytic_otf(mask, grid, pistons), s_o, s_n) / limit
        return float(ratios.mean()) - 1, float(ratios.std()) / math.sqrt(draws)

    one, error = excess(1)
    assert one > 10 * error
    for n_frames in (4, 16):
        more, error = excess(n_frames)
        # of second order in the fluctuation of the mean power over the frames, so it falls as 1 / K in the end
        assert -3 * error < more < 2 * one / n_frames + 3 * error


def test_wiener_mse_is_its_formula() -> None:
    otfs = torch.complex(uniform(2, 3, 8, 9), uniform(2, 3, 8, 9, seed=1))
    s_o, s_n = uniform(8, 9, seed=2), 0.1 + uniform(8, 9, seed=3)
    s_o[0, 0] = 0
    value = wiener_mse(otfs, s_o, s_n)
    assert value.shape == (2,)
    for i in range(2):
        power = sum(abs(otfs[i, k].numpy()) ** 2 for k in range(3))
        expected = np.mean(s_o.numpy() * s_n.numpy() / (s_o.numpy() * power + s_n.numpy()))
        assert float(value[i]) == pytest.approx(expected, rel=1e-13)
    callables = wiener_mse(otfs, PowerLawPSD(1.0, 1e3), NoisePSD(10.0))
    grid = Grid((8, 9), 1.0, 1.0)
    torch.testing.assert_close(callables, wiener_mse(otfs, PowerLawPSD(1.0, 1e3)(grid), NoisePSD(10.0)(grid)))
    assert wiener_mse(otfs.to(torch.complex64), s_o, s_n).dtype == torch.float32


def test_wiener_mse_differentiates_in_otfs_and_power_spectra() -> None:
    """Also where the object has no power, or the OTFs none."""
    otfs = torch.complex(uniform(2, 3, 4) - 0.5, uniform(2, 3, 4) - 0.5)
    otfs[:, 1, 2] = 0
    otfs.requires_grad_()
    s_o, s_n = uniform(3, 4).add(0.5).requires_grad_(), torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(wiener_mse, (otfs, s_o, s_n))
    dark = torch.zeros(3, 4, dtype=torch.float64, requires_grad=True)
    wiener_mse(otfs, dark, s_n).backward()
    torch.testing.assert_close(dark.grad, torch.full_like(dark, 1 / 12))  # all that is not seen is error


def test_wiener_mse_without_noise_is_what_no_light_arrives_of() -> None:
    """Dark frequencies keep the object's power, those without an object have no error, and slopes are finite."""
    otfs = torch.ones(2, 4, 4, dtype=torch.float64)
    otfs[:, 1, 2] = otfs[:, 3, 0] = 0
    s_o = 5 + uniform(4, 4)
    s_o[3, 0] = s_o[2, 2] = 0
    otfs.requires_grad_()
    value = wiener_mse(otfs, s_o, torch.tensor(0.0))
    assert float(value.detach()) == pytest.approx(float(s_o[1, 2]) / 16, rel=1e-15)
    value.backward()
    assert float(otfs.grad.abs().max()) == 0


def test_more_frames_or_photons_restore_better() -> None:
    grid, mask = grid_of(32), mask_of(layouts()["random"])
    frames = [float(criterion_of(grid, n_frames=k).relative(mask)) for k in (1, 2, 10, 100)]
    photons = [float(criterion_of(grid, n_photons=f).relative(mask)) for f in (1e2, 1e3, 1e5, 1e9)]
    for values in (frames, photons):
        assert values[0] < 1
        assert values == sorted(values, reverse=True)
        assert values[-1] > 0


def test_floor_of_the_reference_case() -> None:
    criterion = criterion_of(grid_of(256), 1e7, 20)
    assert criterion.relative_floor(1.0) == pytest.approx(0.063, abs=5e-4)


def test_floor_is_what_remains_without_noise() -> None:
    """One sub-aperture as large as the mask lets every frequency through that any mask of this size does."""
    grid = grid_of((48, 64), diameter=1.3)
    noise = 1e-12
    criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e4), torch.tensor(noise, dtype=torch.float64), 1)
    floor, value = float(criterion.floor(1.0)), float(criterion(SparseAperture([[0.0, 0.0]], 1.0, 1.0)))
    assert floor == pytest.approx(value, rel=1e-6)
    assert floor <= value
    sparse = mask_of((uniform(20, 6, 2) - 0.5) * (1 - DIAMETER) / math.sqrt(2))
    assert bool((criterion(sparse) > floor).all())


def test_other_grid_keeps_the_noise_of_the_image() -> None:
    fine = AsymptoticMSE(grid_of(64), PowerLawPSD(1.5, 1e5), NoisePSD(1e4, 3.0), 5)
    coarse = fine.on_grid((24, 33))
    assert coarse.grid == Grid((24, 33), fine.grid.pixel_scale, WAVELENGTH)
    level = 1e4 + 64 * 64 * 9.0
    assert torch.equal(coarse.noise_psd, torch.full((24, 33), level, dtype=torch.float64))
    assert torch.equal(coarse.object_psd, PowerLawPSD(1.5, 1e5)(coarse.grid))
    again = coarse.on_grid(64)
    mask = mask_of(layouts()["random"])
    assert float(again(mask)) == float(fine(mask))
    assert float(coarse.relative(mask)) == pytest.approx(float(fine.relative(mask)), rel=0.2)


def test_other_grid_resamples_tensors() -> None:
    s_o, s_n = psds("tensors", (64, 64), grid_of(64))
    coarse = AsymptoticMSE(grid_of(64), s_o, s_n, 5).on_grid(32)
    assert torch.equal(coarse.object_psd, s_o[::2, ::2])
    assert torch.equal(coarse.noise_psd, s_n[::2, ::2])


def test_state_survives_saving_copying_and_conversion() -> None:
    grid, mask = grid_of(32), mask_of(layouts()["random"])
    s_o, s_n = psds("tensors", grid.shape, grid)
    source, target = AsymptoticMSE(grid, s_o, s_n, 5), criterion_of(grid)
    value = float(source(mask))
    assert set(source.state_dict()) == {"object_psd", "noise_psd"}
    assert float(target(mask)) != pytest.approx(value, rel=0.01)
    target.load_state_dict(source.state_dict())
    assert float(target(mask)) == value
    assert torch.equal(target.on_grid(16).object_psd, s_o[::2, ::2])  # not the constructor's model
    for other in (copy.deepcopy(source), pickle.loads(pickle.dumps(source))):
        assert float(other(mask)) == value
    assert float(copy.deepcopy(source).float()(mask)) == pytest.approx(value, rel=1e-5)
    same = criterion_of(grid)
    same.load_state_dict(criterion_of(grid).state_dict())
    assert torch.equal(same.on_grid(24).object_psd, PowerLawPSD(1.5, 1e4)(grid_of(24)))


@pytest.mark.parametrize("kind", [AsymptoticMSE, partial(TurbulentMSE, r0=0.3, pixel=SquarePixel())])
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_values_follow_what_is_changed(kind: Any, mode: Any) -> None:
    grid, mask = grid_of(16), mask_of(layouts()["random"])
    s_o, s_n = psds("tensors", grid.shape, grid)

    def values(criterion: AsymptoticMSE) -> list[float]:
        return [float(criterion(mask)), float(criterion.relative(mask)), float(criterion.jensen_term(mask))]

    expected = values(kind(grid, 100 * s_o, 7 * s_n, 50))
    with mode():
        criterion = kind(grid, s_o, s_n, 5)
        before = values(criterion)
        state = {"object_psd": 100 * criterion.object_psd, "noise_psd": 7 * criterion.noise_psd}
        criterion.n_frames = 50
        for _ in range(2):
            assert [float(functional_call(criterion, state, mask))] == pytest.approx(expected[:1], rel=1e-13)
        criterion.n_frames = 5
        assert values(criterion) == before
        criterion.object_psd.mul_(100)
        copied = copy.deepcopy(criterion)  # before it is called again
        criterion.n_frames = copied.n_frames = 50
        for other in (criterion, copied):
            other.noise_psd *= 7
            assert values(other) == pytest.approx(expected, rel=1e-13)
        assert float(criterion.on_grid(8)(mask)) == float(kind(grid, 100 * s_o, 7 * s_n, 50).on_grid(8)(mask))


def test_another_grid_has_the_present_power_spectra() -> None:
    criterion, mask = criterion_of(grid_of(32)), mask_of(layouts()["random"])
    criterion.float().double()
    coarse = criterion.on_grid(24).object_psd
    torch.testing.assert_close(coarse, PowerLawPSD(1.5, 1e4)(grid_of(24)), rtol=1e-14, atol=0)  # not interpolated
    criterion.object_psd.mul_(100)
    assert torch.equal(criterion.on_grid(16).object_psd, criterion.object_psd[::2, ::2])
    assert float(criterion.on_grid(32)(mask)) == float(criterion(mask))


def test_a_number_of_frames_that_cannot_be_is_refused_when_it_is_used() -> None:
    criterion = criterion_of(grid_of(16))
    criterion.n_frames = 0
    with pytest.raises(ValueError, match="n_frames is 0"):
        criterion(mask_of(layouts()["random"]))


def test_power_spectra_that_require_a_gradient_are_refused_in_a_call() -> None:
    criterion, mask = criterion_of(grid_of(16)), mask_of(layouts()["random"])
    noise = criterion.noise_psd.clone().requires_grad_()
    with pytest.raises(ValueError, match="a PSD requires a gradient"):
        functional_call(criterion, {"noise_psd": noise}, mask)
    with torch.no_grad():
        assert float(functional_call(criterion, {"noise_psd": noise}, mask)) == float(criterion(mask))


def test_buffers_take_no_gradient_of_a_power_spectrum_that_trains() -> None:
    psd = PowerLawPSD(1.5, 1e4)(grid_of(16)).requires_grad_()
    criterion = AsymptoticMSE(grid_of(16), psd, psd / 1e4, 20)
    assert not any(buffer.requires_grad for buffer in criterion.buffers())
    assert not criterion(mask_of(layouts()["random"])).requires_grad


def test_an_ordinary_optimiser_improves_a_mask() -> None:
    criterion = criterion_of(grid_of(64), 1e7, 20)
    centers = nn.Parameter((uniform(6, 2) - 0.5) * 0.5)
    mask = SparseAperture(centers, 0.15, 1.0)
    start = float(criterion.relative(mask).detach())
    optimiser = torch.optim.Adam(mask.parameters(), lr=0.01)
    for _ in range(60):
        optimiser.zero_grad()
        criterion.relative(mask).backward()
        optimiser.step()
    assert mask.centers is centers
    assert float(criterion.relative(mask).detach()) < 0.8 * start


def test_diverged_centres_give_nan_and_no_crash() -> None:
    criterion = criterion_of(grid_of((17, 19)))
    centers = uniform(3, 4, 2) - 0.5
    mask = mask_of(centers.clone())
    mask.centers[1, 2, 0] = math.nan
    mask.centers[2, 0, 1] = math.inf
    values = criterion(mask)
    assert float(values[0]) == float(criterion(mask_of(centers[0])))
    assert bool(values[1:].isnan().all())


def test_inference_mode_leaves_nothing_behind() -> None:
    criterion = criterion_of(grid_of(18))
    centers = uniform(4, 2) - 0.5
    with torch.inference_mode():
        value = float(criterion(mask_of(centers)))
    centers.requires_grad_()
    trained = criterion(mask_of(centers))
    trained.backward()
    assert float(trained.detach()) == value


@pytest.fixture
def fresh_compiler() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


@pytest.mark.usefixtures("fresh_compiler")
@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # by torch.compile itself
@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_compiles_to_one_graph(shape: str) -> None:
    criterion = criterion_of(grid_of(16))
    compiled = torch.compile(criterion, backend="eager", fullgraph=True)
    centers = (uniform(2, 4, 2) - 0.5).requires_grad_()
    values, gradients = [], []
    for function in (criterion, compiled):
        value = function(mask_of(centers, shape))
        values.append(value.detach())
        gradients += torch.autograd.grad(value.sum(), centers)
    torch.testing.assert_close(values[1], values[0], rtol=1e-13, atol=0)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-9, atol=0)
    criterion.noise_psd.mul_(7)
    torch.testing.assert_close(
        compiled(mask_of(centers, shape)), criterion(mask_of(centers, shape)), rtol=1e-13, atol=0
    )


def test_pupils_without_closed_form_are_refused() -> None:
    criterion = criterion_of(grid_of(16))
    for pupil in (FullAperture(1.0), FullAperture(1.0, 0.3)):
        with pytest.raises(ValueError, match=r"SparseAperture.*wiener_mse"):
            criterion(pupil)
    with pytest.raises(TypeError, match="Tensor: make a SparseAperture"):
        criterion(torch.zeros(3, 2))


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_subapertures_whose_otf_overlaps_itself_are_refused(shape: str) -> None:
    outer = 1.0 if shape == "disc" else 2 / math.sqrt(3)
    grid = Grid(16, WAVELENGTH / (1.99 * outer), WAVELENGTH)
    mask = SparseAperture([[0.0, 0.0]], 1.0, 1.0, shape)
    with pytest.raises(ValueError, match="pixel_scale must be at most") as refused:
        criterion_of(grid)(mask)
    needed = float(str(refused.value).split("at most ")[1].split()[0])
    assert float(criterion_of(Grid(16, needed * 0.9999, WAVELENGTH)).relative(mask)) < 1


def test_half_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="float32 or float64"):
        criterion_of(grid_of(16))(mask_of(torch.zeros(3, 2, dtype=torch.bfloat16)))


@pytest.mark.parametrize("n_frames", [0, -1, 1.5, math.nan, math.inf])
def test_numbers_of_frames_that_are_none_are_refused(n_frames: float) -> None:
    with pytest.raises(ValueError, match="n_frames"):
        AsymptoticMSE(grid_of(16), PowerLawPSD(1.5, 1.0), NoisePSD(1.0), n_frames)  # type: ignore[arg-type]


def test_a_grid_beyond_the_memory_is_refused() -> None:
    grid = Grid.nyquist(1.0, 550e-9, 10**8)
    with pytest.raises(ValueError, match=r"n_pixels is 100000000: that takes at least .* enough for \d+ at most"):
        AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20)


def test_impossible_psds_are_refused() -> None:
    one, grid = torch.ones(16, 16), grid_of(16)
    for s_o, s_n, message in (
        (one[:5], one, "object_psd has shape"),
        (one, one[:, :5], "noise_psd has shape"),
        (-one, one, "object_psd holds negative"),
        (one, one * math.nan, "noise_psd holds negative or non-finite"),
        (one, one * 0, "noise_psd is 0"),
        (one * 0, one, "object_psd is 0 everywhere"),
    ):
        with pytest.raises(ValueError, match=message):
            AsymptoticMSE(grid, s_o, s_n, 1)
    with pytest.raises(TypeError, match="object_psd is a float"):
        AsymptoticMSE(grid, 1.0, one, 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="mask_diameter"):
        criterion_of(grid).floor(0.0)
    with pytest.raises(ValueError, match="frame"):
        wiener_mse(torch.ones(8, 8), one[:8, :8], one[:8, :8])


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_works_on_the_device_of_the_centres(shape: str) -> None:
    """The meta device stands for any other: it refuses to be mixed with the CPU."""
    criterion = criterion_of(grid_of(16)).to("meta")
    mask = mask_of(nn.Parameter(uniform(3, 4, 2) - 0.5), shape)
    with pytest.raises(ValueError, match="must be on one device"):
        criterion(mask)
    value = criterion.relative(mask.to("meta"))
    value.sum().backward()
    assert (value.device.type, value.shape) == ("meta", (3,))
    assert mask.centers.grad is not None
    assert mask.centers.grad.device.type == "meta"


def test_a_first_call_under_another_default_device_makes_nothing_there():
    """Of a geometry that no other test has, as its indices are kept."""
    criterion = criterion_of(grid_of(22))
    for shape in ("disc", "hexagon", "square"):
        mask = SparseAperture([[-0.2, 0.1], [0.2, 0.0]], 0.1234, 1.0, shape)
        with torch.device("meta"):
            value = criterion(mask)
        overlap.cached_plan.cache_clear()
        assert torch.equal(value, criterion(mask))
