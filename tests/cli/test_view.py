"""masks and view: what they say is what the library measures, and their pictures show it."""

import json
import re

import matplotlib.image
import numpy as np
import pytest
import torch
from astropy.io import fits

from torchmask.cli.main import main
from torchmask.cli.view import view_path
from torchmask.design.drawing import save_dxf
from torchmask.design.manufacture import load_mask, save_fits, save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.grid import Grid
from torchmask.io import save_npz
from torchmask.observation import Observation
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Record
from torchmask.restoration.result import RestorationResult
from torchmask.tracking import RunLogger

GOLAY6 = SparseAperture.from_catalog("golay6", 2.0, 0.2)


def said(capsys, *argv):
    assert main([str(argument) for argument in argv]) == 0
    return capsys.readouterr().out


def refused(capsys, message, *argv):
    assert main([str(argument) for argument in argv]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert re.search(message, err), err


def is_picture(path):
    pixels = matplotlib.image.imread(path)[..., :3]
    return min(pixels.shape[:2]) > 200 and float(np.ptp(pixels)) > 0.3


def test_the_list_has_every_mask_with_its_sizes(capsys):
    lines = {line.split()[0]: line.split() for line in said(capsys, "masks").splitlines() if line}
    for name in catalog.names():
        mask = catalog.entry(name)
        assert lines[name][1:3] == [f"{mask.n_subapertures}", mask.shape.name]
        assert lines[name][3] == ("-" if mask.hole_diameter is None else f"{mask.hole_diameter:.4g}")
        assert lines[name][4] == ("-" if mask.pupil_diameter is None else f"{mask.pupil_diameter:.4g}")


@pytest.mark.parametrize("name", ["golay6", "JWST NIRISS AMI 7", "vlt_sphere_irdis_7"])
def test_one_mask_is_shown_as_built_or_at_some_size(capsys, name):
    text = said(capsys, "masks", name)
    entry = catalog.entry(name)
    assert text.startswith(f"{entry.name}: {entry.n_subapertures} ")
    if entry.as_built:
        assert str(analyse_redundancy(SparseAperture.from_catalog(name))) in text
    centers = np.array([line.split() for line in text.split("[m]\n")[-1].splitlines()], dtype=float)
    assert centers.shape == (entry.n_subapertures, 2)


@pytest.mark.parametrize("suffix", ["json", "dxf", "fits", "svg", "png"])
def test_a_mask_of_the_catalogue_becomes_a_file(tmp_path, capsys, suffix):
    path = tmp_path / f"mask.{suffix}"
    argv = ["masks", "golay6", "--mask-diameter", "2", "--fill-factor", "0.2", "--out", path]
    assert f"written to {path}" in said(capsys, *argv)
    if suffix == "png":
        assert is_picture(path)
    elif suffix != "svg":
        torch.testing.assert_close(load_mask(path).centers, GOLAY6.centers, rtol=1e-12, atol=1e-12)
    refused(capsys, "exists", *argv)


def test_mistakes_about_masks(tmp_path, capsys):
    refused(capsys, "did you mean 'golay6'", "masks", "golay66")
    refused(capsys, "give its name", "masks", "--out", tmp_path / "x.json")
    refused(capsys, "does not end in one of", "masks", "golay6", "--out", tmp_path / "x.doc")
    refused(capsys, "--mask-diameter is -1", "masks", "golay6", "--mask-diameter", "-1")
    assert list(tmp_path.iterdir()) == []


def test_files_of_masks_are_drawn_with_their_baselines(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for suffix, save in (("json", save_json), ("dxf", save_dxf), ("fits", save_fits)):
        save(tmp_path / f"{suffix}.{suffix}", GOLAY6)
        text = said(capsys, "view", f"{suffix}.{suffix}")
        assert "6 discs of 0.3651 m in 2 m" in text
        assert "15, 15 distinct" in text
        assert is_picture(tmp_path / f"{suffix}.png")
        assert is_picture(tmp_path / f"{suffix}-uv.png")
    said(capsys, "view", "json.json")
    assert {"json-2.png", "json-2-uv.png"} <= {path.name for path in tmp_path.iterdir()}
    refused(capsys, "exists", "view", "json.json", "--out", "json.png")
    refused(capsys, "does not end in .png", "view", "json.json", "--out", "json.pdf")


def observation():
    frames = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 100
    return Observation(frames, GOLAY6, Grid.nyquist(2.0, 550e-9, 16), 1.5)


def test_a_stack_is_summed_up(tmp_path, capsys):
    observation().save(tmp_path / "stack.npz")
    text = said(capsys, "view", tmp_path / "stack.npz", "--out", tmp_path / "out.png")
    total = float(observation().frames.sum() / 3)
    assert f"3 frames of 16 x 16 pixels of {np.degrees(550e-9 / 4) * 3600:.4g} arcsec" in text
    assert f"{total:.4g} electrons per frame" in text
    assert is_picture(tmp_path / "out.png")
    assert is_picture(tmp_path / "out-mask.png")


def result():
    frames = torch.ones(3, 16, 16, dtype=torch.float64)
    values = {"object": frames[0], "extended_object": frames[0], "coefficients": torch.zeros(3, 6, 3)}
    values |= {"transmission": torch.ones(3), "model": frames, "residuals": frames, "chi_square": torch.ones(3)}
    numbers = {"prior": "TotalVariation()", "r0": 0.1, "noise": 1.0, "cost": torch.ones(7), "converged": True}
    return RestorationResult(**values, **numbers, message="converged", n_evaluations=9, seconds=2.0)


def test_a_result_says_how_it_went(tmp_path, capsys):
    result().save(tmp_path / "restored.npz")
    text = said(capsys, "view", tmp_path / "restored.npz", "--out", tmp_path / "out.png")
    assert result().summary() in text
    assert is_picture(tmp_path / "out.png")


def test_images_and_cubes_in_fits(tmp_path, capsys):
    image = np.outer(np.hanning(16), np.hanning(16))
    fits.PrimaryHDU(image, fits.Header({"OBJECT": "AB Dor"})).writeto(tmp_path / "image.fits")
    fits.PrimaryHDU(np.stack([image] * 5)).writeto(tmp_path / "cube.fits")
    text = said(capsys, "view", tmp_path / "image.fits", "--out", tmp_path / "image.png")
    assert "image of 16 x 16 pixels, 100 % of them valid\nOBJECT = AB Dor" in text
    text = said(capsys, "view", tmp_path / "cube.fits", "--out", tmp_path / "cube.png")
    assert "5 images of 16 x 16 pixels" in text
    assert is_picture(tmp_path / "image.png")
    assert is_picture(tmp_path / "cube.png")


def test_a_run_is_its_last_values_and_its_result(tmp_path, capsys):
    with RunLogger(tmp_path / "run") as logger:
        for step in (1, 2):
            logger(Record("restoration", step, 5, {"cost": 10.0 / step}, {"object": torch.eye(16)}))
        logger.scalar("result/score", 0.25)
        logger.scalar("result/ssim", 0.5)
    text = view_path(tmp_path / "run").text
    assert "finished after" in text
    assert "restoration 2/5: cost 5\n" in text
    assert "result 0: score 0.25, ssim 0.5" in text
    assert "checkpoints/restoration.npz" in text  # the last state, as there is no result
    result().save(tmp_path / "run" / "restored.npz")
    assert result().summary() in view_path(tmp_path / "run").text
    said(capsys, "view", tmp_path / "run", "--out", tmp_path / "run.png")
    assert is_picture(tmp_path / "run.png")


def test_a_run_whose_result_is_a_table_shows_that(tmp_path, capsys):
    with RunLogger(tmp_path / "rank") as logger:
        logger(Record("ranking", 1, 1, {"relative_mse": 0.5}, {}))
    (tmp_path / "table").mkdir()
    for folder in ("rank", "table"):  # `torchmask table` keeps no log
        (tmp_path / folder / "found.md").write_text("| N |\n|---|\n| 6 |\n")
        (tmp_path / folder / "found.json").write_text("{}")
    shown = f"{tmp_path / 'table' / 'found.md'}:\n| N |\n|---|\n| 6 |\n"
    assert said(capsys, "view", tmp_path / "table") == shown
    text = said(capsys, "view", tmp_path / "rank")
    assert "ranking 1/1: relative_mse 0.5\n" in text
    assert text.endswith(shown.replace("table", "rank"))
    assert "no results" not in text


def test_arrays_without_a_figure_are_listed(tmp_path, capsys):
    save_npz(tmp_path / "x.npz", {"weights": np.zeros((3, 2)), "step": 7})
    text = said(capsys, "view", tmp_path / "x.npz", "--out", tmp_path / "x.png")
    assert "weights: float64 (3, 2)" in text
    assert not (tmp_path / "x.png").exists()


def test_mistakes_about_files(tmp_path, capsys):
    (tmp_path / "text.txt").write_text("x")
    (tmp_path / "bad.npz").write_text("x")
    (tmp_path / "bad.fits").write_text("x")
    (tmp_path / "other.json").write_text(json.dumps({"a": 1}))
    (tmp_path / "empty").mkdir()
    refused(capsys, "there is no file or folder", "view", tmp_path / "none")
    refused(capsys, "unknown kind", "view", tmp_path / "text.txt")
    refused(capsys, "bad.npz", "view", tmp_path / "bad.npz")
    refused(capsys, "bad.fits", "view", tmp_path / "bad.fits")
    refused(capsys, "cannot be read as a mask", "view", tmp_path / "other.json")
    refused(capsys, "is not a run folder", "view", tmp_path / "empty")
    save_npz(tmp_path / "half.npz", {"frames": np.zeros((2, 8, 8))})
    refused(capsys, "has no 'centers'", "view", tmp_path / "half.npz")


def test_a_cube_in_adu_is_shown_in_adu_with_its_sky(write_fits, fits_cube, sky_cards):
    path = write_fits("raw.fits", fits_cube, BUNIT="adu", PIXELSCL=None, **sky_cards(0.3, 1e-7))
    figure = view_path(path).figures[""]
    assert figure.axes[-1].get_ylabel() == "adu, square-root stretch"
    assert figure.axes[0].get_xlabel() in ("x [arcsec]", "x [mas]")
    image = write_fits("image.fits", fits_cube[0], BUNIT="adu", **sky_cards(0.3, 1e-7))
    shown = view_path(image).figures[""].axes
    assert [text.get_text() for text in shown[0].texts if text.get_text()] == ["E", "N"]
    assert shown[-1].get_ylabel() == "adu, square-root stretch"
