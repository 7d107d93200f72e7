"""The closed form of E|OTF|^2 beside draws: a tiny run, and a subset of the comparison with the claim as tolerance."""

import dataclasses
import json

import pytest
import turbulent_transfer
from turbulent_transfer import DIAMETER, WAVELENGTH, Options, cases, check, compare, draw, grid_of

from torchmask.grid import Grid

GRID = Grid.nyquist(DIAMETER, WAVELENGTH, 24)
OPTIONS = Options(
    n_subapertures=(4,), hole_over_r0=(0.8,), pupil_over_r0=(3.0,), n_pixels=24, n_draws=400, n_frequencies=50
)
MASK, PUPIL = cases(OPTIONS, GRID)


@pytest.mark.parametrize("case", [MASK, PUPIL], ids=lambda case: case.name)
def test_closed_form_and_draws_agree(case):
    """3 % is the claim, on top of three standard errors of the draws; on the mean of frequencies that share their
    exposures, of one."""
    drawn = draw(OPTIONS, case, GRID)
    found = compare(OPTIONS, case, GRID, drawn)
    row = found.row(case.name)
    assert row["n_frequencies"] > 40
    assert row["beyond_three_errors"] < 3
    assert row["largest_of_integral"] < 3
    assert abs(row["mean"]) < 3 + row["standard_error"]
    stronger = compare(OPTIONS, case._replace(r0=0.8 * case.r0), GRID, drawn)
    assert stronger.row(case.name)["beyond_three_errors"] > 10  # the closed form of other turbulence would be seen


def test_a_tiny_run_writes_picture_numbers_and_table(tmp_path):
    assert turbulent_transfer.main(["--smoke", "--pupil-over-r0", "3", "--out", str(tmp_path / "run")]) == 0
    rows = json.loads((tmp_path / "run" / "turbulent_transfer.json").read_text())["rows"]
    table = (tmp_path / "run" / "turbulent_transfer.md").read_text().splitlines()
    assert [row["pupil"] for row in rows] == ["4 holes of 0.8 r0", "full pupil of 3 r0"]
    assert len([line for line in table if line.startswith("|")]) == 2 + len(rows)
    assert (tmp_path / "run" / "turbulent_transfer.png").stat().st_size > 10_000


def test_every_wavelength_of_a_band_is_sampled():
    options = dataclasses.replace(OPTIONS, width=0.2, n_draws=2, samples_per_hole=4)
    grid = grid_of(options)
    for case in cases(options, grid):
        drawn = draw(options, case, grid)
        assert float(drawn.mean[0, 0]) == pytest.approx(float(drawn.perfect[0, 0]), rel=1e-9)  # all light is there


def test_impossible_requests_are_refused():
    with pytest.raises(ValueError, match="at least 2"):
        check(Options(n_draws=1))
    with pytest.raises(ValueError, match="must be positive"):
        check(Options(hole_over_r0=(0.0,)))
    with pytest.raises(ValueError, match="lower --samples-per-hole"):
        check(Options(exposure_tau0=1.0, width=0.1))
    with pytest.raises(ValueError, match="width is 1"):
        check(Options(width=1.0))
