"""Visibilities and closure phases from frames by a fit of all fringes, corrected for the bias by noise."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.interferometry.fringe_fit import (
    FringeFit,
    FringeModel,
    PixelNoise,
    fit_fringes,
)
from torchmask.interferometry.fringe_places import find_places
from torchmask.interferometry.observables import Observables
from torchmask.interferometry.visibilities import sky_stations, triangle_sides
from torchmask.interferometry.which_mask import look_at_mask
from torchmask.observation import Observation, check_frames, warn_of_copies
from torchmask.optics.noise import noise_variance
from torchmask.optics.phasor import phasor
from torchmask.optics.unmarked import leave_out_unmarked

_PRIOR = 10  # frames whose weight the noise has in variances
_TINY = torch.finfo(torch.float64).tiny


def frame_observables(observation: Observation) -> Observables:
    """Measure visibilities and closure phases directly on the frames, without a restoration.

    In each frame the fringes of all baselines are fitted jointly, by least squares over the valid pixels weighted by
    their noise, with the diffraction pattern of one hole as envelope: this averages the frame's Fourier transform over
    each baseline's patch. Products are then averaged over the frames; pistons cancel in |V|^2 and closure phases.

    Parameters
    ----------
    observation : Observation
        Observation with a mask of at least two holes whose baselines are distinct. Subtract the sky beforehand, as it
        counts as light without fringes. If its `readout_noise` is None, it is measured beyond the cut-off frequency.
        What its `pixel` takes off the fringes, of long baselines most, is given back.

    Returns
    -------
    Observables
        Raw values, not calibrated for effects that lower the contrast of a point source (band width, motion within an
        exposure, aberrations within a hole); `Observables.calibrate` divides by a star. Variances are those of
        the noise (`errors`, or photon and read-out noise) propagated through the fit or, where they are larger, the
        mean of the scatter over the frames and of that noise, scaled to the scatter of all, which has the weight of ten
        frames; correlations are the mean of both, in which the noise has the weight of as many frames as there are
        observables.

    Raises
    ------
    ValueError
        If the aperture has fewer than two sub-apertures, two baselines are too similar to be separated with this field
        and band, `check_frames` rejects a frame, the read-out noise is neither known nor measurable, or one of the
        `errors` of a valid pixel is not finite and positive.

    Notes
    -----
    Saturated and dead pixels get no weight, nor do cosmic rays and hot pixels that stand out beyond the cut-off, and
    warnings tell of them (`find_saturated`, `find_ceilings`, `find_steady`, `find_dead`, `find_spikes`). Others tell of
    frames that repeat earlier ones, of faint ones that drift, and of fringes that are not those of the mask
    (`look_at_mask`).
    The variances of light and fringes are subtracted from their squares, and the mean contribution of the pixels' noise
    from triple products (Wirnitzer 1985, J. Opt. Soc. Am. A 2, 14, for photon noise), so that means are unbiased even
    for few photons. Frames are fitted around the light of their mean, or each around its own where that moves more than
    noise does (`find_places`). Light at an angle s from it is attenuated by the overlap of a hole's diffraction pattern
    with itself shifted by s, so a companion must be well within wavelength / (hole diameter): through seven holes a
    contrast of 0.1 comes out as 0.090 to 0.097 at 0.2 of that, as 0.086 to 0.088 at 0.4 and as 0.06 to 0.085 at 0.5.

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
    model = FringeModel(aperture, grid, observation.pixel)
    frames, valid = (values.cpu() for values in check_frames(observation.frames, observation.valid, grid))
    frames, valid = leave_out_unmarked(frames, valid, grid, aperture, stacklevel=2)
    warn_of_copies(frames, stacklevel=2)
    look_at_mask(frames, aperture, grid, valid=valid).warn(stacklevel=2)
    noise = _pixel_noise(observation, frames, valid)
    fit = fit_fringes(frames, valid, noise, model, find_places(frames, valid, noise, model, stacklevel=2))
    n = aperture.n_subapertures
    values, noise = fit.fringes * n, fit.fringe_noise * n**2
    visibilities, visibility_errors = _ratio(values, fit.light, noise / 2)
    vis2, vis2_covariance = _squares(fit, n)
    triple, amplitudes_covariance, phases_covariance = _triples(fit, model, n)
    return Observables(
        model.pairs,
        model.triangles,
        sky_stations(observation),
        visibilities,
        visibility_errors,
        vis2,
        vis2_covariance,
        triple.angle(),
        phases_covariance,
        triple.abs(),
        amplitudes_covariance,
    )


def _pixel_noise(observation: Observation, frames: Tensor, valid: Tensor) -> PixelNoise:
    """Return the noise of frames (T, H, W), unbiased if it is estimated from the frames themselves."""
    if observation.errors is not None:
        errors = observation.errors.double().cpu()
        return PixelNoise(errors * errors.abs(), is_own=False, light=frames)  # negative ones stay so, and are refused
    readout = observation.readout_noise
    if readout is None:
        measured = noise_variance(frames, observation.grid, observation.aperture, valid)
        if measured is None:
            raise ValueError(
                "readout_noise is None, and the grid has no frequencies beyond the cut-off to measure it: give it "
                "[electrons rms], or errors"
            )
        readout = max(0.0, measured - float(frames.mean())) ** 0.5
    return PixelNoise(frames + readout**2, is_own=True, light=frames)


def _squares(fit: FringeFit, n_holes: int) -> tuple[Tensor, Tensor]:
    """Return |V|^2 (B,) and its covariance (B, B)."""
    squares = fit.values**2 - fit.covariance.diagonal(dim1=1, dim2=2)
    light = squares[:, :1]
    real, imaginary = squares[:, 1:].chunk(2, 1)
    power = n_holes**2 * (real + imaginary)
    ratio = power.sum(0) / light.sum()
    # rest_b = sum over the parameters of weights_b (x^2 - variance), a quadratic form of Gaussian variables
    each = n_holes**2 * torch.eye(len(ratio), dtype=ratio.dtype)
    weights = torch.cat([-ratio[:, None], each, each], 1)
    noise, without_light = torch.zeros_like(each), torch.zeros_like(each)
    for values, covariance in zip(fit.values, fit.covariance, strict=True):
        slopes = weights * values
        noise += 4 * slopes @ covariance @ slopes.T
        without_light += 2 * weights @ covariance**2 @ weights.T
    # the noise of the slopes adds 4 tr(M C M C), of which only 2 tr(M C M C) are part of the variance
    noise -= without_light
    noise += (without_light - noise).diagonal().clamp(min=0).diag()  # it is more with any light, whatever was measured
    return ratio, _covariance(power - ratio * light, noise) / light.sum() ** 2


def _triples(fit: FringeFit, model: FringeModel, n_holes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return complex triple products (C,), and the covariances (C, C) of their amplitudes and of their phases."""
    sides = triangle_sides(model.pairs, model.triangles)
    first, second, third = sides
    a, b, c = fit.fringes[:, first], fit.fringes[:, second], fit.fringes[:, third].conj()
    ab, _ = _complex_covariances(fit.covariance, first, second)
    _, ac = _complex_covariances(fit.covariance, first, third)
    _, bc = _complex_covariances(fit.covariance, second, third)
    products = n_holes**3 * (a * b * c - a * bc - b * ac - c * ab + fit.cubes[:, 1:])
    light = fit.light**3 - 3 * fit.light * fit.covariance[:, 0, 0] + fit.cubes[:, 0].real
    triple = products.sum(0) / light.sum()
    turn = phasor(-triple.angle())
    noise = _triple_noise(fit, sides, turn, n_holes)
    rest = products * turn - triple.abs() * light[:, None]
    along, across = (
        _covariance(part, of) / light.sum() ** 2 for part, of in zip((rest.real, rest.imag), noise, strict=True)
    )
    amplitudes = triple.abs()
    return triple, along, across / (amplitudes[:, None] * amplitudes)


def _complex_covariances(covariance: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return E(f g) and E(f g*), both (T, M), of the noise of fringes `first` and `second` (M,).

    `covariance` (T, K, K) is that of the parameters.
    """
    size = covariance.shape[-1] // 2
    real, imaginary = slice(1, 1 + size), slice(1 + size, None)
    rr, ii = covariance[:, real, real][:, first, second], covariance[:, imaginary, imaginary][:, first, second]
    ri, ir = covariance[:, real, imaginary][:, first, second], covariance[:, imaginary, real][:, first, second]
    return torch.complex(rr - ii, ri + ir), torch.complex(rr + ii, ir - ri)


def _triple_noise(
    fit: FringeFit, sides: tuple[Tensor, Tensor, Tensor], turn: Tensor, n_holes: int
) -> tuple[Tensor, Tensor]:
    """Return covariances (C, C) by noise, summed over frames, along the mean triple products and across them.

    They are to first order, which is accurate for bright frames; where the noise is as strong as the fringes, variances
    are replaced by those of independent fringes of the same power and noise.
    """
    n_triangles, size = len(turn), fit.fringes.shape[1]
    rows = torch.arange(n_triangles)
    along = torch.zeros(n_triangles, n_triangles, dtype=torch.float64)
    across = torch.zeros_like(along)
    turn, first, second, third = n_holes**3 * turn, *(1 + side for side in sides)
    for values, light, covariance in zip(fit.fringes, fit.light, fit.covariance, strict=True):
        a, b, c = (values[side] for side in sides)
        ab, c = turn * a * b, c.conj()
        ac, bc = turn * a * c, turn * b * c
        # the three sides of a triangle are different baselines, so nothing is written twice
        slopes = torch.zeros(n_triangles, 1 + 2 * size, dtype=torch.complex128)
        slopes[rows, first], slopes[rows, second], slopes[rows, third] = bc, ac, ab
        slopes[rows, size + first], slopes[rows, size + second], slopes[rows, size + third] = 1j * bc, 1j * ac, -1j * ab
        slopes[:, 0] = -3 * (ab * c).real / light
        for total, part in ((along, slopes.real), (across, slopes.imag)):
            total += part @ covariance @ part.T
    noise = fit.fringe_noise.mean(0)
    power = ((fit.fringes.abs() ** 2).mean(0) - noise).clamp(min=0)
    p, e = (torch.stack([values[side] for side in sides]) for values in (power, noise))
    whole = (p + e).prod(0)
    naive = whole * (e / (p + e)).sum(0)
    share = ((whole - p.prod(0)) / naive.clamp(min=torch.finfo(p.dtype).tiny)).clamp(max=1).sqrt()
    return along * share[:, None] * share, across * share[:, None] * share


def _covariance(rest: Tensor, noise: Tensor) -> Tensor:
    """Return the covariance (M, M) of sums over frames, from their scatter `rest` (T, M) and their noise (M, M).

    The sample covariance of few frames is singular and noisy. So the noise enters its variances as a prior, scaled to
    the scatter of all where that is larger, with the weight of ten frames, and its correlations with that of M.
    """
    n, size = rest.shape
    variance = noise.diagonal()
    if n > 1:
        scatter = rest.T @ rest * (n / (n - 1))
        found, more = scatter.diagonal(), (scatter.trace() / noise.trace().clamp(min=_TINY)).clamp(min=1)
        variance = torch.maximum(variance, (_PRIOR * more * variance + n * found) / (_PRIOR + n))
        noise = (size * _correlation(noise) + n * _correlation(scatter)) / (size + n)
    deviation = variance.clamp(min=0).sqrt()
    return _correlation(noise) * deviation[:, None] * deviation


def _correlation(covariance: Tensor) -> Tensor:
    scale = covariance.diagonal().clamp(min=_TINY).rsqrt()
    return covariance * scale[:, None] * scale


def _ratio(values: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return sum(values) / sum(scale) over frames and its error, the larger of scatter over the frames and noise.

    `values` (T, M) are complex, `scale` (T,) is positive, `noise` (T, M) is the variance of a real part.
    """
    total = scale.sum()
    ratio = values.sum(0) / total
    error = noise.sum(0).clamp(min=0).sqrt() / total
    n = len(values)
    if n > 1:
        square = ((values - ratio * scale[:, None]).abs() ** 2).sum(0) / 2
        error = torch.maximum(error, (square * n / (n - 1)).sqrt() / total)
    return ratio, error
