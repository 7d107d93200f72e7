"""What long exposures and wide bands cost: measured at the points, between them, and a warning beyond."""

import math
import warnings

import numpy as np
import pytest

from torchmask.planning.smearing import SmearingMap, smearing_map
from torchmask.planning.success import BlindOutlook

PHOTONS, EXPOSURES, WIDTHS = (1e5, 1e7), (0.0, 1.0, 4.0), (0.02, 0.1, 0.4)
LONG, WIDE = np.array([[1.0, 1.2, 2.0], [1.0, 1.5, 3.0]]), np.array([[1.0, 1.1, 1.3], [1.0, 1.4, 4.0]])
MAP = SmearingMap(PHOTONS, EXPOSURES, WIDTHS, LONG, WIDE)
INSTANTS = BlindOutlook(1.2, 0.75, 0.5, 0.9)


def factor(photons, exposure, width):
    return MAP.outlook(INSTANTS, n_photons=photons, exposure=exposure, width=width).smearing


def test_at_its_points_both_factors_are_multiplied():
    for i, photons in enumerate(PHOTONS):
        for j, exposure in enumerate(EXPOSURES):
            for k, width in enumerate(WIDTHS):
                assert factor(photons, exposure, width) == pytest.approx(LONG[i, j] * WIDE[i, k], rel=1e-12)


def test_between_its_points_it_is_geometric():
    """In exposure and width themselves, in the logarithm of the photons."""
    assert factor(1e5, 2.0, 0.02) == pytest.approx(1.2 ** (2 / 3) * 2.0 ** (1 / 3), rel=1e-12)
    assert factor(1e5, 0.0, 0.2) == pytest.approx(1.1 ** (2 / 3) * 1.3 ** (1 / 3), rel=1e-12)
    assert factor(1e6, 4.0, 0.4) == pytest.approx(math.sqrt(2.0 * 3.0 * 1.3 * 4.0), rel=1e-12)


def test_light_narrower_than_the_first_band_counts_as_that():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert factor(1e5, 4.0, 0.0) == pytest.approx(2.0, rel=1e-12)


@pytest.mark.parametrize(
    ("point", "edge", "name", "said"),
    [
        ((1e4, 4.0, 0.4), (1e5, 4.0, 0.4), "n_photons", r"photons per frame from 100000 to 1e\+07"),
        ((1e5, 9.0, 0.4), (1e5, 4.0, 0.4), "exposure", "exposures over tau0 from 0 to 4"),
        ((1e5, 4.0, 0.5), (1e5, 4.0, 0.4), "width", "widths of the band over the wavelength from 0.02 to 0.4"),
    ],
)
def test_beyond_it_warns_and_takes_the_edge(point, edge, name, said):
    with pytest.warns(UserWarning, match=said):
        outlook = MAP.outlook(INSTANTS, **dict(zip(("n_photons", "exposure", "width"), point, strict=True)))
    assert outlook.outside == (name,)
    assert outlook.smearing == factor(*edge)
    assert (outlook.cost, outlook.success) == (INSTANTS.cost, INSTANTS.success)


def test_the_error_grows_by_the_square_of_both_factors():
    outlook = MAP.outlook(INSTANTS, n_photons=1e5, exposure=1.0, width=0.1)
    assert outlook.mse(0.3, 0.1) == pytest.approx(0.2 + 0.1 * (1.2 * 1.2 * 1.1) ** 2, rel=1e-12)


def test_the_tables_of_the_library_begin_at_no_cost_and_never_fall():
    measured = smearing_map()
    for table in (measured.exposure_cost, measured.width_cost):
        assert (table[:, 0] == 1).all()
        assert (np.diff(table, axis=1) >= 0).all()
    assert "64 x 64 pixels" in measured.conditions


@pytest.mark.parametrize(
    "change", [{"exposure_cost": LONG[:, :2]}, {"width_cost": 0 * WIDE}, {"widths": (0.1, 0.05, 1)}]
)
def test_tables_that_cannot_be_are_refused(change):
    axes = {"n_photons": PHOTONS, "exposures": EXPOSURES, "widths": WIDTHS}
    with pytest.raises(ValueError, match=r"positive numbers of shape|in rising order"):
        SmearingMap(**(axes | {"exposure_cost": LONG, "width_cost": WIDE} | change))


@pytest.mark.parametrize(
    ("point", "said"), [((1e5, -1.0, 0.1), "exposure is -1"), ((1e5, 1.0, math.nan), "width is nan")]
)
def test_points_that_cannot_be_are_refused(point, said):
    with pytest.raises(ValueError, match=f"{said}.*: it must be finite and at least 0"):
        factor(*point)
