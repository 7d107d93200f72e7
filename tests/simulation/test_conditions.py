"""What an exposure adds: sky, transparency and pixels, each against what it must be, and their bad values."""

import math

import pytest
import torch

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import MappedPixel, SquarePixel
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposed_psf import ExposedPSF
from torchmask.simulation.exposures import simulate_observation

WAVELENGTH = 550e-9
GRID = Grid.nyquist(1.0, WAVELENGTH, 32)
MASK = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


def simulate(scene, n_frames=3, turbulence=None, readout_noise=0.0, pixel=None, seed=0, **conditions):
    return simulate_observation(
        *(scene, MASK, GRID, turbulence or TurbulencePhase(0.2, 20.0)),
        *(Detector(readout_noise, pixel=pixel), n_frames),
        torch.Generator().manual_seed(seed),
        conditions=Conditions(**conditions),
    )


def box(light=1e6):
    scene = torch.zeros(32, 32, dtype=torch.float64)
    scene[12:20, 13:18] = light / 40
    return scene


def test_the_sky_adds_its_light_and_its_noise():
    """A faint scene on a sky of 30: mean and variance of the pixels, Poisson's, and the read-out noise beside."""
    sky, noise, n_frames = 30.0, 2.0, 60
    seen = simulate(box(1e-3), n_frames, readout_noise=noise, sky=sky)
    assert seen.background == sky
    n = seen.frames.numel()
    variance = sky + noise**2
    assert float(seen.frames.mean()) == pytest.approx(sky, abs=4 * math.sqrt(variance / n))
    # the variance of a variance: (kurtosis + 2) / n, kurtosis 1 / sky of Poisson's at most
    assert float(seen.frames.var()) == pytest.approx(variance, rel=4 * math.sqrt((2 + 1 / sky) / n))


def test_the_light_that_is_told_to_be_kept_is_not_that_of_the_sky():
    """Of a sky with four times the light of the scene nothing is left but its noise."""
    light, sky, records = 1e7, 4e7 / 32**2, []
    seen = simulate_observation(
        *(box(light), MASK, GRID, TurbulencePhase(0.2, 20.0), Detector(), 3),
        torch.Generator().manual_seed(0),
        conditions=Conditions(sky=sky),
        callback=records.append,
    )
    kept = float(torch.stack([psf.sum() for psf in seen.psfs]).mean())  # of a star in the middle
    noise = math.sqrt(5 * light / 3) / light
    record = records[-1]
    # light that leaves the field from a box of a quarter of its width is more than that of a star by some percent
    assert 0.9 * kept - 5 * noise < record.scalars["kept_light"] < 1 + 5 * noise


def test_the_light_follows_the_transmission_and_the_sky_does_not():
    sky, light = 50.0, 1e8
    clear, cloudy = simulate(box(light), 40, sky=sky), simulate(box(light), 40, sky=sky, transparency_scatter=0.3)
    assert torch.equal(clear.transmission, torch.ones(40, dtype=torch.float64))
    assert torch.equal(clear.psfs, cloudy.psfs)
    ratio = (cloudy.frames - sky).sum((1, 2)) / (clear.frames - sky).sum((1, 2))
    error = ((1 + 1 / cloudy.transmission) / light).sqrt()  # photon noise of both, in units of the transmission
    assert bool(((ratio / cloudy.transmission - 1).abs() < 5 * error).all())


def test_transmissions_are_log_normal_with_mean_1():
    scatter, n = 0.4, 1000
    tiny = Grid.nyquist(1.0, WAVELENGTH, 8)
    scene = torch.ones(8, 8, dtype=torch.float64)
    conditions = Conditions(transparency_scatter=scatter)
    seen = simulate_observation(
        scene, FullAperture(1.0), tiny, None, Detector(), n, torch.Generator().manual_seed(1), conditions=conditions
    )
    logarithm = seen.transmission.log()
    assert float(logarithm.std()) == pytest.approx(scatter, rel=4 / math.sqrt(2 * n))
    assert float(logarithm.mean()) == pytest.approx(-(scatter**2) / 2, abs=4 * scatter / math.sqrt(n))
    spread = math.sqrt(math.expm1(scatter**2) / n)
    assert float(seen.transmission.mean()) == pytest.approx(1, abs=4 * spread)


def test_clouds_and_sky_leave_the_screens_as_they_were():
    plain = simulate(box(), seed=5)
    for other in (simulate(box(), seed=5, sky=3.0), simulate(box(), seed=5, transparency_scatter=0.2)):
        assert torch.equal(other.psfs, plain.psfs)
        assert not torch.equal(other.frames, plain.frames)


@pytest.mark.parametrize("pixel", [SquarePixel(), SquarePixel(0.6), MappedPixel(torch.eye(4).double(), 4)])
def test_a_pixel_multiplies_the_otf_by_its_transfer(pixel):
    """A square one by its sincs. On the raster of the PSFs, before they are cropped to the field."""
    plain, blurred = (torch.fft.fft2(ExposedPSF(MASK, GRID, pixel=own)([None])) for own in (None, pixel))
    nu_y, nu_x = Grid(4 * 32, GRID.pixel_scale, WAVELENGTH).frequencies(torch.float64)
    below_nyquist = (nu_y.abs() < 0.5) & (nu_x.abs() < 0.5)  # there a real image has no odd part
    seen = (plain.abs() > 1e-6) & below_nyquist
    transfer = pixel.transfer(nu_y, nu_x) if isinstance(pixel, MappedPixel) else squares(pixel.fill_factor, nu_y, nu_x)
    assert int(seen.sum()) > 1000
    torch.testing.assert_close((blurred / plain)[seen], transfer[seen] + 0j, rtol=0, atol=1e-9)


def squares(fill, nu_y, nu_x):
    """sin(pi w nu) / (pi w nu) along both axes."""
    width = math.sqrt(fill)
    along = [torch.where(nu == 0, 1.0, torch.sin(math.pi * width * nu) / (math.pi * width * nu)) for nu in (nu_y, nu_x)]
    return along[0] * along[1]


def test_frames_and_psfs_are_those_of_the_pixels():
    """The stored PSF of a simulation is that of its pixels, and so is the image of a point."""
    point = torch.zeros(32, 32, dtype=torch.float64)
    point[16, 16] = 1e10
    seen = simulate(point, 1, pixel=SquarePixel())
    assert seen.pixel == SquarePixel()
    sharp = simulate(point, 1)
    assert float((seen.psfs - sharp.psfs).abs().max()) > 0.05 * float(sharp.psfs.max())
    error = (seen.psfs[0] / 1e10).sqrt().clamp(min=1e-10)
    assert float(((seen.frames[0] / 1e10 - seen.psfs[0]) / error).abs().max()) < 5.5  # photons, of 1024 pixels


@pytest.mark.parametrize(
    ("name", "value"),
    [("sky", -1.0), ("sky", math.nan), ("transparency_scatter", -0.1), ("exposure_time", -1e-3), ("sky", math.inf)],
)
def test_numbers_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*: it must be finite and at least 0"):
        Conditions(**{name: value})


def test_a_band_that_the_pixels_undersample_is_refused():
    with pytest.raises(ValueError, match=r"undersamples .* at 5\.\d+e-07 m"):
        simulate_observation(
            box(), FullAperture(1.0), GRID, None, Detector(), 1, conditions=Conditions(band=Band.top_hat(550e-9, 50e-9))
        )


def test_an_exposure_needs_wind_and_time():
    with pytest.raises(ValueError, match="no wind"):
        simulate(box(), exposure_time=1e-3)
    still = LayeredPhase(Layers([0.0], [1e-13]), WAVELENGTH, 20.0)
    with pytest.raises(ValueError, match="no wind"):
        simulate(box(), turbulence=still, exposure_time=1e-3)
    with pytest.raises(ValueError, match=r"is 20 s, 1\.59e\+03 times tau0, .*: at most 1000 times .*, 12\.6 s"):
        simulate(box(), turbulence=TurbulencePhase(0.2, 20.0, (5.0, 0.0), 100.0), exposure_time=20.0)
    with pytest.raises(ValueError, match=r"longer than the 0\.01 s from one frame to the next"):
        simulate(box(), turbulence=TurbulencePhase(0.2, 20.0, (5.0, 0.0), 0.01), exposure_time=0.02)


def test_what_is_told_stands_in_the_observation_and_light_takes_the_true_way(tmp_path):
    """The PSF is that of the true mask, and the file keeps both."""
    true = MaskGeometry(rotation=0.1, magnification_x=0.98, magnification_y=0.98).apply(MASK)
    seen, honest = (simulate_observation(box(), true, GRID, None, Detector(), 1, told=told) for told in (MASK, None))
    assert torch.equal(seen.psfs, honest.psfs)
    assert torch.equal(seen.aperture.centers, MASK.centers)
    assert torch.equal(seen.true_aperture.centers, true.centers)
    assert torch.equal(honest.aperture.centers, true.centers)
    assert honest.true_aperture is None
    seen.save(tmp_path / "stack.npz")
    again = Observation.load(tmp_path / "stack.npz")
    assert torch.equal(again.true_aperture.centers, true.centers)
    assert again.true_aperture.subaperture_diameter == true.subaperture_diameter
    assert torch.equal(again.aperture.centers, MASK.centers)
    assert torch.equal(again.transmission, seen.transmission)
    with pytest.raises(ValueError, match="keep_phases"):
        simulate_observation(box(), true, GRID, None, Detector(), 1, told=MASK, keep_phases=True)


def test_phases_are_kept_of_snapshots_of_one_wavelength_only():
    windy = TurbulencePhase(0.2, 20.0, (5.0, 0.0), 0.01)
    for conditions in (Conditions(exposure_time=0.01), Conditions(band=Band.of([WAVELENGTH]))):
        with pytest.raises(ValueError, match="keep_phases needs monochromatic snapshots"):
            simulate_observation(box(), MASK, GRID, windy, Detector(), 2, conditions=conditions, keep_phases=True)
