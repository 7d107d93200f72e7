"""What restorations attain in long exposures and wide bands: measured at the points, between them, a warning beyond."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch

from torchmask.atmosphere.structure import StructureFunction
from torchmask.planning.smearing import SmearingMap, phase_spread, smearing_map
from torchmask.planning.success import BlindOutlook, success_map

PHOTONS, EXPOSURES, SPREADS = (1e5, 1e7), (0.0, 1.0, 4.0), (0.2, 1.0, 4.0)
LONG, WIDE = np.array([[0.8, 1.2, 2.0], [0.4, 0.5, 1.0]]), np.array([[0.7, 1.1, 1.3], [0.3, 0.4, 2.0]])
MAP = SmearingMap(PHOTONS, EXPOSURES, SPREADS, LONG, WIDE)
INSTANTS = BlindOutlook(1.2, 0.75, 0.5, 0.9)


def ratio(photons, exposure, spread):
    return MAP.outlook(INSTANTS, n_photons=photons, exposure=exposure, spread=spread).restored


def test_at_its_points_the_ratios_are_multiplied_over_the_mean_of_instants_in_narrow_light():
    for i, photons in enumerate(PHOTONS):
        for j, exposure in enumerate(EXPOSURES):
            for k, spread in enumerate(SPREADS):
                expected = LONG[i, j] * WIDE[i, k] / math.sqrt(LONG[i, 0] * WIDE[i, 0])
                assert ratio(photons, exposure, spread) == pytest.approx(expected, rel=1e-12)


def test_where_both_tables_agree_on_instants_each_is_followed():
    agreed = SmearingMap(PHOTONS, EXPOSURES, SPREADS, LONG, LONG)
    for exposure, measured in zip(EXPOSURES, LONG[1], strict=True):
        outlook = agreed.outlook(INSTANTS, n_photons=1e7, exposure=exposure, spread=0.2)
        assert outlook.restored == pytest.approx(measured, rel=1e-12)


def test_by_what_known_psfs_differ_from_the_prediction_is_multiplied():
    levelled = dataclasses.replace(INSTANTS, restored=0.3)
    outlook = MAP.outlook(levelled, n_photons=1e6, exposure=2.0, spread=2.0)
    assert outlook.restored == pytest.approx(0.3 * ratio(1e6, 2.0, 2.0), rel=1e-12)


def test_between_its_points_it_is_geometric():
    """In exposure and spread themselves, in the logarithm of the photons."""
    halves = [math.sqrt(one * other) for one, other in (LONG[:, 2], WIDE[:, 2], LONG[:, 0], WIDE[:, 0])]
    expected = halves[0] * halves[1] / math.sqrt(halves[2] * halves[3])
    assert ratio(1e6, 4.0, 4.0) == pytest.approx(expected, rel=1e-12)
    assert ratio(1e5, 2.0, 0.2) == pytest.approx(1.2 ** (2 / 3) * 2.0 ** (1 / 3) * math.sqrt(0.7 / 0.8), rel=1e-12)
    assert ratio(1e5, 0.0, 2.0) == pytest.approx(1.1 ** (2 / 3) * 1.3 ** (1 / 3) * math.sqrt(0.8 / 0.7), rel=1e-12)


def test_light_narrower_than_the_first_band_counts_as_that():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ratio(1e5, 4.0, 0.0) == ratio(1e5, 4.0, 0.2)


def test_exposures_shorter_than_the_first_count_as_that():
    first = SmearingMap(PHOTONS, (0.5, 1.0, 4.0), SPREADS, LONG, WIDE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        short, tried = (first.outlook(INSTANTS, n_photons=1e5, exposure=t, spread=0.2) for t in (0.0, 0.5))
    assert short == tried
    assert short.outside == ()


@pytest.mark.parametrize(
    ("point", "edge", "name", "said"),
    [
        ((1e4, 4.0, 0.4), (1e5, 4.0, 0.4), "n_photons", r"photons per frame from 100000 to 1e\+07"),
        ((1e5, 9.0, 0.4), (1e5, 4.0, 0.4), "exposure", "exposures over tau0 from 0 to 4"),
        ((1e5, 4.0, 5.0), (1e5, 4.0, 4.0), "spread", "spreads of the phase across the band in rad from 0.2 to 4"),
    ],
)
def test_beyond_it_warns_and_takes_the_edge(point, edge, name, said):
    with pytest.warns(UserWarning, match=said):
        outlook = MAP.outlook(INSTANTS, **dict(zip(("n_photons", "exposure", "spread"), point, strict=True)))
    assert outlook.outside == (name,)
    assert outlook.harder == ((name,) if name != "n_photons" else ())
    assert outlook.restored == ratio(*edge)
    assert (outlook.cost, outlook.success) == (INSTANTS.cost, INSTANTS.success)


def test_what_instants_lie_outside_of_is_not_said_again():
    faint = dataclasses.replace(INSTANTS, outside=("n_photons",))
    with pytest.warns(UserWarning, match="exposures over tau0") as said:
        outlook = MAP.outlook(faint, n_photons=1e4, exposure=9.0, spread=0.4)
    assert len(said) == 1
    assert outlook.outside == ("n_photons", "exposure")


def test_what_makes_instants_a_limit_makes_all_else_one():
    wide = dataclasses.replace(INSTANTS, outside=("d_over_r0",), harder=("d_over_r0",))
    inside = MAP.outlook(wide, n_photons=1e6, exposure=1.0, spread=0.4)
    assert (inside.outside, inside.harder) == (("d_over_r0",), ("d_over_r0",))
    with pytest.warns(UserWarning, match="exposures over tau0"):
        beyond = MAP.outlook(wide, n_photons=1e6, exposure=9.0, spread=0.4)
    assert beyond.harder == ("d_over_r0", "exposure")


def test_the_error_grows_by_the_square_of_cost_and_ratio():
    """A ratio below 1 lowers it: restorations may be better than the linear estimate that is predicted."""
    for exposure in (0.0, 1.0):
        outlook = MAP.outlook(INSTANTS, n_photons=1e7, exposure=exposure, spread=0.2)
        assert outlook.mse(0.3, 0.1) == pytest.approx(0.2 + 0.1 * (1.2 * outlook.restored) ** 2, rel=1e-12)
    assert outlook.mse(0.3, 0.1) < 0.3


def test_the_spread_of_the_phase_is_the_root_of_its_structure_function_times_the_width():
    d_over_r0, width = 5.0, 0.3
    square = float(StructureFunction(r0=1 / d_over_r0)(torch.tensor([1.0, 0.0], dtype=torch.float64)))
    assert phase_spread(width, d_over_r0) == pytest.approx(width * math.sqrt(square), rel=1e-3)  # 6.88 is rounded


@pytest.mark.parametrize("pupil", ["mask", "full"])
def test_ratios_of_the_library_never_fall_with_blur_and_the_level_falls_with_light(pupil):
    """The prediction is that of a linear estimate, which a positive object of least variation beats in bright light.

    Ratios are over that level, so those of instants in narrow light are near 1: three to eight draws scatter by 20 %.
    """
    measured = smearing_map(pupil)
    for table in (measured.exposure_ratio, measured.band_ratio):
        assert (np.diff(table, axis=1) >= 0).all()
        assert (np.abs(np.log(table[:, 0])) < 0.3).all()
    assert (np.diff(success_map(pupil).level[1:], axis=1) < 0).all()
    assert "64 x 64 pixels" in measured.conditions


@pytest.mark.parametrize(
    "change",
    [
        {"exposure_ratio": LONG[:, :2]},
        {"band_ratio": 0 * WIDE},
        {"band_ratio": math.inf * WIDE},
        {"spreads": (0.1, 0.05, 1)},
    ],
)
def test_tables_that_cannot_be_are_refused(change):
    axes = {"n_photons": PHOTONS, "exposures": EXPOSURES, "spreads": SPREADS}
    with pytest.raises(ValueError, match=r"positive numbers of shape|in rising order"):
        SmearingMap(**(axes | {"exposure_ratio": LONG, "band_ratio": WIDE} | change))


@pytest.mark.parametrize(
    ("point", "said"), [((1e5, -1.0, 0.1), "exposure is -1"), ((1e5, 1.0, math.nan), "spread is nan")]
)
def test_points_that_cannot_be_are_refused(point, said):
    with pytest.raises(ValueError, match=f"{said}.*: it must be finite and at least 0"):
        ratio(*point)
