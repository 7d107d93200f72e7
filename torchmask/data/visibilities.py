"""What an interferometer measures, for every baseline and triangle of a mask: from frames, or from a restored object.

Signs, as in OIFITS (Pauls et al. 2005, PASP 117, 1255; Duvert et al. 2017, A&A 597, A8): the visibility of a brightness
I(E, N), east and north in radians, on the baseline (u, v) metres is

    V = integral I exp(-2 pi i (u E + v N) / wavelength) / integral I,

(u, v) of the pair (i, j) is centre j minus centre i, turned from the axes of the image to those of the sky, and the
closure phase of the triangle (i, j, k) is arg(V_ij V_jk V_ki).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.data.keywords import pixel_matrix
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.otf import OTF, subaperture_otf
from torchmask.optics.zernike import ZernikePhase
from torchmask.restoration.initialization import check_frames
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.observation import Observation

_FIELD = 4  # the envelope of the fringes is computed on a field this many times as wide, against its wrap-around
_WORST_CONDITION = 1e6  # of the normal equations of the fringes


@dataclass(frozen=True, eq=False)
class Observables:
    """Visibilities of B = N (N - 1) / 2 baselines and closure phases of C = N (N - 1) (N - 2) / 6 triangles.

    pairs : (B, 2) holes i < j of each baseline
    triangles : (C, 3) holes i < j < k
    stations : (N, 2) centres of the holes, (u, v) towards east and north [m]
    visibilities : (B,) complex; from frames, pistons and all
    visibility_errors : (B,) rms of the amplitude, and of the phase times the amplitude
    squared, squared_errors : (B,) |V|^2
    closure_phases, closure_errors : (C,) rad
    triple_amplitudes, triple_errors : (C,) |V_ij V_jk V_ki|
    """

    pairs: Tensor
    triangles: Tensor
    stations: Tensor
    visibilities: Tensor
    visibility_errors: Tensor
    squared: Tensor
    squared_errors: Tensor
    closure_phases: Tensor
    closure_errors: Tensor
    triple_amplitudes: Tensor
    triple_errors: Tensor

    @property
    def baselines(self) -> Tensor:
        """(B, 2) (u, v) of each pair [m]."""
        return self.stations[self.pairs[:, 1]] - self.stations[self.pairs[:, 0]]


def frame_observables(observation: Observation) -> Observables:
    """Visibilities and closure phases straight from the frames, without a restoration.

    In each frame the fringes of all baselines are fitted together, by least squares over the valid pixels, under the
    diffraction pattern of one hole: this averages the frame's Fourier transform over each baseline's patch with the
    patch's own shape as weight. Products are then averaged over the frames, so that pistons cancel in |V|^2 and
    closure phases.

    Parameters
    ----------
    observation : Observation
        Of a mask of two holes or more whose baselines can be told apart. Subtract the sky beforehand: it counts as
        light without fringes.

    Returns
    -------
    Observables
        As measured: not calibrated for what lowers the contrast of a point source (band width, aberrations within a
        hole). Errors are the larger of the scatter over the frames and the noise (`errors`, or photon and read-out
        noise) carried through the fit.

    Raises
    ------
    ValueError
        If the aperture has fewer than two sub-apertures, two baselines lie too close together for this field and
        band to tell, or a frame is refused by `check_frames`.

    Notes
    -----
    What lies at an angle s from the brightest point is dimmed as the overlap of a hole's diffraction pattern with
    itself shifted by s: a companion must lie well within wavelength / (hole diameter). |V|^2 is freed of its noise
    bias; the triple product is not (its bias is of relative size N / electrons per frame).
    """
    aperture, grid = observation.aperture, observation.grid
    pairs, triangles = _pairs_and_triangles(aperture)
    frames, valid = check_frames(observation.frames, observation.valid, grid)
    readout = observation.readout_noise or 0.0
    variance = frames.clamp(min=0) + readout**2 if observation.errors is None else observation.errors.double() ** 2
    envelope = _Envelope(aperture, grid)
    waves = _waves(aperture, grid, pairs)
    fits = [_fit_fringes(*frame, envelope, waves, aperture) for frame in zip(frames, valid, variance, strict=True)]
    light, fringes, noise = (torch.stack(values) for values in zip(*fits, strict=True))
    fringes, noise = fringes * aperture.n_subapertures, noise * aperture.n_subapertures**2

    visibilities, errors = _ratio(fringes, light, noise / 2)
    power = fringes.abs() ** 2
    spread = torch.maximum(2 * power * noise - noise**2, noise**2)  # `power` holds the noise itself
    squared, squared_errors = _ratio(power - noise, light**2, spread)
    first, second, third = _sides(pairs, triangles)
    product = fringes[:, first] * fringes[:, second] * fringes[:, third].conj()
    relative = noise / power.clamp(min=torch.finfo(power.dtype).tiny) / 2
    spread = product.abs() ** 2 * (relative[:, first] + relative[:, second] + relative[:, third])
    triple = product.sum(0)
    turned = product * torch.polar(torch.ones_like(triple.abs()), -triple.angle())
    amplitudes, triple_errors = _ratio(turned.real, light**3, spread)
    _, sideways = _ratio(turned.imag, light**3, spread)
    return Observables(
        pairs,
        triangles,
        _stations(observation),
        visibilities,
        errors,
        squared,
        squared_errors,
        triple.angle(),
        sideways / amplitudes,
        amplitudes,
        triple_errors,
    )


def restored_observables(result: RestorationResult, observation: Observation) -> Observables:
    """Visibilities and closure phases of a restored object, freed of the aberrations that were restored with it.

    Errors are those that the noise alone would leave if the restored aberrations were exact: the noise of the frames
    over the light that their transfer functions, made from the restored coefficients, send into the patch of each
    baseline. The prior and the uncertainty of the aberrations are not in them.

    Parameters
    ----------
    result : RestorationResult
    observation : Observation
        That it was restored from.

    Raises
    ------
    ValueError
        If the aperture has fewer than two sub-apertures, or the object is black or does not lie on the frames' pixels.
    """
    aperture, grid = observation.aperture, observation.grid
    pairs, triangles = _pairs_and_triangles(aperture)
    scene = result.object.double()
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"the object has shape {tuple(scene.shape)}: the observation's frames have {grid.shape}")
    light = float(scene.sum())
    if not light > 0:
        raise ValueError("the restored object is black: it has no visibilities")
    values = (_waves(aperture, grid, pairs).conj() @ scene.to(torch.complex128).flatten()) / light
    total = result.noise**2 * math.prod(grid.shape) / (light**2 * _transmitted(result, aperture, grid, pairs))
    power = values.abs() ** 2
    first, second, third = _sides(pairs, triangles)
    triple = values[first] * values[second] * values[third].conj()
    relative = total / power.clamp(min=torch.finfo(power.dtype).tiny) / 2
    closure_errors = (relative[first] + relative[second] + relative[third]).sqrt()
    return Observables(
        pairs,
        triangles,
        _stations(observation),
        values,
        (total / 2).sqrt(),
        power,
        (2 * power * total + total**2).sqrt(),
        triple.angle(),
        closure_errors,
        triple.abs(),
        triple.abs() * closure_errors,
    )


def _pairs_and_triangles(aperture: Aperture) -> tuple[Tensor, Tensor]:
    n = aperture.n_subapertures
    if aperture.centers.ndim != 2 or n < 2:
        raise ValueError(f"the aperture has centres of shape {tuple(aperture.centers.shape)}: two holes are the least")
    pairs = torch.tensor(list(itertools.combinations(range(n), 2)))
    return pairs, torch.tensor(list(itertools.combinations(range(n), 3)), dtype=torch.long).reshape(-1, 3)


def _sides(pairs: Tensor, triangles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the baselines ij, jk and ik of every triangle; ki is ik turned round."""
    number = {pair: index for index, pair in enumerate(map(tuple, pairs.tolist()))}
    rows = [[number[i, j], number[j, k], number[i, k]] for i, j, k in triangles.tolist()]
    first, second, third = torch.tensor(rows, dtype=torch.long).reshape(-1, 3).unbind(1)
    return first, second, third


def _stations(observation: Observation) -> Tensor:
    """(N, 2) centres of the holes towards east and north [m]; along columns and rows if no sky coordinates are known.

    With the matrix M from pixels to the sky, nu . x = u . (M x) for u = M^-T nu.
    """
    centers = observation.aperture.centers.detach().double().cpu()
    matrix = pixel_matrix(observation.header) if observation.header else None
    if matrix is None:
        return centers
    to_sky = torch.from_numpy(matrix).deg2rad() / observation.grid.pixel_scale
    return centers @ torch.linalg.inv(to_sky)


def _positions(grid: Grid) -> Tensor:
    """(P, 2) pixels (x, y) relative to [H // 2, W // 2]."""
    rows, columns = (torch.arange(n, dtype=torch.float64) - n // 2 for n in grid.shape)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1).flatten(0, 1).flip(-1)


def _waves(aperture: Aperture, grid: Grid, pairs: Tensor) -> Tensor:
    """(B, P) exp(2 pi i nu . x) of every baseline."""
    centers = aperture.centers.detach().double().cpu()
    nu = (centers[pairs[:, 1]] - centers[pairs[:, 0]]) / grid.period
    phase = 2 * math.pi * nu @ _positions(grid).T
    return torch.polar(torch.ones_like(phase), phase)


class _Envelope:
    """The diffraction pattern of one hole, at any place in the field."""

    def __init__(self, aperture: Aperture, grid: Grid) -> None:
        self.shape = grid.shape
        self.wide = Grid((grid.shape[0] * _FIELD, grid.shape[1] * _FIELD), grid.pixel_scale, grid.wavelength)
        self.nu_y, self.nu_x = self.wide.frequencies(torch.float64)
        shift = torch.stack(torch.broadcast_tensors(self.nu_x, self.nu_y), -1) * grid.period
        self.transfer = subaperture_otf(shift, aperture)

    def at(self, x: float, y: float) -> Tensor:
        """(P,) the pattern around (x, y), pixels from [H // 2, W // 2]."""
        height, width = self.shape
        ramp = -2 * math.pi * (self.nu_x * (x + width // 2) + self.nu_y * (y + height // 2))
        pattern = torch.fft.ifft2(self.transfer * torch.polar(torch.ones_like(ramp), ramp)).real
        return pattern[:height, :width].flatten()

    def centre(self, frame: Tensor) -> tuple[float, float]:
        """(x, y) where a frame, blurred by the pattern, is brightest: to a fraction of a pixel, by a parabola."""
        blurred = torch.fft.ifft2(torch.fft.fft2(frame, s=self.wide.shape) * self.transfer).real
        blurred = blurred[: self.shape[0], : self.shape[1]]
        row, column = divmod(int(blurred.argmax()), self.shape[1])
        offsets = []
        for place, line in ((column, blurred[row]), (row, blurred[:, column])):
            offset = 0.0
            if 0 < place < len(line) - 1:
                before, here, after = line[place - 1 : place + 2].tolist()
                offset = (before - after) / (2 * (before - 2 * here + after)) if before + after < 2 * here else 0.0
            offsets.append(place + offset - len(line) // 2)
        return offsets[0], offsets[1]


def _fit_fringes(
    frame: Tensor, valid: Tensor, variance: Tensor, envelope: _Envelope, waves: Tensor, aperture: Aperture
) -> tuple[Tensor, Tensor, Tensor]:
    """Light (), fringes (B,) complex and their noise E|n|^2 (B,) of one frame.

    frame = envelope (light + 2 Re sum of fringes exp(2 pi i nu . x)), linear in light, real and imaginary parts.
    """
    good = valid.flatten().double()
    pattern = envelope.at(*envelope.centre(frame)) * good
    columns = torch.cat([torch.ones_like(waves[:1].real), 2 * waves.real, -2 * waves.imag]) * pattern
    normal = columns @ columns.T
    values = torch.linalg.eigvalsh(normal)
    if not values[0] * _WORST_CONDITION > values[-1]:
        raise ValueError(
            f"the fringes of some of the {len(waves)} baselines cannot be told apart: {_closest(aperture)}; use "
            "restored_observables, a mask without redundant baselines or a wider field"
        )
    estimator = torch.linalg.solve(normal, columns)
    fitted = estimator @ frame.flatten()
    spread = (estimator**2) @ variance.flatten().where(valid.flatten(), torch.zeros(()).double())
    light, real, imaginary = fitted.split([1, len(waves), len(waves)])
    _, noise_real, noise_imaginary = spread.split([1, len(waves), len(waves)])
    return light[0], torch.complex(real, imaginary), noise_real + noise_imaginary


def _closest(aperture: Aperture) -> str:
    """Words for the two baselines, of either direction, that lie closest together."""
    centers = aperture.centers.detach().double()
    pairs, _ = _pairs_and_triangles(aperture)
    baselines = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    both = torch.cat([baselines, -baselines])
    distance = torch.linalg.vector_norm(both[:, None] - both, dim=-1).fill_diagonal_(math.inf)
    first, second = divmod(int(distance.argmin()), len(both))
    names = ["-".join(map(str, pairs[index % len(pairs)].tolist())) for index in (first, second)]
    return (
        f"those of holes {names[0]} and {names[1]} lie {float(distance.min()):.3g} m apart, with holes of "
        f"{aperture.subaperture_diameter:.3g} m"
    )


def _ratio(values: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """sum(values) / sum(scale) over frames and its error: scatter over the frames or noise, whichever is larger.

    values (T, M) real or complex; scale (T,) positive; noise (T, M) the variance of a real part.
    """
    total = scale.sum()
    ratio = values.sum(0) / total
    error = noise.sum(0).sqrt() / total
    n = len(values)
    if n > 1:
        rest = values - ratio * scale[:, None]
        square = (rest.abs() ** 2).sum(0) / (2 if rest.is_complex() else 1)
        error = torch.maximum(error, (square * n / (n - 1)).sqrt() / total)
    return ratio, error


def _transmitted(result: RestorationResult, aperture: Aperture, grid: Grid, pairs: Tensor) -> Tensor:
    """(B,) |OTF|^2 of the restored aberrations, summed over the frames and over the frequencies of each baseline."""
    n_modes = result.coefficients.shape[-1]
    oversampling = max(1, math.ceil(2 * grid.period / (aperture.subaperture_diameter * min(grid.shape))))
    phase = ZernikePhase(aperture, grid, n_modes, oversampling)(result.coefficients.to(aperture.centers))
    power = (OTF(aperture, grid, oversampling)(phase).abs() ** 2).sum(0).detach().double().cpu()
    nu_y, nu_x = grid.frequencies(torch.float64)
    centers = aperture.centers.detach().double().cpu()
    nu = (centers[pairs[:, 1]] - centers[pairs[:, 0]]) / grid.period
    reach = grid.cutoff(aperture.subaperture_diameter)
    dx, dy = nu_x - nu[:, 0, None, None], nu_y - nu[:, 1, None, None]
    within = torch.hypot(dx - dx.round(), dy - dy.round()) < reach
    return (power * within).sum((1, 2))
