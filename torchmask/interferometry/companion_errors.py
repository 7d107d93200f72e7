"""Errors of a detected companion, from the exposures themselves and from companions injected beside a single star.

Companions (contrast, east, north) are in radians on the sky; tables give milliarcseconds, degrees and magnitudes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmask.grid import ARCSEC, MAS
from torchmask.interferometry.companion import CompanionModel, Exposures
from torchmask.interferometry.companion_fit import CompanionFit, fit_companion
from torchmask.metrics import shift
from torchmask.record import Callback, Record

MEASURED = ("separation", "position_angle", "magnitude_difference")


def polar(companion: Tensor) -> dict[str, float]:
    """Return separation [mas], position angle [deg, north through east] and magnitude difference.

    Examples
    --------
    >>> found = polar(torch.tensor([0.01, 0.3 * ARCSEC, 0.0], dtype=torch.float64))
    >>> {name: round(value, 6) for name, value in found.items()}
    {'separation': 300.0, 'position_angle': 90.0, 'magnitude_difference': 5.0}
    """
    contrast, east, north = companion.tolist()
    return {
        "separation": math.hypot(east, north) / MAS,
        "position_angle": math.degrees(math.atan2(east, north)) % 360,
        "magnitude_difference": -2.5 * math.log10(contrast) if contrast > 0 else math.inf,
    }


def rotation_towards(companion: Tensor) -> Tensor:
    """Return the rotation (3, 3) from (contrast, east, north) to contrast, and along and across the separation."""
    east, north = (companion[1:] / torch.linalg.vector_norm(companion[1:])).tolist()
    return torch.tensor([[1, 0, 0], [0, east, north], [0, north, -east]], dtype=torch.float64)


def inject_companion(exposures: Exposures, star: CompanionFit, companion: Tensor) -> Exposures:
    """Return the exposures with a companion added, a dimmed and shifted copy of the star's own image.

    In bad pixels the image is taken from `star`, a fit without companion.
    """
    light = torch.where(exposures.valid, exposures.frames, star.images) - star.parameters.own[:, 1, None, None]
    moved = shift(light, exposures.to_pixels @ companion[1:])
    return replace(exposures, frames=exposures.frames + companion[0] * moved)


def injection_errors(
    model: CompanionModel,
    exposures: Exposures,
    star: CompanionFit,
    like: Tensor,
    n: int,
    step: float,
    callback: Callback | None = None,
) -> tuple[Tensor, list[dict[str, float]]]:
    """Inject companions beside a single star and measure the errors with which they are recovered.

    Parameters
    ----------
    model : CompanionModel
        Model of the exposures.
    exposures : Exposures
        Exposures of a single star.
    star : CompanionFit
        Fit to them without companion.
    like : (3,) tensor
        Companion whose contrast and separation are injected.
    n : int
        Number of injected companions, at equidistant position angles.
    step : float
        Step of the search raster [arcsec]; each fit starts at its nearest point.
    callback : callable, optional
        Called with a `Record` of stage "injection" after each companion.

    Returns
    -------
    errors : (n, 3) tensor
        Errors in contrast, and along and across the separation [rad].
    rows : list of dict
        Position angle of each companion, and its recovered values.
    """
    radius, raster = float(torch.linalg.vector_norm(like[1:])), step * ARCSEC
    errors: list[Tensor] = []
    rows: list[dict[str, float]] = []
    for i in range(n):
        angle = 2 * math.pi * (i + 0.5) / n
        outwards = torch.tensor([math.sin(angle), math.cos(angle)], dtype=torch.float64)
        truth = torch.cat([like[:1], radius * outwards])
        start = torch.cat([like[:1], (truth[1:] / raster).round() * raster])
        injected = inject_companion(exposures, star, truth)
        found = fit_companion(model, injected, start, star.parameters).companion
        errors.append(rotation_towards(truth) @ (found - truth))
        rows.append({"true_position_angle": math.degrees(angle)} | polar(found))
        if callback is not None:
            callback(Record("injection", i + 1, n, {"contrast_error": float(errors[-1][0] / like[0])}))
    return torch.stack(errors), rows


def measured_companion(fit: CompanionFit, systematic: Tensor) -> dict[str, Any]:
    """Return the companion of a fit with its errors, as numbers for a table.

    Parameters
    ----------
    fit : CompanionFit
        Fit with a companion.
    systematic : (3,) tensor
        Systematic errors in contrast, and along and across the separation [rad].

    Returns
    -------
    dict
        `MEASURED` by name; "statistical_error" (the larger of jackknife and noise), "systematic_error" and
        "total_error" with the same names; contrast, chi_square, exposures.
    """
    n, rotation = len(fit.jackknife), rotation_towards(fit.companion)
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


def differences_over_errors(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Return the differences of two results of `measured_companion` over their statistical errors."""
    found = {}
    for name in MEASURED:
        error = math.hypot(one["statistical_error"][name], other["statistical_error"][name])
        difference = one[name] - other[name]
        difference = (difference + 180) % 360 - 180 if name == "position_angle" else difference
        found[name] = difference / error
    return found
