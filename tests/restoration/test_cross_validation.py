"""The prior under which each half of the frames predicts the other best."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.restoration.conftest import satellite
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.restoration import cross_validation
from torchmask.restoration.cross_validation import choose_prior
from torchmask.restoration.descent import descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import SmoothVariation, TotalVariation

SHAPE = (6, 8)


class Ridge(ObjectPrior):
    """Weight / 2 times the sum of squares, under which objects have a closed form."""

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, image):
        return 0.5 * self.weight * image.square().sum()


@dataclass(frozen=True)
class SharpFrames:
    """Stands for an objective whose frames show the object itself, with noise of the variance 1 / precision."""

    frames: torch.Tensor
    precision: float
    price: float

    @property
    def model(self):
        return SimpleNamespace(background=SimpleNamespace(price=self.price))

    def of_frames(self, part):
        return replace(self, frames=self.frames[part])

    def object_quadratic(self, image, z, calibration):
        assert len(z) == len(self.frames) == len(calibration.transmission)
        each = self.precision / calibration.noise_inflation[:, None, None]
        return (each * (image - self.frames)).sum(0), torch.full_like(torch.fft.rfft2(image).real, float(each.sum()))


def state_of(image, n_frames):
    ones = torch.ones(n_frames, dtype=image.dtype)
    return State(image, torch.zeros(n_frames, 3, dtype=torch.float64), Calibration(ones, ones, 1.0))


def closed_form(frames, precision, price, weights):
    """Return the misfit of each weight for sharp frames and a ridge; the precision is one, or one of each frame (T,).

    Each half has the object (sum of p frames - price) / (sum of p + w), where that is positive.
    """
    each = torch.as_tensor(precision, dtype=frames.dtype).expand(len(frames))[:, None, None]
    halves = slice(0, None, 2), slice(1, None, 2)
    misfits = []
    for weight in weights:
        total = 0.0
        for fitted, other in (halves, halves[::-1]):
            light = (each[fitted] * frames[fitted]).sum(0) - price
            image = (light / (each[fitted].sum() + weight)).clamp(min=0)
            total += float(0.5 * (each[other] * (image - frames[other]).square()).sum())
        misfits.append(total)
    return misfits


def best_of(misfits):
    """Return the index of the least misfit."""
    return misfits.index(min(misfits))


def chosen(frames, precision, price, weights):
    begun = state_of(frames.mean(0).clamp(min=0), len(frames))
    priors = [Ridge(weight) for weight in weights]
    return choose_prior(SharpFrames(frames, precision, price), begun, priors, 50).weight


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n_frames=st.integers(2, 7),
    precision=st.floats(0.1, 10.0),
    price=st.sampled_from([0.0, 1.0]),
    level=st.floats(0.3, 3.0),
    heaviest=st.floats(-2.0, 4.0),
)
def test_the_choice_is_that_of_the_closed_form(seed, n_frames, precision, price, level, heaviest):
    """Two misfits that agree to the precision of the descents may be taken for each other."""
    generator = torch.Generator().manual_seed(seed)
    scale = precision**-0.5
    truth = level * scale * torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    frames = truth + scale * torch.randn(n_frames, *SHAPE, generator=generator, dtype=torch.float64)
    weights = [precision * 2.0 ** (heaviest - i) for i in range(5)]
    price = price * precision * scale
    misfits = closed_form(frames, precision, price, weights)
    found = chosen(frames, precision, price, weights)
    assert misfits[weights.index(found)] == pytest.approx(misfits[best_of(misfits)], rel=1e-6)


@pytest.mark.parametrize(
    ("weights", "index"),
    [
        ([3.0, 1.5, 1.0, 0.75], 3),  # each is better than the one before
        ([3.0, 0.75, 0.05, 0.02], 1),
        ([0.75, 0.05, 0.02], 0),
        ([3.0, 6.0, 0.75], 2),  # one that is worse does not matter
        ([3.0, 6.0, 5.0, 9.0, 0.75], 4),  # nor do several
        ([3.0, 6.0], 0),
    ],
)
def test_the_least_misfit_of_all_is_chosen(weights, index):
    """Two sharp frames of ones with noise of 0.8, for which the best ridge has a weight of about 0.8^2."""
    noise = 0.8 * torch.randn(2, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames = 1 + noise
    misfits = closed_form(frames, 1.0, 0.0, weights)
    assert best_of(misfits) == index
    assert chosen(frames, 1.0, 0.0, weights) == weights[index]


def test_frames_count_by_their_noise():
    """The choice is that of the frames with all their noise, and another one than for even noise."""
    generator, inflation = torch.Generator().manual_seed(0), torch.tensor([1.0, 1.0, 30.0, 30.0], dtype=torch.float64)
    noise = 0.8 * torch.randn(4, 40, 40, generator=generator, dtype=torch.float64)
    frames, weights = 1 + noise * inflation[:, None, None].sqrt(), [10.0, 5.0, 2.5, 1.2, 0.6, 0.3]
    begun = state_of(torch.ones(40, 40, dtype=torch.float64), 4)
    found = [
        choose_prior(SharpFrames(frames, 1.0, 0.0), state, [Ridge(weight) for weight in weights], 50).weight
        for state in (begun, begun.calibrated(noise_inflation=inflation))
    ]
    misfits = closed_form(frames, 1 / inflation, 0.0, weights)
    assert found[1] == weights[best_of(misfits)] != found[0]


def test_a_price_of_light_counts_in_the_fit_alone():
    """It takes light from the object of either half, as a heavier prior does, so that a lighter one is chosen."""
    noise = 0.8 * torch.randn(2, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames, weights = 2 + noise, [0.6, 0.3, 0.15, 0.08, 0.01]
    found = {}
    for price in (0.0, 0.3):
        misfits = closed_form(frames, 1.0, price, weights)
        found[price] = chosen(frames, 1.0, price, weights)
        assert found[price] == weights[best_of(misfits)]
    assert found[0.3] < found[0.0]


def test_the_first_prior_has_no_advantage_by_where_it_begins(monkeypatch):
    """The object of all frames knows the half that it is to predict, so the objects of the halves leave it twice."""
    settle, share = cross_validation.settle_object, 0.8

    def settle_in_part(centre, gradient, power, prior, n_iterations):
        there = settle(centre, gradient, power, prior, 50)[1]
        return 0.0, centre + share * (there - centre)

    noise = 0.8 * torch.randn(2, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames, weights = 2 + noise, [0.5, 0.3, 0.1]
    misfits = closed_form(frames, 1.0, 0.0, weights)
    monkeypatch.setattr(cross_validation, "settle_object", settle_in_part)
    assert chosen(frames, 1.0, 0.0, weights) == weights[best_of(misfits)] != weights[0]


def test_no_priors_are_no_choice():
    frames = torch.ones(2, *SHAPE)
    with pytest.raises(ValueError, match="no priors to choose from"):
        choose_prior(SharpFrames(frames, 1.0, 0.0), state_of(frames[0], 2), (), 5)


@pytest.mark.parametrize(("n_frames", "n_priors"), [(1, 3), (4, 1)])
def test_one_frame_or_one_prior_leaves_no_choice(n_frames, n_priors, monkeypatch):
    monkeypatch.setattr(cross_validation, "settle_object", None)  # so nothing is fitted
    frames, priors = torch.ones(n_frames, *SHAPE), [Ridge(2.0 - i) for i in range(n_priors)]
    assert choose_prior(SharpFrames(frames, 1.0, 0.0), state_of(frames[0], n_frames), priors, 5) is priors[0]


def test_halves_are_compared_as_by_whole_descents(explain):
    """For blurred frames the choice is that of long descents of the object of each half."""
    objective, state = explain(n_frames=5, noise=1.0)
    priors = [SmoothVariation(factor, bending=0.1) for factor in (6.0, 2.0, 0.6, 0.06, 0.006)]

    def misfit(prior):
        total = 0.0
        for fitted, other in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
            half = objective.of_frames(fitted, free=Free.OBJECT).with_changes(prior=prior)
            found = descend(half, state.of_frames(fitted), 200, ProjectedLBFGS(), lambda *told: None)
            told = objective.of_frames(other).with_changes(prior=TotalVariation(1e-300))
            there = state.of_frames(other)
            total += float(told.evaluator(there.calibration)(found.image, there.z).value)
        return total

    misfits = [misfit(prior) for prior in priors]
    best = best_of(misfits)
    assert 0 < best < len(priors) - 1
    assert choose_prior(objective, state, priors, 100) is priors[best]


@pytest.mark.parametrize("n_frames", [2, 8])
def test_a_faint_object_is_not_left_flat_where_aberrations_are_known(n_frames, five_holes, five_hole_basis):
    """The heaviest priors leave little but an even level, and are not at rest: misfits rise before they fall.

    Of the first few of the family the heaviest is best, which leaves errors of 0.92 to 0.98 where the lightest leaves
    0.39 to 0.63 in two draws. The light is a thousand photons, with a read-out noise of 1.5.
    """
    grid = Grid.nyquist(1.0, 550e-9, 32)
    model, generator = ExposureModel(five_holes, grid, five_hole_basis), torch.Generator().manual_seed(1)
    truth = satellite(grid.shape, 1e3)
    z = torch.randn(n_frames, five_hole_basis.n_parameters, dtype=torch.float64, generator=generator)
    frames = torch.poisson(model(model.window.embed(truth), z).clamp(min=0), generator=generator)
    frames = frames + 1.5 * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    method = MyopicDeconvolution(five_holes, grid, n_modes=3, readout_noise=1.5)
    result = method.restore(frames, coefficients=five_hole_basis.coefficients(z))
    assert relative_error(result.object, truth, model.cutoff) < 0.75
