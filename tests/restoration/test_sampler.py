"""What samples of the aberrations do between moves: their momentum, the size of moves, and what a round leaves."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.restoration import sampler
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.sampler import AberrationSampler, laplace_precision, sample_rounds
from torchmask.restoration.schedule import Schedule

ONCE = Schedule(moves=1, renewal=9, settling=3)


@pytest.mark.parametrize(("size", "accepted"), [(1e4, 0.0), (1e-9, 1.0)])
def test_momentum_is_kept_in_part_and_turned_back_where_a_move_is_rejected(size, accepted, explained):
    """Horowitz's guided moves: half is kept, with as much new noise as keeps the variance at 1; a rejected move changes
    its sign, without which samples would not follow the posterior. The smallest moves change it by less than 1e-6."""
    objective, state = explained
    generator = torch.Generator().manual_seed(0)
    chains = AberrationSampler(objective, state, generator)
    before, again = chains.momentum, torch.Generator()
    again.set_state(generator.get_state())
    new = torch.randn(before.shape, dtype=torch.float64, generator=again)
    z, share = chains.sample(state, 1, size)
    assert share == accepted
    assert torch.equal(z, state.z) == (accepted == 0)
    renewed = 0.5 * before + math.sqrt(0.75) * new
    torch.testing.assert_close(chains.momentum, renewed if accepted else -renewed, rtol=0, atol=1e-6)


def test_moves_grow_while_more_than_four_fifths_are_accepted_and_shrink_otherwise(explained, monkeypatch):
    objective, state = explained
    shares, sizes = iter([0.9, 0.81, 0.79, 0.8, 0.0]), []

    def sample(self, state, n_moves, size):
        sizes.append(size)
        return state.z, next(shares)

    monkeypatch.setattr(AberrationSampler, "sample", sample)
    monkeypatch.setattr(sampler, "settle", lambda objective, state, n: state)
    rounds = sample_rounds(objective, state, 5 * [1.0], ONCE, torch.Generator().manual_seed(0), follow_r0=False)
    assert [share for _, share in rounds] == [0.9, 0.81, 0.79, 0.8, 0.0]
    assert sizes == pytest.approx([0.3, 0.3 * 1.05, 0.3 * 1.05**2, 0.3 * 1.05, 0.3])


@pytest.mark.parametrize("follow_r0", [False, True])
def test_a_round_ends_without_whole_waves_and_may_follow_the_turbulence(follow_r0, explained, monkeypatch):
    """A wave of one hole, which one wavelength does not show, and tilts whose strength becomes that of the prior."""
    objective, state = explained
    basis = objective.model.aberrations
    wave = basis.parameters_of_pistons(torch.tensor([2 * math.pi, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    within = 0.3 * state.z  # of pistons of less than half a wave
    torch.testing.assert_close(basis.unwrapped(within, 0 * within), within, rtol=0, atol=0)
    monkeypatch.setattr(AberrationSampler, "sample", lambda self, state, n_moves, size: (within + wave, 1.0))
    monkeypatch.setattr(sampler, "settle", lambda objective, state, n: state)
    begun = replace(state, calibration=replace(state.calibration, aberration_weight=0.7))
    generator = torch.Generator().manual_seed(0)
    ((found, _),) = sample_rounds(objective, begun, [1.0], ONCE, generator, follow_r0=follow_r0)
    torch.testing.assert_close(found.z, within, rtol=0, atol=1e-9)
    strength = basis.turbulence_strength(within)
    assert strength is not None
    assert 0.05 < strength < 20  # not at a limit
    expected = 1 / strength if follow_r0 else 0.7
    assert found.calibration.aberration_weight == pytest.approx(expected, rel=1e-9)


def test_frames_that_show_nothing_leave_the_metric_of_the_prior(three_holes, explain):
    """Of the frame's own aberrations; those in common, which stay fixed, have another weight."""
    basis = turbulent_basis(three_holes, 3, 4, 0.25, 20.0)
    objective, state = explain(ExposureModel(three_holes, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2), basis))
    unseen = MyopicObjective(objective.model, objective.frames, 0 * objective.precision, objective.prior)
    found = laplace_precision(unseen, state.calibrated(aberration_weight=2.5))
    expected = 2.5 * torch.eye(basis.n_own, dtype=torch.float64).expand(len(state.z), -1, -1)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
