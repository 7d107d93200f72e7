"""What a plan says of its points, in which units, and which of them it takes for the best."""

import math
import re

import pytest

from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Site, Source, Telescope
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.planning.result import AXES, Choice, ObservationPlan
from torchmask.planning.success import BlindOutlook

R0, WIND = 0.15, 10.0
TAU0 = 0.314 * R0 / WIND  # s
OUTLOOK = BlindOutlook(cost=1.37, success=0.62, low=0.41, high=0.83, restored=1.73)
BEYOND = BlindOutlook(cost=1.0, success=1.0, low=1.0, high=1.0, outside=("exposure",), harder=("exposure",))
MASK = SparseAperture.from_catalog("golay6", 1.0, 0.0864)
INSTRUMENT = Instrument(
    telescope=Telescope(diameter=1.0),
    source=Source(photon_rate=1e9),
    site=Site(r0=R0, wind=WIND),
    wavelength=550e-9,
    width=10e-9,
    exposure=3e-3,
    n_frames=10,
)
METRES = {"m": 1.0, "ms": 1e-3, "nm": 1e-9}  # or seconds
ROUNDING = 6e-4  # half of the last of four digits, over the smallest that they can be


def choice(exposure=2e-3, width=30e-9, blind_mse=0.3, blind=OUTLOOK, relative_mse=0.21, hole=0.12, n=6):
    above_floor = relative_mse - 0.08
    return Choice(n, hole, exposure, width, 10, 1.21e5, 3.4, relative_mse, above_floor, blind_mse, blind)


def plan_of(*choices, **settings):
    masks = {(one.n_subapertures, one.hole_diameter): MASK for one in choices}
    return ObservationPlan(INSTRUMENT, choices, masks, **settings)


def test_a_table_has_the_numbers_of_its_points_in_the_units_of_its_heads():
    points = choice(), choice(7e-3, 52e-9, 0.81, relative_mse=0.47, hole=0.093, n=9)
    heads, _, *rows = (line.strip("| ").split(" | ") for line in str(plan_of(*points)).splitlines() if "|" in line)
    assert len(rows) == len(points)
    for point, row in zip(points, rows, strict=True):
        cells = dict(zip(heads, row, strict=True))
        for head, value in (
            ("N", point.n_subapertures),
            ("hole [m]", point.hole_diameter),
            ("exposure [ms]", point.exposure),
            ("band [nm]", point.width),
            ("frames", point.frames),
            ("photons/frame", point.photons),
            ("sky/pixel", point.sky),
            ("relative MSE", point.relative_mse),
            ("above the floor", point.above_floor),
            ("blind", point.blind_mse),
        ):
            unit = re.search(r"\[(.*)\]", head)
            assert float(cells[head]) * (METRES[unit[1]] if unit else 1) == pytest.approx(value, rel=ROUNDING)
        assert cells["success"] == f"{100 * point.blind.success:.0f} %"


def test_the_best_point_is_told_in_units_of_the_site_and_the_least_for_known_psfs_beside_it():
    best, known = choice(), choice(7e-3, relative_mse=0.11, blind_mse=0.4)
    text = str(plan_of(best, known))
    assert f"no mask of this diameter can avoid {best.relative_mse - best.above_floor:.4g}, with" in text
    assert (
        f"with 6 holes of 0.12 m, 10 frames of 2 ms ({0.12 / R0:.2g} r0, {2e-3 / TAU0:.2g} tau0), a band of 30 nm"
        in text
    )
    assert f" and {best.photons:.4g} photons in each" in text
    assert f"that knows the PSFs: {best.relative_mse:.4g}; the least would be {known.relative_mse:.4g}, with" in text
    assert f"{known.relative_mse:.4g}, with 6 holes of 0.12 m, 10 frames of 7 ms." in text


def test_chances_are_in_percent_and_costs_and_levels_are_factors():
    text = str(plan_of(choice()))
    assert "62 % (41 to 83 %) end within" in text
    assert f"the median is {OUTLOOK.cost:.3g} times" in text
    assert f"scores are {OUTLOOK.restored:.3g} times those predicted" in text


def test_the_least_for_known_psfs_is_of_the_whole_error_and_what_shows_something_of_the_blind_one():
    """A floor is higher in less light, so less above it need not be less in all."""
    little = Choice(6, 0.12, 2e-3, 30e-9, 10, 1e5, 0.0, 0.5, 0.1, 0.6, OUTLOOK)
    least = Choice(6, 0.12, 4e-3, 30e-9, 10, 1e5, 0.0, 0.3, 0.2, 0.7, OUTLOOK)
    assert plan_of(little, least).best_known is least
    assert plan_of(little, least).best is little
    assert plan_of(choice(blind_mse=0.5, relative_mse=1.0)).shows_something
    assert not plan_of(choice(blind_mse=1.0, relative_mse=0.5)).shows_something


def test_a_single_point_is_no_edge_and_each_end_of_an_axis_is():
    times, widths = (1e-3, 2e-3, 4e-3), (10e-9, 20e-9)
    for least in times:
        points = [choice(t, w, 0.3 + abs(math.log(t / least)) + 1e6 * w) for t in times for w in widths]
        found = plan_of(*points)
        assert [point.exposure for point in found.axis("exposure")] == list(times)
        assert {point.width for point in found.axis("exposure")} == {widths[0]}
        assert [found.at_edge(name) for name in AXES] == [False, False, least != times[1], True]
        assert ("The best exposure" in str(found)) == (least != times[1])
        assert f"Best exposure between those of the map: {1e3 * found.best_exposure:.4g} ms;" in str(found)
        if least == times[1]:  # as far from either end: the vertex of a parabola lies in the middle
            assert found.best_exposure == pytest.approx(least, rel=1e-9)


def test_between_points_only_what_is_known_counts():
    """Longer exposures were not tried, so that their errors are lower limits: the longest known one is the edge."""
    points = choice(1e-3, blind_mse=0.5), choice(2e-3, blind_mse=0.3), choice(4e-3, blind_mse=0.29, blind=BEYOND)
    found = plan_of(*points, tried_up_to={"exposure": 3e-3})
    assert found.best is points[1]
    assert found.at_edge("exposure")
    assert found.best_exposure == points[1].exposure
    assert "The best exposure, 2 ms, is the largest on the map at which blind restorations were tried: up to 3 ms" in (
        str(found)
    )
    shorter = plan_of(
        points[1], points[2], tried_up_to={"exposure": 3e-3}
    )  # the only known one is the largest such too
    assert "The best exposure, 2 ms, is the largest on the map" in str(shorter)


@pytest.mark.parametrize(("last", "may_be_better"), [(2e-3, True), (3e-3, False)])
def test_a_larger_one_is_worth_a_try_up_to_where_restorations_were_tried(last, may_be_better):
    found = plan_of(choice(1e-3, blind_mse=0.5), choice(last), tried_up_to={"exposure": 3e-3})
    assert ("a larger one may be better, so give exposures above it too" in str(found)) == may_be_better
    assert ("by how much is not known" in str(found)) == (not may_be_better)


def test_the_best_width_is_told_in_nanometres():
    widths = 10e-9, 20e-9, 80e-9
    points = [choice(width=width, blind_mse=0.3 * 2 ** (math.log(width / 25e-9) ** 2)) for width in widths]
    found = plan_of(*points)
    assert found.best_width == pytest.approx(25e-9, rel=1e-9)  # the errors are a parabola in the logarithms
    assert "ms; best width: 25 nm." in str(found)
    edge = plan_of(*points[:2])
    assert f"The best width of the band, {1e9 * edge.best.width:.4g} nm, is the last on the map" in str(edge)


def test_the_best_instrument_has_exposure_and_band_of_the_best_point():
    found = plan_of(choice(2e-3, 30e-9), choice(4e-3, 10e-9, 0.4)).best_instrument
    assert (found.exposure, found.width) == (2e-3, 30e-9)


def test_frames_that_the_wind_leaves_alike_are_counted_by_the_hole():
    """A hole of 0.12 m is crossed in 12 ms; ten frames of 2 ms follow each other without a pause."""
    told = str(plan_of(choice()))
    differ = 1 + 9 * 2e-3 * WIND / 0.12
    assert f"The wind takes {1e3 * 0.12 / WIND:.3g} ms to cross 0.12 m, so only about {differ:.0f} of the 10" in told
    assert "The wind takes" not in str(plan_of(choice(exposure=20e-3)))


def test_the_full_pupil_beside_masks_is_told_with_its_band_and_how_large_a_one_was_tried():
    harder = BlindOutlook(1.0, 1.0, 1.0, 1.0, ("d_over_r0",), 1.0, ("d_over_r0",))
    for blind, least in ((OUTLOOK, "0.7"), (harder, "at least 0.7")):
        one = choice(3e-3, 40e-9, 0.7, blind, hole=1.0, n=1)
        beside = ObservationPlan(INSTRUMENT, (one,), {(1, 1.0): FullAperture(1.0)}, tried_up_to={"hole_diameter": 0.6})
        told = str(plan_of(choice(), full_pupil=beside))
        assert f"the least is {least}, with the full pupil of 1 m, 10 frames of 3 ms, a band of 40 nm" in told
        assert (f"up to D/r0 = {0.6 / R0:.3g}." in told) == (blind is harder)
