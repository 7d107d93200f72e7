"""Visibilities and closure phases against closed forms, their errors, their signs on the sky, and the OIFITS file."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import j0

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.data.observe import read_observation
from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.interferometry.visibilities import Observables, restored_observables, sky_stations
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.otf import disc_otf
from torchmask.optics.psf import psf_from_samples
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.exposures import simulate_observation

reader = pytest.importorskip("oifits")
fits = pytest.importorskip("astropy.io.fits")

CENTERS = [[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]]
WAVELENGTH = 550e-9


def sky_cards(angle, mirrored, scale):
    """A WCS turned by `angle`; east to the left, or to the right if mirrored."""
    degrees, parity = math.degrees(scale), 1 if mirrored else -1
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg", "CRVAL1": 80.0}
    cards |= {"CRVAL2": -65.0, "CRPIX1": 1.0, "CRPIX2": 1.0}
    cards |= {"CD1_1": parity * degrees * math.cos(angle), "CD1_2": -parity * degrees * math.sin(angle)}
    return cards | {"CD2_1": degrees * math.sin(angle), "CD2_2": degrees * math.cos(angle)}


@pytest.fixture
def mask():
    return SparseAperture(CENTERS, 0.1, 1.0)


@pytest.fixture
def grid(mask):
    return Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)


def expose(mask, grid, stars=((0.0, 0.0, 1.0),), electrons=1e6, n_frames=1, oversampling=8, seed=0, pistons=True):
    """Frames of point sources (x, y, flux), pixels from [H // 2, W // 2], a random piston on every hole and frame."""
    samples = mask.samples(grid, oversampling)
    position = samples.offsets + mask.centers[:, None, :]
    generator = torch.Generator().manual_seed(seed)
    phase = 2 * math.pi * torch.rand(n_frames, mask.n_subapertures, 1, generator=generator, dtype=torch.float64)
    frames = torch.zeros(n_frames, *grid.shape, dtype=torch.float64)
    height, width = grid.shape
    for x, y, flux in stars:
        tilt = 2 * math.pi * grid.pixel_scale / grid.wavelength * position @ position.new_tensor([x, y])
        psf = psf_from_samples(samples, tilt + (phase if pistons else 0 * phase))
        frames += flux * psf.roll((height // 2, width // 2), (-2, -1))[:, :height, :width]
    return frames * electrons / sum(flux for *_, flux in stars)


def binary(baselines, east, north, contrast):
    """V of a star and a companion `contrast` as bright, at angles (east, north) [rad]; the star is the phase centre."""
    u, v = np.asarray(baselines).T / WAVELENGTH
    return (1 + contrast * np.exp(-2j * math.pi * (u * east + v * north))) / (1 + contrast)


def closures(visibilities, n):
    number = {pair: index for index, pair in enumerate(itertools.combinations(range(n), 2))}
    triangles = itertools.combinations(range(n), 3)
    return np.array(
        [
            np.angle(visibilities[number[i, j]] * visibilities[number[j, k]] * np.conj(visibilities[number[i, k]]))
            for i, j, k in triangles
        ]
    )


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def dimming(shift, cutoff):
    """What a companion `shift` pixels away loses: the overlap of a disc's diffraction pattern with itself, shifted."""

    def power(x):
        return float(disc_otf(torch.tensor(x))) ** 2 * x

    whole = quad(power, 0, 1)[0]
    return 1 - quad(lambda x: power(x) * j0(2 * math.pi * x * cutoff * shift), 0, 1)[0] / whole


def result_of(scene, mask, n_frames=1, noise=1.0, n_modes=3):
    ones = dict.fromkeys(("transmission", "model", "residuals", "chi_square", "cost"), torch.ones(n_frames))
    return RestorationResult(
        object=scene,
        extended_object=scene,
        coefficients=torch.zeros(n_frames, mask.n_subapertures, n_modes, dtype=torch.float64),
        **ones,
        prior="TotalVariation()",
        r0=1.0,
        noise=noise,
        converged=True,
        message="",
        n_evaluations=1,
        seconds=1.0,
    )


# --- closed forms


@pytest.mark.parametrize("oversampling", [4, 8, 16])
def test_a_point_source_has_full_visibility_and_no_closure_phase_whatever_the_pistons(mask, grid, oversampling):
    # The sampled holes differ from discs by the square of sample over diameter.
    observation = Observation(expose(mask, grid, n_frames=3, oversampling=oversampling), mask, grid, 0.0)
    observables = frame_observables(observation)
    step = grid.period / (oversampling * grid.shape[0]) / mask.subaperture_diameter
    assert float((observables.vis2 - 1).abs().max()) < step**2
    assert float(observables.closure_phases.abs().max()) < step**2
    assert float((observables.triple_amplitudes - 1).abs().max()) < 1.5 * step**2
    assert step < 0.3


def test_pistons_and_place_are_the_phase_of_a_visibility(mask, grid):
    # V_ij of a point at (x, y) pixels is exp(-2 pi i nu . (x, y)) exp(i (p_i - p_j)).
    shift, pistons = torch.tensor([1.3, -0.6], dtype=torch.float64), torch.tensor([0.3, -0.8, 1.1, 0.2])
    samples = mask.samples(grid, 8)
    tilt = 2 * math.pi * grid.pixel_scale / WAVELENGTH * (samples.offsets + mask.centers[:, None, :]) @ shift
    psf = psf_from_samples(samples, tilt + pistons[:, None].double())
    frame = 1e6 * psf.roll((24, 24), (-2, -1))[None, :48, :48]
    observables = frame_observables(Observation(frame, mask, grid, 0.0))
    i, j = observables.pairs.T
    expected = -2 * math.pi * (mask.centers[j] - mask.centers[i]) / grid.period @ shift + pistons[i] - pistons[j]
    assert float(wrapped(observables.visibilities.angle() - expected).abs().max()) < 0.02


@pytest.mark.parametrize("diameter", [0.12, 0.06, 0.03])
def test_a_binary_has_its_known_visibilities_and_closure_phases(diameter):
    mask = SparseAperture(CENTERS, diameter, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 64, 1.1)
    x, y, contrast = 2.0, -1.5, 0.3
    frames = expose(mask, grid, ((0, 0, 1), (x, y, contrast)), n_frames=2, oversampling=8)
    observables = frame_observables(Observation(frames, mask, grid, 0.0))
    expected = binary(observables.baselines, x * grid.pixel_scale, y * grid.pixel_scale, contrast)
    assert np.abs(closures(expected, 4)).max() > 0.2
    assert np.ptp(np.abs(expected)) > 0.2
    # Star and companion are dimmed, one or the other, by no more than the companion off centre.
    lost = contrast * dimming(math.hypot(x, y), grid.cutoff(diameter))
    step = (grid.period / (8 * 64) / diameter) ** 2
    assert np.abs(observables.vis2.numpy() - np.abs(expected) ** 2).max() < 2 * lost + step
    phases = wrapped(observables.closure_phases.numpy() - closures(expected, 4))
    assert np.abs(phases).max() < (3 * lost + step) / np.abs(expected).min()
    assert lost < 0.02 * (diameter / 0.12) ** 2 + 1e-3


@pytest.mark.parametrize(("angle", "mirrored"), [(0.0, False), (0.7, False), (2.5, True)])
def test_signs_on_the_sky_as_a_reader_of_the_file_sees_them(tmp_path, mask, grid, angle, mirrored):
    # A companion towards the north-west: east -2.2, north 1.4 pixels. The WCS says where that is in the image.
    header = sky_cards(angle, mirrored, grid.pixel_scale)
    matrix = np.array([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]])
    sky = np.array([-2.2, 1.4]) * grid.pixel_scale
    x, y = np.linalg.solve(np.radians(matrix), sky)
    frames = expose(mask, grid, ((0, 0, 1), (x, y, 0.2)), n_frames=2)
    observation = Observation(frames, mask, grid, 0.0, header=header)
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[24, 24] = 1.0
    for name, observables in (
        ("frames", frame_observables(observation)),
        ("object", restored_observables(result_of(scene, mask), observation)),
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
        expected = binary(uv, *sky, 0.2)
        # opposite signs, or east for west, would be wrong by twice the closure phases
        phases = np.radians([row.t3phi.data[0] for row in data.t3])
        assert np.abs(closures(expected, 4)).max() > 0.15
        lost = 0.2 * dimming(math.hypot(2.2, 1.4), grid.cutoff(0.1))
        assert np.abs(wrapped(phases - closures(expected, 4))).max() < (3 * lost + 0.003) / np.abs(expected).min() < 0.1
        squared = np.array([row.vis2data.data[0] for row in data.vis2])
        assert np.abs(squared - np.abs(expected) ** 2).max() < 2 * lost + 0.003


def test_oblong_and_skewed_pixels_have_the_phase_of_their_place_on_the_sky(mask, grid):
    header = sky_cards(0.4, False, grid.pixel_scale)
    header |= {"CD1_1": 1.01 * header["CD1_1"], "CD2_1": 1.02 * header["CD2_1"]}
    matrix = np.radians([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]])
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0, header=header)
    x, y = 5.0, -3.0
    nu = mask.centers.numpy() / grid.period
    expected = nu @ [x, y]
    stations = sky_stations(observation).numpy()
    np.testing.assert_allclose(stations @ (matrix @ [x, y]) / WAVELENGTH, expected, rtol=1e-12, atol=1e-12)


def test_a_restored_object_has_exactly_the_visibilities_of_its_pixels(mask, grid):
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[24, 24], scene[29, 17] = 300.0, 60.0
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0)
    observables = restored_observables(result_of(scene, mask), observation)
    expected = binary(observables.baselines, -7 * grid.pixel_scale, 5 * grid.pixel_scale, 0.2)
    np.testing.assert_allclose(observables.visibilities, expected, atol=1e-12)
    np.testing.assert_allclose(observables.vis2, np.abs(expected) ** 2, atol=1e-12)
    phases = observables.closure_phases.numpy() - closures(expected, 4)
    np.testing.assert_allclose(wrapped(phases), 0, atol=1e-12)


def test_dead_pixels_do_no_harm(mask, grid):
    frames = expose(mask, grid, oversampling=16)
    valid = torch.ones(grid.shape, dtype=torch.bool)
    valid[24, 25] = valid[20, 21] = valid[:, 30] = False
    spoilt = torch.where(valid, frames, 1e7)
    observables = frame_observables(Observation(spoilt, mask, grid, 0.0, valid=valid))
    assert float((observables.vis2 - 1).abs().max()) < 1e-2
    assert float(observables.closure_phases.abs().max()) < 1e-3


# --- errors


def test_errors_are_the_scatter_of_the_measurements():
    # Closure phases of a point source are 0 and |V|^2 is 1: mean square over error^2 is 1. Of the 4 triangles of
    # 4 holes 3 are independent; the larger of two estimates makes errors rather too large.
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose(mask, grid, electrons=2e4, n_frames=20, oversampling=8).repeat(30, 1, 1)
    noise = torch.Generator().manual_seed(5)
    noisy = torch.poisson(clean, noise) + 2.0 * torch.randn(clean.shape, generator=noise, dtype=torch.float64)
    for n_frames, low in ((1, 0.8), (12, 0.55)):
        stacks = noisy.split(n_frames)
        found = [frame_observables(Observation(stack, mask, grid, 2.0)) for stack in stacks]
        independent = 3 * len(found)
        slack = 5 * math.sqrt(2 / independent)
        phases = torch.stack([(o.closure_phases / o.closure_errors) ** 2 for o in found]).mean()
        squares = torch.stack([((o.vis2 - 1) / o.vis2_errors) ** 2 for o in found]).mean()
        assert low - slack < phases < 1 + slack
        assert low - slack < squares < 1 + slack
        assert slack < 0.6


def test_squared_visibilities_of_faint_frames_are_free_of_noise_bias():
    mask = SparseAperture(CENTERS, 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 32, 1.1)
    clean = expose(mask, grid, electrons=500, n_frames=20, oversampling=8).repeat(30, 1, 1)
    noise = torch.Generator().manual_seed(6)
    noisy = torch.poisson(clean, noise) + 1.0 * torch.randn(clean.shape, generator=noise, dtype=torch.float64)
    freed = frame_observables(Observation(noisy, mask, grid, 1.0))
    assert float(((freed.vis2 - 1) / freed.vis2_errors).abs().max()) < 4
    noiseless = torch.full_like(noisy, 1e-3)
    biased = frame_observables(Observation(noisy, mask, grid, 0.0, errors=noiseless))
    assert float(((biased.vis2 - 1) / freed.vis2_errors).mean()) > 4


def test_errors_of_a_restored_object_are_those_of_frames_with_its_noise():
    # White noise, no aberrations, patches that do not overlap: two ways to the same error.
    mask = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15]], 0.07, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 96, 1.1)
    frames = expose(mask, grid, electrons=1e5, n_frames=2, pistons=False)
    observation = Observation(frames, mask, grid, 0.0, errors=torch.full_like(frames, 3.0))
    direct = frame_observables(observation)
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[48, 48] = 1e5
    restored = restored_observables(result_of(scene, mask, n_frames=2, noise=3.0), observation)
    # a hole, sampled 8 times, and its patch of 40 frequencies are known to some percent
    for name in ("visibility_errors", "vis2_errors", "closure_errors", "triple_errors"):
        torch.testing.assert_close(getattr(restored, name), getattr(direct, name), rtol=0.08, atol=0)
    louder = restored_observables(result_of(scene, mask, n_frames=2, noise=6.0), observation)
    torch.testing.assert_close(louder.closure_errors, 2 * restored.closure_errors)
    worse = dataclasses.replace(result_of(scene, mask, n_frames=2, noise=3.0), chi_square=torch.tensor([3.0, 5.0]))
    torch.testing.assert_close(restored_observables(worse, observation).closure_errors, 2 * restored.closure_errors)


def test_restoring_a_binary_brings_its_closure_phases_nearer_the_truth():
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.12)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 48)
    scene = torch.zeros(48, 48, dtype=torch.float64)
    scene[24, 24], scene[20, 27] = 1e6, 3e5
    turbulence, generator = TurbulencePhase(0.2, 20.0), torch.Generator().manual_seed(0)
    seen = simulate_observation(scene, mask, grid, turbulence, Detector(), 8, generator)
    restored = MyopicDeconvolution(mask, grid, r0=0.2, max_iterations=300).restore(seen.frames)
    rms = []
    for observables in (restored_observables(restored, seen), frame_observables(seen)):
        truth = closures(binary(observables.baselines, 3 * grid.pixel_scale, -4 * grid.pixel_scale, 0.3), 6)
        rms.append(float(np.sqrt((wrapped(observables.closure_phases.numpy() - truth) ** 2).mean())))
    assert np.abs(truth).max() > 0.5
    assert rms[0] < 0.5 * rms[1]
    assert rms[1] < 0.06


# --- the file


def test_the_file_says_what_was_observed(tmp_path, mask, grid):
    about = {"TARGNAME": "AB Dor", "TARG_RA": 82.18, "TARG_DEC": -65.45, "TELESCOP": "JWST", "INSTRUME": "NIRISS"}
    about |= {"FILTER": "F480M", "DATE-OBS": "2022-06-05", "TIME-OBS": "12:00:00", "XPOSURE": 20.0}
    header = sky_cards(0.3, False, grid.pixel_scale) | about
    observation = Observation(expose(mask, grid, n_frames=3, pistons=False), mask, grid, 0.0, header=header)
    save_oifits(tmp_path / "a.oifits", frame_observables(observation), observation)
    with fits.open(tmp_path / "a.oifits", checksum=True) as hdus:
        names = [hdu.name for hdu in hdus[1:]]
        primary = hdus[0].header
        rows = {name: len(hdus[name].data) for name in names}
        stations = hdus["OI_T3"].data["STA_INDEX"].tolist()
        frame = hdus["OI_ARRAY"].header["FRAME"]
        first = [hdus["OI_T3"].data[name][0] for name in ("U1COORD", "V1COORD", "U2COORD", "V2COORD")]
        data = reader.open(hdus, quiet=True)
    assert names == ["OI_TARGET", "OI_ARRAY", "OI_WAVELENGTH", "OI_VIS", "OI_VIS2", "OI_T3"]
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


def test_unknown_things_are_said_to_be_unknown(tmp_path, mask, grid):
    observation = Observation(expose(mask, grid), mask, grid, 0.0)
    observables = frame_observables(observation)
    with pytest.raises(ValueError, match=r"width of the band is not known.*give bandwidth \[m\]"):
        save_oifits(tmp_path / "a.fits", observables, observation)
    save_oifits(tmp_path / "a.fits", observables, observation, bandwidth=1e-8)
    primary = fits.getheader(tmp_path / "a.fits")
    assert "no sky coordinates" in str(primary["COMMENT"])
    assert "date is not known" in str(primary["COMMENT"])
    np.testing.assert_allclose(observables.stations, mask.centers)


def test_what_is_not_finite_is_flagged(tmp_path, mask, grid):
    observation = Observation(expose(mask, grid), mask, grid, 0.0)
    whole = frame_observables(observation)
    broken = Observables(**{**vars(whole), "vis2_errors": torch.tensor([math.nan, 1, 1, 1, 1, 1])})
    save_oifits(tmp_path / "a.fits", broken, observation, bandwidth=1e-8)
    flags = fits.getdata(tmp_path / "a.fits", "OI_VIS2")["FLAG"]
    assert flags.ravel().tolist() == [True] + 5 * [False]


def test_two_holes_have_a_baseline_and_no_triangle(tmp_path, grid):
    mask = SparseAperture(CENTERS[:2], 0.1, 1.0)
    observation = Observation(expose(mask, grid), mask, grid, 0.0)
    observables = frame_observables(observation)
    assert observables.vis2.shape == (1,)
    assert observables.closure_phases.shape == (0,)
    save_oifits(tmp_path / "a.fits", observables, observation, bandwidth=1e-8)
    with fits.open(tmp_path / "a.fits") as hdus:
        assert "OI_T3" not in hdus
        assert reader.open(hdus, quiet=True).isvalid()


def test_what_cannot_be_is_refused(tmp_path, mask, grid):
    observation = Observation(expose(mask, grid), mask, grid, 0.0)
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
    with pytest.raises(ValueError, match=r"two holes are the least"):
        frame_observables(Observation(observation.frames, FullAperture(0.9), grid, 0.0))
    square = SparseAperture([[0.3, 0.3], [0.3, -0.3], [-0.3, -0.3], [-0.3, 0.3]], 0.1, 1.0)
    with pytest.raises(ValueError, match=r"cannot be told apart: those of holes .* lie 0 m apart"):
        frame_observables(Observation(observation.frames, square, grid, 0.0))
    with pytest.raises(ValueError, match=r"is black"):
        restored_observables(result_of(torch.zeros(grid.shape), mask), observation)
    with pytest.raises(ValueError, match=r"object has shape \(8, 8\)"):
        restored_observables(result_of(torch.ones(8, 8), mask), observation)


# --- the sky


def test_closure_phases_of_ab_dor_show_its_companion(niriss):
    # README of the observations: about 0.3 arcsec away, several magnitudes fainter; the calibrator shows none.
    mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
    star, calibrator = (
        frame_observables(read_observation(sorted(niriss.glob(name)), mask, gain=1.62, crop=48))
        for name in ("ab-dor*.fits", "hd-37093*.fits")
    )
    assert float(star.closure_phases.rad2deg().abs().max()) > 2
    assert float(calibrator.closure_phases.rad2deg().abs().max()) < 1
    phases = wrapped(star.closure_phases - calibrator.closure_phases).numpy()
    errors = torch.hypot(star.closure_errors, calibrator.closure_errors).numpy()
    steps = np.arange(-0.5, 0.51, 0.02) / 3600 * math.pi / 180
    u, v = star.baselines.numpy().T / 4.817e-6
    waves = np.exp(-2j * math.pi * (u * steps[:, None, None] + v * steps[:, None]))  # (east, north, baseline)
    first, second, third = (
        [list(map(tuple, star.pairs.tolist())).index(pair) for pair in pairs]
        for pairs in zip(*[((i, j), (j, k), (i, k)) for i, j, k in star.triangles.tolist()], strict=True)
    )
    found = []
    for magnitude in np.arange(2.5, 7, 0.25):
        contrast = 10 ** (-0.4 * magnitude)
        values = (1 + contrast * waves) / (1 + contrast)
        model = np.angle(values[..., first] * values[..., second] * values[..., third].conj())
        chi = ((phases - model) ** 2 / errors**2).mean(-1)
        east, north = np.unravel_index(chi.argmin(), chi.shape)
        found.append((chi.min(), math.hypot(steps[east], steps[north]) * 3600 * 180 / math.pi, magnitude))
    chi, separation, magnitude = min(found)
    assert chi < 0.1 * float((phases**2 / errors**2).mean())
    assert 0.25 < separation < 0.4
    assert 3.5 < magnitude < 5.5
