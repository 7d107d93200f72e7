"""A plan: the map of the predicted error, and its least point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from torchmask.instrument.instrument import Instrument
from torchmask.optics.pupil import Aperture
from torchmask.planning.success import SUCCESS, BlindOutlook

_EMPTY = 0.99  # expected error from which an image shows nothing
_FEW_REPEAT = 0.7  # of the frames that show turbulence of their own: from here on the others are not worth a word
_LIMIT = (
    "At no point of the map were blind restorations tried: each of their errors is a lower limit, that of the nearest "
    "conditions which were. Restore simulated frames before you trust this plan."
)
_NOTHING = "Such an image shows nothing of the target: it needs more light, by time, band, holes or a brighter target."

AXES = ("n_subapertures", "hole_diameter", "exposure", "width")


@dataclass(frozen=True)
class Choice:
    """One point of a plan's map.

    hole diameter in metres, exposure in seconds, width of the band in metres (None for a filter), photons and sky in
    electrons per frame (of the sky, per pixel)
    relative_mse, above_floor : predicted for a linear estimate that knows the PSFs, and that less what no mask of this
        diameter can avoid
    blind_mse : expected where the aberrations have to be found, at least so much where that was not tried
    blind : what was measured of such restorations; of both, frames or light are left out where that is better
    """

    n_subapertures: int
    hole_diameter: float
    exposure: float
    width: float | None
    frames: int
    photons: float
    sky: float
    relative_mse: float
    above_floor: float
    blind_mse: float
    blind: BlindOutlook

    @property
    def is_limit(self) -> bool:
        """Whether `blind_mse` is only a lower limit, since blind restorations were tried under easier conditions."""
        return bool(self.blind.harder)


@dataclass(frozen=True)
class ObservationPlan:
    """The map of the predicted error, and its least point; `print` shows both as Markdown.

    instrument : what was planned for
    choices : every point that can be built
    masks : by number of holes and hole diameter [m]
    left_out : why points of the axes are missing
    tried_up_to : the largest value of an axis at which blind restorations were tried
    full_pupil : the plan of the same telescope without a mask, beside searched masks; its `relative_mse` is that of
        instants in narrow light

    Examples
    --------
    >>> from torchmask.instrument.parts import Site, Source, Telescope
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.planning.plan import plan_observation
    >>> instrument = Instrument(
    ...     telescope=Telescope(diameter=1.0),
    ...     source=Source(photon_rate=1e9),
    ...     site=Site(r0=0.15, wind=10.0),
    ...     wavelength=550e-9,
    ...     width=10e-9,
    ...     exposure=2e-3,
    ...     n_frames=10,
    ... )
    >>> mask = SparseAperture.from_catalog("golay6", 1.0, 0.1)
    >>> plan = plan_observation(instrument, aperture=mask, exposures=(2e-3,), n_frequencies=32)
    >>> plan.mask is mask, len(plan.choices)
    (True, 1)
    """

    instrument: Instrument
    choices: tuple[Choice, ...]
    masks: dict[tuple[int, float], Aperture]
    left_out: tuple[str, ...] = ()
    tried_up_to: Mapping[str, float] = field(default_factory=dict)
    full_pupil: ObservationPlan | None = None

    @property
    def best(self) -> Choice:
        """Where the predicted error of a blind restoration is least: of the points where more than a limit is known, if
        there are any."""
        known = [choice for choice in self.choices if not choice.is_limit]
        return min(known or self.choices, key=lambda choice: choice.blind_mse)

    @property
    def best_known(self) -> Choice:
        """Where the predicted error would be least if the PSFs were known."""
        return min(self.choices, key=lambda choice: choice.relative_mse)

    @property
    def mask(self) -> Aperture:
        """The aperture of the best point."""
        return self.masks[self.best.n_subapertures, self.best.hole_diameter]

    @property
    def shows_something(self) -> bool:
        """Whether the best image is expected to show anything of the target."""
        return self.best.blind_mse <= _EMPTY

    def axis(self, name: str) -> list[Choice]:
        """Return the points that differ from the best one in `name` alone, in order."""
        others = [other for other in AXES if other != name]
        best = self.best
        line = [c for c in self.choices if all(getattr(c, other) == getattr(best, other) for other in others)]
        return sorted(line, key=lambda choice: getattr(choice, name))

    @property
    def best_instrument(self) -> Instrument:
        """The instrument with the exposure and the width of the band of the best point."""
        found, best = self.instrument.with_exposure(self.best.exposure), self.best
        return found if best.width in (None, found.width) else found.with_width(best.width)

    def at_edge(self, name: str) -> bool:
        """Return whether the best point is the first or last along an axis, so that the optimum may lie beyond.

        Points of which only a limit is known are not counted beside others.
        """
        line = self._known(name)
        return len(self.axis(name)) > 1 and self.best in (line[0], line[-1])

    def _known(self, name: str) -> list[Choice]:
        """Return the points along an axis of which as much is known as of the best one."""
        return [choice for choice in self.axis(name) if choice.is_limit == self.best.is_limit]

    @property
    def best_exposure(self) -> float:
        """The exposure [s] of the least error, between those of the map: by a parabola through the three around it.

        At an edge of the axis, the edge.
        """
        return self._between("exposure")

    @property
    def best_width(self) -> float | None:
        """The width of the band [m] of the least error, found as `best_exposure` is; None for a filter."""
        return None if self.best.width is None else self._between("width")

    def _between(self, name: str) -> float:
        line, best = self._known(name), getattr(self.best, name)
        place = line.index(self.best)
        if place in (0, len(line) - 1):
            return best
        x, y = np.log([[getattr(c, name), c.blind_mse] for c in line[place - 1 : place + 2]]).T
        curvature, slope, _ = np.polyfit(x - x[1], y, 2)
        return best * math.exp(-slope / (2 * curvature))

    def _edge(self, name: str) -> str:
        """Return a sentence on an axis along which the best point is the first or last."""
        axis, best = _WORDS[name], getattr(self.best, name)
        told = f"The best {axis.words}, {axis.scale * best:.4g}{axis.unit}, is the"
        known = self._known(name)
        first = self.best is known[0] and len(known) > 1
        limit = self.tried_up_to.get(name, math.inf)
        if not first and (self.best is not self.axis(name)[-1] or best > 0.999 * limit):
            room = (
                f"up to {axis.scale * limit:.4g}{axis.unit} a larger one may be better, "
                if best < 0.999 * limit
                else ""
            )
            return (
                f"{told} largest on the map at which blind restorations were tried: {room}beyond they lose more, by "
                "how much is not known."
            )
        place, beyond, side = ("first", "a smaller", "below") if first else ("last", "a larger", "above")
        return f"{told} {place} on the map: {beyond} one may be better, so give {axis.parameter} {side} it too."

    def __str__(self) -> str:
        best, told = self.best, self.best_instrument
        band = "" if best.width is None else f", a band of {1e9 * best.width:.4g} nm"
        between = self.best_width if len(self.axis("width")) > 1 else None
        width = "" if between is None else f"; best width: {1e9 * between:.4g} nm"
        lines = [
            f"Least predicted error of a blind restoration, from 0 for a perfect image to 1 for an empty one: "
            f"{best.blind_mse:.4g}, of which no mask of this diameter can avoid "
            f"{best.relative_mse - best.above_floor:.4g}, with {self._point(best)} "
            f"({best.hole_diameter / told.site.r0:.2g} r0, {best.exposure / told.seeing.tau0:.2g} tau0){band} and "
            f"{best.photons:.4g} photons in each.",
            *([_LIMIT] if best.is_limit else [_blind_line(best.blind)]),
            *([] if self.shows_something else [_NOTHING]),
            *self._repeating_line(),
            *self._full_pupil_line(),
            f"Predicted for a linear estimate that knows the PSFs: {best.relative_mse:.4g}; the least would be "
            f"{self.best_known.relative_mse:.4g}, with {self._point(self.best_known)}.",
            f"Best exposure between those of the map: {1e3 * self.best_exposure:.4g} ms{width}.",
            *(self._edge(name) for name in AXES if self.at_edge(name)),
            "",
            "| " + " | ".join(_HEADINGS) + " |",
            "|" + "---|" * len(_HEADINGS),
            *("| " + " | ".join(_cells(choice)) + " |" for choice in self.choices),
        ]
        return "\n".join(
            [*lines, *(["", *(f"- left out: {reason}" for reason in self.left_out)] if self.left_out else [])]
        )

    def _point(self, choice: Choice) -> str:
        """Return the pupil of a point, and its frames, in words."""
        pupil = f"{choice.n_subapertures} holes of {choice.hole_diameter:.4g} m"
        if self.masks[choice.n_subapertures, choice.hole_diameter].is_full:
            pupil = f"the full pupil of {choice.hole_diameter:.4g} m"
        return f"{pupil}, {choice.frames} frames of {1e3 * choice.exposure:.4g} ms"

    def _repeating_line(self) -> list[str]:
        """Return a sentence on frames that show the same turbulence, where many do."""
        best, told = self.best, self.best_instrument
        differ = told.frames_that_differ(best.hole_diameter)
        if differ > _FEW_REPEAT * best.frames:
            return []
        crossing = 1e3 * best.hole_diameter / told.site.wind
        return [
            f"The wind takes {crossing:.3g} ms to cross {best.hole_diameter:.4g} m, so only about {differ:.0f} of the "
            f"{best.frames} frames show turbulence of their own; the prediction counts them all. Frames that are "
            "further apart in time show more."
        ]

    def _full_pupil_line(self) -> list[str]:
        """Return a sentence on what the telescope attains without a mask."""
        if self.full_pupil is None:
            return []
        full = self.full_pupil.best
        least, why = f"{full.blind_mse:.4g}", ""
        if full.is_limit:
            least, why = f"at least {least}", "; such restorations were tried under easier conditions only"
            if "d_over_r0" in full.blind.harder:
                why += f", up to D/r0 = {self.full_pupil.tried_up_to['hole_diameter'] / self.instrument.site.r0:.3g}"
        band = "" if full.width is None else f", a band of {1e9 * full.width:.4g} nm"
        return [f"Without a mask the least is {least}, with {self.full_pupil._point(full)}{band}{why}."]


def _blind_line(blind: BlindOutlook) -> str:
    return (
        f"Of blind restorations under such conditions, with frames or light left out if that is better, "
        f"{100 * blind.success:.0f} % ({100 * blind.low:.0f} to "
        f"{100 * blind.high:.0f} %) end within {SUCCESS:g} times the score, an error in amplitude, that they have with "
        f"known PSFs; the median is {blind.cost:.3g} times. With known PSFs, at this exposure and in this band, scores "
        f"are {blind.restored:.3g} times those predicted for a linear estimate of instants in narrow light."
    )


class _Words(NamedTuple):
    """How to write of an axis: its name, its unit, 1 in that unit, and the parameter of `plan_observation`."""

    words: str
    unit: str
    scale: float
    parameter: str


_WORDS = {
    "n_subapertures": _Words("number of holes", "", 1, "n_subapertures"),
    "hole_diameter": _Words("hole diameter", " m", 1, "hole_diameters"),
    "exposure": _Words("exposure", " ms", 1e3, "exposures"),
    "width": _Words("width of the band", " nm", 1e9, "widths"),
}
_HEADINGS = (
    "N",
    "hole [m]",
    "exposure [ms]",
    "band [nm]",
    "frames",
    "photons/frame",
    "sky/pixel",
    "relative MSE",
    "above the floor",
    "blind",
    "success",
)


def _cells(choice: Choice) -> list[str]:
    return [
        str(choice.n_subapertures),
        f"{choice.hole_diameter:.4g}",
        f"{1e3 * choice.exposure:.4g}",
        "-" if choice.width is None else f"{1e9 * choice.width:.4g}",
        str(choice.frames),
        f"{choice.photons:.4g}",
        f"{choice.sky:.4g}",
        f"{choice.relative_mse:.4f}",
        f"{choice.above_floor:.4f}",
        f"{'> ' * choice.is_limit}{choice.blind_mse:.4f}",
        "-" if choice.is_limit else f"{100 * choice.blind.success:.0f} %",
    ]
