"""What is expected of restorations that have to find the aberrations, against its formula and maps that are known."""

import functools
import itertools
import warnings

import numpy as np
import pytest

import torchmask.planning.expectation
from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT
from torchmask.design.observed import instrument_criterion
from torchmask.design.turbulent import TurbulentMSE
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.planning.expectation import expect_blind
from torchmask.planning.smearing import SmearingMap, phase_spread
from torchmask.planning.success import SuccessMap

R0, WIND, SIDE = 0.15, 10.0, 24
TAU0 = R0 / WIND * STRUCTURE_CONSTANT**-0.6  # in which the phase at a point changes by 1 rad^2
MASK = SparseAperture([[-0.2, 0.0], [0.2, 0.05], [0.0, 0.3]], 0.1, 0.8)  # narrower than the telescope
FRAMES, LIGHTS, SIZES = (4, 10, 30), (2e2, 1e3, 1e4), (0.3, 0.9, 20.0)
LEAST = {"mask": 3e3, "full": 6e3}  # photons with which exposures and bands were tried


def maps_of(pupil):
    """Maps of random numbers, which differ between masks and full pupils."""
    random = np.random.default_rng(("mask", "full").index(pupil))
    lights = [light * (1.0 if pupil == "mask" else 1.2) for light in LIGHTS]
    shape = (len(FRAMES), len(LIGHTS), len(SIZES))
    cost, level = random.uniform(1.0, 1.4, shape), random.uniform(0.6, 0.8, shape)
    cost *= np.array([1.0, 1.2, 1.8])[:, None]  # so much that less light is better
    success = SuccessMap(FRAMES, lights, SIZES, np.full(shape, 8), random.integers(1, 8, shape), cost, "", pupil, level)
    tables = random.uniform(0.9, 1.3, (2, 2)), random.uniform(0.9, 1.3, (2, 2))
    return success, SmearingMap((LEAST[pupil], 1e5), (0.0, 3.0), (0.0, 2.0), *tables)


@pytest.fixture
def known(monkeypatch):
    """Maps that are known, and pistons alone in place of turbulence, which know no full pupil: a mask stands for it."""
    of_mask = TurbulentMSE.forward
    stand_in = functools.partial(instrument_criterion, turbulence=False)
    monkeypatch.setattr(torchmask.planning.expectation, "instant_criterion", stand_in)
    monkeypatch.setattr(TurbulentMSE, "forward", lambda self, aperture: of_mask(self, MASK))
    for place, name in enumerate(("success_map", "smearing_map")):
        monkeypatch.setattr(torchmask.planning.expectation, name, lambda pupil, place=place: maps_of(pupil)[place])


def instrument_of(photons, frames, aperture, exposure=2e-3):
    rate = photons / (float(aperture.area) * exposure)
    return Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(photon_rate=rate),
        site=Site(r0=R0, wind=WIND, sky=18.0),
        camera=Camera(n_pixels=32, readout_noise=1.0),
        wavelength=550e-9,
        width=20e-9,
        exposure=exposure,
        n_frames=frames,
    )


def formula(instrument, aperture):
    """The least error that is expected with all frames and light or with fewer that were tried, and with what."""
    success, smearing = maps_of("full" if aperture.is_full else "mask")
    area, size = float(aperture.area), aperture.subaperture_diameter
    whole = instrument_criterion(instrument, area, SIDE, turbulence=False)
    floor, light = whole.relative_floor(1.0), instrument.equivalent_photons(area)

    def linear(noise):
        """The prediction with `noise` times the noise."""
        psds = whole.object_psd, noise * whole.noise_psd
        return float(TurbulentMSE(whole.grid, *psds, instrument.frames, pixel=whole.pixel).relative(aperture))

    found = []
    lights = [light, *(one for one in success.n_photons if one < light)]
    numbers = [instrument.frames, *(one for one in FRAMES if one < instrument.frames)]
    for photons, frames in itertools.product(lights, numbers):
        noise = light / photons * instrument.frames / frames  # over all frames
        outlook = smearing.outlook(
            success.outlook(size / R0, photons, frames),
            n_photons=photons,
            exposure=instrument.exposure / TAU0,
            spread=phase_spread(instrument.band.relative_width, 1.0 / R0),
        )
        least = smearing.n_photons[0]
        tried = linear(noise * min(1, photons / least))
        kept = 1 - outlook.mse(tried, tried - floor)
        found.append((1 - kept * (1 - linear(noise)) / (1 - tried), outlook))
    return *min(found, key=lambda one: one[0]), found[0][1], linear(1.0), floor


@pytest.mark.parametrize("aperture", [MASK, FullAperture(1.0)], ids=["mask", "full"])
@pytest.mark.parametrize(("photons", "frames", "exposure"), [(2e3, 12, 2e-3), (5e3, 40, 2e-3), (3e4, 7, 20e-3)])
def test_it_is_the_least_of_what_all_or_less_of_frames_and_light_give(aperture, photons, frames, exposure, known):
    instrument = instrument_of(photons, frames, aperture, exposure)
    key = aperture.n_subapertures, aperture.subaperture_diameter
    bright = instrument_of(1e7, 3, aperture)  # before it: nothing of its light is left
    with warnings.catch_warnings(action="ignore"):  # of what lies outside the maps
        found = expect_blind([bright, instrument], {key: aperture}, SIDE)[*key, 1]
        error, outlook, own, instants, floor = formula(instrument, aperture)
    assert found.instants == pytest.approx(instants, rel=1e-12)
    assert found.floor == pytest.approx(floor, rel=1e-12)
    assert found.error == pytest.approx(error, rel=1e-9)
    for name in ("cost", "restored", "success", "low", "high"):
        assert getattr(found.blind, name) == pytest.approx(getattr(outlook, name), rel=1e-9)
    # what lies beyond the maps is that of the point itself, whatever is left out
    assert (found.blind.outside, found.blind.harder) == (own.outside, own.harder)
