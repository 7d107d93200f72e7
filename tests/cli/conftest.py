"""One instrument and its mask, and a folder that holds both, for the commands that read them."""

import pytest

from torchmask.design.manufacture import save_json
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import SparseAperture


@pytest.fixture
def golay():
    return SparseAperture.from_catalog("golay6", 1.2, 0.1)


@pytest.fixture
def recorded():
    return Instrument(
        telescope=Telescope(diameter=1.2, central_obstruction=0.2, throughput=0.5),
        source=Source(magnitude=2.0, size=0.5, exponent=2.0, temperature=3000.0),
        site=Site(r0=0.3, wind=5.0, sky=4.0, outer_scale=30.0),
        camera=Camera(n_pixels=24, readout_noise=2.5, pixel_fill=0.9),
        wavelength=700e-9,
        width=20e-9,
        n_wavelengths=2,
        exposure=3e-3,
        n_frames=2,
    )


@pytest.fixture
def folder(tmp_path, recorded, golay):
    recorded.save(tmp_path / "instrument.json")
    save_json(tmp_path / "mask.json", golay)
    return tmp_path
