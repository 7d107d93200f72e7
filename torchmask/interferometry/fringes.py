"""Visibilities and closure phases straight from the frames, by a fit of all fringes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.visibilities import (
    Observables,
    fringe_waves,
    pairs_and_triangles,
    sky_stations,
    triangle_sides,
)
from torchmask.observation import Observation, check_frames
from torchmask.optics.aperture import Aperture

_FIELD = 4  # the envelope of the fringes is computed on a field this many times as wide, against its wrap-around
_WORST_CONDITION = 1e6  # of the normal equations of the fringes


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

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.optics.detector import Detector
    >>> from torchmask.simulation.exposures import simulate_observation
    >>> star = torch.zeros(64, 64, dtype=torch.float64); star[32, 32] = 1e7  # electrons per frame
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> seen = simulate_observation(star, mask, Grid.nyquist(1.0, 550e-9, 64), None, Detector(), n_frames=4)
    >>> observables = frame_observables(seen)
    >>> bool((observables.vis2 > 0.97).all()), bool((observables.closure_phases.abs() < 0.01).all())
    (True, True)
    """
    aperture, grid = observation.aperture, observation.grid
    pairs, triangles = pairs_and_triangles(aperture)
    frames, valid = (values.cpu() for values in check_frames(observation.frames, observation.valid, grid))
    readout, errors = observation.readout_noise or 0.0, observation.errors
    variance = frames.clamp(min=0) + readout**2 if errors is None else errors.double().cpu() ** 2
    envelope = _Envelope(aperture, grid)
    waves = fringe_waves(aperture, grid, pairs)
    fits = [_fit_fringes(*frame, envelope, waves, aperture) for frame in zip(frames, valid, variance, strict=True)]
    light, fringes, covariance = (torch.stack(values) for values in zip(*fits, strict=True))
    size = len(pairs)
    diagonal = covariance.diagonal(dim1=1, dim2=2)
    noise = diagonal[:, 1 : 1 + size] + diagonal[:, 1 + size :]  # E|n|^2
    logarithms = _log_jacobian(light, fringes)
    n = aperture.n_subapertures
    values, noise = fringes * n, noise * n**2
    visibilities, visibility_errors = _ratio(values, light, noise / 2)
    power = (values.abs() ** 2 - noise).clamp(min=0)
    vis2, vis2_errors = _ratio(
        values.abs() ** 2 - noise, light**2, 4 * power**2 * _variance(logarithms.real, covariance) + noise**2
    )
    first, second, third = triangle_sides(pairs, triangles)
    one, two, three = logarithms[:, first], logarithms[:, second], logarithms[:, third]
    product = values[:, first] * values[:, second] * values[:, third].conj()
    triple = product.sum(0)
    turned = product * torch.polar(torch.ones_like(triple.abs()), -triple.angle())
    _, sideways = _ratio(turned.imag, light**3, product.abs() ** 2 * _variance((one + two - three).imag, covariance))
    amplitudes, triple_errors = _ratio(
        turned.real, light**3, product.abs() ** 2 * _variance((one + two + three).real, covariance)
    )
    return Observables(
        pairs,
        triangles,
        sky_stations(observation),
        visibilities,
        visibility_errors,
        vis2,
        vis2_errors,
        triple.angle(),
        sideways / amplitudes,
        amplitudes,
        triple_errors,
    )


class _Envelope:
    """The diffraction pattern of one hole, at any place in the field."""

    def __init__(self, aperture: Aperture, grid: Grid) -> None:
        self.shape = grid.shape
        self.wide = Grid((grid.shape[0] * _FIELD, grid.shape[1] * _FIELD), grid.pixel_scale, grid.wavelength)
        self.nu_y, self.nu_x = self.wide.frequencies(torch.float64)
        shift = torch.stack(torch.broadcast_tensors(self.nu_x, self.nu_y), -1) * grid.period
        self.transfer = aperture.shape.otf(shift, aperture.subaperture_diameter)

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
    """Light (), fringes (B,) complex, and the covariance (1 + 2 B, 1 + 2 B) of light, real and imaginary parts.

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
    light, real, imaginary = (estimator @ frame.flatten()).split([1, len(waves), len(waves)])
    covariance = (estimator * torch.where(valid, variance, 0.0).flatten()) @ estimator.T
    return light[0], torch.complex(real, imaginary), covariance


def _log_jacobian(light: Tensor, fringes: Tensor) -> Tensor:
    """(T, B, 1 + 2 B) complex: derivatives of ln(fringe / light) by light, real and imaginary parts of the fringes.

    Photon noise ties the baselines of a triangle together, and all of them to the light; this carries it on.
    """
    inverse = torch.diag_embed(1 / fringes)
    by_light = (-1 / light).to(fringes)[:, None, None].expand(*fringes.shape, 1)
    return torch.cat([by_light, inverse, 1j * inverse], dim=-1)


def _variance(rows: Tensor, covariance: Tensor) -> Tensor:
    """Variance (T, M) of what has derivatives `rows` (T, M, P) by parameters with `covariance` (T, P, P)."""
    return ((rows @ covariance) * rows).sum(-1)


def _closest(aperture: Aperture) -> str:
    """Words for the two baselines, of either direction, that lie closest together."""
    centers = aperture.centers.detach().double()
    pairs, _ = pairs_and_triangles(aperture)
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
