"""From which difference on a stack contradicts the instrument that it is said to come from."""

import dataclasses

import pytest
import torch

from torchmask.cli.agreement import Statement, complete, exposure_in_tau0, require_agreement
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.pixel import SquarePixel


@pytest.mark.parametrize(("tolerance", "told"), [(0.01, {}), (0.1, {"tolerance": 0.1})])
def test_numbers_agree_within_a_fraction_of_the_larger(tolerance, told):
    for large in (5.5e-7, 80.0):
        for side in (0.99, 1.01):
            small = large * (1 - side * tolerance)
            for seen, planned in ((large, small), (small, large)):
                statement = Statement("wavelength", seen, planned, "m", **told)
                assert statement.contradicts == (side > 1)


def test_what_is_unknown_contradicts_nothing():
    assert not Statement("wavelength", None, 1.0, "m").contradicts
    assert not Statement("wavelength", 1.0, None, "m").contradicts


def test_all_contradictions_are_told_with_both_numbers():
    wrong = [Statement("readout_noise", 3.0, 5.0, "electrons", 0.1), Statement("wavelength", 5.5e-7, 6e-7, "m")]
    with pytest.raises(ValueError, match=r"--readout-noise \(3 against 5 electrons\).*--wavelength \(5\.5e-07 against"):
        require_agreement([*wrong, Statement("pixel_fill", 1.0, 1.0, "of the area")], "a.fits")


def test_an_exposure_counts_in_coherence_times():
    """tau0 = 0.314 r0 / wind: 4.71 ms here."""
    assert exposure_in_tau0(None, None, 2e-3, 10.0, 0.15) == pytest.approx(2e-3 / (0.314 * 0.15 / 10.0), rel=1e-3)
    assert exposure_in_tau0(None, None, 2e-3, None, 0.15) == 0.0


def test_pixels_are_those_of_the_instrument_unless_the_stack_or_the_user_says_what_they_are(recorded, golay):
    """Someone who says that pixels are points, which is no response, is not told otherwise."""
    grid = Grid(8, recorded.pixel_scale, recorded.mean_wavelength)
    bare = Observation(torch.ones(1, 8, 8), golay, grid, recorded.camera.readout_noise)
    assert complete(bare, recorded, set(), "a.fits").pixel == SquarePixel(recorded.camera.pixel_fill)
    assert complete(bare, recorded, {"pixel_fill"}, "a.fits").pixel is None
    own = dataclasses.replace(bare, pixel=SquarePixel(0.5))
    assert complete(own, recorded, {"pixel_fill"}, "a.fits").pixel == SquarePixel(0.5)
    with pytest.raises(ValueError, match=r"--pixel-fill \(0\.5 against 0\.9 of the area\)"):
        complete(own, recorded, set(), "a.fits")
