"""The prior under which each half of the frames predicts the other best."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.restoration import cross_validation
from torchmask.restoration.cross_validation import choose_prior
from torchmask.restoration.descent import descend
from torchmask.restoration.objective import Free
from torchmask.restoration.priors import ObjectPrior, SmoothVariation, TotalVariation
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.state import Calibration, State

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
        power = torch.full_like(torch.fft.rfft2(image).real, self.precision * len(self.frames))
        return self.precision * (image - self.frames).sum(0), power


def state_of(image, n_frames):
    ones = torch.ones(n_frames, dtype=image.dtype)
    return State(image, torch.zeros(n_frames, 3, dtype=torch.float64), Calibration(ones, ones, 1.0))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n_frames=st.integers(2, 7),
    precision=st.floats(0.1, 10.0),
    price=st.sampled_from([0.0, 0.2]),
    level=st.floats(1.5, 6.0),
)
def test_the_choice_is_that_of_the_closed_form(seed, n_frames, precision, price, level):
    """Sharp frames and a ridge: each half has the object (p sum of frames - price) / (p n + w), where that is positive.

    Two misfits that agree to the precision of the descents may be taken for each other.
    """
    generator = torch.Generator().manual_seed(seed)
    truth = level * torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    noise = torch.randn(n_frames, *SHAPE, generator=generator, dtype=torch.float64) / precision**0.5
    frames = truth + noise
    priors = [Ridge(precision * factor) for factor in (4.0, 2.0, 1.0, 0.5, 0.2)]

    def misfit(weight):
        total = 0.0
        for fitted, other in ((frames[0::2], frames[1::2]), (frames[1::2], frames[0::2])):
            image = ((precision * fitted.sum(0) - price) / (precision * len(fitted) + weight)).clamp(min=0)
            total += float(0.5 * precision * (image - other).square().sum())
        return total

    misfits = [misfit(prior.weight) for prior in priors]
    rises = [i for i in range(len(priors) - 1) if misfits[i + 1] >= misfits[i]]
    best = rises[0] if rises else len(priors) - 1
    found = choose_prior(
        SharpFrames(frames, precision, price), state_of(frames.mean(0).clamp(min=0), n_frames), priors, 50
    )
    assert misfit(found.weight) == pytest.approx(misfits[best], rel=1e-6)


@pytest.mark.parametrize(("n_frames", "n_priors"), [(1, 3), (4, 1)])
def test_one_frame_or_one_prior_leaves_no_choice(n_frames, n_priors, monkeypatch):
    monkeypatch.setattr(cross_validation, "settle_object", None)  # so nothing is fitted
    frames, priors = torch.ones(n_frames, *SHAPE), [Ridge(2.0 - i) for i in range(n_priors)]
    assert choose_prior(SharpFrames(frames, 1.0, 0.0), state_of(frames[0], n_frames), priors, 5) is priors[0]


@pytest.mark.parametrize("seed", range(2))
def test_halves_are_compared_as_by_whole_descents(seed, explain):
    """For blurred frames the misfit of each prior is that of two long descents of the object of a half."""
    objective, state = explain(n_frames=5, noise=0.3)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(objective.frames.shape, dtype=torch.float64, generator=generator)
    objective.frames = objective.model(state.image, state.z) + 0.3 * noise
    priors = [SmoothVariation(factor, bending=0.1) for factor in (3.0, 1.0, 0.3)]

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
    rises = [i for i in range(len(priors) - 1) if misfits[i + 1] >= misfits[i]]
    best = rises[0] if rises else len(priors) - 1
    assert choose_prior(objective, state, priors, 100) is priors[best]
