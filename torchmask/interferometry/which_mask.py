"""Which mask was in the beam, and how it lay, as far as the power of fringes in frames of any object tells."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.fringe_power import FringePower, Match, expected_power, fringe_wavelengths, likeness
from torchmask.optics import catalog
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.geometry import MaskGeometry

ORIENTATIONS = {
    "with x reversed": MaskGeometry(mirrored=True),
    "with x and y swapped": MaskGeometry(math.pi / 2, mirrored=True),
    "turned by 90 degrees": MaskGeometry(math.pi / 2),
}
"""Orientations besides the given one; these four turned by 180 degrees make the same fringes."""

_NAMED = 2.5  # standard errors of the share by which another orientation must show
_RIGHT = 0.6  # least share of the right mask, with two standard errors added, see docs/method.md
_RIGHT_IN_SECTORS = 0.7  # the same within sectors, which an object makes less uneven than rings
_FOUND = 4.0  # standard errors by which one of some hundred candidates must show
_SCALES = 0.7, 1.4  # range of magnifications that are tried
_FILLED_IN = 0.05  # of the light: with more in pixels that were filled in, the right mask may not show
_ALIKE = 0.95  # correlation of two patterns above which frames do not tell them apart


class MaskLook(NamedTuple):
    """What the fringes in frames say about the mask as given.

    contradiction : what speaks against it, and what fits better; empty if nothing
    unseen : which other orientations would make the same fringes; empty if there are none
    """

    contradiction: str = ""
    unseen: str = ""

    def warn(self, stacklevel: int) -> None:
        """Issue a warning if the fringes contradict the mask as given."""
        if self.contradiction:
            warnings.warn(self.contradiction, stacklevel=stacklevel + 1)


class _Comparison(NamedTuple):
    """How much of the pattern of the mask as given the power shows, and the orientation that fits clearly better."""

    told: Match
    better: tuple[str, Match] | None


def look_at_mask(
    frames: Tensor, aperture: Aperture, grid: Grid, band: Band | None = None, valid: Tensor | None = None
) -> MaskLook:
    """Compare the fringes of frames (T, H, W) with the mask as given, and with others if it does not fit.

    Others are its mirrored and turned orientations first, then the masks of the catalogue, and the given mask at any
    angle or at another scale. Nothing is said of a full pupil, of two holes, or where frames do not tell. Without a
    band the light has the wavelength of the grid. `valid` (T, H, W) bool is False where pixels were filled in: where
    these hold much of the light, which hides fringes, only an orientation that fits better contradicts the mask.
    """
    if not isinstance(aperture, SparseAperture) or aperture.n_subapertures < 3:
        return MaskLook()
    light = [] if band is None else fringe_wavelengths(aperture, grid, band)
    own = expected_power(aperture, grid, light)
    others = {name: expected_power(turn.apply(aperture), grid, light) for name, turn in ORIENTATIONS.items()}
    unseen = " or ".join(name for name, other in others.items() if likeness(own, other) > _ALIKE)
    power = FringePower.of(frames, aperture, grid, light)
    if power is None:
        return MaskLook(unseen=unseen)
    comparisons = []
    # Rings tell most, but of a long and narrow object they accuse the right mask: their sectors have to agree.
    for each, least in ((power, _RIGHT), (power.in_sectors(), _RIGHT_IN_SECTORS)):
        comparison = _compare(each, aperture, own, others)
        if comparison.better is None and _may_be(comparison.told, least):
            return MaskLook(unseen=unseen)
        comparisons.append(comparison)
    fits_none = all(comparison.better is None for comparison in comparisons)
    if fits_none and valid is not None and _is_filled_in(frames, valid):
        return MaskLook(unseen=unseen)
    return MaskLook(_contradiction(power, aperture, comparisons), unseen)


def require_mask(frames: Tensor, valid: Tensor, aperture: SparseAperture, grid: Grid) -> None:
    """Raise ValueError if the fringes in frames (T, H, W) of a star are not those of the mask.

    The message names the mask of the catalogue that they fit, if one fits clearly. Nothing is said where pixels that
    were filled in, False in `valid` (T, H, W), hold much of the light.
    """
    if _is_filled_in(frames, valid):
        return
    power = FringePower.of(frames, aperture, grid)
    if power is None or _may_be(told := _match(power, aperture)):
        return
    found = _clearest(power, _catalogue(aperture, grid))
    raise ValueError(
        f"the fringes of the frames are not those of this mask at any angle ({_shown(told)} of its pattern): "
        + (f"they fit {found[0]} ({_shown(found[1])})" if found else "no mask of the catalogue fits clearly either")
    )


def _is_filled_in(frames: Tensor, valid: Tensor) -> bool:
    """Return whether pixels that were filled in hold so much light that the right mask may not show."""
    return float((frames * ~valid).sum()) > _FILLED_IN * float(frames.sum())


def _match(power: FringePower, aperture: SparseAperture, pattern: Tensor | None = None) -> Match:
    """Return how much of the pattern of a mask the power shows, with the error that light in few rings leaves."""
    share, error = power.match(aperture, pattern)
    return Match(share, power.wider * error)


def _compare(power: FringePower, aperture: SparseAperture, own: Tensor, others: dict[str, Tensor]) -> _Comparison:
    """Compare with the `expected_power` (H, W) of a mask and of its other orientations, whose holes are as many."""
    told = _match(power, aperture, own)
    matches = {name: _match(power, aperture, other) for name, other in others.items()}
    name = max(matches, key=lambda key: matches[key].share)
    best = matches[name]
    is_better = best.share > max(told.share + best.error, _NAMED * best.error) and _may_be(best)
    return _Comparison(told, (name, best) if is_better else None)


def _contradiction(power: FringePower, aperture: SparseAperture, comparisons: Sequence[_Comparison]) -> str:
    """Return what is said of a mask that all comparisons contradict, and what fits better."""
    for told, better in comparisons:
        if better is not None:
            name, best = better
            return (
                f"the fringes of the frames fit the mask better {name} than as given (they show {best.share:.2f} of "
                f"its pattern instead of {told.share:.2f}): check its orientation, or calibrate it on frames of a star"
            )
    told = comparisons[0].told
    seen = f"the fringes of the frames are not those of the mask in any of its eight orientations ({_shown(told)}"
    found = _clearest(power, _catalogue(aperture, power.grid)) or _clearest(power, _moved(aperture))
    if found is not None:
        return f"{seen} of its pattern), but fit {found[0]} ({_shown(found[1])})"
    return (
        f"{seen} of its pattern): check which mask was in the beam, its angle, and its scale (wavelength, pixel "
        "scale); no mask of the catalogue fits clearly"
    )


def _may_be(match: Match, least: float = _RIGHT) -> bool:
    """Return whether the fringes may be those of the mask; a share below 0 is noise."""
    return max(match.share, 0.0) + 2 * match.error > least


def _shown(match: Match) -> str:
    return f"{match.share:.2f} +- {match.error:.2f}"


def _clearest(power: FringePower, candidates: Iterator[tuple[str, SparseAperture]]) -> tuple[str, Match] | None:
    """Return name and match of the candidate whose pattern is seen most clearly, if one is seen clearly."""
    matches = [(name, _match(power, mask)) for name, mask in candidates]
    best = max(matches, key=lambda pair: pair[1].share / pair[1].error, default=None)
    return best if best is not None and best[1].share > _FOUND * best[1].error else None


def _catalogue(aperture: SparseAperture, grid: Grid) -> Iterator[tuple[str, SparseAperture]]:
    """Return the masks of the catalogue that the grid samples, in their four orientations."""
    for name in catalog.names():
        known = catalog.entry(name)
        size = aperture.mask_diameter if known.pupil_diameter is None else None
        fill = aperture.fill_factor if size is not None or known.hole_diameter is None else None
        mask = SparseAperture.from_catalog(name, size, fill).to(aperture.centers)
        if mask.n_subapertures < 3 or grid.cutoff(mask.extent) > 0.5:
            continue
        yield f"{name} of the catalogue", mask
        for orientation, geometry in ORIENTATIONS.items():
            yield f"{name} of the catalogue {orientation}", geometry.apply(mask)


def _moved(aperture: SparseAperture) -> Iterator[tuple[str, SparseAperture]]:
    """Return the mask at other angles, also mirrored, and at other scales.

    The farthest fringes of one and the next are a hole's radius apart, half of what they are wide.
    """
    step = aperture.subaperture_diameter / aperture.mask_diameter
    for number in range(1, math.ceil(math.pi / step)):
        angle = f"turned by about {math.degrees(number * step):.0f} degrees from x to y"
        yield f"it {angle}", MaskGeometry(number * step).apply(aperture)
        yield f"it with x reversed, then {angle}", MaskGeometry(number * step, mirrored=True).apply(aperture)
    for number in range(math.ceil(math.log(_SCALES[0]) / step), math.floor(math.log(_SCALES[1]) / step) + 1):
        scale = math.exp(number * step)
        yield f"it magnified by about {scale:.2f}", MaskGeometry(0.0, scale, scale).apply(aperture)
