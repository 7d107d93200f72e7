"""The search: exactly feasible, reproducible, harmless to its surroundings, and good."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import nn

from torchmask.design.constraint_base import project
from torchmask.design.constraints import (
    FixedHoles,
    InsideDisc,
    KeepOutDisc,
    MinimumGap,
    NFoldSymmetry,
    NoOverlap,
    check_mask,
)
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.refine import refine_mask
from torchmask.design.search import search_mask
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD


def reference(n_pixels):
    """The reference case of the design, on a grid of one's choice."""
    grid = Grid.nyquist(1.0, 550e-9, n_pixels)
    return AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)


COARSE = reference(96)


@pytest.mark.parametrize(("method", "budget"), [("cma", 640), ("hybrid", 1500)])
def test_result_is_feasible_and_measured_where_it_stands(method, budget):
    found = search_mask(COARSE, 7, 1.0, 0.15, method=method, budget=budget, seed=3)
    check_mask(found.aperture, tolerance=1e-9)
    assert found.aperture.fill_factor == pytest.approx(0.15, rel=1e-12)
    assert found.mse == float(COARSE(found.aperture))
    assert found.relative_mse == float(COARSE.relative(found.aperture))
    assert found.evaluations >= budget / 2
    for best in found.history.values():
        assert bool((best[1:, 0] >= best[:-1, 0]).all())


@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_same_seed_same_mask_and_another_seed_another(method):
    def centers(seed):
        return search_mask(reference(48), 5, 1.0, 0.15, method=method, budget=100, seed=seed).aperture.centers

    assert torch.equal(centers(0), centers(0))
    assert not torch.equal(centers(0), centers(1))


def test_search_leaves_the_process_and_the_folder_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.random.seed(7)  # noqa: NPY002 - the global state is what is watched
    numpy_state, torch_state = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    search_mask(COARSE, 5, 1.0, 0.15, method="cma", budget=320, seed=0)
    after = np.random.get_state()  # noqa: NPY002
    assert all(np.array_equal(one, other) for one, other in zip(numpy_state, after, strict=True))
    assert torch.equal(torch_state, torch.get_rng_state())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("constraints", [(), (MinimumGap(0.02), KeepOutDisc(0.1), NFoldSymmetry(3))])
@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_another_default_device_sees_nothing_of_it(method, constraints):
    """From the room for holes, over the coarse grid, to projections and checks, all is where the criterion is."""
    criterion = reference(64)

    def found():
        return search_mask(criterion, 6, 1.0, 0.1, method=method, budget=96, seed=0, constraints=constraints)

    expected = found()
    with torch.device("meta"):
        again = found()
        refined = refine_mask(criterion, expected.aperture, budget=10, constraints=constraints)
    assert torch.equal(again.aperture.centers, expected.aperture.centers)
    assert all(torch.equal(again.history[stage], rows) for stage, rows in expected.history.items())
    assert refined.aperture.centers.device.type == "cpu"


@pytest.mark.parametrize("constraints", [(), (MinimumGap(0.02), KeepOutDisc(0.1)), (NFoldSymmetry(3),)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_short_refinement_makes_no_mask_worse(constraints, dtype):
    """Ten evaluations begin a little off the rim, and may end before they are back."""
    criterion = reference(64)
    given = search_mask(criterion, 6, 1.0, 0.1, method="cma", budget=96, constraints=constraints).aperture.to(dtype)
    refined = refine_mask(criterion, given, budget=10, constraints=constraints)
    assert refined.mse <= float(criterion(given))
    assert refine_mask(criterion, given, budget=1, constraints=constraints).evaluations == 1
    last = float(refined.history["design/refine"][-1, 1])  # of the mask projected once more
    assert last == pytest.approx(refined.relative_mse, rel=10 * torch.finfo(dtype).eps)


class Elsewhere(nn.Module):
    """A criterion on a device that is not the processor, for which the meta device stands: all masks are alike."""

    def __init__(self):
        super().__init__()
        self.register_buffer("psd", torch.ones(2, device="meta"))
        self.seen = set()

    def forward(self, aperture):
        self.seen.add(aperture.centers.device.type)
        return torch.ones(aperture.centers.shape[:-2], dtype=torch.float64, requires_grad=True)

    relative = forward


@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_a_criterion_on_another_device_is_given_masks_there(method):
    criterion = Elsewhere()
    found = search_mask(criterion, 3, 1.0, 0.1, method=method, budget=96)
    assert criterion.seen == {"meta"}
    assert found.aperture.centers.device.type == "meta"
    criterion.seen.clear()
    given = SparseAperture.from_catalog("golay3", 1.0, 0.1)
    refined = refine_mask(criterion, given, budget=10)
    assert criterion.seen == {"meta"}
    assert (refined.aperture.centers.device.type, given.centers.device.type) == ("meta", "cpu")


def test_gradient_stage_improves_on_cma_alone():
    plain = search_mask(COARSE, 9, 1.0, 0.15, method="cma", refine=False, budget=640, seed=0)
    refined = search_mask(COARSE, 9, 1.0, 0.15, method="cma", refine=True, budget=640, seed=0)
    check_mask(plain.aperture)
    assert refined.mse < plain.mse


def test_refinement_goes_downhill_and_stays_feasible():
    start = SparseAperture.random(8, 1.0, 0.15, torch.Generator().manual_seed(0))
    found = refine_mask(COARSE, start, budget=60)
    check_mask(found.aperture)
    assert found.mse < float(COARSE(start))


def test_records_lead_to_the_result():
    records = []
    found = search_mask(COARSE, 5, 1.0, 0.15, method="hybrid", budget=600, seed=0, callback=records.append)
    assert all(record.step <= record.n_steps for record in records)
    records = [record for record in records if not record.preparatory]
    assert {record.stage for record in records} == {"design/hybrid", "design/refine"}
    assert all(record.arrays["centers"].shape == (5, 2) for record in records)
    assert records[-1].scalars["relative_mse"] == pytest.approx(found.relative_mse, rel=1e-2)


def test_what_a_search_does_after_its_evaluations_is_told():
    """Projections and the errors of the history, which take long for many holes: every mask, and steps within."""
    records = []
    found = search_mask(COARSE, 12, 1.0, 0.5, budget=64, seed=0, callback=records.append)
    after = [record for record in records if record.preparatory]
    assert {record.stage for record in after} == {"design/hybrid/history", "design/project", "design/refine/history"}
    for stage in ("design/hybrid/history", "design/refine/history"):
        told = [record for record in after if record.stage == stage]
        assert [record.step for record in told] == list(range(1, told[0].n_steps + 1))
    steps = [record.step for record in after if record.stage == "design/project"]
    assert steps == sorted(steps)
    assert len(steps) > 2 * max(steps)  # several within each projection
    assert records[-1].scalars["relative_mse"] == pytest.approx(found.relative_mse, rel=1e-9)


@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_history_is_of_feasible_masks_on_one_grid_and_one_axis(method):
    """Both stages as the criterion measures what one would get, whatever grid and penalties they work with."""
    fine, records = reference(128), []
    found = search_mask(fine, 7, 1.0, 0.15, method=method, budget=640, seed=1, callback=records.append)
    rules = [InsideDisc(), NoOverlap()]
    search, refine = found.history[f"design/{method}"], found.history["design/refine"]
    told = [record for record in records if record.stage == f"design/{method}"]
    for record, value in ((told[0], search[0, 1]), (told[-1], search[-1, 1])):
        again = project(found.aperture.replace(centers=record.arrays["centers"]), rules)
        # projected twice, and to rounding of the rules: far below the curve's steps
        assert float(value) == pytest.approx(float(fine.relative(again)), rel=1e-9)
    assert told[-1].scalars["relative_mse"] == float(search[-1, 1])  # what `view` prints is what the figure shows
    torch.testing.assert_close(refine[0], search[-1], rtol=0, atol=0)
    assert float(refine[-1, 0]) == found.evaluations
    assert float(refine[-1, 1]) == pytest.approx(found.relative_mse, rel=1e-9)


def test_history_never_rises_and_is_of_few_masks_where_they_are_many():
    """Masks of the refinement may break rules, and be worse than where the search ended once they are put right."""
    records = []
    rules = [MinimumGap(0.02)]
    found = search_mask(reference(64), 24, 1.0, 0.5, budget=96, seed=0, constraints=rules, callback=records.append)
    errors = torch.cat([points[:, 1] for points in found.history.values()])
    assert bool((errors.diff() <= 0).all())
    for stage in found.history:  # each takes half a second
        assert 2 < sum(record.stage == f"{stage}/history" for record in records) <= 1 + 150_000 / 24**3


def test_extra_rules_are_obeyed_exactly():
    rules = [KeepOutDisc(0.2), MinimumGap(0.02), NFoldSymmetry(3)]
    found = search_mask(COARSE, 6, 1.0, 0.1, budget=1500, constraints=rules, seed=0)
    check_mask(found.aperture, 1e-9, rules)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((6, 1.0, 0.9), r"fill|room|fit"),
        ((1, 1.0, 1.2), r"fill"),
        ((6, 1.0, 0.0), r"fill_factor"),
        ((6, 1.0, math.nan), r"fill_factor"),
        ((0, 1.0, 0.15), r"n_subapertures"),
        ((math.inf, 1.0, 0.15), r"n_subapertures is inf: it must be a whole number"),
        ((6, -1.0, 0.15), r"mask_diameter"),
    ],
)
def test_impossible_requests_are_refused_with_the_reason(arguments, message):
    with pytest.raises(ValueError, match=message):
        search_mask(COARSE, *arguments)


def test_holes_narrower_than_a_sample_of_the_frequencies_are_refused_at_once():
    """Their baselines fall between the samples; thousands of holes were packed for minutes first."""
    with pytest.raises(
        ValueError,
        match=r"holes of 0\.007071 m are narrower than a sample .*, 0\.03125 m .*: take holes of at least 0\.03125 m, "
        r"n_subapertures of at most 153 at this fill factor, or a grid of at least 283 x 283 frequencies",
    ):
        search_mask(reference(64), 3000, 1.0, 0.15)


def test_unknown_method_lists_the_known_ones():
    with pytest.raises(ValueError, match="cma"):
        search_mask(COARSE, 6, 1.0, 0.15, method="annealing")


@pytest.mark.parametrize(
    "option", [{"seed": -1}, {"seed": 0.5}, {"seed": math.inf}, {"budget": 0}, {"budget": math.inf}]
)
def test_bad_options_are_refused(option):
    (name,) = option
    with pytest.raises(ValueError, match=f"{name} is {option[name]}"):
        search_mask(COARSE, 6, 1.0, 0.15, **option)


def test_whole_numbers_may_be_floats():
    for method in ("hybrid", "cma"):
        plain = search_mask(COARSE, 4, 1.0, 0.1, method=method, budget=40, seed=1).aperture
        other = search_mask(COARSE, 4.0, 1.0, 0.1, method=method, budget=40.0, seed=1.0).aperture
        assert torch.equal(plain.centers, other.centers)
    assert refine_mask(COARSE, plain, budget=2.0).evaluations == 2
    with pytest.raises(ValueError, match=r"n_subapertures is 2\.5: it must be a whole number of at least 1"):
        search_mask(COARSE, 2.5, 1.0, 0.1)


@pytest.mark.parametrize("method", ["cma", "hybrid"])
@pytest.mark.parametrize("budget", [1, 2, 3])
def test_a_search_of_very_few_masks_has_a_result(method, budget):
    found = search_mask(COARSE, 4, 1.0, 0.1, method=method, budget=budget, refine=False)
    check_mask(found.aperture, 1e-9)
    assert found.evaluations <= 2 * budget + 1  # each once more where it is feasible, and the mask that room gave


@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_a_search_without_anything_to_move_returns_what_is_given(method):
    places = [(0.3, 0.0), (-0.2, 0.25), (-0.1, -0.3)]
    found = search_mask(COARSE, 3, 1.0, 0.1, method=method, budget=40, constraints=[FixedHoles(places)])
    # of a mapping onto the disc and back, in a few roundings of numbers of at most 1
    torch.testing.assert_close(found.aperture.centers, torch.tensor(places, dtype=torch.float64), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("n", "constraints", "most"), [(1, [], 320 + 9 * 120), (2, [FixedHoles([(0.3, 0.0), (-0.2, 0.25)])], 8)]
)
@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_what_has_no_pattern_to_find_is_not_searched_for(n, constraints, most, method):
    """A single hole has the same error everywhere, and fixed holes one place: a hundred thousand were measured."""
    found = search_mask(COARSE, n, 1.0, 0.1, method=method, constraints=constraints)
    check_mask(found.aperture, 1e-9, constraints)
    assert found.evaluations <= most


class Bad(nn.Module):
    """A criterion that has one value for every mask, or `else_` for those whose first hole is to the right."""

    def __init__(self, value, else_=None):
        super().__init__()
        self.value, self.else_ = value, value if else_ is None else else_

    def forward(self, aperture):
        right = aperture.centers[..., 0, 0] > 0
        return torch.where(right, self.else_, self.value) + 0 * aperture.centers.sum((-2, -1))

    relative = forward


@pytest.mark.parametrize("method", ["cma", "hybrid"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -1.0])
@pytest.mark.parametrize("constraints", [(), (KeepOutDisc(0.1, (0.2, 0.0)),)])
def test_a_criterion_without_a_finite_logarithm_is_told_of(method, value, constraints):
    with pytest.raises(ValueError, match=r"relative error has no finite logarithm at any of \d+ masks: it must"):
        search_mask(Bad(value), 3, 1.0, 0.1, method=method, budget=96, constraints=constraints)


@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_a_criterion_that_fails_at_some_masks_is_searched_at_the_others(method):
    found = search_mask(Bad(math.nan, 0.5), 3, 1.0, 0.1, method=method, budget=96, refine=False)
    assert found.relative_mse == 0.5


def test_only_one_sparse_aperture_is_refined(golay6):
    with pytest.raises(TypeError, match="aperture is of type FullAperture: it must be of type SparseAperture"):
        refine_mask(COARSE, FullAperture(1.0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one mask"):
        refine_mask(COARSE, SparseAperture(golay6.centers.expand(2, -1, -1), golay6.subaperture_diameter, 1.0))
    with pytest.raises(ValueError, match="budget is 0"):
        refine_mask(COARSE, golay6, budget=0)


def congruence(points, pattern):
    """Largest distance of matched points over all rotations and reflections, at the best scale."""
    points, pattern = (p - p.mean(0) for p in (points, pattern))
    pattern = pattern * np.linalg.norm(points) / np.linalg.norm(pattern)
    z = points[:, 0] + 1j * points[:, 1]
    best = np.inf
    for w in (pattern[:, 0] + 1j * pattern[:, 1], pattern[:, 0] - 1j * pattern[:, 1]):
        for angle in np.linspace(0, 2 * np.pi, 720, endpoint=False):
            distance = np.abs(z[:, None] - np.exp(1j * angle) * w[None])
            rows, columns = linear_sum_assignment(distance**2)
            turn = np.sum(z[rows] * w[columns].conj())
            best = min(best, np.abs(z[rows] - turn / abs(turn) * w[columns]).max())
    return best


@pytest.mark.slow
def test_six_holes_find_the_golay_array(golay6):
    """Within 3 % of D, up to rotation, reflection and scale; and at least as good as quoted (0.1702)."""
    found = search_mask(reference(256), 6, 1.0, 0.15, budget=20_000, seed=0)
    assert congruence(found.aperture.centers.numpy(), golay6.centers.numpy()) < 0.03
    assert found.relative_mse < 0.1702 * 1.02
    # Broken on purpose: a mask that is not the Golay array is told apart.
    other = SparseAperture.random(6, 1.0, 0.15, torch.Generator().manual_seed(0))
    assert congruence(other.centers.numpy(), golay6.centers.numpy()) > 0.03


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_caller_without_gradients_gets_the_same(mode):
    criterion, rules = reference(32), [InsideDisc(), NoOverlap()]

    def designs():
        found = search_mask(criterion, 4, 1.0, 0.1, budget=60, seed=1).aperture
        crowded = found.replace(centers=0.3 * found.centers)
        return found, refine_mask(criterion, found, budget=20).aperture, project(crowded, rules)

    expected = designs()
    with mode():
        again = designs()
    for one, other in zip(expected, again, strict=True):
        assert torch.equal(one.centers, other.centers)
        assert not other.centers.requires_grad


def test_a_grid_that_aliases_the_mask_is_refused_before_any_work():
    """On it baselines meet at frequencies that are not theirs, and an error of 0.2 looks like 1e-4."""
    psds = PowerLawPSD(1.5, 1e7), NoisePSD(1e7)
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 64), *psds, n_frames=20)
    with pytest.raises(ValueError, match=r"undersamples an aperture of 2 m .* pixel_scale must be at most"):
        search_mask(criterion, 9, 2.0, 0.15, budget=100)


@pytest.mark.parametrize("seed", range(12))
def test_a_refinement_of_few_evaluations_returns_the_best_that_it_has_measured(seed):
    """From holes that overlap; a mask may be better than the one at which the budget ends."""
    psds = PowerLawPSD(1.5, 1e7), NoisePSD(1e7)
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 48), *psds, n_frames=20)
    centers = 0.7 * torch.rand(5, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.35
    found = refine_mask(criterion, SparseAperture(centers, math.sqrt(0.15 / 5), 1.0), budget=12)
    curve = found.history["design/refine"][:, 1]
    assert bool((curve.diff() <= 0).all())
    assert float(curve[-1]) == pytest.approx(found.relative_mse, rel=1e-12)


class Form(torch.nn.Module):
    """A criterion whose values are what a function makes of good ones."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def forward(self, aperture):
        return self.change(1 / (1 + aperture.centers.square().sum((-2, -1))))

    relative = forward


@pytest.mark.parametrize(
    ("criterion", "error", "said"),
    [
        (lambda _: 1.0, TypeError, "criterion is function: .* a method `relative`"),
        (Form(lambda values: 1.0), TypeError, "criterion returns float: a tensor is needed"),
        (Form(torch.sum), ValueError, r"relative returns shape \(\) for a population of 2 masks"),
        (Form(lambda values: values[None]), ValueError, r"criterion returns shape \(1,\) for one mask"),
        (Form(torch.detach), TypeError, "not differentiable in the centres"),
    ],
)
def test_criteria_of_another_form_are_refused_before_any_work(criterion, error, said):
    records = []
    mask = SparseAperture.from_catalog("golay3", 1.0, 0.1)
    with pytest.raises(error, match=said):
        search_mask(criterion, 3, 1.0, 0.1, budget=96)
    with pytest.raises(error, match=said):
        refine_mask(criterion, mask, callback=records.append)
    assert records == []


def test_a_search_without_gradients_needs_none():
    found = search_mask(Form(torch.detach), 3, 1.0, 0.1, method="cma", refine=False, budget=96)
    assert 0 < found.relative_mse < 1


@pytest.mark.parametrize("factor", [math.nan, math.inf, 0.0, -1.0])
def test_a_refinement_needs_a_finite_error_to_begin_with(factor):
    mask = SparseAperture.from_catalog("golay3", 1.0, 0.1)
    with pytest.raises(ValueError, match=r"of the given mask is .*: it must be finite and positive"):
        refine_mask(Form(lambda values: factor * values), mask)
