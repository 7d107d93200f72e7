"""torchmask masks: masks of the catalogue and of files, what is written of them, and overlapping holes."""

import re
import warnings

import pytest
import torch
from ezdxf import readfile

from torchmask.cli.main import main
from torchmask.design.manufacture import load_mask, mask_wavelength, save_json
from torchmask.optics.aperture import SparseAperture

GOLAY = ["masks", "golay9", "--mask-diameter", "2", "--fill-factor", "0.1"]


def run(*argv):
    return main([str(argument) for argument in argv])


def test_a_file_is_shown_and_written_as_the_mask_it_holds(tmp_path, capsys):
    mask = SparseAperture.from_catalog("golay9", 2.0, 0.1)
    assert run(*GOLAY, "--out", tmp_path / "golay.dxf") == 0
    assert run("masks", tmp_path / "golay.dxf", "--out", tmp_path / "again.json") == 0
    assert run("masks", tmp_path / "again.json", "--out", tmp_path / "third.fits") == 0
    assert "9 discs of 0.2108 m in 2 m" in capsys.readouterr().out
    for name in ("golay.dxf", "again.json", "third.fits"):
        found = load_mask(tmp_path / name)
        torch.testing.assert_close(found.centers, mask.centers, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["holes.csv", "holes.txt"])
def test_a_file_of_another_kind_is_told_which_are_read(tmp_path, capsys, name):
    for _ in range(2):  # first without the file, which is none of the catalogue either
        assert main(["masks", str(tmp_path / name)]) == 1
        assert "its name must end in .json, .dxf, .fits" in capsys.readouterr().err
        (tmp_path / name).write_text("0.1 0.2")


def test_the_wavelength_of_a_mask_goes_with_it(tmp_path, capsys):
    save_json(tmp_path / "first.json", SparseAperture.from_catalog("golay9", 2.0, 0.1), 2.2e-6)
    assert run("masks", tmp_path / "first.json", "--out", tmp_path / "second.json") == 0
    assert mask_wavelength(tmp_path / "second.json") == 2.2e-6
    assert "for light of 2.2e-06 m" in capsys.readouterr().out


def test_drawings_are_as_large_as_the_scale_says(tmp_path):
    """A pupil of 2 m at 5 mm a metre is a plate of 10 mm; the drawing remembers what it stands for."""
    for name, scale, radius in (("small.dxf", ["--scale", "5"], 5.0), ("true.dxf", [], 1000.0)):
        assert run(*GOLAY, *scale, "--out", tmp_path / name) == 0
        (rim,) = readfile(tmp_path / name).modelspace().query('CIRCLE[layer=="OUTLINE"]')
        assert rim.dxf.radius == pytest.approx(radius, rel=1e-12)
        assert load_mask(tmp_path / name).mask_diameter == pytest.approx(2.0, rel=1e-12)
    assert run(*GOLAY, "--scale", "5", "--out", tmp_path / "small.svg") == 0
    assert 'r="5.0"' in (tmp_path / "small.svg").read_text()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--scale", "5", "--out", "NEW.json"], "--scale is for drawings"),
        (["--scale", "-5", "--out", "NEW.dxf"], "scale is -5.0"),
        (["--out", "NEW.pdf"], "does not end in one of"),
        (["--scale", "5"], r"--scale is for a drawing: give --out with a file that ends in \.dxf or \.svg"),
        (["--mask-diameter", "0"], r"--mask-diameter is 0\.0: it must be from 0\.001 to 1000 m"),
        (["--mask-diameter", "8200"], r"--mask-diameter is 8200\.0: .* in m, so 8\.2 m are 8\.2"),
        (["--fill-factor", "0"], r"--fill-factor is 0\.0: it must be finite and positive"),
        (["--fill-factor", "0.9", "--out", "NEW.dxf"], r"9 pairs of holes overlap: .* --allow-overlap"),
    ],
)
def test_what_cannot_be_written_is_refused_and_nothing_is(tmp_path, monkeypatch, capsys, given, message):
    monkeypatch.chdir(tmp_path)
    assert run(*GOLAY, *given) == 1
    err = capsys.readouterr().err
    assert re.search(message, err), err
    assert list(tmp_path.iterdir()) == []


def test_options_of_the_catalogue_are_refused_for_files(tmp_path, capsys):
    assert run(*GOLAY, "--out", tmp_path / "golay.json") == 0
    assert run("masks", tmp_path / "golay.json", "--mirrored") == 1
    assert "are for masks from the catalogue" in capsys.readouterr().err
    assert run("masks", tmp_path / "none.dxf") == 1
    assert "there is no mask file" in capsys.readouterr().err


def test_overlapping_holes_are_refused_unless_asked_for(tmp_path, capsys):
    """One real mask has such holes: those of Keck LWS, 41 mm."""
    mask, out = "keck_lws_pattern2a_9", tmp_path / "keck.json"
    assert run("masks", mask) == 0
    assert "3 pairs of holes overlap: 1 and 6 by 0.0412 m" in capsys.readouterr().out
    assert run("masks", mask, "--out", out) == 1
    assert not out.exists()
    assert run("masks", mask, "--allow-overlap", "--out", out) == 0
    simulate = ["simulate", "--wavelength", "1e-5", "--n-pixels", "32", "--n-frames", "1", "--out", tmp_path / "run"]
    for source in (mask, out):
        capsys.readouterr()
        assert run(*simulate, "--mask", source) == 1
        assert "3 pairs of holes overlap" in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    with warnings.catch_warnings(action="always"):  # real masks exceed their nominal pupils
        assert run(*simulate, "--mask", out, "--allow-overlap") == 0
    assert "not all holes of --mask" in capsys.readouterr().err
