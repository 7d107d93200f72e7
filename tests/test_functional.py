"""Laws of torch.func: what is mapped equals a loop, and reverse Jacobians equal autograd's, from pupil to error."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, grad, jacrev, vmap

from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.overlap import baseline_mse
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import OTF, analytic_otf
from torchmask.optics.psf import PSF
from torchmask.optics.zernike import ZernikePhase
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, 16)
CRITERION = AsymptoticMSE(GRID, PowerLawPSD(1.5, 1e4), NoisePSD(1e4), n_frames=5)
TURBULENT = TurbulentMSE(GRID, PowerLawPSD(1.5, 1e4), NoisePSD(1e4), n_frames=5, r0=0.2)
SIZE = {"subaperture_diameter": 0.3, "mask_diameter": 1.0}


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


CENTERS = 0.6 * (uniform(4, 3, 2) - 0.5)
MASK = SparseAperture(CENTERS[0], **SIZE, shape="hexagon", orientation=0.2)
PISTONS = 3 * uniform(4, 3, seed=1)


def pistons_on_samples(pistons: Tensor) -> Tensor:
    return pistons[:, None].expand(-1, PSF(MASK, GRID).samples().weights.shape[-1])


# what depends on centres (3, 2), with every shape that has its own way to the derivative
OF_CENTERS: dict[str, Callable[[Tensor], Tensor]] = {
    "PSF": lambda c: PSF(SparseAperture(c, **SIZE), GRID)(),
    "OTF": lambda c: OTF(SparseAperture(c, **SIZE, shape="hexagon"), GRID)().real,
    "closed OTF of discs": lambda c: analytic_otf(SparseAperture(c, **SIZE), GRID, PISTONS[0]).real,
    "closed OTF of hexagons": lambda c: analytic_otf(SparseAperture(c, **SIZE, shape="hexagon"), GRID).real,
    "MSE_a of discs": lambda c: CRITERION(SparseAperture(c, **SIZE)),
    "MSE_a of hexagons": lambda c: CRITERION(SparseAperture(c, **SIZE, shape="hexagon")),
    "MSE_a of squares": lambda c: CRITERION(SparseAperture(c, **SIZE, shape="square")),
    "MSE under turbulence": lambda c: TURBULENT(SparseAperture(c, **SIZE)),
    "relative MSE_a of a population": lambda c: CRITERION.relative(SparseAperture(torch.stack([c, 2 * c]), **SIZE)),
    "Wiener error": lambda c: wiener_mse(
        analytic_otf(SparseAperture(c, **SIZE), GRID, PISTONS), CRITERION.object_psd, CRITERION.noise_psd
    ),
}
# what depends on one piston a hole (3,)
OF_PISTONS: dict[str, Callable[[Tensor], Tensor]] = {
    "PSF": lambda p: PSF(MASK, GRID)(pistons_on_samples(p)),
    "OTF": lambda p: OTF(MASK, GRID)(pistons_on_samples(p)).imag,
    "closed OTF": lambda p: analytic_otf(MASK, GRID, p).imag,
    "Zernike phase": lambda p: ZernikePhase(MASK, GRID, 2)(torch.stack([p, p**2], -1)),
}
CASES = [(f, CENTERS) for f in OF_CENTERS.values()] + [(f, PISTONS) for f in OF_PISTONS.values()]
each_case = pytest.mark.parametrize(
    ("function", "inputs"), CASES, ids=[f"{n} of centres" for n in OF_CENTERS] + [f"{n} of pistons" for n in OF_PISTONS]
)


def jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """By plain autograd, row by row."""
    at = at.clone().requires_grad_()
    value = function(at)
    rows = [torch.autograd.grad(one, at, retain_graph=True)[0] for one in value.flatten()]
    return torch.stack(rows).reshape(*value.shape, *at.shape)


def close(value: Tensor, expected: Tensor) -> None:
    """Equal but for the order of sums."""
    scale = float(expected.detach().abs().max())
    torch.testing.assert_close(value, expected, rtol=1e-11, atol=1e-12 * scale)


@each_case
def test_mapped_equals_the_loop(function, inputs):
    expected = torch.stack([function(one) for one in inputs])
    close(vmap(function)(inputs), expected)
    close(vmap(function, in_dims=1)(inputs.movedim(0, 1)), expected)
    close(vmap(function, chunk_size=2)(inputs), expected)


@each_case
def test_jacobians_equal_those_of_autograd(function, inputs):
    close(jacrev(function)(inputs[0]), jacobian(function, inputs[0]))


@each_case
def test_gradients_are_mapped_and_mapped_functions_differentiated(function, inputs):
    def loss(x: Tensor) -> Tensor:
        return function(x).square().mean()

    expected = torch.stack([jacobian(loss, one) for one in inputs])
    close(vmap(grad(loss))(inputs), expected)
    close(grad(lambda x: vmap(loss)(x).sum())(inputs), expected)
    leaf = inputs.clone().requires_grad_()
    vmap(loss)(leaf).sum().backward()
    close(leaf.grad, expected)


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_maps_may_be_nested(shape):
    population = 0.6 * (uniform(2, 3, 4, 2, seed=2) - 0.5)
    nested = vmap(vmap(lambda c: CRITERION(SparseAperture(c, 0.2, 1.0, shape))))(population)
    close(nested, CRITERION(SparseAperture(population, 0.2, 1.0, shape)))


def test_the_axis_that_is_mapped_may_be_any():
    """The node of autograd itself, which the criterion always gives the mapped axis first."""
    mask = SparseAperture(CENTERS, **SIZE)
    geometry = CRITERION._geometry(mask)
    population = torch.stack([CENTERS, 0.5 * CENTERS], dim=1)  # (masks, maps, N, 2)

    def values(centers: Tensor) -> Tensor:
        return baseline_mse(centers, *CRITERION._layers(), geometry)

    mapped = vmap(values, in_dims=1, out_dims=1)(population)
    close(mapped, torch.stack([values(CENTERS), values(0.5 * CENTERS)], dim=1))


def test_modules_are_called_with_other_states():
    model = PSF(MASK, GRID)
    images = vmap(lambda c: functional_call(model, {"aperture.centers": c}, ()))(CENTERS)
    close(images, torch.stack([PSF(MASK.replace(centers=c), GRID)() for c in CENTERS]))
    phase, coefficients = ZernikePhase(MASK, GRID, 3), uniform(3, 3, seed=3)
    phases = vmap(lambda c: functional_call(phase, {"aperture.centers": c}, (coefficients,)))(CENTERS)
    close(phases, torch.stack([ZernikePhase(MASK.replace(centers=c), GRID, 3)(coefficients) for c in CENTERS]))


def test_a_second_derivative_of_mse_a_is_refused_under_torch_func_too():
    with pytest.raises(RuntimeError, match="first derivative only"):
        jacrev(jacrev(OF_CENTERS["MSE_a of discs"]))(CENTERS[0])


def test_only_masks_are_mapped_over():
    object_psd = CRITERION.object_psd.expand(2, *CRITERION.object_psd.shape)
    with pytest.raises(ValueError, match="runs over the centres"):
        vmap(lambda psd: functional_call(CRITERION, {"object_psd": psd}, (MASK,)))(object_psd)
    weight, ratio = CRITERION._layers()
    with pytest.raises(ValueError, match="runs over the centres"):
        vmap(lambda w: baseline_mse(CENTERS, w, ratio, CRITERION._geometry(MASK)))(weight.expand(2, *weight.shape))
