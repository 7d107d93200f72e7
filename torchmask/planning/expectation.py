"""What is expected of restorations that have to find the aberrations, for the points of a plan."""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from torchmask.design.observed import change_light, instant_criterion
from torchmask.design.turbulent import TurbulentMSE
from torchmask.instrument.instrument import Instrument
from torchmask.optics.pupil import Aperture
from torchmask.planning.smearing import phase_spread, smearing_map
from torchmask.planning.success import BlindOutlook, Pupil, success_map


class Expected(NamedTuple):
    """What is expected at one point.

    error : relative mean squared error of a blind restoration
    blind : what was measured of such restorations under the nearest conditions, or with frames or light left out if
        that gives the smaller error
    instants : relative error that is predicted for known PSFs of instants in narrow light with the photons of a frame
    floor : what of it no mask can avoid
    """

    error: float
    blind: BlindOutlook
    instants: float
    floor: float


def expect_blind(
    exposed: Sequence[Instrument], masks: Mapping[tuple[int, float], Aperture], n_frequencies: int
) -> dict[tuple[int, float, int], Expected]:
    """Return what is expected of each mask, by its key, and each instrument, by its place.

    Masks with holes of one size come one after the other, as they share what is known of the turbulence.
    """
    found, criterion = {}, None
    for (n, hole), mask in sorted(masks.items(), key=lambda item: item[0][1]):
        for place, instrument in enumerate(exposed):
            criterion = criterion or instant_criterion(instrument, float(mask.area), n_frequencies)
            found[n, hole, place] = _expect(criterion, mask, instrument)
    return found


def kind_of(aperture: Aperture) -> Pupil:
    """Return of which kind of pupil the restorations were that tell about an aperture."""
    return "full" if aperture.is_full else "mask"


def _expect(criterion: TurbulentMSE, aperture: Aperture, instrument: Instrument) -> Expected:
    """Return what is expected of one aperture; `criterion` is that of instants, whose light is changed.

    Frames and light can be left out, so no more is expected than of as much of either as restorations were tried with.
    """
    area = float(aperture.area)
    change_light(criterion, instrument, area)
    noise, floor = criterion.noise_psd.clone(), criterion.relative_floor(instrument.telescope.diameter)
    least_tried = smearing_map(kind_of(aperture)).n_photons[0]

    @functools.cache  # as points often have a factor in common
    def predict(factor: float) -> float:
        criterion.load_state_dict(criterion.state_dict() | {"noise_psd": factor * noise})
        return float(criterion.relative(aperture))

    def expect(photons: float, frames: float, factor: float) -> Expected:
        blind, error = _outlook(instrument, aperture, photons, frames), predict(factor)
        share = min(1.0, photons / least_tried)  # of less light than was tried, as of as much less noise
        tried = error if share == 1 else predict(share * factor)
        return Expected(_in_less_light(blind, error, tried, floor), blind, error, floor)

    light, frames = instrument.equivalent_photons(area), instrument.frames
    own = expect(light, frames, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what lies outside the maps, which the point itself has told
        less = [expect(*point) for point in _less(kind_of(aperture), light, frames)]
    best = min((own, *less), key=lambda one: one.error)
    blind = replace(best.blind, outside=own.blind.outside)
    return own._replace(error=best.error, blind=blind)


def _less(kind: Pupil, light: float, frames: int) -> Iterator[tuple[float, float, float]]:
    """Yield photons and frames with which restorations were tried, where they are less than there are, and by how much
    the noise over all frames grows with them."""
    tried = success_map(kind)
    lights = [light, *(photons for photons in tried.n_photons if photons < light)]
    numbers = [frames, *(number for number in tried.n_frames if number < frames)]
    for photons, number in itertools.product(lights, numbers):
        if (photons, number) != (light, frames):
            yield photons, number, light / photons * frames / number


def _outlook(instrument: Instrument, aperture: Aperture, photons: float, frames: float) -> BlindOutlook:
    """Return what was measured of restorations that have to find the aberrations behind an aperture."""
    kind, r0, diameter = kind_of(aperture), instrument.site.r0, instrument.telescope.diameter
    instants = success_map(kind).outlook(aperture.subaperture_diameter / r0, photons, frames)
    spread = phase_spread(instrument.band.relative_width, diameter / r0)
    exposure = instrument.exposure / instrument.seeing.tau0
    return smearing_map(kind).outlook(instants, n_photons=photons, exposure=exposure, spread=spread)


def _in_less_light(blind: BlindOutlook, error: float, tried: float, floor: float) -> float:
    """Return the error expected of a blind restoration, where `error` is predicted for instants in narrow light.

    `tried` is predicted for the least light in which restorations were tried, or is `error` where there is more, and
    `floor` is what of both no mask can avoid. In less light a restoration is taken to lose the same share of the image
    as the linear estimate does, so that from no light nothing is expected.
    """
    return 1 - (1 - blind.mse(tried, tried - floor)) * (1 - error) / (1 - tried)
