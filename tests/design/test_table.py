"""Design tables: what a row means, what is refused, and that an interrupted table goes on."""

from __future__ import annotations

import csv
import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmask.design.constraint_base import Infeasible
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table, measure
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

SMALL = DesignSpace(
    n_subapertures=(3, 5), n_frequencies=32, n_frames=(2,), n_draws=2, diameter_over_r0=(3.0,), budget=64
)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder and the table of SMALL in it."""
    folder = tmp_path_factory.mktemp("table")
    return folder, design_table(SMALL, folder, n_workers=1)


def test_every_combination_is_a_row_in_the_order_of_the_axes():
    space = replace(SMALL, fill_factor=(0.1, 0.12), diameter_over_r0=(3.0, 4.0), seed=(0, 1))
    rows = [(r.n_subapertures, r.fill_factor, r.seed, r.diameter_over_r0) for r in space.designs()]
    assert rows == [(n, f, s, q) for n in (3, 5) for f in (0.1, 0.12) for s in (0, 1) for q in (3.0, 4.0)]


def test_photons_grow_with_the_collecting_area():
    space = replace(SMALL, fill_factor=(0.05, 0.15, 0.3), n_photons=(1e5, 2e6), reference_fill_factor=0.15)
    for row in space.designs():
        n, d = row.n_subapertures, row.subaperture_diameter
        assert n * d**2 == pytest.approx(row.fill_factor * space.mask_diameter**2, rel=1e-12)
        assert row.photons_per_frame == pytest.approx(row.n_photons * n * d**2 / 0.15, rel=1e-12)


def test_errors_are_those_of_the_mask_at_its_own_flux(tmp_path):
    space = replace(SMALL, n_subapertures=(3,), fill_factor=(0.06,), readout_noise=2.0, n_photons=(1e5,), knee=1 / 32)
    space = replace(space, diameter_over_r0=(), exponent=2.0, n_frames=(7,), n_pixels=48)
    table = design_table(space, tmp_path, n_workers=1)
    (row,) = table.rows
    photons = 1e5 * 0.06 / 0.15
    grid = Grid.nyquist(1.0, 550e-9, 32)
    criterion = AsymptoticMSE(grid, PowerLawPSD(2.0, photons, 1 / 32), NoisePSD(photons, 2.0, 48**2), 7)
    mask = table.aperture(row)
    floor = criterion.floor(1.0) / criterion.object_psd.mean()
    assert row.relative_mse == pytest.approx(float(criterion.relative(mask)), rel=1e-12)
    assert row.above_floor == pytest.approx(float(criterion.relative(mask) - floor), rel=1e-9)
    assert row.wiener_mse is None
    assert mask.centers.tolist() == [list(center) for center in row.centers]
    assert mask.n_subapertures == 3
    assert mask.fill_factor == pytest.approx(0.06, rel=1e-12)


def test_holes_larger_than_the_turbulence_allows_are_rows_that_say_so(tmp_path):
    space = replace(SMALL, fill_factor=(0.05, 0.2), diameter_over_r0=(6.0,), max_hole_over_r0=1.0)
    table = design_table(space, tmp_path, n_workers=1)
    for row in table.rows:
        hole_over_r0 = 6 * math.sqrt(row.fill_factor / row.n_subapertures)
        assert (row.infeasible is not None) == (hole_over_r0 > 1)
        assert (row.relative_mse is None) == (row.wiener_mse is None) == (row.infeasible is not None)
    refused = next(row for row in table.rows if row.n_subapertures == 3 and row.fill_factor == 0.2)
    assert refused.infeasible == "d/r0 is 1.55, above 1: fill_factor must be at most 0.08333"
    assert refused.infeasible in str(table)
    with pytest.raises(ValueError, match=r"d/r0 is 1\.55, above 1"):
        table.aperture(refused)
    largest = 3 * (1.0 / 6.0) ** 2  # d = r0: the largest that is allowed, rounding notwithstanding
    assert all(row.infeasible is None for row in replace(space, n_subapertures=(3,), fill_factor=(largest,)).designs())


def test_holes_that_cannot_be_packed_are_rows_that_say_so():
    space = replace(SMALL, n_subapertures=(7,), fill_factor=(0.7777, 0.78), diameter_over_r0=())
    fits, crowded = space.designs()
    assert fits.infeasible is None
    assert crowded.infeasible is not None
    assert "at most 0.77777" in crowded.infeasible  # six discs around one: 7/9


def test_a_search_that_finds_no_room_is_a_row_that_says_so(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise Infeasible("no mask was found")

    monkeypatch.setattr("torchmask.design.table.search_mask", refuse)
    table = design_table(replace(SMALL, n_subapertures=(3,)), tmp_path, n_workers=1)
    assert [row.infeasible for row in table.rows] == ["no mask was found"]
    monkeypatch.undo()
    assert design_table(replace(SMALL, n_subapertures=(3,)), tmp_path, n_workers=1) == table  # it is on disk too


def test_a_space_without_any_design_is_refused_before_any_work(tmp_path):
    space = replace(SMALL, n_subapertures=(3,), diameter_over_r0=(20.0,))
    with pytest.raises(
        ValueError, match=r"no combination can be built; the reason for the first one: d/r0 is 4\.47.* at most 0\.01688"
    ):
        design_table(space, tmp_path / "table")
    assert not (tmp_path / "table").exists()


def test_holes_too_small_to_sample_are_rows_that_say_so():
    space = replace(SMALL, n_subapertures=(3,), fill_factor=(1e-4,), diameter_over_r0=(1.0,))
    (row,) = space.designs()
    assert row.infeasible == "a hole spans less than 2 samples of the pupil: n_frequencies must be at least 693"
    (row,) = replace(space, n_frequencies=693).designs()
    assert row.infeasible is None


def trial(**change):
    """A task of a measurement: three holes of 0.2 m."""
    task = {
        "centers": [[0.0, 0.38], [-0.3, -0.2], [0.35, -0.1]],
        "subaperture_diameter": 0.2,
        "mask_diameter": 1.0,
        "wavelength": 550e-9,
        "n_pixels": 64,
        "n_frequencies": 64,
        "pixel_scale": 275e-9,
        "oversampling": 8,
        "exponent": 1.5,
        "knee": 1 / 64,
        "readout_noise": 0.0,
        "photons_per_frame": 1e7,
        "n_frames": 3,
        "seed": 0,
        "diameter_over_r0": 1e-3,
        "outer_scale": 20.0,
        "n_draws": 2,
    }
    return task | change


def test_without_turbulence_the_measured_error_is_that_of_the_perfect_mask():
    task = trial()
    measured = measure(task)
    grid = Grid.nyquist(1.0, 550e-9, 64)
    mask = SparseAperture(task["centers"], 0.2, 1.0)
    s_o = PowerLawPSD(1.5, 1e7)(grid)
    perfect = wiener_mse(analytic_otf(mask, grid).expand(3, -1, -1), s_o, NoisePSD(1e7)) / s_o.mean()
    # The sampled pupil (512 samples over the raster) leaks a little light beyond the edge of a hole's OTF.
    assert float(measured["wiener_mse"]) == pytest.approx(float(perfect), rel=2e-3)
    assert float(measured["wiener_error"]) < 1e-6
    coarse = measure(trial(oversampling=1))
    assert abs(float(coarse["wiener_mse"] / perfect) - 1) > 1e-2  # why the pupil is oversampled


def test_the_standard_error_is_that_of_independent_stacks():
    noisy = {"photons_per_frame": 1e4, "diameter_over_r0": 5.0, "oversampling": 2, "n_frames": 2, "n_draws": 8}
    means, errors = [], []
    for seed in range(12):
        result = measure(trial(seed=seed, **noisy))
        means.append(float(result["wiener_mse"]))
        errors.append(float(result["wiener_error"]))
    ratio = np.var(means, ddof=1) / np.mean(np.square(errors))
    assert 0.16 < ratio < 3.24  # F of 11 and 84 degrees of freedom, all but 2 in 1000
    grid = Grid.nyquist(1.0, 550e-9, 64)
    criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e4), NoisePSD(1e4), 2)
    limit = float(criterion.relative(SparseAperture(trial()["centers"], 0.2, 1.0)))
    assert np.mean(means) > limit + 3 * np.std(means) / math.sqrt(12)  # two exposures are far from the limit


def test_an_interrupted_table_goes_on_where_it_was(tmp_path, small):
    _, expected = small
    seen = []

    def interrupt(record):
        seen.append((record.stage, record.step, record.n_steps))
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        design_table(SMALL, tmp_path, n_workers=1, callback=interrupt)
    assert seen == [("design/table/search", 1, 2), ("design/table/search", 2, 2), ("design/table/turbulence", 1, 2)]
    assert not list(tmp_path.glob("table.*"))  # a table is whole or absent
    assert len(list((tmp_path / "tasks").iterdir())) == 3
    seen.clear()
    table = design_table(SMALL, tmp_path, n_workers=1, callback=interrupt)
    assert seen == [("design/table/turbulence", 2, 2)]
    assert table == expected


def test_a_wider_axis_shares_what_is_there(tmp_path, small):
    _, expected = small
    design_table(replace(SMALL, n_subapertures=(3,)), tmp_path, n_workers=1)
    done = []
    wider = replace(SMALL, diameter_over_r0=(2.0, 3.0))
    table = design_table(wider, tmp_path, n_workers=1, callback=lambda record: done.append(record.stage))
    assert done == ["design/table/search"] + ["design/table/turbulence"] * 3
    assert tuple(row for row in table.rows if row.diameter_over_r0 == 3.0) == expected.rows


def test_a_damaged_task_is_named_and_computed_again(tmp_path, small):
    folder, expected = small
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = next((tmp_path / "tasks").glob("design-table-search-*.json"))
    path.write_text(path.read_text()[:-40])
    with pytest.warns(RuntimeWarning, match=path.name):
        assert design_table(SMALL, tmp_path, n_workers=1) == expected


def test_the_files_hold_the_table(small):
    folder, table = small
    with open(folder / "table.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    stored = json.loads((folder / "table.json").read_text())
    assert len(lines) == len(stored["rows"]) == len(table.rows) == 2
    for line, record, row in zip(lines, stored["rows"], table.rows, strict=True):
        assert float(line["relative_mse"]) == record["relative_mse"] == row.relative_mse
        assert int(line["n_subapertures"]) == row.n_subapertures
        assert line["infeasible"] == ""
        assert record["infeasible"] is None
        assert record["centers"] == [list(center) for center in row.centers]
    assert stored["space"]["reference_fill_factor"] == 0.15


def test_prints_as_markdown_with_what_all_rows_share_above(small):
    _, table = small
    _, shared, empty, *markdown = str(table).splitlines()
    assert empty == ""
    assert f"D/r0 = {SMALL.diameter_over_r0[0]:g}, seed = 0." in shared
    assert "N =" not in shared
    assert len(markdown) == 4
    assert len({(len(line), line.count("|")) for line in markdown}) == 1
    heading, row = ([cell.strip() for cell in markdown[k].split("|")] for k in (0, 3))
    assert row[heading.index("wiener_mse")] == f"{table.rows[1].wiener_mse:#.4g}"
    assert row[heading.index("N")] == "5"
    assert not {"infeasible", "seed"} & set(heading)  # without any entry, or the same in all rows


def test_masks_are_feasible_and_seeds_differ(tmp_path):
    space = replace(SMALL, n_subapertures=(5,), seed=(0, 1), diameter_over_r0=())
    table = design_table(space, tmp_path, n_workers=1)
    first, second = (table.aperture(row).centers for row in table.rows)
    assert not torch.equal(first, second)
    for centers, row in ((first, table.rows[0]), (second, table.rows[1])):
        d = row.subaperture_diameter
        assert float(torch.linalg.vector_norm(centers, dim=-1).max()) <= (1 - d) / 2 + 1e-9
        assert float(torch.pdist(centers).min()) >= d - 1e-9


def test_two_workers_give_the_numbers_of_one(tmp_path, small):
    _, expected = small
    assert design_table(SMALL, tmp_path, n_workers=2) == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_subapertures": ()}, r"n_subapertures is \(\): it must hold at least one value"),
        ({"fill_factor": (0.1, 0.1)}, r"fill_factor is \(0\.1, 0\.1\): .* none twice"),
        ({"n_subapertures": (3.5,)}, r"n_subapertures is 3\.5: it must be whole and positive"),
        ({"n_frames": (0,)}, r"n_frames is 0: it must be whole and positive"),
        ({"n_photons": (-1.0,)}, r"n_photons is -1\.0: it must be finite and positive"),
        ({"diameter_over_r0": (math.inf,)}, r"diameter_over_r0 is inf"),
        ({"seed": (-1,)}, r"seed is -1: it must be whole and not negative"),
        ({"mask_diameter": math.nan}, r"mask_diameter is nan: it must be finite and positive, in m"),
        ({"n_draws": 1}, r"n_draws is 1: a standard error needs at least 2"),
        ({"method": "anneal"}, r"method is 'anneal': known methods are hybrid, cma"),
        ({"budget": 0}, r"budget is 0"),
        ({"n_frequencies": 1}, r"n_pixels"),
        ({"n_pixels": 0}, r"n_pixels is 0"),
    ],
)
def test_a_space_that_makes_no_sense_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)


def test_an_unknown_backend_is_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="known backends are loky, ray"):
        design_table(SMALL, tmp_path / "table", backend="slurm")
    assert not (tmp_path / "table").exists()


def test_whole_numbers_and_floats_name_the_same_task():
    assert replace(SMALL, n_photons=(10**7,)) == replace(SMALL, n_photons=(1e7,))
    assert isinstance(replace(SMALL, n_photons=(10**7,)).n_photons[0], float)
    assert isinstance(replace(SMALL, n_subapertures=(3.0,)).n_subapertures[0], int)
