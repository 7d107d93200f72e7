"""The plan of an observation: its numbers are the criterion's, its optimum lies between read-out and turbulence."""

import dataclasses
import functools
import itertools
import json
import warnings

import matplotlib.figure
import numpy as np
import pytest
import torch

import torchmask.cli.plan
import torchmask.planning.expectation
import torchmask.planning.plan
from torchmask.cli.main import main
from torchmask.design.constraints import KeepOutDisc, KeepOutSegment, MinimumGap, RimMargin, check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import load_mask
from torchmask.design.observed import change_light, instant_criterion, instrument_criterion
from torchmask.design.turbulent import TurbulentMSE
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pixel import SquarePixel
from torchmask.planning.plan import PlanInterrupted, plan_observation
from torchmask.planning.result import Choice, ObservationPlan
from torchmask.planning.smearing import SmearingMap, phase_spread, smearing_map
from torchmask.planning.success import BlindOutlook, SuccessMap, success_map
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.planning import plan_figure

MASK = SparseAperture.from_catalog("golay6", 1.0, 0.05)
WIDE = SparseAperture([[-0.45, 0.0], [0.45, 0.0], [0.1, 0.2]], 0.1, 1.0)
TINY = {"n_frequencies": 32, "budget": 64}
AXES = {"n_subapertures": (3, 7), "hole_diameters": (0.09, 0.15, 0.35), "exposures": (2e-3, 6e-3)}
FULL = 0.6  # relative error, where one is made up
SURE = BlindOutlook(cost=1.0, success=1.0, low=1.0, high=1.0)
EVERYWHERE = {"n_frames": (1, 1e6), "n_photons": (1, 1e12), "d_over_r0": (0.1, 10)}


def lossless(pupil="mask"):
    """A map on which blind restorations always succeed and lose nothing."""
    return SuccessMap(**EVERYWHERE, tried=np.ones((2, 2, 2)), succeeded=np.ones((2, 2, 2)), cost=np.ones((2, 2, 2)))


def sharp(pupil="mask"):
    """Tables in which restorations are as good as predicted, and exposure and band cost nothing."""
    axes = {"n_photons": (1, 1e12), "exposures": (0, 100), "spreads": (0, 100)}
    return SmearingMap(**axes, exposure_ratio=np.ones((2, 2)), band_ratio=np.ones((2, 2)))


def with_maps(patch, **maps):
    """Put these in the place of the maps that come with the library."""
    for module in (torchmask.planning.plan, torchmask.planning.expectation):
        for name, made in maps.items():
            patch.setattr(module, name, made)


def lose_nothing(patch):
    """Take away what blind restorations lose."""
    with_maps(patch, success_map=lossless, smearing_map=sharp)


def without_turbulence(patch):
    """Predict by pistons alone, which cannot tell of a full pupil: of that the error is made up."""
    of_mask = TurbulentMSE.forward

    def forward(self, aperture):
        return FULL * self.object_psd.mean() if aperture.is_full else of_mask(self, aperture)

    plain = functools.partial(instrument_criterion, turbulence=False)
    patch.setattr(torchmask.planning.plan, "instrument_criterion", plain)
    patch.setattr(torchmask.planning.expectation, "instant_criterion", plain)
    patch.setattr(TurbulentMSE, "forward", forward)


def make(**changes):
    known = {
        "telescope": Telescope(diameter=1.0, throughput=0.5),
        "source": Source(photon_rate=3e8),
        "site": Site(r0=0.15, wind=10.0, sky=18.0),
        "camera": Camera(n_pixels=64, readout_noise=3.0, readout_time=1e-3, pixel_fill=1.0),
        "wavelength": 550e-9,
        "width": 20e-9,
        "exposure": 4e-3,
        "observing_time": 0.5,
    }
    return Instrument(**(known | changes))


@pytest.fixture
def quick(monkeypatch):
    """Without the tables of turbulence, which take seconds each."""
    without_turbulence(monkeypatch)
    lose_nothing(monkeypatch)


@pytest.fixture(scope="module")
def plan():
    with pytest.MonkeyPatch.context() as patch:
        without_turbulence(patch)
        lose_nothing(patch)
        return plan_observation(make(), **AXES, **TINY)


def floor_of(choice):
    """What no mask of the telescope's diameter can avoid."""
    psds = PowerLawPSD(1.5, choice.photons), NoisePSD(choice.photons)
    return AsymptoticMSE(make().grid(32), *psds, choice.frames).relative_floor(1.0)


def test_points_have_the_light_of_their_area(plan):
    for choice in plan.choices:
        mask = plan.masks[choice.n_subapertures, choice.hole_diameter]
        photons = 3e8 * 0.5 * float(mask.area) * choice.exposure
        assert choice.photons == pytest.approx(photons, rel=1e-12)
        assert choice.frames == int(0.5 / (choice.exposure + 1e-3) + 1e-9)
        assert choice.relative_mse - choice.above_floor == pytest.approx(floor_of(choice), rel=1e-10)


BRIGHT = {"source": Source(photon_rate=3e10), "n_wavelengths": 1}


@pytest.fixture(scope="module")
def exposures():
    """Criteria and plan of three exposures under turbulence: 3 electrons per pixel drown the short one."""
    built = []

    def keep(*args, **kwargs):
        built.append(instrument_criterion(*args, **kwargs))
        return built[-1]

    bright = make(**BRIGHT)
    lengths = [factor * bright.seeing.tau0 for factor in (0.1, 1.5, 6.0)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torchmask.planning.plan, "instrument_criterion", keep)
        lose_nothing(patch)
        return built, plan_observation(bright, aperture=MASK, exposures=lengths, n_frequencies=24)


@pytest.mark.slow  # tables of turbulence for three exposures
def test_points_are_the_criterion_under_turbulence(exposures):
    built, found = exposures
    assert [criterion.seeing.exposure for criterion in built] == [choice.exposure for choice in found.choices]
    for criterion, choice in zip(built, found.choices, strict=True):
        assert choice.relative_mse == pytest.approx(float(criterion.relative(MASK)), rel=1e-12)
    # where restorations are as good as predicted, what is expected is the prediction for instants
    still = instant_criterion(make(**BRIGHT, exposure=choice.exposure), float(MASK.area), 24)
    assert choice.blind_mse == pytest.approx(float(still.relative(MASK)), rel=1e-12)


def test_the_floor_is_that_of_the_band_and_blind_errors_grow_above_that_of_narrow_light(monkeypatch):
    """A band of 100 nm reaches further than its middle; what restorations lose was measured in narrow light."""
    costly = BlindOutlook(cost=1.1, success=0.5, low=0.4, high=0.6)
    monkeypatch.setattr(torchmask.planning.expectation, "_outlook", lambda *point: costly)
    known = make(**BRIGHT | {"width": 100e-9, "n_wavelengths": 2})
    best = plan_observation(known, aperture=MASK, exposures=(1e-3,), n_frequencies=24).best
    there, area = known.with_exposure(1e-3), float(MASK.area)
    band, narrow = (criterion(there, area, 24) for criterion in (instrument_criterion, instant_criterion))
    assert best.relative_mse - best.above_floor == pytest.approx(band.relative_floor(1.0), rel=1e-12)
    error, least = float(narrow.relative(MASK)), narrow.relative_floor(1.0)
    assert best.blind_mse == pytest.approx(error + (1.1**2 - 1) * (error - least), rel=1e-12)
    assert band.relative_floor(1.0) < 0.9 * least


@pytest.mark.parametrize("instrument", [make(), make(exposure=6e-3, n_wavelengths=2)])
def test_the_criterion_is_that_of_turbulence_band_pixels_and_sky(instrument):
    criterion = instrument_criterion(instrument, float(MASK.area), 24)
    photons, sky = instrument.photons(float(MASK.area)), instrument.sky(float(MASK.area))
    expected = TurbulentMSE(
        instrument.grid(24),
        PowerLawPSD(1.5, photons),
        NoisePSD(photons, 3.0, 64**2),
        instrument.frames,
        r0=0.15,
        outer_scale=20.0,
        exposure=instrument.exposure,
        wind=10.0,
        wavelengths=instrument.band.wavelengths,
        weights=instrument.band.shares,
        pixel=SquarePixel(1.0),
        sky=sky,
    )
    for name in ("grid", "n_frames", "seeing", "band", "pixel"):
        assert getattr(criterion, name) == getattr(expected, name)
    for name, buffer in expected.named_buffers():
        torch.testing.assert_close(getattr(criterion, name), buffer, rtol=1e-14, atol=0)


def test_a_change_of_light_is_the_criterion_of_that_light_and_of_as_many_frames():
    criterion = instrument_criterion(make(), 0.05, 32, turbulence=False)
    other = make(exposure=9e-3)
    assert other.frames != criterion.n_frames
    change_light(criterion, other, 0.02)
    torch.testing.assert_close(
        criterion(MASK), instrument_criterion(other, 0.02, 32, turbulence=False)(MASK), rtol=1e-14, atol=0
    )


def test_the_criterion_of_instants_has_the_light_of_the_exposure_and_band():
    instrument = make(exposure=6e-3, n_wavelengths=2)
    found, whole = (build(instrument, float(MASK.area), 24) for build in (instant_criterion, instrument_criterion))
    assert (found.seeing.exposure, found.seeing.speed, found.band) == (0.0, 0.0, None)
    assert (found.seeing.r0, found.seeing.outer_scale) == (whole.seeing.r0, whole.seeing.outer_scale)
    assert (found.grid, found.n_frames, found.pixel) == (whole.grid, whole.n_frames, whole.pixel)
    for name in ("object_psd", "noise_psd"):
        torch.testing.assert_close(getattr(found, name), getattr(whole, name), rtol=0, atol=0)


def test_masks_are_those_of_the_axes_and_what_does_not_fit_is_told(plan):
    assert sorted(plan.masks) == [(3, 0.09), (3, 0.15), (3, 0.35), (7, 0.09), (7, 0.15)]
    for (n, hole), mask in plan.masks.items():
        check_mask(mask, 1e-9)
        assert (mask.n_subapertures, mask.subaperture_diameter) == (n, pytest.approx(hole, rel=1e-12))
    assert plan.left_out == ("7 holes of 0.35 m do not fit: at most 0.3333 m",)
    assert len(plan.choices) == 10


def test_the_full_pupil_stands_beside_the_masks(plan):
    """With the telescope's light, at the same exposures, and never among the masks."""
    full = plan.full_pupil
    assert full is not None
    assert full.mask.is_full
    assert full.full_pupil is None
    assert [choice.exposure for choice in full.choices] == list(AXES["exposures"])
    for choice in full.choices:
        assert choice.photons == pytest.approx(3e8 * 0.5 * np.pi / 4 * choice.exposure, rel=1e-9)
        assert choice.blind_mse == pytest.approx(FULL, rel=1e-9)  # what restorations lose is taken away
        assert choice.relative_mse == pytest.approx(FULL, rel=1e-9)
        assert choice.relative_mse - choice.above_floor == pytest.approx(floor_of(choice), rel=1e-10)
    assert not any(mask.is_full for mask in plan.masks.values())
    assert "Without a mask the least is 0.6, with the full pupil of 1 m, 166 frames of 2 ms, a band of 20 nm." in str(
        plan
    )
    assert "full pupil" not in str(dataclasses.replace(plan, full_pupil=None))


def test_masks_keep_clear_of_the_obstruction_and_its_vanes(quick):
    spider = {"vane_width": 0.05, "vane_angles": (0.0, 180.0)}
    blocked = make(telescope=Telescope(diameter=1.0, central_obstruction=0.3, **spider))
    found = plan_observation(blocked, n_subapertures=(3,), hole_diameters=(0.15,), exposures=(2e-3,), **TINY)
    check_mask(found.mask, 1e-9, [KeepOutDisc(0.3), KeepOutSegment((-0.5, 0.0), (0.5, 0.0), 0.05)])


def test_the_best_point_and_the_edges_of_the_map(plan):
    best = plan.best
    assert best.blind_mse == min(choice.blind_mse for choice in plan.choices)
    assert plan.best_known.relative_mse == min(choice.relative_mse for choice in plan.choices)
    assert plan.mask is plan.masks[best.n_subapertures, best.hole_diameter]
    assert (best.n_subapertures, best.hole_diameter) == (3, 0.35)  # pistons alone: the most light wins
    assert plan.at_edge("hole_diameter")
    text = str(plan)
    wider = "is the last on the map: a larger one may be better, so give"
    assert f"The best hole diameter, 0.35 m, {wider} hole_diameters above it too." in text
    assert f"The best exposure, 6 ms, {wider} exposures above it too." in text
    assert "The best number of holes" not in text  # of 0.35 m no more were tried than can be built
    least = dataclasses.replace(plan, choices=tuple(dataclasses.replace(c, blind_mse=c.exposure) for c in plan.choices))
    smaller = "is the first on the map: a smaller one may be better, so give"
    assert f"The best exposure, 2 ms, {smaller} exposures below it too." in str(least)
    assert text.count("\n| 3 |") == 6
    assert "do not fit" in text


def test_no_point_beyond_what_was_tried_is_the_best(monkeypatch, quick):
    """Without turbulence in the prediction more light always wins, so the widest holes and longest exposures would."""
    tried = SuccessMap((1, 1e6), (1, 1e12), (0.1, 1.0), *np.ones((3, 2, 2, 2)))
    known = SmearingMap((1, 1e12), (0, 2.0), (0, 100), np.ones((2, 2)), np.ones((2, 2)))
    with_maps(monkeypatch, success_map=lambda pupil: tried, smearing_map=lambda pupil: known)
    instrument, holes = make(), (0.09, 0.15, 0.35)
    tau0 = instrument.seeing.tau0
    exposures = (tau0, 2 * tau0, 9 * tau0)
    with pytest.warns(UserWarning, match="a plan chooses such a point only if there is no other"):
        found = plan_observation(instrument, n_subapertures=(3,), hole_diameters=holes, exposures=exposures, **TINY)
    assert (found.best.hole_diameter, found.best.exposure) == (0.15, pytest.approx(2 * tau0))  # r0 is 0.15 m
    spread = phase_spread(instrument.band.relative_width, 1.0 / 0.15)  # 100 rad were tried
    limits = {"hole_diameter": 0.15, "exposure": 2 * tau0, "width": instrument.width * 100 / spread}
    assert found.tried_up_to == pytest.approx(limits, rel=1e-12)
    least = min(found.choices, key=lambda choice: choice.blind_mse)
    assert least.is_limit
    assert least.blind_mse < found.best.blind_mse
    assert set(least.blind.harder) == {"d_over_r0", "exposure"}
    text = str(found)
    assert "Without a mask the least is at least 0.6, with the full pupil" in text
    assert "; such restorations were tried under easier conditions only, up to D/r0 = 1." in text
    assert "The best hole diameter, 0.15 m, is the largest on the map at which blind restorations were tried" in text
    assert "beyond they lose more" in text
    assert "a larger one may be better" not in text  # both are where trials end
    axes = {"n_subapertures": (3,), "hole_diameters": (0.09, 0.35), "exposures": (tau0,)}
    with pytest.warns(UserWarning, match="d/r0 from 0.1 to 1"):
        narrower = plan_observation(instrument, **axes, **TINY)
    assert "tried: up to 0.15 m a larger one may be better, beyond they lose more" in str(narrower)
    assert "give exposures above it" not in text
    assert f"| > {least.blind_mse:.4f} | - |" in text
    figure = plan_figure(found)
    assert any(line.get_marker() == "^" for line in figure.axes[1].lines)
    with pytest.warns(UserWarning, match="d/r0 from 0.1 to 1"):
        beyond = plan_observation(instrument, n_subapertures=(3,), hole_diameters=(0.35,), exposures=(tau0,), **TINY)
    assert beyond.best.is_limit
    assert "At no point of the map were blind restorations tried" in str(beyond)
    assert "Of blind restorations under such conditions" not in str(beyond)


def test_what_blind_restorations_lose_moves_the_best_point(monkeypatch, plan, quick):
    """Holes of more than 0.8 r0 lose a factor of 2 or more: the smaller ones win, though known PSFs favour the wide."""
    cost = np.broadcast_to([1.0, 4.0], (2, 2, 2))
    steep = SuccessMap((1, 1e6), (1, 1e12), (0.6, 1.0), np.full((2, 2, 2), 4), np.full((2, 2, 2), 3), cost)
    with_maps(monkeypatch, success_map=lambda pupil: steep)
    with pytest.warns(UserWarning, match="for d/r0 from 0.6 to 1"):
        found = plan_observation(make(), **AXES, **TINY)
    assert found.best_known.hole_diameter == plan.best.hole_diameter == 0.35
    assert found.best.hole_diameter == 0.09
    for choice in found.choices:
        grown = choice.relative_mse + (choice.blind.cost**2 - 1) * choice.above_floor
        assert choice.blind_mse == pytest.approx(min(1, grown), rel=1e-12)
    text = str(found)
    assert "75 % (50 to 90 %) end within 1.3 times" in text
    assert f"the least would be {plan.best.relative_mse:.4g}, with 3 holes of 0.35 m" in text


def test_the_map_is_asked_at_the_size_light_and_frames_of_each_point(monkeypatch, quick):
    asked = []

    def outlook(self, *point):
        asked.append(point)
        return BlindOutlook(1.0, 1.0, 1.0, 1.0)

    monkeypatch.setattr(SuccessMap, "outlook", outlook)
    found = plan_observation(make(), aperture=MASK, exposures=(2e-3, 6e-3), n_frequencies=32)
    size, tried = MASK.subaperture_diameter / 0.15, lossless()
    for choice in found.choices:  # photons that would tell as much without sky and 3 electrons of read-out noise
        photons = choice.photons**2 / (choice.photons + 64**2 * (choice.sky + 9))
        lights = [photons, *(number for number in tried.n_photons if number < photons)]
        numbers = [choice.frames, *(number for number in tried.n_frames if number < choice.frames)]
        for light, frames in itertools.product(lights, numbers):
            assert asked.pop(0) == (size, pytest.approx(light, rel=1e-12), frames)
    assert not asked


@pytest.mark.parametrize("axis", ["n_frames", "n_photons"])
def test_more_frames_and_more_light_never_cost(axis, monkeypatch, quick):
    """Although on the map restorations lose four times as much with all of them: some can be left out."""
    cost = np.ones((2, 2, 2))
    place = (slice(None),) * ("n_frames", "n_photons").index(axis)
    cost[(*place, 1)] = 4.0
    axes = {"n_frames": (5, 20), "n_photons": (1e3, 1e6), "d_over_r0": (0.1, 10)}
    worse = SuccessMap(**axes, tried=np.ones((2, 2, 2)), succeeded=np.ones((2, 2, 2)), cost=cost)
    with_maps(monkeypatch, success_map=lambda pupil: worse)
    quiet = {"site": Site(r0=0.15, wind=10.0), "camera": Camera(n_pixels=64), "observing_time": None}

    def expected(photons, frames):
        rate = photons / (0.5 * float(MASK.area) * 4e-3)
        known = make(**quiet, source=Source(photon_rate=rate), n_frames=frames)
        return plan_observation(known, aperture=MASK, exposures=(4e-3,), n_frequencies=32).best

    if axis == "n_frames":
        few, some, many = (expected(1e4, frames) for frames in (5, 10, 20))
    else:
        few, some, many = (expected(photons, 10) for photons in (1e3, 3e4, 1e6))
    assert few.relative_mse > some.relative_mse > many.relative_mse
    assert few.blind_mse == pytest.approx(few.relative_mse, rel=1e-9)
    rounding = 1 + 1e-12
    assert few.blind_mse * rounding >= some.blind_mse
    assert some.blind_mse * rounding >= many.blind_mse > many.relative_mse
    if axis == "n_frames":  # four times the amplitude of 20 frames is more than that of five
        assert many.blind_mse == pytest.approx(few.blind_mse, rel=1e-9)


def test_frames_that_repeat_themselves_are_told(quick):
    """A wind of 10 m/s takes 9.13 ms to cross a hole of 0.0913 m; frames follow each other every 3 or 23 ms."""
    for readout, said in ((1e-3, True), (21e-3, False)):
        known = make(camera=Camera(n_pixels=64, readout_time=readout), n_frames=20, observing_time=None)
        found = plan_observation(known, aperture=MASK, exposures=(2e-3,), n_frequencies=32)
        differ = min(20, 1 + 19 * (readout + 2e-3) * 10 / MASK.subaperture_diameter)
        assert found.best_instrument.frames_that_differ(MASK.subaperture_diameter) == pytest.approx(differ, rel=1e-12)
        line = f"only about {differ:.0f} of the 20 frames show turbulence of their own"
        assert (line in str(found)) == said
        assert ("The wind takes 9.13 ms to cross 0.09129 m" in str(found)) == said


def test_an_image_of_nothing_is_called_that(quick, tmp_path, capsys):
    """And no mask is to be designed for it."""
    known = make(source=Source(photon_rate=1e-3), site=Site(r0=0.15, wind=10.0))
    with warnings.catch_warnings(action="ignore"):  # of photons beyond those tried
        found = plan_observation(known, aperture=MASK, exposures=(2e-3,), n_frequencies=32)
        known.save(tmp_path / "dark.json")
        again = "--n-subapertures 3 --hole-diameters 0.15 --exposures 0.002 --n-frequencies 32 --budget 64"
        command = f"plan --instrument {tmp_path}/dark.json {again} --out {tmp_path}/plan"
        assert main(command.split()) == 0
    assert not found.shows_something
    assert "Such an image shows nothing of the target" in str(found)
    told = capsys.readouterr().out
    assert "Such an image shows nothing of the target" in " ".join(told.split())
    assert "design the final mask" not in told


def test_less_light_than_was_tried_loses_the_share_that_the_linear_estimate_loses(monkeypatch, quick):
    """Down to the least light tried errors are a quarter of those predicted; from no light nothing is expected."""
    axes = {"n_photons": (1e5, 1e12), "exposures": (0, 100), "spreads": (0, 100)}
    halves = SmearingMap(**axes, exposure_ratio=np.full((2, 2), 0.5), band_ratio=np.full((2, 2), 0.5))
    with_maps(monkeypatch, smearing_map=lambda pupil: halves)
    quiet = {"site": Site(r0=0.15, wind=10.0), "camera": Camera(n_pixels=64), "observing_time": None, "n_frames": 10}

    def plan(photons, frames=10, **changes):
        source = Source(photon_rate=photons / (0.5 * float(MASK.area) * 4e-3))
        known = make(**(quiet | {"source": source, "n_frames": frames} | changes))
        return plan_observation(known, aperture=MASK, exposures=(4e-3,), n_frequencies=32).best

    tried = plan(1e5)
    floor = tried.relative_mse - tried.above_floor
    assert tried.blind_mse == pytest.approx(floor + tried.above_floor / 4, rel=1e-12)
    with warnings.catch_warnings(action="ignore"):  # of photons beyond those tried
        faint, dark, darkest = plan(20.0), plan(1e-3), plan(1e-20)
        drowned = plan(2e5, camera=Camera(n_pixels=64, readout_noise=1e3))
    kept = (1 - faint.relative_mse) / (1 - tried.relative_mse)
    assert kept < 0.9
    assert 1 - faint.blind_mse == pytest.approx(kept * (1 - tried.blind_mse), rel=1e-9)
    gained = (1 - tried.blind_mse) / (1 - tried.relative_mse)
    assert darkest.blind_mse == pytest.approx(1, abs=1e-12)
    assert 0 <= 1 - dark.blind_mse <= 0.01 * gained  # a hundredth of a photon in all tells that share of an image
    assert drowned.relative_mse > 0.5
    assert drowned.blind_mse > 0.4  # a quarter of the prediction would be as good as bright light


def test_pixels_that_undersample_are_refused_before_any_search(quick):
    coarse = make(camera=Camera(pixel_scale=0.3))
    with pytest.raises(ValueError, match=r"\(0.3 arcsec\) undersamples an aperture of 1 m"):
        plan_observation(coarse, **AXES, **TINY)


def test_bands_that_the_pixels_of_the_camera_undersample_are_left_out(quick):
    """0.0565 arcsec sample 1 m from 548 nm on: a band of 2 nm around 550 nm, but none of 10 or 100 nm."""
    known, settings = make(camera=Camera(pixel_scale=0.0565)), {"aperture": WIDE, "exposures": (4e-3,)}
    found = plan_observation(known, widths=(10e-9, 2e-9, 100e-9), n_frequencies=24, **settings)
    assert [choice.width for choice in found.choices] == [2e-9]
    assert [reason.split(" undersamples")[0] for reason in found.left_out] == [
        f"a band of {width} nm is left out: pixel_scale 2.739e-07 rad (0.0565 arcsec)" for width in (10, 100)
    ]
    with pytest.raises(ValueError, match="undersamples an aperture"):
        plan_observation(known, widths=(10e-9, 100e-9), **settings)


def test_exposure_and_width_are_best_where_light_balances_what_their_smearing_costs(monkeypatch, quick):
    """For pistons alone the most light is best for known PSFs; with costs of 2 % a tau0 and 3 % of width it is not."""
    steps, spreads = 1.02 ** np.arange(5.0), phase_spread(0.03, 1 / 0.15) * np.arange(5.0)
    axes = {"n_photons": (1, 1e12), "exposures": (0, 1, 2, 3, 4), "spreads": spreads}
    tables = {"exposure_ratio": np.tile(steps, (2, 1)), "band_ratio": np.tile(steps, (2, 1))}
    monkeypatch.setattr(torchmask.planning.expectation, "smearing_map", lambda pupil: SmearingMap(**axes, **tables))
    known = make(source=Source(photon_rate=3e9), n_wavelengths=2, n_frames=20, observing_time=None)
    tau0 = 0.314 * 0.15 / 10  # r0 / wind
    times, widths = [factor * tau0 for factor in (0.05, 0.2, 0.8, 3.2)], [5e-9, 20e-9, 60e-9]
    found = plan_observation(known, aperture=MASK, exposures=times, widths=widths, n_frequencies=32)
    assert (found.best_known.exposure, found.best_known.width) == (times[-1], widths[-1])
    assert (found.at_edge("exposure"), found.at_edge("width")) == (False, False)
    assert times[0] < found.best_exposure < times[-1]
    assert widths[0] < found.best_width < widths[-1]
    assert f"ms; best width: {1e9 * found.best_width:.4g} nm." in str(found)
    for choice in found.choices:
        steps_there = choice.exposure / tau0 + choice.width / 550e-9 / 0.03
        assert np.log(choice.blind.restored) == pytest.approx(steps_there * np.log(1.02), rel=2e-3)


@pytest.mark.slow
def test_an_exposure_between_read_out_and_turbulence_is_best(exposures):
    """At 3 electrons per pixel short frames drown in read-out noise; in long ones the fringes are gone."""
    _, found = exposures
    assert found.best_known is found.choices[1]
    assert found.masks == {(6, MASK.subaperture_diameter): MASK}


def test_the_best_exposure_is_the_vertex_of_a_parabola_of_logarithms():
    def error(exposure):
        return 0.3 * 10 ** (0.2 * (torch.tensor(exposure / 5e-3).log10()) ** 2)

    choices = tuple(
        Choice(3, 0.1, time, 20e-9, 10, 1e3, 0.0, 0.2, 0.1, float(error(time)), SURE) for time in (2e-3, 4e-3, 9e-3)
    )
    plan = ObservationPlan(make(), choices, {(3, 0.1): MASK})
    assert plan.best_exposure == pytest.approx(5e-3, rel=1e-5)
    edge = ObservationPlan(make(), choices[:2], {(3, 0.1): MASK})
    assert edge.best_exposure == 4e-3
    assert edge.at_edge("exposure")


def test_exposures_longer_than_the_observation_are_left_out(quick):
    found = plan_observation(make(), aperture=MASK, exposures=(2e-3, 0.8), n_frequencies=32)
    assert [choice.exposure for choice in found.choices] == [2e-3]
    assert found.left_out[0].startswith("observing_time is 0.5 s, but one frame takes 0.801 s")


def test_bands_are_compared_on_the_same_pixels(quick):
    found = plan_observation(make(), aperture=MASK, exposures=(4e-3,), widths=(80e-9, 20e-9), **TINY)
    narrow, wide = found.choices
    assert (narrow.width, wide.width) == (20e-9, 80e-9)
    assert wide.photons == pytest.approx(4 * narrow.photons)  # a rate of photons grows with the width
    assert wide.relative_mse < narrow.relative_mse
    assert found.best_instrument.width == 80e-9
    floors = [choice.relative_mse - choice.above_floor for choice in found.choices]
    assert floors[0] == pytest.approx(floors[1], rel=1e-12)
    assert found.at_edge("width")
    assert plan_figure(found).axes[-1].get_xlabel() == "width of the band [nm]"
    with pytest.raises(ValueError, match=r"the band is the filter|give wavelength and width"):
        plan_observation(make(filter="bessell-V", width=None, wavelength=None), aperture=MASK, widths=(1e-8,))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"n_subapertures": ()}, "n_subapertures are"),
        ({"n_subapertures": (1,)}, "at least 2"),
        ({"n_subapertures": (6, 6)}, "none twice"),
        ({"hole_diameters": (0.0,)}, "in m"),
        ({"exposures": (-1e-3,)}, "in s"),
        ({"exposures": (2.0,)}, "no exposure is short enough: observing_time is 0.5 s"),
        (
            {"n_subapertures": (20,), "hole_diameters": (0.3,)},
            "no point .*: 20 holes of 0.3 m do not fit: at most 0.1952.* m$",
        ),
        (
            {"n_subapertures": (25, 20), "hole_diameters": (0.4, 0.3)},
            "no point .*: 20 holes of 0.3 m do not fit: at most .* m; nor can the other 3, of more or wider holes$",
        ),
    ],
)
def test_maps_without_a_point_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        plan_observation(make(), **settings, **TINY)


def test_a_population_of_masks_is_no_aperture_of_a_plan():
    both = SparseAperture(MASK.centers.expand(2, -1, -1), MASK.subaperture_diameter, 1.0)
    with pytest.raises(ValueError, match=r"aperture has centers of shape \(2, 6, 2\): one mask is needed"):
        plan_observation(make(), aperture=both, **TINY)


def test_the_picture_shows_the_map_and_the_exposures(plan):
    figure = plan_figure(plan)
    assert isinstance(figure, matplotlib.figure.Figure)
    titles = [ax.get_title(loc="left") for ax in figure.axes[:2]]
    assert titles == [f"at {1e3 * plan.best.exposure:.3g} ms", f"holes of {plan.best.hole_diameter:.3g} m"]
    texts = {text.get_text() for text in figure.axes[0].texts}
    assert f"{plan.best.blind_mse:.3f}" in texts
    assert "does not fit" in texts
    best = plan.best
    assert plan.full_pupil is not None
    (line,) = (line for line in figure.axes[1].lines if line.get_label() == "full pupil")
    assert list(line.get_ydata()) == [choice.blind_mse for choice in plan.full_pupil.choices]
    alone = plan_figure(dataclasses.replace(plan, masks={(best.n_subapertures, best.hole_diameter): MASK}))
    assert len(alone.axes) == 1
    assert [text.get_text() for text in plan_figure(plan.full_pupil).legends[0].get_texts()] == ["full pupil"]


def test_the_picture_has_no_panel_of_one_value_and_no_error_above_1(plan):
    figure = plan_figure(plan)
    highest = max(ax.get_ylim()[1] for ax in figure.axes[1:2])
    assert highest <= 1.03
    name = next(text for text in figure.axes[1].texts if text.get_text() == "tau0")
    assert name.get_position()[0] > 0  # points to the right of the dashed line
    alone = dataclasses.replace(plan, choices=tuple(c for c in plan.choices if c.exposure == plan.best.exposure))
    assert [ax.get_ylabel() for ax in plan_figure(alone).axes] == ["number of holes", "relative MSE, blind"]  # its bar
    assert plan_figure(alone).axes[0].get_title(loc="left").endswith(f"; full pupil: {FULL:.3f}")
    one = (plan.best.n_subapertures, plan.best.hole_diameter)
    point = dataclasses.replace(alone, choices=(plan.best,), masks={one: plan.mask})
    assert [ax.get_xlabel() for ax in plan_figure(point).axes] == ["exposure [ms]"]
    bad = dataclasses.replace(plan, choices=tuple(dataclasses.replace(c, blind_mse=1.0) for c in plan.choices))
    assert plan_figure(bad).axes[1].get_ylim()[1] <= 1.03


def test_an_interrupted_plan_is_that_of_the_points_reached(quick):
    told = []

    def stop(record):
        told.append(record.stage)
        if told.count("plan/map") == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        plan_observation(make(), **AXES, **TINY, callback=stop)
    found = stopped.value.plan
    assert (len(found.choices), len(found.masks)) == (2, 2)
    assert found.left_out[-1] == "interrupted: 2 of 10 points of the map were reached"
    assert found.full_pupil is not None
    texts = {text.get_text() for text in plan_figure(found).axes[0].texts}
    assert f"{found.best.blind_mse:.3f}" in texts

    def stop_early(record):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        plan_observation(make(), **AXES, **TINY, callback=stop_early)
    assert not isinstance(stopped.value, PlanInterrupted)


def test_the_command_writes_plan_mask_and_instrument(quick, tmp_path, capsys):
    known = "--telescope.diameter 1 --source.photon-rate 3e8 --site.r0 0.15 --site.wind 10 --wavelength 550e-9"
    known += " --width 2e-8 --exposure 4e-3 --n-frames 20 --n-subapertures 3 --hole-diameters 0.15 0.6"
    known += " --exposures 0.002 0.004 --n-frequencies 32 --budget 64"
    assert main(["plan", *known.split(), "--out", str(tmp_path / "plan")]) == 0
    numbers = json.loads((tmp_path / "plan/plan.json").read_text())
    assert numbers["best"] in numbers["map"]
    assert numbers["best"]["relative_mse"] >= numbers["best_known"]["relative_mse"]
    assert len(numbers["map"]) == len(numbers["full_pupil"]["map"]) == 2
    assert numbers["full_pupil"]["best"]["hole_diameter"] == 1
    mask = load_mask(tmp_path / "plan/mask.json")
    assert mask.n_subapertures == 3
    instrument = Instrument.load(tmp_path / "plan/instrument.json")
    assert instrument.exposure == numbers["best"]["exposure"]
    assert numbers["best"]["photons"] == pytest.approx(instrument.photons(float(mask.area)))
    assert (tmp_path / "plan/plan.png").stat().st_size > 10_000
    told = capsys.readouterr().out
    assert "Least predicted error" in told
    assert "3 holes of 0.6 m do not fit" in told
    assert "Without a mask the least is" in told
    assert "a larger one may be better, so give --exposures above it too." in " ".join(told.split())
    fill_factor = 3 * 0.15**2
    command = f"--instrument {tmp_path}/plan/instrument.json --n-subapertures 3 --fill-factor {fill_factor:.4g}"
    assert f"design the final mask with: torchmask design {command}" in told
    again = ["plan", "--config", str(tmp_path / "plan/config.yaml"), "--mask", "golay6", "--fill-factor", "0.05"]
    assert main([*again, "--out", str(tmp_path / "again")]) == 1
    said = "--n-subapertures is for masks that are searched, but --mask golay6 exists: leave out one of the two"
    assert said in capsys.readouterr().err
    instrument = ["--instrument", str(tmp_path / "plan/instrument.json"), "--exposures", "0.004", "--n-frequencies"]
    assert main(["plan", *instrument, "32", *again[3:], "--out", str(tmp_path / "again")]) == 0
    assert load_mask(tmp_path / "again/mask.json").n_subapertures == 6


QUICK = "--telescope.diameter 1 --source.photon-rate 3e8 --site.r0 0.15 --site.wind 10 --wavelength 550e-9 --width 2e-8"
QUICK += " --exposure 4e-3 --n-frames 20 --exposures 0.002 0.004 --n-frequencies 32"
SEARCHED = "--n-subapertures 3 --hole-diameters 0.15 --budget 64"


def test_the_rules_of_a_workshop_hold_for_the_masks_and_are_handed_on(quick, tmp_path, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(torchmask.cli.plan, "draw_zones", lambda figure, zones, scale: drawn.append((zones, scale)))
    rules = "--min-gap 0.05 --rim-margin 0.02 --keep-out 0.3 0.0 0.2 0.0 0.3 0.1"
    spider = "--telescope.central-obstruction 0.2 --telescope.vane-width 0.02 --telescope.vane-angles 90"
    words = f"{QUICK} {SEARCHED} {rules} {spider}".split()
    assert main(["plan", *words, "--out", str(tmp_path / "plan")]) == 0
    told = [MinimumGap(0.05), RimMargin(0.02), KeepOutDisc(0.2, (0.3, 0.0)), KeepOutDisc(0.1, (0.0, 0.3))]
    check_mask(load_mask(tmp_path / "plan/mask.json"), 1e-6, told)
    said = capsys.readouterr().out
    assert f"--n-subapertures 3 --fill-factor 0.0675 {rules}" in said
    assert "| outer scale | 20 m |" in said
    ((zones, scale),) = drawn
    assert scale == 1.0
    assert {*told, KeepOutDisc(0.2)} < set(zones)
    assert sum(isinstance(zone, KeepOutSegment) for zone in zones) == 1
    assert main(["plan", *words, "--min-gap", "0.9", "--out", str(tmp_path / "none")]) == 1
    assert "a --min-gap of at most 0.5514 m" in capsys.readouterr().err


@pytest.mark.parametrize(
    "given", ["--n-subapertures 5", "--hole-diameters 0.2", "--budget 9", "--seed 1", "--min-gap 0.1", "--rim-margin 1"]
)
def test_options_of_a_search_are_refused_beside_a_mask(given, tmp_path, capsys):
    mask = ["--mask", "golay6", "--fill-factor", "0.05", "--out", str(tmp_path / "plan")]
    assert main(["plan", *QUICK.split(), *mask, *given.split()]) == 1
    assert f"{given.split()[0]} is for masks that are searched, but --mask golay6 exists" in capsys.readouterr().err


def test_an_interrupted_command_leaves_the_plan_of_the_points_reached(quick, tmp_path, capsys, monkeypatch):
    def stop_at(last):
        def tell(callback, stage, *numbers):
            if stage == last:
                raise KeyboardInterrupt

        monkeypatch.setattr(torchmask.planning.plan, "_tell", tell)

    stop_at("plan/map")
    assert main(["plan", *f"{QUICK} {SEARCHED}".split(), "--out", str(tmp_path / "plan")]) == 130
    assert "interrupted: 1 of 2 points of the map were reached" in (tmp_path / "plan/plan.md").read_text()
    for name in ("plan.json", "plan.png", "mask.json", "instrument.json"):
        assert (tmp_path / "plan" / name).is_file()
    assert f"the results so far are in {tmp_path / 'plan'}" in capsys.readouterr().err
    stop_at("plan/search")
    assert main(["plan", *f"{QUICK} {SEARCHED}".split(), "--out", str(tmp_path / "early")]) == 130
    assert "no point of the map was reached: there is no plan and no mask" in capsys.readouterr().err
    assert not (tmp_path / "early/plan.md").exists()


def test_a_full_pupil_is_planned_without_a_mask(tmp_path, monkeypatch):
    """Its error is made up here, because tables of turbulence take seconds."""
    monkeypatch.setattr(TurbulentMSE, "forward", lambda self, aperture: FULL * self.object_psd.mean())
    known = "--telescope.diameter 1 --source.photon-rate 3e8 --site.r0 0.25 --site.wind 10 --wavelength 550e-9"
    known += " --width 2e-8 --exposure 4e-3 --n-frames 10 --mask full --exposures 0.004 --n-frequencies 24"
    assert main(["plan", *known.split(), "--out", str(tmp_path / "plan")]) == 0
    numbers = json.loads((tmp_path / "plan/plan.json").read_text())
    best, photons = numbers["best"], 3e8 * 4e-3 * float(FullAperture(1.0).area)
    assert best["photons"] == pytest.approx(photons)
    assert numbers["full_pupil"] is None  # it is the plan itself
    assert "with the full pupil of 1 m, 10 frames of 4 ms" in (tmp_path / "plan/plan.md").read_text()
    assert best["relative_mse"] == pytest.approx(FULL)
    instants = success_map("full").outlook(1 / 0.25, photons, 10)
    amounts = {"exposure": 4e-3 * 10 / (0.314 * 0.25), "spread": phase_spread(20 / 550, 1 / 0.25)}
    told = smearing_map("full").outlook(instants, n_photons=photons, **amounts)  # tau0 is 0.314 r0 / wind
    assert best["blind"]["cost"] == instants.cost
    assert best["blind"]["restored"] == pytest.approx(told.restored, rel=1e-3)  # 0.314 is rounded
    floor = instant_criterion(Instrument.load(tmp_path / "plan/instrument.json"), photons, 24).relative_floor(1.0)
    assert best["blind_mse"] == pytest.approx(told.mse(FULL, FULL - floor), rel=1e-3)
    assert not (tmp_path / "plan/mask.json").exists()
