"""How many frames fit into the observing time, however its seconds are rounded, and what is said of them."""

import math

import pytest

from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope


def make(exposure, readout_time, observing_time):
    return Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(magnitude=5.0),
        site=Site(r0=0.15, wind=10.0),
        camera=Camera(readout_time=readout_time),
        wavelength=550e-9,
        width=10e-9,
        n_wavelengths=1,
        exposure=exposure,
        observing_time=observing_time,
    )


def test_frames_that_fill_the_time_exactly_are_all_counted():
    """The quotients of these decimals are rounded to just below a whole number."""
    for exposure, readout_time, observing_time, frames in ((0.1, 0.0, 0.3, 3), (7e-3, 3e-3, 0.29, 29)):
        assert math.floor(observing_time / (exposure + readout_time)) == frames - 1
        assert make(exposure, readout_time, observing_time).frames == frames


@pytest.mark.parametrize("lacking", [1e-6, 1e-3])
def test_a_frame_that_does_not_fit_is_not_counted(lacking):
    assert make(0.1, 0.0, 0.3 * (1 - lacking)).frames == 2


def test_the_table_says_what_one_can_work_out_by_hand():
    told = Instrument(
        telescope=Telescope(diameter=1.2),
        source=Source(photon_rate=1e6),
        site=Site(r0=0.1, wind=8.0, sky=20.0),
        camera=Camera(n_pixels=64, pixel_scale=0.05, readout_noise=1.5),
        wavelength=550e-9,
        width=10e-9,
        n_wavelengths=1,
        exposure=4e-3,
        n_frames=30,
    )
    rows = dict(row.strip("| ").split(" | ") for row in told.describe(0.3).splitlines())
    assert rows["wavelength"] == "550 nm"
    assert rows["photons per frame"] == "1200 electrons"  # 1e6 / (s m^2), 0.3 m^2, 4 ms
    assert rows["read-out noise of a frame"] == "96 electrons rms"  # the root of 64^2 pixels of 1.5^2
    assert rows["pixel"] == "0.05 arcsec"
    assert rows["D / r0"] == "12"
    # 3631 Jy over h, times the band's relative width, fainter by 20 magnitudes, 0.05^2 square arcsec
    sky = 3631e-26 / 6.62607015e-34 * (10 / 550) * 1e-8 * 0.3 * 4e-3 * 0.05**2
    assert float(rows["sky"].removesuffix(" electrons per pixel and frame")) == pytest.approx(sky, rel=1e-3)
    tau0 = 6.88 ** (-3 / 5) * 0.1 / 8.0
    ratio, said = rows["exposure / tau0"].removesuffix(" ms)").split(" (tau0 = ")
    assert float(said) == pytest.approx(1e3 * tau0, rel=1e-3)
    assert float(ratio) == pytest.approx(4e-3 / tau0, rel=1e-3)
