"""Whether a star behind a mask explains frames, after it was fitted to them."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.grid import Grid
from torchmask.interferometry.star_fit import Information, StarFit, explained_variance, prior_weights
from torchmask.interferometry.star_frames import StarFrames
from torchmask.interferometry.star_model import PLACE, StarModel
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import PixelResponse
from torchmask.optics.zernike import noll

_LEAST_EXPLAINED = 0.5  # of the variance of a frame: a fit that explains less is not of a star behind this mask
_NO_STAR = 0.5  # of what the fit explains of the median frame: a frame of which it explains less shows no star
_ORDERS = 5  # radial orders of turbulence beyond the modes of a fit: light scattered by higher ones falls elsewhere
_DRAWN = 8  # number of frames for which they are drawn, spread over all
_OUTER_SCALE = 20.0  # [m] of that turbulence, whose higher modes hardly depend on it
_CUT_OFF = 1.05  # of the given mask's cut-off frequency, beyond which there is but noise: masks may be larger
# What the chi-square of a star may have beyond that of noise: so many times the model error, or this share of the
# variance of a frame, as motion and pixels at the border of the square leave, and so many standard deviations.
_MODEL_ERRORS, _MISSED, _CHANCE = 2.0, 1e-3, 4.0
_OF_MEDIAN = 1.25  # its standard deviation over that of a mean


class StarVerdict(NamedTuple):
    """Whether a star and the mask explain frames; `str` says it.

    chi_square : median over frames of the mean square of the residuals, in units of the variance of the noise
    degrees_of_freedom : number of pixels of a frame that are compared less the parameters fitted, its median
    model_error : what modes of turbulence beyond those of the fit are expected to add; infinite if it is not known, as
        in frames with too few pixels
    limit : up to which chi-square a star and the mask count as explaining the frames
    lost : numbers, from 0, of the single frames that are not explained
    """

    chi_square: float
    degrees_of_freedom: int
    model_error: float
    limit: float
    lost: tuple[int, ...]

    @property
    def explained(self) -> bool:
        """Whether a star and the mask explain the frames, but for less than half of them."""
        return self.chi_square <= self.limit

    def to_json(self) -> dict[str, Any]:
        """Return the verdict as plain values, with the string of `str` as "text"."""
        return self._asdict() | {"explained": self.explained, "text": str(self)}

    def __str__(self) -> str:
        numbers = (
            f"chi-square is {self.chi_square:.4g} over {self.degrees_of_freedom} degrees of freedom, where noise and "
            f"modes left out make up to {self.limit:.4g}"
        )
        if self.explained:
            some = f"; but for frames {', '.join(map(str, self.lost))}, counted from 0" if self.lost else ""
            return f"explained: {numbers}{some}"
        return (
            f"not explained by a star and this mask: {numbers}; geometry and transmissions may be wrong by many of "
            "their errors, so check for a companion, a resolved star, a wide band, motion during the exposures, and "
            "cosmic rays or hot pixels, which valid= leaves out"
        )


def require_star(data: Tensor, counted: Tensor, fit: StarFit, model: StarModel, cutoff: float) -> None:
    """Raise ValueError unless the fit of a star to `data` (T, pixels) explains most of the variance of most frames.

    What is left may be noise, if the star is faint; it is measured beyond the `cutoff` [cycles/pixel] of the mask.
    """
    explained = float(explained_variance(data, counted, fit.images).median())
    if explained >= _LEAST_EXPLAINED:
        return
    mean = (data * counted).sum(1, keepdim=True) / counted.sum(1, keepdim=True)
    variance = (counted * (data - mean) ** 2).sum(1) / counted.sum(1)
    share = float((_white_noise(counted * (data - fit.images), counted, model.side, cutoff) / variance).median())
    if share > 1 - _LEAST_EXPLAINED:
        raise ValueError(
            f"noise is {100 * min(share, 1.0):.0f} % of the variance of the frames: the star is too faint, or there is "
            "none; give longer exposures, or frames of a brighter point source"
        )
    raise ValueError(
        f"a star behind this mask explains only {100 * max(explained, 0.0):.0f} % of the variance of the frames: "
        "give frames of a point source through this mask, at the scale of the grid"
    )


def judge_star(
    star: StarFrames,
    model: StarModel,
    fit: StarFit,
    information: Information,
    aperture: SparseAperture,
    grid: Grid,
    readout_noise: float,
    pixel: PixelResponse | None,
) -> StarVerdict:
    """Return whether a fit of the `model` leaves no more than noise and the modes that it lacks.

    The noise is that of photons and of read-out, told or measured beyond the cut-off of the mask, whichever is more.
    Frames that show no star, as under clouds, are lost, and a warning names them: noise alone is fitted by huge modes,
    which would excuse whatever the other frames leave.
    """
    data, counted = star.pixels.flatten(1), star.counted.flatten(1).double()
    shows = _show_star(data, counted, fit)
    data, counted, fit = data[shows], counted[shows], replace(fit, own=fit.own[shows], images=fit.images[shows])
    information = replace(information, own_covariances=information.own_covariances[shows])  # the rest is not used here
    left, light, n = counted * (data - fit.images), counted * fit.images.clamp(min=0), counted.sum(1)
    cutoff = _CUT_OFF * grid.cutoff(aperture.extent)
    photons = light.sum(1) / n
    extra = float((_white_noise(left, counted, model.side, cutoff) - photons).median())
    noise = counted * (light + max(extra, readout_noise**2, 1e-12 * float(light.max())))
    level = noise.sum(1) / n
    held = (information.own_covariances.diagonal(dim1=1, dim2=2) * prior_weights(model)).sum(1)
    free = (n - (fit.own.shape[1] - held)).clamp(min=1)
    chi_square = (left**2).sum(1) / free / level
    error = _model_error(model, fit, information, noise / level[:, None], level * free, aperture, grid, pixel)
    mean = (counted * data).sum(1) / n
    variance = (counted * (data - mean[:, None]) ** 2).sum(1) / level / free
    n_beyond = max(int(_beyond(model.side, cutoff).sum()), 1)
    own = float((2 * noise**2 + noise).sum(1).sqrt().div(level * free).median())  # of one frame's chi-square
    chances = [math.hypot(own * each, math.sqrt(2 / n_beyond / len(data))) for each in (1.0, len(data) ** -0.5)]
    allowed = 1 + max(_MODEL_ERRORS * error, _MISSED * float(variance.median()))
    single, limit = (allowed + _CHANCE * _OF_MEDIAN * chance for chance in chances)
    shows[shows.clone()] = chi_square <= single
    lost = tuple((~shows).nonzero().flatten().tolist())
    return StarVerdict(float(chi_square.quantile(0.5)), round(float(free.median())), error, limit, lost)


def _show_star(data: Tensor, counted: Tensor, fit: StarFit) -> Tensor:
    """Return which frames (T,) show the star, and warn of those that do not."""
    explained = explained_variance(data, counted, fit.images)
    shows = explained >= _NO_STAR * explained.median()
    if not bool(shows.all()):
        warnings.warn(
            f"frames {(~shows).nonzero().flatten().tolist()} of this stack, counted from 0, show no star behind this "
            f"mask: it explains {100 * max(float(explained[~shows].max()), 0.0):.0f} % of their variance or less, and "
            f"{100 * float(explained.median()):.0f} % of that of a median frame; leave them out",
            stacklevel=4,
        )
    return shows


def _beyond(side: int, cutoff: float) -> Tensor:
    """Return which frequencies (side, side) of a square no light of the mask reaches."""
    nu = torch.fft.fftfreq(side, dtype=torch.float64, device="cpu")
    return torch.hypot(nu[:, None], nu) > max(cutoff, 0.5)


def _white_noise(left: Tensor, counted: Tensor, side: int, cutoff: float) -> Tensor:
    """Return the mean variance (T,) of the noise of counted pixels in residuals (T, pixels), from high frequencies."""
    power = torch.fft.fft2(left.view(-1, side, side)).abs() ** 2
    beyond = _beyond(side, cutoff)
    return power[:, beyond].mean(1) / counted.sum(1) if bool(beyond.any()) else torch.zeros_like(power[:, 0, 0])


def _model_error(
    model: StarModel,
    fit: StarFit,
    information: Information,
    noise: Tensor,
    scale: Tensor,
    aperture: SparseAperture,
    grid: Grid,
    pixel: PixelResponse | None,
) -> float:
    """Return the chi-square that turbulence beyond the modes of a fit adds, infinite if frames have too few pixels.

    `noise` (T, pixels) is the variance of pixels in any unit, 0 where they are not counted, and `scale` (T,) what sums
    of squared residuals are divided by. Modes are drawn as strong as those of the fit say, and what the modes of the
    fit would take of them is taken off to first order.
    """
    n, few = model.n_holes, model.n_modes
    most = model.side**2 // n
    orders = [order for order in range(noll(few)[0] + _ORDERS, 0, -1) if few < (order + 1) * (order + 2) // 2 <= most]
    if not orders:
        return math.inf
    many = (orders[0] + 1) * (orders[0] + 2) // 2
    hole = aperture.replace(centers=torch.zeros_like(aperture.centers[:1]))
    covariance = modal_covariance(hole, many, 1.0, _OUTER_SCALE).cpu()
    low, both, high = covariance[:few, :few], covariance[:few, few:], covariance[few:, few:]
    values, vectors = torch.linalg.eigh(high - both.T @ torch.linalg.solve(low, both))
    mixing = vectors * values.clamp(min=0).sqrt()
    first = 3 if few > 3 else 1  # tilts move with the star
    found = fit.own[:, PLACE:].view(-1, n, few)[..., first:] ** 2
    found = found - information.own_covariances.diagonal(dim1=1, dim2=2)[:, PLACE:].view(-1, n, few)[..., first:]
    strength = float((found / low.diagonal()[first:]).mean().clamp(min=0))
    finer = StarModel(aperture, grid, (model.side - 1) // 2, many, pixel)
    kernels, hold = [each.kernels(fit.shared.matrix) for each in (model, finer)], prior_weights(model)
    generator, added = torch.Generator().manual_seed(0), []
    for t in sorted({round(t) for t in np.linspace(0, len(fit.own) - 1, _DRAWN)}):
        own, weight = fit.own[t], torch.where(noise[t] > 0, 1 / noise[t].clamp(min=1e-30), 0.0)
        drawn = torch.randn(n, many - few, dtype=torch.float64, generator=generator, device="cpu") @ mixing.T
        modes = torch.cat([own[PLACE:].view(n, few), math.sqrt(strength) * drawn], 1)
        made, by_own, _ = model.linearise(own, fit.shared, kernels[0])
        change = finer.image(torch.cat([own[:PLACE], modes.flatten()]), fit.shared, kernels[1]) - made
        taken = torch.linalg.solve((by_own.T * weight) @ by_own + hold.diag(), by_own.T @ (weight * change))
        rest = (change - by_own @ taken) ** 2
        added.append(float(rest[noise[t] > 0].sum() / scale[t]))
    return sum(added) / len(added)
