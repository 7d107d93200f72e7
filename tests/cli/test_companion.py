"""`torchmask companion`: what it finds, writes and refuses."""

import json

import numpy as np
import pytest
import torch

from torchmask.cli.companion import summary
from torchmask.cli.main import main
from torchmask.grid import ARCSEC, MAS, Grid
from torchmask.interferometry.companion_limits import DetectionLimits
from torchmask.interferometry.disc_model import DiscFit
from torchmask.interferometry.disc_visibility import disc_visibilities
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.interferometry.oifits_reader import load_oifits
from torchmask.interferometry.pair_fit import PairFit
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

fits = pytest.importorskip("astropy.io.fits")

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05], [-0.2, 0.28]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 48, 1.1)


@pytest.fixture
def write(tmp_path, expose_points):
    def write(name, stars, seed):
        frames = expose_points(MASK, GRID, stars, electrons=1e6, n_frames=8)
        observation = Observation(torch.poisson(frames, torch.Generator().manual_seed(seed)), MASK, GRID, 0.0)
        save_oifits(tmp_path / name, frame_observables(observation), observation, bandwidth=1e-8)
        return tmp_path / name

    return write


def run(*arguments):
    return main(["companion", *map(str, arguments)])


def test_a_companion_is_found_beside_its_star_and_none_beside_another(write, tmp_path, capsys):
    binary = write("binary.oifits", ((0, 0, 1), (-1.8, 1.2, 0.05)), 1)
    star, other = write("star.oifits", ((0, 0, 1),), 2), write("other.oifits", ((0, 0, 1),), 3)
    assert run(binary, "--star", star, "--out", tmp_path / "found") == 0
    found = json.loads((tmp_path / "found/companion.json").read_text())
    companion, errors = found["companion"], found["companion"]["errors"]
    assert found["detected"]
    assert found["side_known"]
    # without sky coordinates east runs along the columns and north along the rows
    separation = float(np.hypot(1.8, 1.2)) * GRID.pixel_scale / MAS
    angle = float(np.degrees(np.arctan2(-1.8, 1.2))) % 360
    # 5 % for what a hole's diffraction pattern dims, as far as errors allow
    assert abs(companion["separation"] - separation) < 4 * errors["separation"] + 0.02 * separation
    assert abs(companion["position_angle"] - angle) < 4 * errors["position_angle"] + 1
    assert abs(companion["contrast"] - 0.05) < 4 * companion["contrast_error"] + 0.05 * 0.05
    with np.load(tmp_path / "found/companion.npz") as stored:
        best = stored["offsets"][stored["significance"].argmax()] / GRID.pixel_scale
    assert np.abs(best - [-1.8, 1.2]).max() < 0.3
    assert (tmp_path / "found/companion.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "a companion of 0.0" in said
    assert "taken as calibrated" not in said
    assert run(other, "--star", star, "--closures-only", "--out", tmp_path / "none") == 0
    assert not json.loads((tmp_path / "none/companion.json").read_text())["detected"]
    assert "no companion above 5 standard errors" in capsys.readouterr().out


def test_a_resolved_source_is_no_companion(write, tmp_path, capsys):
    ring = [(1.5 * np.sin(angle), 1.5 * np.cos(angle), 1) for angle in np.linspace(0, 2 * np.pi, 7)[:-1]]
    resolved, star = write("resolved.oifits", ring, 1), write("star.oifits", ((0, 0, 1),), 2)
    assert run(resolved, "--star", star, "--out", tmp_path / "run") == 3
    found = json.loads((tmp_path / "run/companion.json").read_text())
    companion = found["companion"]
    assert companion["chi_square"] > companion["chi_square_limit"]
    assert companion["significance"] > 5  # by how much better it is than a star alone
    assert not found["explained"]
    assert not found["detected"]
    assert json.loads((tmp_path / "run/status.json").read_text())["explained"] is False
    said = capsys.readouterr().out
    assert "not explained: a star and one companion leave a chi-square of" in said
    with np.load(tmp_path / "run/companion.npz") as stored:
        farthest = float(np.linalg.norm(stored["offsets"], axis=1).max())
    assert f"one companion at most, within {farthest / MAS:.4g} mas (--most-arcsec looks farther)" in said
    assert "would be found" not in said


def write_disc(point, path):
    """Write what is in a file as it would be for a disc of half the finest fringe; return its diameter [rad]."""
    size = 0.5 * load_oifits(point).finest
    with fits.open(point) as hdus:
        rows = hdus["OI_VIS2"].data
        baselines = torch.tensor(np.stack([rows["UCOORD"], rows["VCOORD"]], 1).astype(float))
        rows["VIS2DATA"] *= disc_visibilities(baselines / GRID.wavelength, size)[:, None].numpy() ** 2
        hdus.writeto(path)
    return size


def test_a_slightly_resolved_star_is_told_as_such(write, tmp_path, capsys):
    """|V|^2 of a uniform disc of half the finest fringe: the pair that looks like it is closer than the search."""
    single, star = write("single.oifits", ((0, 0, 1),), 1), write("star.oifits", ((0, 0, 1),), 2)
    size = write_disc(single, tmp_path / "disc.oifits")
    assert run(tmp_path / "disc.oifits", "--star", star, "--out", tmp_path / "run") == 0
    found = json.loads((tmp_path / "run/companion.json").read_text())
    assert found["verdict"] == "resolved"
    assert not found["detected"]
    disc = found["disc"]
    assert abs(disc["diameter"] - size / MAS) < 4 * disc["diameter_error"]
    said = capsys.readouterr().out
    closest = load_oifits(single).finest / 2 / MAS
    assert f"resolved, or a pair closer than {closest:.4g} mas: a uniform disc of {disc['diameter']:.4g} +- " in said
    assert "the companion that fits best leaves" in said


def test_bounds_are_in_arcsec(write, tmp_path, capsys):
    star = write("star.oifits", ((0, 0, 1),), 2)
    wide = ("--least-arcsec", "0.1", "--most-arcsec", "0.3")
    assert run(star, *wide, "--out", tmp_path / "run") == 0
    assert "without --star, |V|^2 are taken as calibrated" in capsys.readouterr().out
    with np.load(tmp_path / "run/companion.npz") as stored:
        away = np.linalg.norm(stored["offsets"], axis=1) / ARCSEC
    assert 0.1 < away.min() < 0.12
    assert 0.28 < away.max() < 0.3


def test_a_mistake_is_one_line_and_nothing_is_written(write, tmp_path, capsys):
    star = write("star.oifits", ((0, 0, 1),), 2)
    text = tmp_path / "text.fits"
    text.write_text("no FITS")
    for arguments, message in (
        ((), "there are no files to search: give OIFITS files"),
        ((tmp_path / "none.fits",), "there is no file"),
        ((text,), "is not an OIFITS file"),
        ((star, star, star, "--star", star, star), "--star names 2 files for 3 of the object"),
        (
            (star, "--least-arcsec", "0.3", "--most-arcsec", "0.1"),
            "--least-arcsec, --most-arcsec: separations from 0.3",
        ),
        ((star, "--target", "moon"), "no target 'moon': it has UNKNOWN"),
    ):
        assert run(*arguments, "--out", tmp_path / "run") == 1
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1
        assert not (tmp_path / "run").exists()


def test_object_and_calibrator_may_be_in_one_file(write, tmp_path, capsys):
    binary, star = write("binary.oifits", ((0, 0, 1), (-1.8, 1.2, 0.05)), 1), write("star.oifits", ((0, 0, 1),), 2)
    with fits.open(binary) as one, fits.open(star) as other:
        targets = fits.BinTableHDU(np.repeat(one["OI_TARGET"].data, 2), one["OI_TARGET"].header)
        targets.data["TARGET_ID"], targets.data["TARGET"] = [1, 2], ["SCI", "CAL"]
        kinds = ("OI_VIS2", "OI_T3", "OI_CORR")
        for name in kinds:
            other[name].header["CORRNAME"] = "CAL"
        for name in kinds[:2]:
            other[name].data["TARGET_ID"] = 2
        hdus = [one[0], targets, one["OI_WAVELENGTH"], *(each[name] for each in (one, other) for name in kinds)]
        fits.HDUList([hdu.copy() for hdu in hdus]).writeto(tmp_path / "both.fits")
    both = tmp_path / "both.fits"
    assert run(both, "--target", "SCI", "--star", both, "--out", tmp_path / "run") == 1
    said = capsys.readouterr().err
    assert "--star, --star-target: " in said
    assert "holds several targets: say which of SCI, CAL is meant" in said
    options = ("--target", "SCI", "--star", both, "--star-target", "CAL")
    assert run(both, *options, "--out", tmp_path / "one") == 0
    assert run(binary, "--star", star, "--out", tmp_path / "two") == 0
    one, two = (json.loads((tmp_path / name / "companion.json").read_text()) for name in ("one", "two"))
    assert one["companion"] == two["companion"]
    assert one["detected"]


def test_a_calibrator_of_known_diameter_takes_no_contrast_off(write, tmp_path, capsys):
    """Its own |V|^2 are those of a disc of half the finest fringe; taken for a point, it brightens the object."""
    single, star = write("single.oifits", ((0, 0, 1),), 1), write("star.oifits", ((0, 0, 1),), 2)
    size = write_disc(star, tmp_path / "disc.oifits")
    known = ("--star", tmp_path / "disc.oifits", "--star-diameter-mas", size / MAS)
    assert run(single, *known, "--star-diameter-error-mas", 0.01 * size / MAS, "--out", tmp_path / "known") == 0
    found = json.loads((tmp_path / "known/companion.json").read_text())
    assert found["verdict"] == "none"
    assert run(single, *known[:2], "--out", tmp_path / "point") in (0, 3)
    assert json.loads((tmp_path / "point/companion.json").read_text())["companion"]["contrast"] < 0
    for options, message in (
        (("--star-diameter-mas", 0.1), "--star-diameter-mas has 1 values for 0 files of --star"),
        (("--star", star, "--star-diameter-error-mas", 1, 2), "--star-diameter-error-mas has 2 values for 1 files"),
        (("--star", star, "--star-diameter-mas", 1e6), "shows no fringes on the longest baseline"),
    ):
        assert run(single, *options, "--out", tmp_path / "refused") == 1
        assert message in capsys.readouterr().err


def test_a_companion_of_negative_light_is_none(write, tmp_path, capsys):
    """|V|^2 are too large by 1.5 % where the calibrator has lost as much of its contrast."""
    single, star = write("single.oifits", ((0, 0, 1),), 2), write("star.oifits", ((0, 0, 1),), 3)
    with fits.open(star) as hdus:
        hdus["OI_VIS2"].data["VIS2DATA"] *= 0.985
        hdus.writeto(tmp_path / "dim.oifits")
    assert run(single, "--star", tmp_path / "dim.oifits", "--out", tmp_path / "run") == 0
    found = json.loads((tmp_path / "run/companion.json").read_text())
    assert found["companion"]["contrast"] < 0
    assert not found["detected"]
    assert "no companion; what fits best is one of negative light" in capsys.readouterr().out


def test_where_fringes_repeat_no_limit_is_told():
    companion, covariance = torch.tensor([0.1, 1e-7, 1e-7]).double(), 1e-4 * torch.eye(3).double()
    fit = PairFit(companion, covariance, 20.0, 400.0, DiscFit(1e-7, 1e-8, 200.0), 22, (5e-8, 1e-6))
    limits = DetectionLimits(np.array([0.1, 0.2]), np.array([0.01, np.inf]), np.array([0.001, np.inf]))
    near, far = summary(fit, limits, side_known=True)[-2:]
    assert near == (
        "  at 100 mas a companion of 0.01 +- 0.001 of the star's light would be found half of the time, one of 0.013 "
        "in nine of ten"
    )
    rival = (torch.tensor([0.05, 0.0, 2e-7]).double(), 21.5)
    told = summary(fit, limits, side_known=True, rival=rival)[1]
    assert told == (
        f"the place is not certain: 0.05 of the star's light {2e-7 / MAS:.4g} mas away at 0 deg leave a chi-square of "
        "21.5"
    )
    assert far.startswith("  at 200 mas a companion would not be found everywhere")
