"""The AB Dor experiment on files of binaries made with finer optics, and on real exposures if they are there."""

import json
import math

import niriss_ab_dor
import niriss_pose
import numpy as np
import pytest
import torch

from torchmask.grid import ARCSEC, Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS

pytestmark = pytest.mark.usefixtures("coarse_figures")

GRID = Grid(64, 0.0655 * ARCSEC, FILTERS[("NIRISS", "F480M")].wavelength)


def test_valley_of_a_parabola():
    points = [(x, 3 * (x - 0.37) ** 2 + 2) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    assert niriss_pose.valley(points) == pytest.approx(0.37)
    # never beyond what was tried; x of order 1 goes through a least-squares fit of three numbers
    assert niriss_pose.valley([(0.0, 1.0), (1.0, 2.0), (2.0, 5.0)]) == pytest.approx(0.0, abs=16 * np.finfo(float).eps)


@pytest.fixture(scope="module")
def write(expose_binary, sky_matrix, sky_cards):
    """Files as the archive gives them, in DN/s, with two dithers."""
    fits = pytest.importorskip("astropy.io.fits")

    def to_folder(folder, star, companion, mask, n, seed):
        for t in range(n):
            angle = math.radians(188.0)
            sky, cards = sky_matrix(angle, GRID.pixel_scale), sky_cards(angle, GRID.pixel_scale)
            place = ((31.9, 34.1), (36.05, 29.0))[t % 2]
            image, noise = expose_binary(mask, GRID, sky, companion, place, [GRID.wavelength], seed + t)
            unit = niriss_ab_dor.GAIN * 26.0
            sci = fits.ImageHDU((image / unit).numpy().astype(np.float32), name="SCI")
            sci.header.update(cards | {"BUNIT": "DN/s", "XPOSURE": 26.0})
            dq = np.zeros(image.shape, np.uint32)
            dq[33, 36], dq[:4] = 1, 1
            primary = fits.PrimaryHDU()
            primary.header.update({"INSTRUME": "NIRISS", "FILTER": "F480M"})
            err = fits.ImageHDU((noise / unit).numpy().astype(np.float32), name="ERR")
            fits.HDUList([primary, sci, err, fits.ImageHDU(dq, name="DQ")]).writeto(folder / f"{star}_{t}.fits")

    return to_folder


def test_directions_on_the_sky_are_those_of_the_world_coordinates(tmp_path, write):
    """Of the arrays against astropy's own: one arcsecond north, one east."""
    from astropy.io import fits
    from astropy.wcs import WCS

    write(tmp_path, "star", np.zeros(3), SparseAperture.from_catalog(niriss_pose.MASK), 1, seed=1)
    exposures, grid = niriss_ab_dor.read(tmp_path, "star", 40)
    assert grid.wavelength == GRID.wavelength
    assert grid.pixel_scale == pytest.approx(GRID.pixel_scale, rel=1e-6)
    with fits.open(tmp_path / "star_0.fits") as file:
        wcs = WCS(file["SCI"].header)
    here = wcs.wcs_world2pix([[82.0, -65.0]], 0)[0]
    for east, north in ((0.0, 1.0), (1.0, 0.0)):
        world = [82.0 + east / 3600 / math.cos(math.radians(65.0)), -65.0 + north / 3600]
        x, y = wcs.wcs_world2pix([world], 0)[0] - here
        moved = exposures.to_pixels[0] @ torch.tensor([east, north], dtype=torch.float64) * ARCSEC
        assert moved.numpy() == pytest.approx([y, x], abs=1e-3)


@pytest.fixture(scope="module")
def observed(tmp_path_factory, write):
    folder = tmp_path_factory.mktemp("niriss")
    mask = SparseAperture.from_catalog(niriss_pose.MASK, mirrored=True)
    turn = math.radians(0.7)
    rotation = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    mask = mask.replace(centers=mask.centers @ rotation.T, shape=mask.shape.turned(turn))
    angle = math.radians(100.0)
    companion = np.array([0.03, 0.35 * ARCSEC * math.sin(angle), 0.35 * ARCSEC * math.cos(angle)])
    write(folder, "pair", companion, mask, 2, seed=10)
    write(folder, "single", np.zeros(3), mask, 2, seed=20)
    write(folder, "lonely", np.zeros(3), mask, 2, seed=30)
    return folder


def run(folder, runs, target):
    given = ["--data", folder, "--target", target, "--calibrator", "single", "--smoke", "--out", runs / target]
    assert niriss_ab_dor.main([str(value) for value in given]) == 0
    return json.loads((runs / target / "results.json").read_text())


def test_from_files_to_the_companion(observed, tmp_path, capsys):
    """A mask mirrored and turned on the detector, which the calibrator tells; then the binary, with its errors."""
    results = run(observed, tmp_path, "pair")
    assert results["pose"]["mirrored"]
    assert results["pose"]["rotation"] == pytest.approx(0.7, abs=0.05)
    assert results["pose"]["magnification"] == pytest.approx(1, abs=1e-3)
    assert results["found"]
    pair, total = results["companion"], results["companion"]["total_error"]
    assert abs(pair["separation"] - 350) < 4 * total["separation"] < 40
    assert abs(pair["position_angle"] - 100) < 4 * total["position_angle"] < 8
    assert abs(pair["magnitude_difference"] + 2.5 * math.log10(0.03)) < 4 * total["magnitude_difference"] < 0.6
    assert set(results["half_differences"]) == {"separation", "position_angle", "magnitude_difference"}
    said = capsys.readouterr().out
    assert "pair: a companion at" in said
    assert "mirrored in x" in said
    for name in ("search", "exposure", "restored"):
        assert (tmp_path / "pair" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_no_companion_is_said_so(observed, tmp_path, capsys, monkeypatch):
    pose = niriss_pose.Pose(mirrored=True, rotation=0.7)
    rows = [{"mirrored": mirrored, "chi_square": 1.0} for mirrored in (True, False)]
    monkeypatch.setattr(niriss_ab_dor, "find_pose", lambda *args: (pose, rows))
    results = run(observed, tmp_path, "lonely")
    assert not results["found"]
    assert results["companion"] is None
    assert "lonely: NO companion found" in capsys.readouterr().out


def test_missing_exposures_are_said_so(tmp_path, capsys):
    assert niriss_ab_dor.main(["--data", str(tmp_path), "--out", str(tmp_path / "runs")]) == 1
    assert "has no ab-dor_*.fits: give the folder of the exposures with --data" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_real_exposures(niriss, tmp_path, capsys):
    """Small and rough; what counts is that it runs on files from the archive, and finds the mask's way round."""
    assert niriss_ab_dor.main(["--data", str(niriss), "--smoke", "--out", str(tmp_path / "real")]) == 0
    results = json.loads((tmp_path / "real" / "results.json").read_text())
    assert not results["pose"]["mirrored"]
    assert results["pose"]["rotation"] == pytest.approx(-0.4, abs=0.15)
    assert min(results["calibrator"]["limits"]["magnitude_difference"]) > 4
