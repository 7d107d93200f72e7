"""Visibilities and closure phases of a restored object, and the geometry of baselines and triangles."""

from __future__ import annotations

import itertools
import math
from typing import Protocol

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.observables import Observables
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture
from torchmask.optics.otf import OTF
from torchmask.optics.phasor import phasor
from torchmask.optics.zernike import ZernikePhase

_SAMPLES_PER_HOLE = 8


class Restored(Protocol):
    """Part of a restoration's result that is needed for visibilities; a `RestorationResult` has it.

    object : (H, W) object on the frames' pixels, in the frames' unit
    coefficients : (T, N, J) Zernike coefficients of the frames [rad rms]
    noise : rms noise of a pixel of a frame, in the frames' unit
    chi_square : (T,) mean square of the residuals in units of the noise
    """

    @property
    def object(self) -> Tensor: ...

    @property
    def coefficients(self) -> Tensor: ...

    @property
    def noise(self) -> float: ...

    @property
    def chi_square(self) -> Tensor: ...


def restored_observables(result: Restored, observation: Observation) -> Observables:
    """Return visibilities and closure phases of a restored object, free of the restored aberrations.

    Errors are those by noise if the restored aberrations were exact: the noise of the frames (or the residual of the
    model, if that is larger) over the light that pixels and the transfer functions of the restored coefficients
    transmit in the patch of each baseline. They do not include the effect of the prior and the uncertainty of the
    aberrations, which dominate at high flux.

    Parameters
    ----------
    result : RestorationResult
        Result of a restoration, or another object with the attributes of `Restored`.
    observation : Observation
        Observation that was restored, with its `pixel`.

    Raises
    ------
    ValueError
        If the aperture has fewer than two sub-apertures, or the object is zero or has another shape than the frames.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.optics.detector import Detector
    >>> from torchmask.simulation.exposures import simulate_observation
    >>> star = torch.zeros(64, 64, dtype=torch.float64); star[32, 32] = 1e7  # electrons per frame
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> seen = simulate_observation(star, mask, Grid.nyquist(1.0, 550e-9, 64), None, Detector(), n_frames=4)
    >>> from torchmask.restoration.myopic import MyopicDeconvolution
    >>> method = MyopicDeconvolution(seen.aperture, seen.grid, n_modes=3, max_iterations=20)
    >>> restored_observables(method.restore(seen.frames), seen).vis2.shape
    torch.Size([3])
    """
    aperture, grid = observation.aperture, observation.grid
    pairs, triangles = pairs_and_triangles(aperture)
    scene = result.object.double().cpu()
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"the object has shape {tuple(scene.shape)}: the observation's frames have {grid.shape}")
    light = float(scene.sum())
    if not light > 0:
        raise ValueError("the restored object is zero everywhere: it has no visibilities")
    values = (fringe_waves(aperture, grid, pairs).conj() @ scene.to(torch.complex128).flatten()) / light
    variance = result.noise**2 * max(1.0, float(result.chi_square.mean()))
    noise = variance * math.prod(grid.shape) / (light**2 * _transmitted(result, observation, pairs))
    total, of_light = noise[1:], noise[0]
    power = values.abs() ** 2
    first, second, third = triangle_sides(pairs, triangles)
    triple = values[first] * values[second] * values[third].conj()
    relative = total / power.clamp(min=torch.finfo(power.dtype).tiny) / 2  # of an amplitude's, and a phase's, variance
    sides = torch.nn.functional.one_hot(torch.stack([first, second, third]), len(pairs)).to(relative)
    signs = torch.tensor([1.0, 1.0, -1.0], dtype=relative.dtype)
    amplitudes, phases = sides.sum(0), (signs[:, None, None] * sides).sum(0)  # (C, B), of the logarithm
    return Observables(
        pairs,
        triangles,
        sky_stations(observation),
        values,
        (total / 2).sqrt(),
        power,
        (2 * power * total + total**2).diag() + 4 * of_light * power[:, None] * power,
        triple.angle(),
        (phases * relative) @ phases.T,
        triple.abs(),
        triple.abs()[:, None] * triple.abs() * ((amplitudes * relative) @ amplitudes.T + 9 * of_light),
    )


def pairs_and_triangles(aperture: Aperture) -> tuple[Tensor, Tensor]:
    n = aperture.n_subapertures
    if aperture.centers.ndim != 2 or n < 2:
        raise ValueError(f"the aperture has centres of shape {tuple(aperture.centers.shape)}: give at least two holes")
    pairs = torch.tensor(list(itertools.combinations(range(n), 2)))
    return pairs, torch.tensor(list(itertools.combinations(range(n), 3)), dtype=torch.long).reshape(-1, 3)


def triangle_sides(pairs: Tensor, triangles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the indices of the baselines ij, jk and ik of every triangle; ki is ik reversed."""
    number = {pair: index for index, pair in enumerate(map(tuple, pairs.tolist()))}
    rows = [[number[i, j], number[j, k], number[i, k]] for i, j, k in triangles.tolist()]
    first, second, third = torch.tensor(rows, dtype=torch.long).reshape(-1, 3).unbind(1)
    return first, second, third


def sky_stations(observation: Observation) -> Tensor:
    """Return the holes' centres (N, 2) towards east and north [m], or along columns and rows without sky coordinates.

    With the matrix M from pixels to the sky, nu . x = u . (M x) for u = M^-T nu.
    """
    centers = observation.aperture.centers.detach().double().cpu()
    matrix = observation.sky_matrix
    if matrix is None:
        return centers
    return centers @ torch.linalg.inv(matrix / observation.grid.pixel_scale)


def pixel_positions(grid: Grid) -> Tensor:
    """Return the positions (x, y) of the pixels (P, 2), relative to [H // 2, W // 2]."""
    rows, columns = (torch.arange(n, dtype=torch.float64) - n // 2 for n in grid.shape)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1).flatten(0, 1).flip(-1)


def fringe_waves(aperture: Aperture, grid: Grid, pairs: Tensor) -> Tensor:
    """Return exp(2 pi i nu . x) of every baseline (B, P)."""
    centers = aperture.centers.detach().double().cpu()
    nu = (centers[pairs[:, 1]] - centers[pairs[:, 0]]) / grid.period
    phase = 2 * math.pi * nu @ pixel_positions(grid).T
    return phasor(phase)


def _transmitted(result: Restored, observation: Observation, pairs: Tensor) -> Tensor:
    """Return |OTF|^2 (1 + B,) of pixels and restored aberrations, summed over frames and patches of 0 and baselines."""
    aperture, grid = observation.aperture, observation.grid
    n_modes = result.coefficients.shape[-1]
    samples = _SAMPLES_PER_HOLE * grid.period / (aperture.subaperture_diameter * min(grid.shape))
    oversampling = max(1, math.ceil(samples))
    otf, phase = OTF(aperture, grid, oversampling), ZernikePhase(aperture, grid, n_modes, oversampling)
    power = torch.zeros(grid.shape, dtype=torch.float64)
    with torch.no_grad():
        for coefficients in result.coefficients.to(aperture.centers):
            power += otf(phase(coefficients)).abs().double().cpu() ** 2
    nu_y, nu_x = grid.frequencies(torch.float64)
    if observation.pixel is not None:
        power *= observation.pixel.transfer(nu_y, nu_x).abs() ** 2
    centers = aperture.centers.detach().double().cpu()
    nu = torch.cat([centers.new_zeros(1, 2), centers[pairs[:, 1]] - centers[pairs[:, 0]]]) / grid.period
    reach = grid.cutoff(aperture.subaperture_diameter)
    dx, dy = nu_x - nu[:, 0, None, None], nu_y - nu[:, 1, None, None]
    within = torch.hypot(dx - dx.round(), dy - dy.round()) < reach
    return (power * within).sum((1, 2))
