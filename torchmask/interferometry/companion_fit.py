"""Joint fit of star, companion, aberrations, blur and background to all exposures, by Gauss-Newton steps.

Aberrations that could be mistaken for a companion are fitted with it, so its error includes that ambiguity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.interferometry.companion import OWN_MODES, CompanionModel, Exposures, Parameters
from torchmask.interferometry.companion_equations import BLUR, LeastSquares
from torchmask.record import Brief, Callback, Record

STEPS = 40  # maximum number of Gauss-Newton steps
TOLERANCE = 0.1  # decrease of the squared residuals at which the fit ends: far below the error bars
_HALVINGS = 6  # maximum number of halvings of a step that makes the fit worse
_CORE = 3  # pixels to each side of the middle within which the star is first sought


@dataclass(frozen=True, eq=False, repr=False)
class CompanionFit(Brief):
    """Result of a fit.

    parameters : best-fitting parameters
    covariance : (3, 3) covariance of the companion, scaled by the residuals; 0 if none was fitted
    images : (T, H, W) model of the exposures [electrons]
    chi_square : (T,) mean squared residual of the pixels compared
    jackknife : (T, 3) companion with each of the exposures left out, to first order
    """

    parameters: Parameters
    covariance: Tensor
    images: Tensor
    chi_square: Tensor
    jackknife: Tensor

    @property
    def companion(self) -> Tensor:
        """Contrast, east and north [rad] of the companion (3,)."""
        return self.parameters.companion


def fit_companion(
    model: CompanionModel,
    exposures: Exposures,
    companion: Tensor | None = None,
    start: Parameters | None = None,
    steps: int = STEPS,
    callback: Callback | None = None,
) -> CompanionFit:
    """Fit a star to its exposures, or a star and its companion if an estimate of the companion is given.

    Parameters
    ----------
    model : CompanionModel
        Model of the exposures.
    exposures : Exposures
        Exposures to fit.
    companion : (3,) tensor, optional
        Initial contrast, east and north [rad], within about half a resolution element of the truth, such as from
        `search_companions`. None: fit the star alone.
    start : Parameters, optional
        Initial parameters from an earlier fit to the same exposures; its companion is ignored. None: no aberrations.
    steps : int
        Maximum number of Gauss-Newton steps; a step that makes the fit worse is halved.
    callback : callable, optional
        Called with a `Record` of stage "fit" after each step.

    Raises
    ------
    ValueError
        If the exposures do not have the model's shape, or are narrower than 7 pixels.

    Examples
    --------
    A companion of 5 %, two pixels to the east and one to the north, without noise: the star alone, a search on a
    raster, and both together.

    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.optics.band import Band
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> grid = Grid.nyquist(1.0, 550e-9, 24)
    >>> model = CompanionModel(mask, grid, n_modes=3, band=Band.of([550e-9]), radius=10.0)
    >>> sky = torch.tensor([[[0.0, 1.0], [-1.0, 0.0]]], dtype=torch.float64) / grid.pixel_scale  # east is left
    >>> truth = torch.tensor([0.05, 2 * grid.pixel_scale, grid.pixel_scale], dtype=torch.float64)
    >>> own = torch.tensor([[1e7, 0.0, 12.0, 12.0] + 9 * [0.0]], dtype=torch.float64)
    >>> frames = model.images(Parameters(own.new_zeros(9), own.new_full((2,), 0.1), own, truth), sky)
    >>> shots = Exposures(frames, torch.full_like(frames, 10.0), frames > -1, sky)
    >>> star = fit_companion(model, shots)
    >>> line = torch.arange(-3, 4) * grid.pixel_scale
    >>> offsets = torch.cartesian_prod(line, line).double()
    >>> contrast, error = search_companions(model, shots, star, offsets)
    >>> best = int((contrast / error).argmax())
    >>> found = fit_companion(model, shots, torch.cat([contrast[best, None], offsets[best]]), star.parameters)
    >>> torch.allclose(found.companion, truth, rtol=1e-3, atol=0)
    True
    """
    if exposures.frames.shape[1:] != model.grid.shape or min(model.grid.shape) <= 2 * _CORE:
        raise ValueError(
            f"the exposures have {tuple(exposures.frames.shape[1:])} pixels and the model {model.grid.shape}: they "
            f"must be alike, and more than {2 * _CORE} to a side"
        )
    problem = LeastSquares(model, exposures, free=companion is not None)
    found = _first_guess(model, exposures) if start is None else start
    found = replace(found, companion=torch.zeros(3, dtype=torch.float64) if companion is None else companion.double())
    cost = problem.cost(found)
    for step in range(steps):
        before = cost
        change = problem.normal_equations(found).solve()
        for _ in range(_HALVINGS):
            moved = problem.move(found, change)
            new_cost = problem.cost(moved)
            if new_cost < cost:
                found, cost = moved, new_cost
                break
            change = change / 2
        if callback is not None:
            callback(Record("fit", step + 1, steps, {"cost": cost}))
        if before - cost < TOLERANCE:
            break
    return _summarise(problem, found)


def search_companions(
    model: CompanionModel, exposures: Exposures, fit: CompanionFit, offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the contrast of a companion at each of `offsets` (M, 2) [rad], and its standard error, (M,) each.

    The model is linearised about `fit`, and all parameters but a companion that `fit` already has are refitted. If it
    has one, a second companion is searched for.

    The example of `fit_companion` searches before it fits.
    """
    problem = LeastSquares(model, exposures, free=False)
    normal = problem.normal_equations(fit.parameters)
    weights, own = model.root_weights(exposures), fit.parameters.own
    aligned = torch.zeros(len(offsets), dtype=torch.float64)
    power = torch.zeros_like(aligned)
    crossed = torch.zeros(normal.vectors.shape[1], len(offsets), dtype=torch.float64)
    for t, weight in enumerate(weights):
        residual, jacobian = problem.linearise(fit.parameters, t)
        shifted = model.moved(fit.images[t] - own[t, 1], offsets @ exposures.to_pixels[t].T)
        template = (shifted * weight)[:, model.near]  # (M, pixels)
        aligned += template @ residual
        power += (template**2).sum(1)
        crossed[problem.places(fit.parameters, t)] += jacobian.T @ template.T
    variance = 1 / (power - (crossed * normal.solve_for(crossed)).sum(0))
    contrast = variance * (aligned - normal.solve() @ crossed)
    return contrast, (variance * max(1.0, float(fit.chi_square.mean()))).sqrt()


def unexplained_flux(model: CompanionModel, exposures: Exposures, fit: CompanionFit) -> float:
    """Return the fraction of a pixel's flux that, added to its noise, explains the residuals of `fit`; at most 1."""
    near = exposures.valid & model.near
    squares = ((exposures.frames - fit.images) ** 2)[near]
    noise, flux = (exposures.errors**2)[near], exposures.frames.clamp(min=0)[near]
    low, high = 0.0, 1.0
    for _ in range(40):  # bisection
        middle = (low + high) / 2
        explained = float((squares / (noise + (middle * flux) ** 2)).mean())
        low, high = (middle, high) if explained > 1 else (low, middle)
    return high


def _first_guess(model: CompanionModel, exposures: Exposures) -> Parameters:
    """Return initial parameters without aberrations, with flux and centroid from the pixels around the middle."""
    middle = [n // 2 for n in model.grid.shape]
    rows, columns = (slice(m - _CORE, m + _CORE + 1) for m in middle)
    own = torch.zeros(len(exposures.frames), 4 + model.n_subapertures * OWN_MODES, dtype=torch.float64)
    light = torch.where(exposures.valid, exposures.frames, 0.0).clamp(min=0)
    core = light[:, rows, columns]
    ramp = torch.arange(-_CORE, _CORE + 1, dtype=torch.float64)
    own[:, 0] = light.sum((1, 2))
    own[:, 2] = middle[0] + (core.sum(2) * ramp).sum(1) / core.sum((1, 2))
    own[:, 3] = middle[1] + (core.sum(1) * ramp).sum(1) / core.sum((1, 2))
    static = torch.zeros(model.n_subapertures * model.n_modes, dtype=torch.float64)
    return Parameters(static, static.new_full((2,), BLUR), own, static.new_zeros(3))


def _summarise(problem: LeastSquares, at: Parameters) -> CompanionFit:
    """Return the fit that ends at these parameters, with its errors."""
    n, exposures, model = len(at.own), problem.exposures, problem.model
    images = model.images(at, exposures.to_pixels)
    residual = (exposures.frames - images) * model.root_weights(exposures)
    chi_square = (residual**2).sum((1, 2)) / (exposures.valid & model.near).sum((1, 2))
    covariance, jackknife = torch.zeros(3, 3, dtype=torch.float64), at.companion.expand(n, 3)
    if problem.free:
        normal = problem.normal_equations(at)
        corner = torch.eye(normal.vectors.shape[1], dtype=torch.float64)[:, -3:]
        covariance = normal.solve_for(corner)[-3:] * max(1.0, float(chi_square.mean()))
        if n > 1:
            jackknife = torch.stack([at.companion + normal.solve(leave_out=t)[-3:] for t in range(n)])
    return CompanionFit(at, covariance, images, chi_square, jackknife)
