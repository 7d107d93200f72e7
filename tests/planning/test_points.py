"""The points of a plan: which holes and exposures there are without a choice, and in which light masks are searched."""

import functools
import math
from types import SimpleNamespace

import pytest
import torch

import torchmask.planning.plan
from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT
from torchmask.design.observed import instrument_criterion
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.planning.expectation import Expected
from torchmask.planning.plan import plan_observation
from torchmask.planning.smearing import phase_spread, smearing_map
from torchmask.planning.success import BlindOutlook, success_map

R0, WIND, DIAMETER, SIDE = 0.12, 8.0, 1.1, 24
TAU0 = R0 / WIND * STRUCTURE_CONSTANT**-0.6  # in which the phase at a point changes by 1 rad^2
OUTLOOK = BlindOutlook(cost=1.0, success=1.0, low=1.0, high=1.0)
INSTRUMENT = Instrument(
    telescope=Telescope(diameter=DIAMETER, throughput=0.4),
    source=Source(photon_rate=3e8),
    site=Site(r0=R0, wind=WIND, sky=17.0),
    camera=Camera(n_pixels=48, readout_noise=2.0, readout_time=1e-3),
    wavelength=600e-9,
    width=30e-9,
    exposure=3e-3,
    observing_time=0.4,
)


@pytest.fixture
def searched(monkeypatch):
    """What searches are given, which find any mask; by pistons alone, with an expectation that is made up."""
    found = []

    def search(criterion, n, diameter, fill, **settings):
        found.append((criterion, n, diameter, fill))
        mask = SparseAperture.random(n, diameter, fill, torch.Generator().manual_seed(0))
        return SimpleNamespace(aperture=mask, relative_mse=0.5)

    def expect(exposed, masks, n_frequencies):
        return {(*key, place): Expected(0.3, OUTLOOK, 0.2, 0.1) for key in masks for place in range(len(exposed))}

    plain = functools.partial(instrument_criterion, turbulence=False)
    for name, stand_in in (("search_mask", search), ("expect_blind", expect)):
        monkeypatch.setattr(torchmask.planning.plan, name, stand_in)
    monkeypatch.setattr(torchmask.planning.plan, "instrument_criterion", lambda *given, turbulence=True: plain(*given))
    return found


def test_without_a_choice_holes_go_with_r0_and_exposures_with_tau0(searched):
    found = plan_observation(INSTRUMENT, n_subapertures=(3,), n_frequencies=SIDE)
    holes = sorted({choice.hole_diameter for choice in found.choices})
    exposures = sorted({choice.exposure for choice in found.choices})
    assert holes == pytest.approx([factor * R0 for factor in (0.5, 0.8, 1.2)], rel=1e-12)
    assert exposures == pytest.approx([factor * TAU0 for factor in (0.25, 0.5, 1, 2, 4, 8)], rel=1e-12)


def test_each_mask_is_searched_in_the_light_of_its_holes(searched):
    """At the exposure of the instrument, whatever those of the plan."""
    holes = 0.07, 0.2
    found = plan_observation(
        INSTRUMENT, n_subapertures=(3, 5), hole_diameters=holes, exposures=(1e-3, 9e-3), n_frequencies=SIDE
    )
    assert len(searched) == len(found.masks) == 4
    for criterion, n, diameter, fill in searched:
        hole = diameter * math.sqrt(fill / n)
        area = float(found.masks[n, min(holes, key=lambda one: abs(one - hole))].area)
        assert area == pytest.approx(n * math.pi / 4 * hole**2, rel=1e-9)
        photons = 3e8 * 0.4 * area * 3e-3
        # the mean of an object is its photons; the noise adds that of 48^2 pixels with sky and read-out
        assert float(criterion.object_psd.max()) == pytest.approx(photons**2, rel=1e-9)
        sky = INSTRUMENT.sky(area)
        assert float(criterion.noise_psd.max()) == pytest.approx(photons + 48**2 * (sky + 2.0**2), rel=1e-9)


def test_points_have_the_light_sky_and_floor_of_their_mask_and_telescope(searched):
    """Of a mask that is narrower than the telescope the floor is still that of the telescope."""
    mask = SparseAperture([[-0.2, 0.0], [0.2, 0.05], [0.0, 0.3]], 0.1, 0.8)
    for choice in plan_observation(INSTRUMENT, aperture=mask, exposures=(1e-3, 9e-3), n_frequencies=SIDE).choices:
        there = INSTRUMENT.with_exposure(choice.exposure)
        area = 3 * math.pi / 4 * 0.1**2
        assert choice.photons == pytest.approx(3e8 * 0.4 * area * choice.exposure, rel=1e-9)
        assert choice.sky == pytest.approx(there.sky(area), rel=1e-9)
        assert choice.sky / there.sky(2 * area) == pytest.approx(0.5, rel=1e-9)
        criterion = instrument_criterion(there, area, SIDE, turbulence=False)
        assert choice.relative_mse == pytest.approx(float(criterion.relative(mask)), rel=1e-9)
        floor = criterion.relative_floor(DIAMETER)
        assert choice.relative_mse - choice.above_floor == pytest.approx(floor, rel=1e-9)
        assert (choice.blind_mse, choice.blind) == (0.3, OUTLOOK)


@pytest.mark.parametrize("kind", ["mask", "full"])
def test_what_was_tried_is_told_in_metres_and_seconds_of_this_site(kind, searched, monkeypatch):
    aperture = SparseAperture([[-0.2, 0.0], [0.2, 0.05]], 0.1, 0.8) if kind == "mask" else FullAperture(DIAMETER)
    stand_in = SparseAperture([[-0.2, 0.0], [0.2, 0.05]], 0.1, 0.8)  # pistons tell of no full pupil
    of_mask = torchmask.planning.plan.instrument_criterion

    def criterion(*given, **settings):
        made = of_mask(*given, **settings)
        made.relative = lambda _, relative=made.relative: relative(stand_in)
        return made

    monkeypatch.setattr(torchmask.planning.plan, "instrument_criterion", criterion)
    found = plan_observation(INSTRUMENT, aperture=aperture, exposures=(1e-3,), n_frequencies=SIDE)
    smearing, tried = smearing_map(kind), found.tried_up_to
    assert tried["hole_diameter"] / R0 == pytest.approx(max(success_map(kind).d_over_r0), rel=1e-12)
    assert tried["exposure"] / TAU0 == pytest.approx(max(smearing.exposures), rel=1e-12)
    spread = phase_spread(INSTRUMENT.band.relative_width, DIAMETER / R0)
    assert spread * tried["width"] / INSTRUMENT.width == pytest.approx(max(smearing.spreads), rel=1e-12)
