"""The OIFITS file as its own reader sees it: signs on the sky, what was observed, what is not known."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchmask.data.observe import read_observation
from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.observables import Observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.interferometry.visibilities import restored_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

reader = pytest.importorskip("oifits")
fits = pytest.importorskip("astropy.io.fits")

CENTERS = [[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]]
WAVELENGTH = 550e-9


@pytest.fixture
def mask():
    return SparseAperture(CENTERS, 0.1, 1.0)


@pytest.fixture
def grid(mask):
    return Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


@pytest.mark.parametrize(("angle", "mirrored"), [(0.0, False), (0.7, False), (2.5, True)])
def test_signs_on_the_sky_as_a_reader_of_the_file_sees_them(
    tmp_path, mask, grid, angle, mirrored, expose_points, binary, sky_cards
):
    # A companion towards the north-west: east -2.2, north 1.4 pixels. The WCS says where that is in the image.
    header = sky_cards(angle, grid.pixel_scale, mirrored)
    matrix = np.array([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]])
    sky = np.array([-2.2, 1.4]) * grid.pixel_scale
    x, y = np.linalg.solve(np.radians(matrix), sky)
    frames = expose_points(mask, grid, ((0, 0, 1), (x, y, 0.2)), n_frames=2)
    observation = Observation(frames, mask, grid, 0.0, header=header)
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[24, 24] = 1.0
    flat = torch.zeros(2, 4, 3, dtype=torch.float64)
    restored = SimpleNamespace(object=scene, coefficients=flat, noise=1.0, chi_square=torch.ones(2))
    for name, observables in (
        ("frames", frame_observables(observation)),
        ("object", restored_observables(restored, observation)),
    ):
        path = tmp_path / f"{name}.fits"
        save_oifits(path, observables, observation, bandwidth=1e-8)
        with fits.open(path) as hdus:
            data = reader.open(hdus, quiet=True)
        assert data.isvalid()
        uv = np.array([(row.ucoord, row.vcoord) for row in data.vis2])
        xyz = np.array([station.staxyz for station in data.array["MASK"].station])
        pairs = list(itertools.combinations(range(4), 2))
        np.testing.assert_allclose(uv, [xyz[j, :2] - xyz[i, :2] for i, j in pairs], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), np.linalg.norm(CENTERS, axis=1), rtol=1e-12)
        if name == "object":
            continue
        pair = binary(*sky, 0.2)
        expected, closures = pair.visibilities(uv, WAVELENGTH), pair.closure_phases(uv, WAVELENGTH)
        # opposite signs, or east for west, would be wrong by twice the closure phases
        phases = np.radians([row.t3phi.data[0] for row in data.t3])
        assert np.abs(closures).max() > 0.15
        lost = pair.dimming(grid, 0.1)
        assert np.abs(wrapped(phases - closures)).max() < (3 * lost + 0.003) / np.abs(expected).min() < 0.1
        squared = np.array([row.vis2data.data[0] for row in data.vis2])
        assert np.abs(squared - np.abs(expected) ** 2).max() < 2 * lost + 0.003


def test_the_file_says_what_was_observed(tmp_path, mask, grid, expose_points, sky_cards):
    about = {"TARGNAME": "AB Dor", "TARG_RA": 82.18, "TARG_DEC": -65.45, "TELESCOP": "JWST", "INSTRUME": "NIRISS"}
    about |= {"FILTER": "F480M", "DATE-OBS": "2022-06-05", "TIME-OBS": "12:00:00", "XPOSURE": 20.0}
    header = sky_cards(0.3, grid.pixel_scale) | about
    frames = torch.poisson(expose_points(mask, grid, n_frames=3, pistons=False), torch.Generator().manual_seed(0))
    observation = Observation(frames, mask, grid, 0.0, header=header)
    save_oifits(tmp_path / "a.oifits", frame_observables(observation), observation)
    with fits.open(tmp_path / "a.oifits", checksum=True) as hdus:
        names = [hdu.name for hdu in hdus[1:]]
        primary = hdus[0].header
        rows = {name: len(hdus[name].data) for name in names}
        stations = hdus["OI_T3"].data["STA_INDEX"].tolist()
        frame = hdus["OI_ARRAY"].header["FRAME"]
        first = [hdus["OI_T3"].data[name][0] for name in ("U1COORD", "V1COORD", "U2COORD", "V2COORD")]
        data = reader.open(hdus, quiet=True)
    assert names == ["OI_TARGET", "OI_ARRAY", "OI_WAVELENGTH", "OI_VIS", "OI_VIS2", "OI_T3", "OI_CORR"]
    assert rows.pop("OI_CORR") == 15 + 6 + 6
    assert rows == {"OI_TARGET": 1, "OI_ARRAY": 4, "OI_WAVELENGTH": 1, "OI_VIS": 6, "OI_VIS2": 6, "OI_T3": 4}
    assert primary["CONTENT"] == "OIFITS2"
    assert "COMMENT" not in primary
    assert frame == "SKY"
    assert stations == [[1, 2, 3], [1, 2, 4], [1, 3, 4], [2, 3, 4]]
    uv = [(row.ucoord, row.vcoord) for row in data.vis2]
    np.testing.assert_allclose(first, [*uv[0], *uv[3]])  # 1-2 and 2-3
    assert data.isvalid()
    assert data.isconsistent()
    assert data.getoifitsver() == 2
    assert data.target[0].target == "AB Dor"
    assert float(data.target[0].raep0) == 82.18
    (wave,) = data.wavelength.values()
    np.testing.assert_allclose([wave.eff_wave[0], wave.eff_band[0]], [WAVELENGTH, 0.298e-6], rtol=1e-6)
    row = data.t3[0]
    assert row.timeobs.isoformat()[:16] == "2022-06-05T12:00"
    assert row.int_time == 60.0
    assert not row.flag.any()
    assert row.t3amp[0] == pytest.approx(1.0, abs=0.1)
    assert data.vis[0].visamp[0] == pytest.approx(1.0, abs=0.1)
    assert row.array.station[0].diameter == pytest.approx(0.1)


def test_unknown_things_are_said_to_be_unknown(tmp_path, mask, grid, expose_points):
    observation = Observation(expose_points(mask, grid), mask, grid, 0.0)
    observables = frame_observables(observation)
    with pytest.raises(ValueError, match=r"no known FILTER.*give bandwidth \[m\]"):
        save_oifits(tmp_path / "a.fits", observables, observation)
    save_oifits(tmp_path / "a.fits", observables, observation, bandwidth=1e-8)
    primary = fits.getheader(tmp_path / "a.fits")
    assert "no sky coordinates" in str(primary["COMMENT"])
    assert "date is not known" in str(primary["COMMENT"])
    np.testing.assert_allclose(observables.stations, mask.centers)


def test_the_integration_time_of_a_cube_is_that_of_the_whole_exposure(tmp_path, mask, grid, expose_points, sky_cards):
    """As of JWST, whose XPOSURE is that of all integrations (EFFEXPTM): 69 of 0.3772 s in 26.013 s for AB Dor."""
    cards = {"EFFINTTM": 0.3772, "XPOSURE": 3 * 0.3772, "EFFEXPTM": 3 * 0.3772, "BUNIT": "electron"}
    cards |= sky_cards(0.3, grid.pixel_scale) | {"WAVELEN": grid.wavelength}
    frames = expose_points(mask, grid, n_frames=3).numpy()
    fits.PrimaryHDU(frames, fits.Header(cards)).writeto(tmp_path / "cube.fits")
    observation = read_observation(tmp_path / "cube.fits", mask)
    save_oifits(tmp_path / "a.oifits", frame_observables(observation), observation, bandwidth=1e-8)
    times = fits.getdata(tmp_path / "a.oifits", "OI_VIS2")["INT_TIME"]
    np.testing.assert_allclose(times, 3 * 0.3772, rtol=1e-12)


def test_what_is_not_finite_is_flagged(tmp_path, mask, grid, expose_points):
    observation = Observation(expose_points(mask, grid), mask, grid, 0.0)
    whole = frame_observables(observation)
    broken = Observables(**{**vars(whole), "vis2_covariance": torch.diag(torch.tensor([math.nan, 1, 1, 1, 1, 1]))})
    save_oifits(tmp_path / "a.fits", broken, observation, bandwidth=1e-8)
    flags = fits.getdata(tmp_path / "a.fits", "OI_VIS2")["FLAG"]
    assert flags.ravel().tolist() == [True] + 5 * [False]
    correlations = fits.getdata(tmp_path / "a.fits", "OI_CORR")
    assert np.isfinite(correlations["CORR"]).all()
    assert 1 not in correlations["IINDX"]  # the number of that value


def test_two_holes_have_a_baseline_and_no_triangle(tmp_path, grid, expose_points):
    mask = SparseAperture(CENTERS[:2], 0.1, 1.0)
    observation = Observation(expose_points(mask, grid), mask, grid, 0.0)
    observables = frame_observables(observation)
    assert observables.vis2.shape == (1,)
    assert observables.closure_phases.shape == (0,)
    save_oifits(tmp_path / "a.fits", observables, observation, bandwidth=1e-8)
    with fits.open(tmp_path / "a.fits") as hdus:
        assert "OI_T3" not in hdus
        assert reader.open(hdus, quiet=True).isvalid()


def test_what_cannot_be_is_refused(tmp_path, mask, grid, expose_points):
    observation = Observation(expose_points(mask, grid), mask, grid, 0.0)
    observables = frame_observables(observation)
    (tmp_path / "a.fits").write_text("mine")
    with pytest.raises(ValueError, match=r"exists and is not overwritten"):
        save_oifits(tmp_path / "a.fits", observables, observation, bandwidth=1e-8)
    assert (tmp_path / "a.fits").read_text() == "mine"
    with pytest.raises(ValueError, match=r"ends neither in"):
        save_oifits(tmp_path / "a.txt", observables, observation, bandwidth=1e-8)
    with pytest.raises(ValueError, match=r"bandwidth is -1"):
        save_oifits(tmp_path / "b.fits", observables, observation, bandwidth=-1.0)
    bad_date = Observation(observation.frames, mask, grid, 0.0, header={"DATE-OBS": "yesterday"})
    with pytest.raises(ValueError, match=r"DATE-OBS is 'yesterday'"):
        save_oifits(tmp_path / "b.fits", observables, bad_date, bandwidth=1e-8)
    three = SparseAperture(CENTERS[:3], 0.1, 1.0)
    with pytest.raises(ValueError, match=r"of 4 holes and the observation's mask has 3"):
        save_oifits(tmp_path / "b.fits", observables, Observation(observation.frames, three, grid, 0.0), bandwidth=1e-8)
    assert [path.name for path in tmp_path.iterdir()] == ["a.fits"]
