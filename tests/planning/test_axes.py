"""Bands of a plan: one grid for all, which samples the light of the widest; and those that pixels sample."""

import pytest

from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import SparseAperture
from torchmask.planning.axes import bands_of, positive, sampled, whole

WAVELENGTH, WIDTH = 550e-9, 20e-9


def instrument_of(pixel_scale=None):
    return Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(photon_rate=1e9),
        site=Site(r0=0.15, wind=10.0),
        camera=Camera(pixel_scale=pixel_scale),
        wavelength=WAVELENGTH,
        width=WIDTH,
        exposure=2e-3,
        n_frames=20,
    )


@pytest.mark.parametrize("widths", [(10e-9, 60e-9), (60e-9, 10e-9)])
def test_the_pixels_of_all_bands_sample_the_shortest_wavelength_of_the_widest(widths):
    bands = bands_of(instrument_of(), widths)
    assert [band.width for band in bands] == list(widths)
    shortest = min(band.band.shortest for band in bands)
    assert shortest < 530e-9
    for band in bands:
        assert band.pixel_scale == pytest.approx(shortest / 2.0, rel=1e-12)  # wavelength / (2 D)
        assert band.source.photon_rate == pytest.approx(1e9 * band.width / WIDTH, rel=1e-12)


def samples(diameter, aperture):
    """Whether pixels for `diameter` [m] at the shortest wavelength, to a per cent, sample the image of an aperture."""
    shortest = instrument_of().band.shortest
    instrument = instrument_of(0.99 * shortest / (2 * diameter) / ARCSEC)
    try:
        return sampled([instrument], aperture, []) == [instrument]
    except ValueError:
        return False


def test_what_an_aperture_reaches_has_to_be_sampled_but_no_more_than_the_telescope():
    """Of a mask its outermost edges count, 0.5 m apart, whatever diameter it is meant for; some reach too far."""
    narrow = SparseAperture([[-0.2, 0.0], [0.2, 0.0]], 0.1, 1.0)
    wide = SparseAperture([[-0.6, 0.0], [0.6, 0.0]], 0.1, 1.0)
    assert narrow.extent == pytest.approx(0.5, rel=1e-6)
    for aperture, reach in ((None, 1.0), (narrow, 0.5), (wide, 1.0)):
        assert samples(reach, aperture)
        assert not samples(0.98 * reach, aperture)


@pytest.mark.parametrize("values", [(), (0.0, 1.0), (1.0, 1.0), (-1.0,), (float("inf"),)])
def test_values_of_an_axis_are_positive_and_different(values):
    with pytest.raises(ValueError, match=r"widths are .* all finite and positive, in m"):
        positive("widths", values, "m")
    assert positive("widths", (2.0, 1e-12), "m") == (1e-12, 2.0)


@pytest.mark.parametrize("values", [(), (1,), (3, 3), (2.5,)])
def test_numbers_of_holes_are_whole_from_two_on(values):
    with pytest.raises(ValueError, match=r"n_subapertures are .* whole, at least 2"):
        whole(values)
    assert whole((7, 2.0)) == (2, 7)
