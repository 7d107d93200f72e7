"""Where the marks of a plan's figure lie: milliseconds, nanometres, and the errors of blind restorations."""

import numpy as np
import pytest

from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Site, Source, Telescope
from torchmask.optics.aperture import SparseAperture
from torchmask.planning.result import Choice, ObservationPlan
from torchmask.planning.success import BlindOutlook
from torchmask.viz.planning import plan_figure

pytest.importorskip("matplotlib")

EXPOSURES, WIDTHS = (1e-3, 2e-3, 5e-3), (10e-9, 30e-9)
OUTLOOK = BlindOutlook(cost=1.1, success=0.9, low=0.8, high=0.95)


def blind_error(exposure, width):
    """Least at 2 ms in 30 nm, and all different."""
    return 0.3 + 0.1 * abs(np.log(exposure / 2e-3)) + 1e6 * abs(width - 30e-9)


@pytest.fixture(scope="module")
def figure():
    instrument = Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(photon_rate=1e9),
        site=Site(r0=0.15, wind=10.0),
        wavelength=550e-9,
        width=10e-9,
        exposure=2e-3,
        n_frames=10,
    )
    choices = tuple(
        Choice(6, 0.1, exposure, width, 10, 1e5, 0.0, 0.1, 0.05, blind_error(exposure, width), OUTLOOK)
        for exposure in EXPOSURES
        for width in WIDTHS
    )
    masks = {(6, 0.1): SparseAperture.from_catalog("golay6", 1.0, 0.06)}
    return plan_figure(ObservationPlan(instrument, choices, masks))


def points(line):
    return np.stack([line.get_xdata(), line.get_ydata()], -1)


def test_exposures_are_in_milliseconds_at_the_width_of_the_best(figure):
    ax = figure.axes[0]
    (line,) = (line for line in ax.lines if line.get_label() == "6 holes")
    expected = [(1e3 * exposure, blind_error(exposure, 30e-9)) for exposure in EXPOSURES]
    np.testing.assert_allclose(points(line), expected, rtol=1e-12)
    assert ax.get_xlabel() == "exposure [ms]"
    (ring,) = (line for line in ax.lines if line.get_fillstyle() == "none")
    np.testing.assert_allclose(points(ring), [(2.0, 0.3)], rtol=1e-12)


def test_the_dashed_line_is_the_coherence_time(figure):
    """tau0 = 0.314 r0 / wind, with r0 of the same wavelength."""
    (line,) = (line for line in figure.axes[0].lines if line.get_linestyle() == "--")
    np.testing.assert_allclose(line.get_xdata(), 1e3 * 0.314 * 0.15 / 10.0, rtol=1e-3)


def test_widths_are_in_nanometres_at_the_best_exposure(figure):
    ax = figure.axes[1]
    line = next(line for line in ax.lines if len(line.get_xdata()) == 2)
    np.testing.assert_allclose(points(line), [(1e9 * w, blind_error(2e-3, w)) for w in WIDTHS], rtol=1e-12)
    (ring,) = (line for line in ax.lines if line.get_fillstyle() == "none")
    np.testing.assert_allclose(points(ring), [(30.0, 0.3)], rtol=1e-12)
    assert (ax.get_xlabel(), ax.get_title(loc="left")) == ("width of the band [nm]", "at 2 ms")
