"""Orientation of a mask from the power of its fringes, which does not depend on the pistons of turbulence."""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.phasor import phasor

_FINENESS = 4  # oversampling of the frequencies relative to those of the frames
_TURNS = 181  # number of rotations tried over 180 degrees: the other half looks the same
_SCALES = (0.95, 0.96, 0.97, 0.98, 0.99, 1.0, 1.01, 1.02, 1.03, 1.04, 1.05)
_ALIKE = 0.05  # difference in the mean logarithm of the power below which the smaller rotation is preferred


class FirstLook(NamedTuple):
    """The geometry, to about a degree and a percent, and whether a mirrored mask would look different."""

    geometry: MaskGeometry
    mirror_seen: bool


def mean_power(frames: Tensor, centers: Tensor, grid: Grid) -> Tensor:
    """Return the power |DFT|^2, averaged over frames (T, H, W), at the B baselines of `centers` (..., N, 2) [m]."""
    fine = tuple(_FINENESS * side for side in frames.shape[-2:])
    power = (torch.fft.fft2(frames, s=fine).abs() ** 2).mean(0)
    power = torch.cat([power, power[:1]])
    power = torch.cat([power, power[:, :1]], 1)  # periodic, with the seam on both sides
    n = centers.shape[-2]
    i, j = torch.triu_indices(n, n, 1).unbind()
    nu = (centers[..., i, :] - centers[..., j, :]) / grid.period
    places = 2 * (nu - nu.floor()) - 1  # (x, y) in [-1, 1], the convention of grid_sample
    places = places.reshape(1, -1, 1, 2).to(power)
    sampled = torch.nn.functional.grid_sample(power[None, None], places, align_corners=True)
    return sampled.flatten().view(nu.shape[:-1])


def first_look(frames: Tensor, centers: Tensor, grid: Grid) -> FirstLook:
    """Return rotation, mirror and magnification with the most power at the baselines in a star's frames (T, H, W).

    Among geometries that explain the power equally well, as for a symmetric mask, it is the one nearest to the given.
    """
    turns = [math.pi * (k / (_TURNS - 1) - 0.5) for k in range(_TURNS)]
    tried = [
        MaskGeometry(turn, scale, scale, mirrored=mirrored)
        for mirrored in (False, True)
        for scale in _SCALES
        for turn in sorted(turns, key=abs)
    ]
    moved = torch.stack([centers @ geometry.matrix.to(centers).T for geometry in tried])
    power = mean_power(frames, moved, grid)
    scores = power.clamp(min=torch.finfo(power.dtype).tiny).log().mean(-1)
    good = (scores > scores.max() - _ALIKE).nonzero().flatten().tolist()
    mirrors = {tried[index].mirrored for index in good}
    mirrored = mirrors == {True}
    nearest = min(abs(tried[index].rotation) for index in good if tried[index].mirrored == mirrored)
    close = [
        index
        for index in good
        if tried[index].mirrored == mirrored and abs(tried[index].rotation) <= nearest + math.radians(5)
    ]
    best = max(close, key=lambda index: float(scores[index]))
    return FirstLook(tried[best], len(mirrors) == 1)


_OTHERS = {
    "with x reversed": MaskGeometry(mirrored=True),
    "with x and y swapped": MaskGeometry(math.pi / 2, mirrored=True),
    "turned by 90 degrees": MaskGeometry(math.pi / 2),
}
_AT_A_TIME = 32  # frames
_CERTAIN = 2.0  # standard errors above which a correlation is significant
_SEEN = 2.0  # standard errors of the noise's power above which a frequency has a signal


def warn_of_orientation(frames: Tensor, aperture: Aperture, grid: Grid) -> None:
    """Issue the warning of `orientation_warning`, if any; a full pupil and two holes do not show an orientation."""
    if isinstance(aperture, SparseAperture) and aperture.n_subapertures > 2:
        message = orientation_warning(frames.double(), aperture, grid)
        if message is not None:
            warnings.warn(message, stacklevel=3)


def orientation_warning(frames: Tensor, aperture: SparseAperture, grid: Grid) -> str | None:
    """Return a warning if the power of frames (T, H, W) fits another orientation of the mask better, or else None.

    Fringes have power at the mask's baselines for any object: its logarithm over frequencies, without the radial trend,
    correlates with that of a point source. The standard error of this correlation over N (N - 1) patches is
    (N (N - 1))^(-1/2). The warning names another orientation if its correlation exceeds twice this error and that of
    the given orientation by more than that. Rotations by 180 degrees, and mirrors of symmetric baselines, have no
    effect on the power.
    """
    nu_y, nu_x = grid.frequencies(torch.float64, frames.device)
    radius = torch.hypot(nu_y, nu_x)
    window = [torch.hann_window(side, periodic=False, dtype=torch.float64, device=frames.device) for side in grid.shape]
    power = torch.zeros_like(radius)
    for part in frames.split(_AT_A_TIME):
        still = (part - part.mean((1, 2), keepdim=True)) * window[0][:, None] * window[1]
        power += (torch.fft.fft2(still).abs() ** 2).sum(0) / len(frames)
    beyond = radius > grid.cutoff(aperture.extent)
    inner = grid.cutoff(aperture.outer_diameter)
    within = (radius > inner) & ~beyond
    if int(beyond.sum()) < 8 or int(within.sum()) < 8:
        return None
    noise = power[beyond].mean()
    signal = power - noise
    seen = within & (signal > _SEEN * noise / math.sqrt(len(frames)))
    if int(seen.sum()) < 8:
        return None
    trend = radius[seen].log()[:, None] ** torch.arange(3, device=frames.device)
    measured = _without_trend(signal[seen].log(), trend)

    def correlation(geometry: MaskGeometry) -> float:
        expected = _without_trend(_fringe_power(geometry.apply(aperture), grid)[seen].clamp(min=1e-3).log(), trend)
        return float(torch.nn.functional.cosine_similarity(measured, expected, dim=0))

    told = correlation(MaskGeometry())
    others = {name: correlation(geometry) for name, geometry in _OTHERS.items()}
    name = max(others, key=lambda key: others[key])
    n = aperture.n_subapertures
    error = (n * (n - 1)) ** -0.5
    if others[name] > max(told + error, _CERTAIN * error):
        return (
            f"the fringes of the frames fit the mask better {name} than as given (correlation {others[name]:.2f} "
            f"instead of {told:.2f}): check its orientation, or measure it with calibrate_mask on frames of a star"
        )
    return None


def _without_trend(values: Tensor, trend: Tensor) -> Tensor:
    """Return values (P,) minus their least-squares fit by the columns (P, K)."""
    return values - trend @ torch.linalg.lstsq(trend, values[:, None]).solution[:, 0]


def _fringe_power(aperture: SparseAperture, grid: Grid) -> Tensor:
    """Return the sum (H, W) of |OTF|^2 over the pairs of holes, its mean for independent pistons.

    It is one patch convolved with all baselines, whose transform is |sum of exp(2 pi i x . nu_m)|^2 - N.
    """
    nu_y, nu_x = grid.frequencies(torch.float64, aperture.centers.device)
    shift = torch.stack(torch.broadcast_tensors(nu_x, nu_y), -1) * grid.period
    patch = torch.fft.ifft2(aperture.shape.otf(shift, aperture.subaperture_diameter) ** 2)
    x, y = nu_x * grid.shape[1], nu_y * grid.shape[0]  # whole pixels, in FFT order
    phase = 2 * math.pi / grid.period * aperture.centers.detach().double()
    waves = [phasor(angle) for angle in (phase[:, 1:] * y.T, phase[:, :1] * x)]
    pairs = (waves[0].T @ waves[1]).abs() ** 2 - len(phase)
    return torch.fft.fft2(patch * pairs).real
