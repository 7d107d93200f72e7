"""How well a companion is known that was found: from the exposures themselves, and from companions put beside a star.

Companions (contrast, east, north) are in radians on the sky; what is said of them is in milliarcseconds, degrees and
magnitudes.
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
    """Separation [mas], position angle [deg, north through east] and magnitude difference.

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
    """The rotation (3, 3) from (contrast, east, north) to contrast, along and across the direction of a companion."""
    east, north = (companion[1:] / torch.linalg.vector_norm(companion[1:])).tolist()
    return torch.tensor([[1, 0, 0], [0, east, north], [0, north, -east]], dtype=torch.float64)


def inject_companion(exposures: Exposures, star: CompanionFit, companion: Tensor) -> Exposures:
    """The exposures with a companion made of the star's own light, dimmed and moved.

    Bad pixels give the light of `star`, a fit without companion.
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
    """Errors with which companions are found that were put beside a single star.

    Parameters
    ----------
    model : CompanionModel
    exposures : Exposures
        Of a single star.
    star : CompanionFit
        To them, without companion.
    like : (3,) tensor
        The companion whose contrast and separation these have, at n position angles.
    n : int
    step : float
        Of the search's raster [arcsec], from whose nearest point each is fitted.
    callback : callable, optional
        Receives a `Record` of stage "injection" after each.

    Returns
    -------
    errors : (n, 3) tensor
        In contrast, along and across the separation [rad].
    rows : list of dict
        The position angle of each, and what was found.
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
    """The companion of a fit with its errors, as numbers for a table.

    Parameters
    ----------
    fit : CompanionFit
    systematic : (3,) tensor
        Errors that the exposures do not show: in contrast, along and across the separation [rad].

    Returns
    -------
    dict
        `MEASURED` by name; "statistical_error", that of the exposures (jackknife, or the noise if that is more),
        "systematic_error" and "total_error" with the same names; contrast, chi_square, exposures.
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
    """Differences of two of `measured_companion` over their errors, those of the exposures alone."""
    found = {}
    for name in MEASURED:
        error = math.hypot(one["statistical_error"][name], other["statistical_error"][name])
        difference = one[name] - other[name]
        difference = (difference + 180) % 360 - 180 if name == "position_angle" else difference
        found[name] = difference / error
    return found
