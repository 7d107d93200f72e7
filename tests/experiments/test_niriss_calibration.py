"""NIRISS's mask from a single star: the pipeline's convention worked out, and a tiny run on simulated exposures."""

import json
import math

import niriss_calibration
import numpy as np
import pytest
import torch

from torchmask.grid import ARCSEC, Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS

GRID = Grid(64, 0.0655 * ARCSEC, FILTERS[("NIRISS", "F480M")].wavelength)


def test_the_fringes_of_the_pipeline_are_those_of_the_geometry():
    """By the formulas of its Affine2d.distortFargs, on its own hole centres and axes."""
    affine = niriss_calibration.PipelineAffine()
    design = SparseAperture.from_catalog(niriss_calibration.MASK).centers.numpy()
    live = np.stack([-design[:, 1], -design[:, 0]], 1)  # x reversed, then turned by 90 degrees
    first, second = 0.3, -1.7  # frequencies along the rows' and the columns' index
    determinant = affine.mx * affine.my - affine.sx * affine.sy
    u = (affine.my * first - affine.sy * second) / determinant
    v = (-affine.sx * first + affine.mx * second) / determinant
    expected = live @ [u, v]
    placed = affine.geometry().apply(SparseAperture.from_catalog(niriss_calibration.MASK)).centers.numpy()
    # turned by 180 degrees, which no image shows
    np.testing.assert_allclose(-placed @ [second, first], expected, rtol=1e-12)
    assert not affine.geometry().mirrored


def test_a_tiny_run_finds_the_mask_of_the_pipeline_where_it_lies_so(tmp_path, expose_binary, sky_matrix, sky_cards):
    fits = pytest.importorskip("astropy.io.fits")
    told = niriss_calibration.PipelineAffine().geometry()
    mask = told.apply(SparseAperture.from_catalog(niriss_calibration.MASK))
    sky, cards = sky_matrix(0.2, GRID.pixel_scale), sky_cards(0.2, GRID.pixel_scale)
    image, _ = expose_binary(mask, GRID, sky, np.zeros(3), (31.9, 33.1), [GRID.wavelength], 1)
    sci = fits.ImageHDU((image / niriss_calibration.GAIN / 26.0).numpy().astype(np.float32), name="SCI")
    sci.header.update(cards | {"BUNIT": "DN/s", "XPOSURE": 26.0})
    primary = fits.PrimaryHDU()
    primary.header.update({"INSTRUME": "NIRISS", "FILTER": "F480M"})
    fits.HDUList([primary, sci]).writeto(tmp_path / "hd-37093_0.fits")
    fits.HDUList([primary, sci]).writeto(tmp_path / "hd-37093_1.fits")
    both = niriss_calibration.read_star(niriss_calibration.Options(data=tmp_path, crop=40))  # --smoke reads the first
    assert both.frames.shape == (2, 40, 40)
    assert both.frame_numbers == (0, 1)
    assert niriss_calibration.main(["--data", str(tmp_path), "--smoke", "--out", str(tmp_path / "run")]) == 0
    rows = json.loads((tmp_path / "run/niriss_calibration.json").read_text())["rows"]
    for row in rows:
        # the errors count the modes of the simulated holes that three cannot follow
        assert abs(row["ours"] - row["pipeline"]) < 4 * row["error"], row
        assert row["error"] < (0.1 if "deg" in row["name"] else 0.003)
    assert rows[0]["pipeline"] == pytest.approx(math.degrees(told.rotation))
    table = [line for line in (tmp_path / "run/niriss_calibration.md").read_text().splitlines() if line[:1] == "|"]
    assert len(table) == len(rows) + 2


def test_a_folder_without_the_star_is_refused(tmp_path, capsys):
    assert niriss_calibration.main(["--data", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    assert "has no hd-37093_*.fits: give the folder" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert torch.allclose(
        niriss_calibration.PipelineAffine(1.0, 1.0, 0.0, 0.0).geometry().matrix, torch.eye(2, dtype=torch.float64)
    )
