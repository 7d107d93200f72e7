"""Bands of a plan: one grid for all, which samples the light of the widest."""

import pytest

from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Site, Source, Telescope
from torchmask.planning.axes import bands_of


@pytest.mark.parametrize("widths", [(10e-9, 60e-9), (60e-9, 10e-9)])
def test_the_pixels_of_all_bands_sample_the_shortest_wavelength_of_the_widest(widths):
    instrument = Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(photon_rate=1e9),
        site=Site(r0=0.15, wind=10.0),
        wavelength=550e-9,
        width=20e-9,
        exposure=2e-3,
        n_frames=20,
    )
    bands = bands_of(instrument, widths)
    assert [band.width for band in bands] == list(widths)
    shortest = min(band.band.shortest for band in bands)
    assert shortest < 530e-9
    for band in bands:
        assert band.pixel_scale == pytest.approx(shortest / 2.0, rel=1e-12)  # wavelength / (2 D)
        assert band.source.photon_rate == pytest.approx(1e9 * band.width / 20e-9, rel=1e-12)
