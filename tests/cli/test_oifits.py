"""`torchmask restore --oifits`: what is in the file, and what is refused before any work."""

import dataclasses

import numpy as np
import pytest
import torch

from torchmask.cli.main import main
from torchmask.cli.oifits import FILE, OIFITSOptions, measure_frames, write_frames
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import SquarePixel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.verdict import Finding

fits = pytest.importorskip("astropy.io.fits")

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 32, 1.1)


@pytest.fixture
def seen(expose_points):
    frames = torch.poisson(expose_points(MASK, GRID, electrons=1e5, n_frames=3), torch.Generator().manual_seed(0))
    return Observation(frames, MASK, GRID, 1.0)


def restore(*arguments):
    return main(["restore", *map(str, arguments), "--max-iterations", "2", "--n-modes", "3"])


@pytest.mark.parametrize("n_stacks", [1, 2])
def test_the_file_holds_the_observables_of_the_frames(n_stacks, seen, tmp_path, capsys):
    stacks = [tmp_path / f"stack{number}.npz" for number in range(n_stacks)]
    for path in stacks:
        seen.save(path)
    given = ("--oifits", "--bandwidth", "1e-8", "--pixel-fill", "0.8", "--workers", "1", "--out", tmp_path / "run")
    assert restore(*stacks, *given) == NOT_EXPLAINED  # after two iterations
    files = sorted((tmp_path / "run").rglob("*.oifits"))
    assert len(files) == n_stacks
    expected = frame_observables(dataclasses.replace(seen, pixel=SquarePixel(0.8)))
    for file in files:
        assert str(file) in capsys.readouterr().out.replace("\n", "") or n_stacks > 1
        with fits.open(file) as hdus:
            np.testing.assert_allclose(hdus["OI_VIS2"].data["VIS2DATA"].ravel(), expected.vis2, rtol=1e-12)
            phases = np.radians(hdus["OI_T3"].data["T3PHI"].ravel())
            np.testing.assert_allclose(phases, expected.closure_phases, atol=1e-12)
            assert float(hdus["OI_WAVELENGTH"].data["EFF_BAND"][0]) == pytest.approx(1e-8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--oifits"], "give --bandwidth [m]"),
        (
            ["--oifits", "--bandwidth", "-1"],
            "--bandwidth is -1: it must be positive and less than twice the wavelength",
        ),
        (
            ["--oifits", "--bandwidth", "20"],
            "--bandwidth is 20: it must be positive and less than twice the wavelength",
        ),
        (["--bandwidth", "1e-8"], "--bandwidth is for the OIFITS file alone: give --oifits"),
        (["--wavelengths", "545", "555"], "--wavelengths is 545: it must be a wavelength of light in m"),
    ],
)
def test_an_unknown_band_is_refused_before_any_work(options, message, seen, tmp_path, capsys):
    seen.save(tmp_path / "stack.npz")
    assert restore(tmp_path / "stack.npz", *options, "--out", tmp_path / "run") == 1
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("told", "width"),
    [
        (["--wavelengths", "545e-9", "555e-9"], 10e-9 * 3**0.5),  # the top hat of their variance, 5 nm squared
        (["--filter", "{curve}"], 20e-9),
        (["--filter", "{curve}", "--bandwidth", "1e-8"], 1e-8),
    ],
)
def test_the_width_of_the_band_is_that_of_its_filter_or_wavelengths(told, width, seen, tmp_path):
    seen.save(tmp_path / "stack.npz")
    curve = tmp_path / "curve.txt"
    curve.write_text("540e-9 1\n560e-9 1\n")
    told = [word.format(curve=curve) for word in told]
    assert restore(tmp_path / "stack.npz", "--oifits", *told, "--out", tmp_path / "run") == NOT_EXPLAINED
    with fits.open(tmp_path / "run/frames.oifits") as hdus:
        assert float(hdus["OI_WAVELENGTH"].data["EFF_BAND"][0]) == pytest.approx(width, rel=1e-3)


def test_a_sky_that_is_known_is_taken_off_with_its_noise_counted(seen):
    bright = dataclasses.replace(seen, frames=seen.frames + 50)
    found = measure_frames(bright, OIFITSOptions(oifits=True, bandwidth=1e-8), sky=50.0)
    expected = frame_observables(dataclasses.replace(seen, readout_noise=51**0.5))
    torch.testing.assert_close(found.vis2, expected.vis2)
    torch.testing.assert_close(found.vis2_covariance, expected.vis2_covariance)
    assert measure_frames(bright, OIFITSOptions()) is None


def test_a_sky_that_explains_the_frames_is_taken_off(seen, tmp_path):
    sky = torch.poisson(torch.full_like(seen.frames, 50.0), generator=torch.Generator().manual_seed(0))
    bright, options = dataclasses.replace(seen, frames=seen.frames + sky), OIFITSOptions(oifits=True, bandwidth=1e-8)
    ended = MyopicDeconvolution(MASK, GRID, 3, readout_noise=1.0, max_iterations=1).restore(bright.frames)
    assert ended.verdict is not None
    assert not ended.verdict.explained
    lost = dataclasses.replace(ended, background=torch.full((3,), 50.0, dtype=torch.float64))
    good = dataclasses.replace(lost, verdict=dataclasses.replace(ended.verdict, finding=Finding.EXPLAINED))
    raw = measure_frames(bright, options)
    for name, result, known, expected, told in (
        ("good", good, 0.0, measure_frames(bright, options, 50.0), ", without a sky of 50 electrons"),
        ("lost", lost, 0.0, raw, "; a sky in the frames lowers |V|^2: take it off by --sky"),
        ("known", good, 50.0, raw, ""),  # what is handed in is without it already
    ):
        (tmp_path / name).mkdir()
        (line,) = write_frames(tmp_path / name, raw, bright, options, result, known)
        assert line.endswith(f"{FILE}{told}")
        with fits.open(tmp_path / name / FILE) as hdus:
            np.testing.assert_allclose(hdus["OI_VIS2"].data["VIS2DATA"].ravel(), expected.vis2, rtol=1e-12)
