"""What a finite number of exposures adds to the error: a tiny run, and that its table says what was drawn."""

import json
import math

import jensen
import torch

from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

OPTIONS = jensen.Options(photons=(1e5,), n_frames=(5,), d_over_r0=1.0, n_pixels=24)
GRID = Grid.nyquist(1.0, 550e-9, 24)
MASK = SparseAperture([[0.0, 0.3], [0.0, 0.0], [0.3, 0.3], [0.3, 0.0]], 0.2, 1.0)  # pairs share baselines


def test_a_tiny_run_writes_numbers_and_table(tmp_path, monkeypatch):
    monkeypatch.setattr(jensen, "pupils", lambda *_: [("4 holes", MASK, 2, 40)])  # a full pupil takes seconds
    assert jensen.main(["--smoke", "--out", str(tmp_path / "run")]) == 0
    rows = json.loads((tmp_path / "run/jensen.json").read_text())["rows"]
    assert [row["n_frames"] for row in rows] == [2, 4]
    assert all(row["alone"] < row["with_term"] and row["standard_error"] > 0 for row in rows)
    table = (tmp_path / "run/jensen.md").read_text().splitlines()
    assert len([line for line in table if line.startswith("|")]) == 2 + 1


def test_pistons_alone_are_predicted(seeded, monkeypatch):
    """Under independent pistons the closed form is exact, but for the Gamma distribution of the term."""
    monkeypatch.setattr(jensen, "criterion_of", pistons)
    phases = 2 * math.pi * torch.rand(2000, 4, generator=seeded(0), dtype=torch.float64)
    power = analytic_otf(MASK, GRID, phases).abs() ** 2
    seen = power.mean(0) > 1e-9
    (row,) = jensen.compare(OPTIONS, "mask", MASK, GRID, power, seen)
    transmitted = row["transmitted"] / row["with_term"]  # both errors are the same, one over less
    assert row["alone"] * transmitted < -4 * row["standard_error"]
    for name in ("with_term", "transmitted", "drawn_mean"):
        assert abs(row[name]) < 4 * row["standard_error"], name


def pistons(options, grid, photons, n_frames, r0):
    return TurbulentMSE(grid, PowerLawPSD(options.exponent, photons), NoisePSD(photons), n_frames)


def test_too_few_draws_are_refused(tmp_path, capsys):
    assert jensen.main(["--n-draws", "30", "--out", str(tmp_path / "run")]) == 1
    assert "--n-draws is 30" in capsys.readouterr().err
