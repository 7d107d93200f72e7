"""Rules of a telescope and a workshop: those that forbid nothing are most often in millimetres."""

import pytest

from torchmask.design.rules import MaskRules
from torchmask.design.space import DesignSpace


@pytest.mark.parametrize(
    ("rule", "misses"),
    [
        ({"keep_out": ((0.3, 0.1, 0.2),)}, False),
        ({"keep_out": ((300.0, 100.0, 200.0),)}, True),
        ({"keep_out": ((300.0, 100.0, 700.0),)}, False),  # it reaches over the mask
        ({"keep_out": ((0.6, 0.0, 0.21),)}, False),
        ({"keep_out": ((0.6, 0.0, 0.19),)}, True),
        ({"spiders": ((-9.0, 0.2, 9.0, 0.2, 0.1),)}, False),  # from far outside through it
        ({"spiders": ((0.0, 0.0, 0.5, 0.0, 0.01),)}, False),
        ({"spiders": ((5.0, 5.0, 8.0, 8.0, 0.1),)}, True),
        ({"spiders": ((-9.0, 0.6, 9.0, 0.6, 0.1),)}, True),
    ],
)
def test_a_zone_that_misses_the_mask_is_refused(rule, misses):
    if not misses:
        MaskRules(**rule).require_on_pupil(1.0)
        return
    with pytest.raises(ValueError, match=r"outside the mask, of 1 m around 0 0; give it in m \(300 mm are 0.3\)"):
        MaskRules(**rule).require_on_pupil(1.0)
    with pytest.raises(ValueError, match="outside the mask"):
        DesignSpace(**rule)


def test_a_bar_in_millimetres_from_the_centre_is_told():
    with pytest.raises(ValueError, match=r"bar 0 0 600 0 30: wider than a mask of 1\.2 m; give it in m"):
        MaskRules(spiders=((0.0, 0.0, 600.0, 0.0, 30.0),)).require_on_pupil(1.2)


@pytest.mark.parametrize(
    ("given", "said"),
    [({"mask_diameter": 8200.0}, "8.2 m are 8.2"), ({"wavelength": 550e-6}, "from 1e-07 to 5e-05")],
)
def test_sizes_and_wavelengths_that_no_telescope_has_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        DesignSpace(**given)
