"""How faint a companion would be found beside a single star, and how well one is known that was found.

Offsets and companions (contrast, east, north) are in radians on the sky; what is said of them is in arcseconds,
milliarcseconds, degrees and magnitudes.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from companion_fit import CompanionModel, Exposures, Fit
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.record import Callback, Record

SIGNIFICANCE = 5.0  # times the scatter of the calibrator: what counts as found
MAS = ARCSEC / 1000
MEASURED = ("separation", "position_angle", "magnitude_difference")


def polar(companion: Tensor) -> dict[str, float]:
    """Separation [mas], position angle [deg, north through east] and magnitude difference."""
    contrast, east, north = companion.tolist()
    return {
        "separation": math.hypot(east, north) / MAS,
        "position_angle": math.degrees(math.atan2(east, north)) % 360,
        "magnitude_difference": -2.5 * math.log10(contrast) if contrast > 0 else math.inf,
    }


def turn(companion: Tensor) -> Tensor:
    """The rotation (3, 3) from (contrast, east, north) to contrast, along and across the direction of a companion."""
    east, north = (companion[1:] / torch.linalg.vector_norm(companion[1:])).tolist()
    return torch.tensor([[1, 0, 0], [0, east, north], [0, north, -east]], dtype=torch.float64)


def places(step: float, least: float = 0.1, most: float = 0.7) -> Tensor:
    """Offsets (M, 2) to search, between two separations [arcsec]."""
    n = math.ceil(most / step)
    line = torch.arange(-n, n + 1, dtype=torch.float64) * step * ARCSEC
    grid = torch.cartesian_prod(line, line)
    separation = torch.linalg.vector_norm(grid, dim=1) / ARCSEC
    return grid[(separation > least) & (separation < most)]


@dataclass(frozen=True)
class Limits:
    """Faintest companion that would be found, by separation [arcsec] of annuli."""

    separation: np.ndarray
    contrast: np.ndarray

    def __call__(self, offsets: Tensor) -> Tensor:
        """Limiting contrast at offsets (..., 2)."""
        away = torch.linalg.vector_norm(offsets, dim=-1) / ARCSEC
        return torch.from_numpy(np.interp(away.numpy(), self.separation, self.contrast))


def detection_limits(offsets: Tensor, contrast: Tensor) -> Limits:
    """SIGNIFICANCE times the rms contrast that is found, annulus by annulus, where there is no companion."""
    away = torch.linalg.vector_norm(offsets, dim=1) / ARCSEC
    edges = torch.arange(0.1, float(away.max()) + 0.05, 0.1, dtype=torch.float64)
    inside = [(away >= low - 0.025) & (away < low + 0.125) for low in edges[:-1]]
    rms = [SIGNIFICANCE * float(contrast[ring].square().mean().sqrt()) for ring in inside]
    return Limits((edges[:-1] + 0.05).numpy(), np.array(rms))


def inject(exposures: Exposures, star: Fit, companion: Tensor) -> Exposures:
    """The exposures with a companion made of the star's own light, shifted; bad pixels give the model's."""
    light = torch.where(exposures.valid, exposures.frames, star.images) - star.own[:, 1, None, None]
    nu = [torch.fft.fftfreq(n, dtype=torch.float64) for n in light.shape[1:]]
    move = torch.einsum("tij,j->ti", exposures.to_pixels, companion[1:])
    phase = nu[0][:, None] * move[:, 0, None, None] + nu[1] * move[:, 1, None, None]
    moved = torch.fft.ifft2(torch.fft.fft2(light) * torch.exp(-2j * math.pi * phase)).real
    return dataclasses.replace(exposures, frames=exposures.frames + companion[0] * moved)


def injection_errors(
    model: CompanionModel, exposures: Exposures, star: Fit, like: Tensor, n: int, step: float, callback: Callback
) -> tuple[Tensor, list[dict[str, float]]]:
    """Errors (n, 3) in contrast, along and across the separation, with which such a companion is found.

    The same contrast and separation at n position angles beside the calibrator, each fitted from the nearest point
    of the search grid, `step` [arcsec] wide.
    """
    radius, errors, rows = float(torch.linalg.vector_norm(like[1:])), [], []
    for i in range(n):
        angle = 2 * math.pi * (i + 0.5) / n
        outwards = torch.tensor([math.sin(angle), math.cos(angle)], dtype=torch.float64)
        truth = torch.cat([like[:1], radius * outwards])
        start = torch.cat([like[:1], (truth[1:] / (step * ARCSEC)).round() * step * ARCSEC])
        found = model.fit(inject(exposures, star, truth), start, star).companion
        errors.append(turn(truth) @ (found - truth))
        rows.append({"true_position_angle": math.degrees(angle)} | polar(found))
        callback(Record("injection", i + 1, n, {"contrast_error": float(errors[-1][0] / like[0])}))
    return torch.stack(errors), rows


def measurement(fit: Fit, systematic: Tensor) -> dict[str, Any]:
    """The companion of a fit with its errors.

    Those of the exposures (jackknife, or the noise if that is more), and `systematic` (3,): in contrast, along and
    across.
    """
    n, rotation = len(fit.jackknife), turn(fit.companion)
    scatter = (fit.jackknife - fit.jackknife.mean(0)) @ rotation.T
    jackknife = (n - 1) / n * (scatter**2).sum(0)
    noise = (rotation @ fit.covariance @ rotation.T).diagonal()
    statistical = torch.maximum(jackknife, noise).sqrt()
    radius = float(torch.linalg.vector_norm(fit.companion[1:]))

    def named(errors: Tensor) -> dict[str, float]:
        contrast, along, across = errors.tolist()
        share = contrast / abs(float(fit.companion[0]))
        values = (along / MAS, math.degrees(across / radius), 2.5 / math.log(10) * share)
        return dict(zip(MEASURED, values, strict=True))

    return {
        "contrast": float(fit.companion[0]),
        **polar(fit.companion),
        "statistical_error": named(statistical),
        "systematic_error": named(systematic),
        "total_error": named(torch.hypot(statistical, systematic)),
        "chi_square": fit.chi_square.tolist(),
        "exposures": n,
    }


def agreement(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Differences of two measurements over their errors, those of the exposures alone."""
    found = {}
    for name in MEASURED:
        error = math.hypot(one["statistical_error"][name], other["statistical_error"][name])
        difference = one[name] - other[name]
        difference = (difference + 180) % 360 - 180 if name == "position_angle" else difference
        found[name] = difference / error
    return found
