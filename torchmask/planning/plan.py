"""Planning an observation: the error over the number of holes, their size and the exposure, and where it is least."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

from torchmask.design.constraint_base import Constraint, Infeasible
from torchmask.design.observed import change_light, instrument_criterion
from torchmask.design.rules import MaskRules
from torchmask.design.search import search_mask
from torchmask.instrument.instrument import Instrument
from torchmask.optics.packing import largest_fill_factor
from torchmask.optics.pupil import Aperture
from torchmask.planning.axes import at_exposures, bands_of, or_default, positive, sampled, whole
from torchmask.planning.expectation import expect_blind, kind_of
from torchmask.planning.result import AXES, Choice, ObservationPlan
from torchmask.planning.smearing import phase_spread, smearing_map
from torchmask.planning.success import Pupil, success_map
from torchmask.record import Callback, Record

_HOLES = (0.5, 0.8, 1.2)  # in r0: wider holes hold aberrations that a blind restoration has to find
_EXPOSURES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # in tau0


class PlanInterrupted(KeyboardInterrupt):
    """An interruption of `plan_observation` after it has reached points of the map; `plan` is that of these points."""

    def __init__(self, plan: ObservationPlan) -> None:
        super().__init__()
        self.plan = plan


def plan_observation(
    instrument: Instrument,
    *,
    n_subapertures: Sequence[int] = (6, 9, 12, 16),
    hole_diameters: Sequence[float] | None = None,
    exposures: Sequence[float] | None = None,
    widths: Sequence[float] | None = None,
    aperture: Aperture | None = None,
    constraints: Sequence[Constraint] = (),
    n_frequencies: int = 128,
    budget: int = 1000,
    seed: int = 0,
    callback: Callback | None = None,
) -> ObservationPlan:
    """Return the predicted error over the number of holes, their size and the exposure, and where it is least.

    The error is `TurbulentMSE` with the photons, the sky, the frames and the read-out noise that follow from the
    instrument at each point, for a linear estimate that knows every transfer function. What to expect of a restoration
    that has to find the aberrations is that error for instants in narrow light, times what such restorations were
    measured to lose, `success_map`, and what light, exposure and band do to them, `smearing_map`. Each mask is searched
    for its number and size of holes by `AsymptoticMSE` (hybrid, `budget` evaluations) at the light of the instrument's
    own exposure, and kept for all exposures. Beside them the full pupil is planned, at the same exposures and widths.

    Parameters
    ----------
    instrument : Instrument
        Its own exposure is that of the searches.
    n_subapertures : sequence of int
        Numbers of holes N.
    hole_diameters : sequence of float, optional
        Diameters of the holes [m]; None: 0.5, 0.8 and 1.2 r0.
    exposures : sequence of float, optional
        Exposure times of a frame [s]; None: 0.25, 0.5, 1, 2, 4 and 8 tau0.
    widths : sequence of float, optional
        Widths of the even band [m], all of them on the pixels that the widest needs, or on those of the camera, without
        bands that they undersample; None: the instrument's band.
    aperture : Aperture, optional
        A mask that exists, or a full pupil, in place of the searches: only exposure and width are planned then, of
        nothing else.
    constraints : sequence of Constraint
        Rules of the searches; the central obstruction and the vanes of the telescope are among them already.
    n_frequencies : int
        Frequencies of the criterion's grid, per side.
    budget : int
        Evaluations of each search.
    seed : int
        Random seed of the searches.
    callback : callable, optional
        Gets a Record after each search and each point.

    Raises
    ------
    ValueError
        For an axis that is empty or holds what cannot be, an `aperture` that is a population, pixels that undersample
        the image at the shortest wavelength of every band, and if no point can be built: says why.
    PlanInterrupted
        If a KeyboardInterrupt comes when points of the map have been reached.

    Warns
    -----
    UserWarning
        If points lie outside what blind restorations were tried on.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.instrument.parts import Camera, Site, Source, Telescope
    >>> instrument = Instrument(
    ...     telescope=Telescope(diameter=1.0),
    ...     source=Source(photon_rate=1e9),
    ...     site=Site(r0=0.15, wind=10.0),
    ...     camera=Camera(readout_noise=1.0, readout_time=1e-3),
    ...     wavelength=550e-9,
    ...     width=10e-9,
    ...     exposure=2e-3,
    ...     observing_time=0.05,
    ... )
    >>> mask = SparseAperture.from_catalog("golay6", 1.0, 0.1)
    >>> plan = plan_observation(instrument, aperture=mask, exposures=(6e-3,), n_frequencies=32)
    >>> plan.best.frames
    7
    """
    if aperture is not None and aperture.centers.ndim != 2:
        raise ValueError(
            f"aperture has centers of shape {tuple(aperture.centers.shape)}: one mask is needed, (n_subapertures, 2); "
            "plan each of a population by itself"
        )
    lengths = positive("exposures", or_default(exposures, _EXPOSURES, instrument.seeing.tau0), "s")
    left_out: list[str] = []
    bands = [instrument] if widths is None else bands_of(instrument, positive("widths", tuple(widths), "m"))
    bands = sampled(bands, aperture, left_out)
    exposed = [one for band in bands for one in at_exposures(band, lengths, left_out)]
    if not exposed:
        raise ValueError(f"no exposure is short enough: {left_out[-1]}")
    if aperture is None:
        numbers, sizes = whole(n_subapertures), or_default(hole_diameters, _HOLES, instrument.site.r0)
        points = tuple(itertools.product(numbers, positive("hole_diameters", sizes, "m")))
        settings, n_known = {"budget": budget, "seed": seed, "n_frequencies": n_frequencies}, len(left_out)
        masks = _search(instrument, points, _rules(instrument, constraints), settings, left_out, callback)
        if not masks:  # the first has the fewest and smallest holes, the nearest to what can be built
            reason, *others = left_out[n_known:]
            more = f"; nor can the other {len(others)}, of more or wider holes" if others else ""
            raise ValueError(f"no point of the map can be built: {reason}{more}")
        alone = _alone(instrument.telescope.pupil())
        reached = list(_measure(exposed, alone, n_frequencies, callback, beside=True))
        full = _plan_of(instrument, reached, alone)
    else:
        masks, full = _alone(aperture), None
    choices: list[Choice] = []
    try:
        for choice in _measure(exposed, masks, n_frequencies, callback, beside=False):
            choices.append(choice)
    except KeyboardInterrupt as error:
        if not choices:
            raise
        left_out.append(f"interrupted: {len(choices)} of {len(exposed) * len(masks)} points of the map were reached")
        raise PlanInterrupted(_plan_of(instrument, choices, masks, left_out, full)) from error
    return _plan_of(instrument, choices, masks, left_out, full)


def _alone(aperture: Aperture) -> dict[tuple[int, float], Aperture]:
    return {(aperture.n_subapertures, aperture.subaperture_diameter): aperture}


def _plan_of(
    instrument: Instrument,
    choices: Sequence[Choice],
    masks: dict[tuple[int, float], Aperture],
    left_out: Sequence[str] = (),
    full: ObservationPlan | None = None,
) -> ObservationPlan:
    """Return the plan of given points, of masks which are all of one kind of pupil."""
    points = tuple(sorted(choices, key=lambda choice: tuple(getattr(choice, name) for name in AXES)))
    reached = {(choice.n_subapertures, choice.hole_diameter) for choice in points}
    tried = _tried_up_to(instrument, kind_of(next(iter(masks.values()))))
    kept = {point: mask for point, mask in masks.items() if point in reached}
    return ObservationPlan(instrument, points, kept, tuple(dict.fromkeys(left_out)), tried, full)


def _rules(instrument: Instrument, constraints: Sequence[Constraint]) -> tuple[Constraint, ...]:
    telescope = instrument.telescope
    own = MaskRules(central_obstruction=telescope.central_obstruction, spiders=telescope.spiders)
    return (*constraints, *own.constraints())


def _search(
    instrument: Instrument,
    points: Sequence[tuple[int, float]],
    rules: tuple[Constraint, ...],
    settings: dict[str, Any],
    left_out: list[str],
    callback: Callback | None,
) -> dict[tuple[int, float], Aperture]:
    """Return a mask for each number of holes and hole diameter, where one can be built."""
    diameter, masks = instrument.telescope.diameter, {}
    for step, (n, hole) in enumerate(points, 1):
        fill, most = n * (hole / diameter) ** 2, largest_fill_factor(n)
        if fill > most:
            left_out.append(f"{n} holes of {hole:.4g} m do not fit: at most {diameter * math.sqrt(most / n):.4g} m")
            continue
        area = n * math.pi / 4 * hole**2
        criterion = instrument_criterion(instrument, area, settings["n_frequencies"], turbulence=False)
        try:
            found = search_mask(
                criterion, n, diameter, fill, budget=settings["budget"], seed=settings["seed"], constraints=rules
            )
        except Infeasible as error:
            left_out.append(f"{n} holes of {hole:.4g} m: {error}")
            continue
        masks[n, hole] = found.aperture
        _tell(callback, "plan/search", step, len(points), found.relative_mse)
    return masks


def _measure(
    exposed: Sequence[Instrument],
    masks: dict[tuple[int, float], Aperture],
    n_frequencies: int,
    callback: Callback | None,
    *,
    beside: bool,
) -> Iterator[Choice]:
    """Yield the predicted error at every point; masks with holes of one size share what is known of the turbulence.

    For the full pupil `beside` masks the prediction is that of instants in narrow light alone, on which what is
    expected rests: long exposures and bands of a full pupil take minutes each.
    """
    step, n_steps = 0, len(exposed) * len(masks)
    expected = expect_blind(exposed, masks, n_frequencies)
    for place, instrument in enumerate(exposed):
        criterion = None
        for (n, hole), mask in sorted(masks.items(), key=lambda item: item[0][1]):
            area, (blind_error, blind, error, floor) = float(mask.area), expected[n, hole, place]
            if not beside:
                criterion = criterion or instrument_criterion(instrument, area, n_frequencies)
                change_light(criterion, instrument, area)
                error = float(criterion.relative(mask))
                floor = criterion.relative_floor(instrument.telescope.diameter)
            photons, sky = instrument.photons(area), instrument.sky(area)
            light = instrument.exposure, instrument.width, instrument.frames, photons, sky
            yield Choice(n, hole, *light, error, error - floor, blind_error, blind)
            step += 1
            _tell(callback, "plan/full" if beside else "plan/map", step, n_steps, error)


def _tried_up_to(instrument: Instrument, kind: Pupil) -> dict[str, float]:
    """Return the largest hole diameter [m], exposure [s] and band [m] at which blind restorations were tried."""
    site, smearing = instrument.site, smearing_map(kind)
    most = {
        "hole_diameter": success_map(kind).d_over_r0[-1] * site.r0,
        "exposure": smearing.exposures[-1] * instrument.seeing.tau0,
    }
    spread = phase_spread(instrument.band.relative_width, instrument.telescope.diameter / site.r0)
    if instrument.width is not None and spread > 0:  # a single wavelength stands for a band without spread
        most["width"] = smearing.spreads[-1] / spread * instrument.width
    return most


def _tell(callback: Callback | None, stage: str, step: int, n_steps: int, relative_mse: float) -> None:
    if callback is not None:
        callback(Record(stage, step, n_steps, {"relative_mse": relative_mse}))
