import pytest

from torchmask.optics.band import Band


def test_nanometres_are_refused():
    with pytest.raises(ValueError, match=r"the longest of wavelengths is 560: .* of light in m, .*; 560 nm are 560e-9"):
        Band.of([550.0, 560.0])


def test_wavelengths_may_be_in_the_units_of_a_grid():
    """As of `Grid`, in which only the wavelength over the pixel scale counts."""
    assert Band.of([0.9, 1.1]).mean == pytest.approx(1.0)
