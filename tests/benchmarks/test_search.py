"""The best masks ever found, which the benchmark of the searches is held against."""

import math
from types import SimpleNamespace

import pytest
import search

from torchmask.design.constraints import check_mask
from torchmask.io import read_json
from torchmask.optics.aperture import SparseAperture


@pytest.mark.parametrize("row", read_json(search.BEST), ids=lambda row: f"{row['telescope']} {row['n_subapertures']}")
def test_the_masks_that_are_kept_are_feasible_and_as_good_as_said(row):
    case = search.Case(row["telescope"], row["fill_factor"])
    mask = case.best(row["n_subapertures"])
    assert mask is not None
    check_mask(mask, 1e-9, case.rules)
    assert float(case.criterion.relative(mask)) == pytest.approx(row["relative_mse"], rel=1e-9)


def test_only_a_better_mask_takes_the_place(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "BEST", tmp_path / "best.json")
    search.BEST.write_text("[]")
    case = search.Case("vlt", 0.1)
    assert case.best(3) is None
    mask = SparseAperture([[0.0, 3.0], [3.0, -1.0], [-2.0, -2.0]], 8.2 * math.sqrt(0.1 / 3), 8.2)
    case.keep(SimpleNamespace(aperture=mask, relative_mse=float(case.criterion.relative(mask))))
    case.keep(SimpleNamespace(aperture=mask.replace(-mask.centers), relative_mse=1.0))
    assert case.best(3).centers.tolist() == mask.centers.tolist()
    (row,) = read_json(search.BEST)
    assert (row["telescope"], row["n_subapertures"], row["fill_factor"]) == ("vlt", 3, 0.1)


def test_the_budget_is_what_the_time_buys_whatever_the_gradient_stage_takes(monkeypatch):
    """Searches of 3 s (or anything from 2 to 4 by chance) and 1 ms an evaluation."""
    clock, stage = [0.0], iter([4.0, 2.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0])
    case = search.Case("vlt", 0.15)

    def run(n, *, seed, budget):
        clock[0] += next(stage) + 1e-3 * budget

    monkeypatch.setattr(case, "search", run)
    # The last two trials, of 5120 and 20480 evaluations, take 3 s beside what grows, so that nothing is guessed.
    assert search.affordable(case, 11, 60.0, lambda: clock[0], {}) == pytest.approx(57_000, abs=1)


def test_less_time_than_a_trial_takes_buys_fewer_evaluations(monkeypatch):
    clock, case = [0.0], search.Case("reference", 0.15)
    monkeypatch.setattr(case, "search", lambda n, *, seed, budget: clock.__setitem__(0, clock[0] + 1.0 + 1e-2 * budget))
    assert search.affordable(case, 6, 10.0, lambda: clock[0], {}) == pytest.approx(900, abs=1)
