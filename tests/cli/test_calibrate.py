"""`torchmask calibrate`: from exposures of a star to a mask file."""

import json
import math

import pytest
import torch

from torchmask.cli.main import main
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.design.manufacture import load_mask, mask_wavelength
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import SquarePixel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.exposures import simulate_observation

pytestmark = pytest.mark.usefixtures("coarse_figures")

TOLD = SparseAperture([[0.0, 0.35], [-0.35, -0.2], [0.3, -0.25]], 0.2, 1.0)
TRUE = MaskGeometry(rotation=0.02, magnification_x=1.01, magnification_y=1.01)
GRID = Grid.nyquist(1.1, 550e-9, 64)


@pytest.fixture
def star(tmp_path):
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[32, 32] = 1e7
    seen = simulate_observation(scene, TRUE.apply(TOLD), GRID, None, Detector(), n_frames=1)
    Observation(seen.frames, TOLD, GRID, 1.0, frame_numbers=(3,)).save(tmp_path / "star.npz")
    return tmp_path / "star.npz"


def test_the_mask_where_it_lies_is_written(star, tmp_path, capsys):
    instrument = Instrument(
        telescope=Telescope(diameter=1.0),
        source=Source(magnitude=2.0, size=0.1),
        site=Site(r0=0.3, wind=5.0),
        camera=Camera(n_pixels=64, readout_noise=1.0, pixel_scale=GRID.pixel_scale / ARCSEC),
        wavelength=GRID.wavelength,
        width=20e-9,
        exposure=3e-3,
        n_frames=1,
    )
    instrument.save(tmp_path / "plan.json")
    told = ["--instrument", str(tmp_path / "plan.json"), "--out", str(tmp_path / "run")]
    assert main(["calibrate", str(star), *told]) == 0
    assert Instrument.load(tmp_path / "run/instrument.json") == instrument
    numbers = json.loads((tmp_path / "run" / "calibration.json").read_text())
    assert abs(numbers["rotation"] - 0.02) < 4 * numbers["errors"]["rotation"] + 1e-4
    assert numbers["frame_numbers"] == [3]  # as the file has them
    assert len(numbers["explained"]) == 1
    mask = load_mask(tmp_path / "run" / "mask.json")
    assert mask_wavelength(tmp_path / "run" / "mask.json") == GRID.wavelength
    expected = MaskGeometry(**{name: numbers[name] for name in TRUE.__dataclass_fields__}).apply(TOLD)
    assert torch.equal(mask.centers, expected.centers)
    assert f"{math.degrees(numbers['rotation']):.4f}" in capsys.readouterr().out


def test_a_folder_that_exists_is_said_before_the_star_is_measured(tmp_path, capsys):
    files = [str(tmp_path / "stack.npz"), "--star", str(tmp_path / "star.npz")]  # which are not there
    assert main(["restore", *files, "--out", str(tmp_path)]) == 1
    assert f"{tmp_path} exists and is not overwritten" in capsys.readouterr().err


def test_without_a_star_or_a_mask_nothing_is_written(tmp_path, capsys):
    frames = torch.ones(1, 64, 64)
    Observation(frames, TOLD, GRID, 1.0).save(tmp_path / "sky.npz")
    Observation(frames, FullAperture(1.0), GRID, 1.0).save(tmp_path / "full.npz")
    noise = torch.poisson(torch.full((2, 64, 64), 500.0), generator=torch.Generator().manual_seed(0))
    Observation(noise, TOLD, GRID, 1.0).save(tmp_path / "noise.npz")  # refused after the first fit only
    for file, message in (("sky.npz", "point source"), ("noise.npz", "point source"), ("full.npz", "full pupil")):
        assert main(["calibrate", str(tmp_path / file), "--out", str(tmp_path / "run")]) == 1
        assert message in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    assert main(["calibrate"]) == 1
    assert "give .npz or FITS files" in capsys.readouterr().err


def test_a_restoration_calibrates_on_its_star_first(star, tmp_path, capsys):
    """The mask it restores through is the one that `torchmask calibrate` writes, and a sky is no star."""
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[28:36, 26:38] = 1e5
    seen = simulate_observation(scene, TRUE.apply(TOLD), GRID, None, Detector(), n_frames=2)
    Observation(seen.frames, TOLD, GRID, 1.0).save(tmp_path / "stack.npz")
    Observation(torch.ones(1, 64, 64), TOLD, GRID, 1.0).save(tmp_path / "sky.npz")
    given = ["restore", str(tmp_path / "stack.npz"), "--max-iterations", "2", "--refine-geometry", "no"]
    assert main([*given, "--star", str(tmp_path / "sky.npz"), "--out", str(tmp_path / "none")]) == 1
    assert "--star" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    assert main(["calibrate", str(star), "--out", str(tmp_path / "star")]) == 0
    status = main([*given, "--star", str(star), "--out", str(tmp_path / "run")])
    assert status == NOT_EXPLAINED  # two iterations explain nothing
    mask, alone = (load_mask(tmp_path / name / "mask.json") for name in ("run", "star"))
    errors = json.loads((tmp_path / "star" / "calibration.json").read_text())["errors"]
    # Each of the two fits ends where a step promises less than 0.01 of the squared residuals, a tenth of an error.
    end = 0.2 * (errors["rotation"] + errors["magnification_x"] + errors["magnification_y"] + errors["shear"])
    torch.testing.assert_close(mask.centers, alone.centers, rtol=0, atol=end * float(TOLD.centers.abs().max()))
    assert (tmp_path / "run" / "calibration.json").exists()
    method = MyopicDeconvolution(mask, GRID, max_iterations=2, readout_noise=1.0, refine_geometry=False)
    expected = method.restore(seen.frames)
    found = RestorationResult.load(tmp_path / "run" / "restored.npz")
    assert torch.allclose(found.object, expected.object, rtol=1e-9)
    assert "rotation" in capsys.readouterr().out


def test_a_restoration_takes_the_pixels_of_its_star(tmp_path, capsys):
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[32, 32] = 1e7
    seen = simulate_observation(scene, TOLD, GRID, None, Detector(pixel=SquarePixel(0.8)), n_frames=1)
    seen = Observation(seen.frames, TOLD, GRID, 1.0)
    seen.save(tmp_path / "star.npz")
    given = ["restore", str(tmp_path / "star.npz"), "--max-iterations", "2", "--estimate-pixel"]
    for more, message in (
        ([], "give --star"),
        (["--star", "x.npz", "--pixel-fill", "1"], "give one of them"),
        (["--star", "x.npz", "--jitter", "1"], "does not tell jitter"),
    ):
        assert main([*given, *more]) == 1
        assert message in capsys.readouterr().err
    main([*given, "--star", str(tmp_path / "star.npz"), "--out", str(tmp_path / "run")])
    numbers = json.loads((tmp_path / "run" / "calibration.json").read_text())
    # noise of 1e7 electrons, and the border of the star's square, which is blurred as if it were periodic
    assert abs(numbers["fill_factor"] - 0.8) < 4 * numbers["fill_factor_error"] + 0.005
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())["pixel"]
    assert told == str(SquarePixel(numbers["fill_factor"]))
