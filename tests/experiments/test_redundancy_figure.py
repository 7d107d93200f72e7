"""The experiment that shows why masking works: its closed forms, and a tiny run."""

import json
import math

import numpy as np
import pytest
import redundancy
import redundancy_report
import torch

from torchmask.atmosphere.von_karman import von_karman_structure_function
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture

GRID = Grid.nyquist(1.0, 550e-9, 128)
STEP = GRID.period / 128


def row_of_holes(count, spacing):
    """The raster of equal small holes `spacing` samples apart."""
    places = [[(k - count // 2) * spacing * STEP, 0.0] for k in range(count)]
    return redundancy.raster_of(SparseAperture(torch.tensor(places, dtype=torch.float64), 2.5 * STEP, 1.0), GRID)


def test_without_turbulence_all_contrast_is_kept():
    pupil = redundancy.raster_of(FullAperture(1.0), GRID)
    for shift in ((0, 0), (0, 20), (13, -31)):
        assert redundancy.expected_power(pupil, shift, GRID, 1e6, 1e3) == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("steps", [1, 3, 6])
def test_far_apart_holes_make_a_random_walk(steps):
    """With r0 much smaller than the distance of the holes, R = N - k pairs keep 1 / R of what one pair alone keeps."""
    count, spacing, r0 = 7, 9, 3.4 * STEP
    kept = redundancy.expected_power(row_of_holes(count, spacing), (0, steps * spacing), GRID, r0, 1e3)
    alone = redundancy.expected_power(row_of_holes(2, steps * spacing), (0, steps * spacing), GRID, r0, 1e3)
    assert 0.3 < alone < 1  # the phase is not flat inside a hole
    # two neighbouring pairs share exp(-0.41 D) at least, with D = 6.88 (9 / 3.4)^(5/3) = 35
    assert kept == pytest.approx(alone / (count - steps), rel=1e-5)


def test_a_large_full_pupil_approaches_the_limit_of_many_speckles():
    """0.4353 (r0 / D)^2 T in power (Korff 1973), times 1 + 0.64 (B / r0)^(-1/3) + ...

    The first correction is the mean of D'' u^2 / 2 over exp(-D(u)): with D = 6.88 u^(5/3) in units of r0 the mean of
    u^2 is 6.88^(-6/5) Gamma(12/5) / Gamma(6/5) = 0.134, and half the Laplacian of D at B is 9.56 B^(-1/3).
    """
    assert pytest.approx(0.4353, abs=5e-5) == redundancy_report.KORFF
    pupil = redundancy.raster_of(FullAperture(1.0), GRID)
    shift = 32
    product = pupil * torch.roll(pupil, (0, -shift), dims=(0, 1))
    transfer = float(product.sum() / (pupil**2).sum())
    ratios = []
    for d_over_r0 in (8, 12, 16):
        kept = redundancy.expected_power(pupil, (0, shift), GRID, 1 / d_over_r0, 1e6)
        excess = kept * transfer / (redundancy_report.KORFF / d_over_r0**2) - 1
        ratios.append(excess / (0.64 * (shift * STEP * d_over_r0) ** (-1 / 3)))
    assert ratios[0] > ratios[1] > ratios[2] > 1
    assert ratios[2] < 1.5


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "redundancy"
    assert redundancy.main(["--smoke", "--out", str(folder)]) == 0
    return folder


def test_drawn_contrasts_agree_with_the_closed_forms(finished):
    rows = json.loads((finished / "redundancy.json").read_text())["rows"]
    assert {row["pupil"] for row in rows} == {"full pupil", "Golay-6", "row"}
    # 80 rows of either sign, Student's t of 40 frames: 5 standard errors are exceeded once in a thousand runs.
    for key in ("short", "long", "pistons"):
        assert redundancy_report.deviation(rows, key) < 5
    for row in rows:
        assert row["long_theory"] == pytest.approx(
            math.exp(-float(von_karman_structure_function(torch.tensor(row["baseline"]), 1 / 7, 20.0)) / 2), rel=1e-4
        )


def test_masks_keep_what_full_pupils_lose(finished):
    rows = json.loads((finished / "redundancy.json").read_text())["rows"]
    full = [row["short"] for row in rows if row["pupil"] == "full pupil" and 0.3 < row["baseline"] < 0.7]
    golay = [row["short"] for row in rows if row["pupil"] == "Golay-6"]
    assert np.mean(golay) > 2 * np.mean(full)


def test_picture_and_table_are_written_once(finished, capsys):
    assert (finished / "redundancy.png").read_bytes().startswith(b"\x89PNG")
    rows = json.loads((finished / "redundancy.json").read_text())["rows"]
    table = [line for line in (finished / "redundancy.md").read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(rows) + 2
    assert len({line.count("|") for line in table}) == 1
    assert redundancy.main(["--smoke", "--out", str(finished)]) == 1
    assert "exists and is not overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--d-over-r0", "0"], "--d-over-r0 is 0.0"),
        (["--outer-scale", "-1"], "--outer-scale is -1.0"),
        (["--n-frames", "1"], "--n-frames is 1"),
        (["--row-holes", "1"], "--row-holes is 1"),
    ],
)
def test_a_bad_setting_is_one_line(tmp_path, capsys, options, message):
    assert redundancy.main([*options, "--out", str(tmp_path / "new" / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"redundancy: error: {message}")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
