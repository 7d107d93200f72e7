"""Basin hopping on criteria whose optima are known in closed form, and the pool that it keeps them in."""

import math

import numpy as np
import pytest
import torch

from torchmask.design import hybrid
from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.hybrid import FINALISTS, RANDOM_SHARE, Pool, basin_hopping, coarse_criterion
from torchmask.design.merit import Holes
from torchmask.design.refine import Monitor
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD


def holes_of(n, hole=0.1):
    template = SparseAperture(torch.zeros(n, 2, dtype=torch.float64), hole, 1.0)
    return Holes(template, (InsideDisc(), NoOverlap()))


def coordinates(holes, centers):
    return holes.coordinates(torch.as_tensor(centers, dtype=torch.float64))


TRIANGLE = np.array([[0.3, 0.1], [-0.2, 0.25], [0.05, -0.35]])


@pytest.fixture
def pool():
    return Pool(holes_of(3), 4)


def values(pool):
    return [value for value, _, _ in pool.entries]


def stretched(factor):
    return coordinates(holes_of(3), factor * TRIANGLE)


def test_the_best_are_kept_in_order(pool):
    for factor, value in ((1.0, 0.5), (0.9, 0.2), (0.8, 0.9), (0.7, 0.4), (0.6, 0.3), (0.5, 0.6)):
        pool.offer(stretched(factor), value)
    assert values(pool) == [0.2, 0.3, 0.4, 0.5]
    for (_, x, _), factor in zip(pool.entries, (0.9, 0.6, 0.7, 1.0), strict=True):
        assert torch.equal(x, stretched(factor))


def moved(angle, mirror, order):
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return (TRIANGLE @ turn.T * ([-1, 1] if mirror else [1, 1]))[list(order)]


@pytest.mark.parametrize(
    ("angle", "mirror", "order"),
    [(1.0, False, (0, 1, 2)), (0.0, True, (0, 1, 2)), (0, False, (2, 0, 1)), (2, True, (1, 2, 0))],
)
def test_a_mask_turned_mirrored_or_renumbered_is_the_same_optimum_and_the_better_stays(pool, angle, mirror, order):
    same = coordinates(pool.holes, moved(angle, mirror, order))
    pool.offer(stretched(1.0), 0.5)
    pool.offer(same, 0.6)
    assert values(pool) == [0.5]
    pool.offer(same, 0.5)  # a tie: who came first stays
    assert torch.equal(pool.entries[0][1], stretched(1.0))
    pool.offer(same, 0.4)
    assert values(pool) == [0.4]
    assert torch.equal(pool.entries[0][1], same)


def test_masks_are_one_optimum_up_to_a_hundredth_of_the_diameter(pool):
    """Separations of the triangle scaled by f differ by (1 - f) times their rms, which is known."""
    rms = math.sqrt(np.mean([np.sum((TRIANGLE[i] - TRIANGLE[j]) ** 2) for i, j in ((0, 1), (0, 2), (1, 2))]))
    pool.offer(stretched(1.0), 0.5)
    pool.offer(stretched(1 - 0.0099 / rms), 0.6)
    assert values(pool) == [0.5]
    pool.offer(stretched(1 - 0.0101 / rms), 0.6)
    assert values(pool) == [0.5, 0.6]


def test_one_that_is_better_than_several_of_its_kind_takes_the_place_of_all(pool):
    rms = math.sqrt(np.mean([np.sum((TRIANGLE[i] - TRIANGLE[j]) ** 2) for i, j in ((0, 1), (0, 2), (1, 2))]))
    step = 0.006 / rms
    pool.offer(stretched(1.0), 0.5)
    pool.offer(stretched(1 - 2 * step), 0.6)
    assert len(pool.entries) == 2
    pool.offer(stretched(1 - step), 0.4)
    assert values(pool) == [0.4]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_has_no_value_is_not_kept(pool, value):
    pool.offer(stretched(1.0), value)
    assert pool.entries == []


class Wells:
    """A relative MSE of two holes that depends on their separation alone, with wells of known place and depth."""

    wells = ((0.3, 0.5), (0.5, 0.8), (0.75, 0.6))  # separation [mask diameters], depth

    def relative(self, aperture):
        separation = (aperture.centers[..., 0, :] - aperture.centers[..., 1, :]).square().sum(-1).sqrt()
        return 1 - sum(depth * torch.exp(-(((separation - at) / 0.04) ** 2)) for at, depth in self.wells)

    __call__ = relative


def separation(holes, x):
    first, second = holes.aperture(x).centers
    return float((first - second).norm())


def hop(criterion, holes, budget, seed=0):
    records = []
    monitor = Monitor("design/hybrid", budget, holes, records.append)
    found, evaluations = basin_hopping(criterion, holes, budget, np.random.default_rng(seed), monitor)
    return found, evaluations, records


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_deepest_well_is_found_and_the_best_come_first(seed):
    holes = holes_of(2)
    found, evaluations, _ = hop(Wells(), holes, 2000, seed)
    # A descent rests where it promises less than 1e-3 in log MSE, about twice what is left: in a well 1 - depth deep,
    # at s = 0.04 sqrt(1e-3 (1 - depth) / depth / 2) beside its middle; the steps before may have known it by half.
    assert separation(holes, found[0]) == pytest.approx(0.5, abs=4 * 0.04 * math.sqrt(1e-3 * 0.2 / 0.8 / 2))
    merits = [float(Wells().relative(holes.aperture(x))) for x in found]
    assert merits == sorted(merits)
    assert len(found) == FINALISTS
    assert 2000 - hybrid.BATCH < evaluations <= 2000


def test_the_same_seed_hops_the_same_way_and_another_one_does_not():
    first, again, other = (hop(Wells(), holes_of(2), 640, seed)[0] for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


@pytest.mark.parametrize("budget", [1, 5, 33])
def test_a_small_budget_is_kept_and_still_gives_a_mask(budget):
    counted = []

    class Counting(Wells):
        def relative(self, aperture):
            counted.append(aperture.centers.shape[0])
            return super().relative(aperture)

    found, evaluations, records = hop(Counting(), holes_of(2), budget)
    assert 1 <= len(found) <= budget
    assert sum(counted) == evaluations <= budget
    assert records[-1].step <= budget


def test_random_starts_come_first_and_then_the_pool_is_hopped_on(monkeypatch):
    spent, hops = [0], []

    class Counting(Wells):
        def relative(self, aperture):
            spent[0] += aperture.centers.shape[0]
            return super().relative(aperture)

    def changed(holes, x, rng):
        hops.append(spent[0])
        return original(holes, x, rng)

    original = hybrid.changed_mask
    monkeypatch.setattr(hybrid, "changed_mask", changed)
    hop(Counting(), holes_of(2), 2000)
    assert min(hops) >= RANDOM_SHARE * 2000
    assert min(hops) < RANDOM_SHARE * 2000 + 4 * hybrid.BATCH
    assert len(hops) > 50


def test_rules_are_kept_up_to_what_the_penalty_lets_through():
    """One well at a separation that the rule forbids: the best that is left is touching holes."""

    class Close(Wells):
        wells = ((0.05, 0.5),)

    holes = holes_of(2)
    found, _, _ = hop(Close(), holes, 1500)
    # The penalty WEIGHT / 2 (0.1 - s)^2 balances the slope of log MSE, at most depth * sqrt(2 / e) / 0.04 / 0.5.
    slack = 0.5 * math.sqrt(2 / math.e) / 0.04 / 0.5 / hybrid.WEIGHT
    assert 0.1 - slack < separation(holes, found[0]) < 0.1 + 0.01


def test_a_criterion_is_searched_on_a_coarse_grid_if_it_has_one():
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 256), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20)
    assert coarse_criterion(criterion).grid == Grid.nyquist(1.0, 550e-9, 96)
    small = criterion.on_grid(64)
    assert coarse_criterion(small) is small
    wells = Wells()
    assert coarse_criterion(wells) is wells
