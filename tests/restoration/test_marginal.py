"""Aberrations integrated out: their samples against quadrature, their Hessian against autograd, what is gained."""

from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration import marginal, sampler
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.descent import descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS, minimize_bounded
from torchmask.restoration.sampler import AberrationSampler, laplace_precision
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation

GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
BRIEF = Schedule(moves=3, renewal=2, segment=3)


def one_piston(noise, n_frames, identical=False, weight=1.0):
    """Frames of a block through two holes, whose only aberration is the one difference of their pistons."""
    pair = SparseAperture([[-0.3, 0.0], [0.3, 0.05]], 0.36, 1.0)
    model = ExposureModel(pair, GRID, turbulent_basis(pair, 1, 0, 2.0, 20.0))
    generator = torch.Generator().manual_seed(0)
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[13:17, 12:15] = 40.0
    z = torch.randn(n_frames, 1, dtype=torch.float64, generator=generator)
    frames = model(image, z)
    frames = frames + noise * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    if identical:
        frames = frames[:1].expand_as(frames).clone()
    ones = torch.ones(n_frames, dtype=torch.float64)
    objective = MyopicObjective(model, frames, torch.tensor([[[noise**-2]]]).double(), TotalVariation(weight))
    return objective, State(image, z, Calibration(ones, ones, 1.0))


def energies(objective, state, grid):
    """Cost (Z, T) of every frame at each piston of `grid` (Z,)."""
    columns = [z.expand(len(state.z), 1) for z in grid]
    return torch.stack([objective.frame_costs(state.image, z, state.calibration) for z in columns])


def marginal_cost(objective, image):
    """Minus the logarithm of the object's posterior, by the trapezoidal rule over the piston; autograd goes through."""
    grid = torch.linspace(-6, 6, 49, dtype=torch.float64)[:, None]
    errors = objective.model(image, grid)[:, None] - objective.frames
    energy = 0.5 * (objective.precision * errors**2).sum((-2, -1)) + 0.5 * grid**2
    return objective.prior(image) - torch.logsumexp(-energy, 0).sum()


def least_marginal_cost(objective, image):
    """What 60 iterations in the object alone lower it to."""

    def cost(x):
        leaf = x.view_as(image).detach().requires_grad_()
        value = marginal_cost(objective, leaf)
        value.backward()
        return float(value.detach()), leaf.grad.flatten()

    start = image.flatten()
    return minimize_bounded(cost, start, torch.zeros_like(start), max_iterations=60).value


@pytest.mark.parametrize("size", [0.5, 1.9])
def test_samples_follow_the_posterior_of_a_piston(size):
    """Which is wide and skew: moments by quadrature, within four standard errors of independent chains."""
    n_frames = 200
    objective, state = one_piston(8.0, n_frames, identical=True)
    grid = torch.linspace(-6, 6, 241, dtype=torch.float64)
    weights = (-energies(*one_frame(objective, state), grid)[:, 0]).softmax(0)
    generator = torch.Generator().manual_seed(1)
    chains = AberrationSampler(objective, replace(state, z=torch.zeros_like(state.z)), generator)
    z, accepted = chains.sample(state, 40, size)
    assert 0.3 < accepted < 1
    for moment in (lambda x: x, lambda x: x**2, lambda x: (3 * x).cos()):
        expected = float((weights * moment(grid)).sum())
        error = float((weights * moment(grid) ** 2).sum() - expected**2) ** 0.5 / n_frames**0.5
        assert abs(float(moment(z).mean()) - expected) < 4 * error


@pytest.mark.parametrize("heat", [1.0, 4.0])
def test_heated_samples_follow_the_posterior_in_more_noise(heat, monkeypatch):
    """Of one piston, with the object held: moments by quadrature, within four standard errors of independent chains."""
    n_frames = 200
    objective, state = one_piston(8.0, n_frames, identical=True)
    for name in ("settle", "unwrap_pistons"):
        monkeypatch.setattr(sampler, name, lambda objective, state, *rest: state)
    grid = torch.linspace(-6, 6, 241, dtype=torch.float64)
    cost = energies(*one_frame(objective, state), grid)[:, 0]
    weights = (-(cost - grid**2 / 2) / heat - grid**2 / 2).softmax(0)
    generator = torch.Generator().manual_seed(1)
    schedule, how = Schedule(moves=40, move_size=0.5), {"follow_r0": False}
    ((found, _),) = sampler.sample_rounds(objective, state, [heat], schedule, generator, **how)
    assert torch.allclose(found.calibration.noise_inflation, heat * state.calibration.noise_inflation)
    for moment in (lambda x: x, lambda x: x**2):
        expected = float((weights * moment(grid)).sum())
        error = float((weights * moment(grid) ** 2).sum() - expected**2) ** 0.5 / n_frames**0.5
        assert abs(float(moment(found.z).mean()) - expected) < 4 * error


def test_each_round_has_its_own_heat(explain):
    """Of the noise that the state came with, frame by frame."""
    objective, state = explain(n_frames=2)
    noise = torch.tensor([1.0, 1.5], dtype=torch.float64)
    state = replace(state, calibration=replace(state.calibration, noise_inflation=noise))
    generator = torch.Generator().manual_seed(0)
    rounds = sampler.sample_rounds(objective, state, [4.0, 2.0, 1.0], BRIEF, generator, follow_r0=False)
    assert [found.calibration.noise_inflation.tolist() for found, _ in rounds] == [[4.0, 6.0], [2.0, 3.0], [1.0, 1.5]]


def test_the_metric_of_moves_is_renewed_now_and_then(explain, monkeypatch):
    objective, state = explain(n_frames=2)
    made = []

    class Counted(AberrationSampler):
        def __init__(self, objective, state, generator, *, shared):
            super().__init__(objective, state, generator, shared=shared)
            made.append(state)

    monkeypatch.setattr(sampler, "AberrationSampler", Counted)
    rounds = sampler.sample_rounds(
        objective, state, 5 * [1.0], BRIEF, torch.Generator().manual_seed(0), follow_r0=False
    )
    found = [now for now, _ in rounds]
    assert len(made) == 3  # before rounds 0, 2 and 4
    assert torch.equal(made[2].z, found[3].z)


@pytest.mark.parametrize("alone", [False, True])
def test_samples_that_are_heated_alone_leave_the_object_its_noise(explain, monkeypatch, alone):
    objective, state = explain(n_frames=2)
    settled, metrics = [], []
    monkeypatch.setattr(
        sampler, "settle", lambda objective, state, n: settled.append(state.calibration.noise_inflation) or state
    )
    moved = AberrationSampler.sample
    monkeypatch.setattr(
        AberrationSampler,
        "sample",
        lambda self, state, *rest: (
            metrics.append((self.factor.ndim, float(state.calibration.noise_inflation[0]))) or moved(self, state, *rest)
        ),
    )
    rounds = sampler.sample_rounds(
        objective, state, [4.0, 2.0], BRIEF, torch.Generator().manual_seed(0), follow_r0=False, alone=alone
    )
    noise = [float(found.calibration.noise_inflation[0]) for found, _ in rounds]
    assert metrics == [(2 if alone else 3, 4.0), (2 if alone else 3, 2.0)]  # one metric, or one for each frame
    assert noise == [float(of[0]) for of in settled] == ([1.0, 1.0] if alone else [4.0, 2.0])


def test_a_shared_metric_keeps_exact_samples_exact_and_takes_larger_moves(explain):
    """True aberrations, drawn from the prior, are a sample of the posterior, and remain one: 300 frames tell."""
    objective, state = explain(n_frames=300, noise=0.3)
    accepted = []
    for shared in (True, False):
        some = slice(300 if shared else 50)  # of which the shares are known to a hundredth
        seen, now = objective.of_frames(some), state.of_frames(some)
        chains = AberrationSampler(seen, now, torch.Generator().manual_seed(0), shared=shared)
        z, share = chains.sample(now, 60, 0.3)
        accepted.append(share)
        if shared:
            grown = 0.5 * (z.square() - state.z.square()).sum(1)
            assert abs(float(grown.mean())) < 4 * float(grown.std()) / len(z) ** 0.5
            assert not torch.allclose(z, state.z, atol=0.1)
    assert 1 - accepted[0] < 0.5 * (1 - accepted[1])


def one_frame(objective, state):
    return objective.of_frames(slice(0, 1)), state.of_frames(slice(0, 1))


def test_without_data_samples_follow_the_prior(explain):
    """Around what is expected, with the weight that the prior has."""
    objective, state = explain(n_frames=60)
    centre = 0.3 * torch.ones_like(objective.centre)
    objective = MyopicObjective(
        objective.model, objective.frames, 0 * objective.precision, objective.prior, centre=centre
    )
    state = replace(state, calibration=replace(state.calibration, aberration_weight=4.0))
    z, _ = AberrationSampler(objective, state, torch.Generator().manual_seed(0)).sample(state, 30, 0.7)
    n = z.numel()
    assert abs(float(z.mean()) - 0.3) < 4 * 0.5 / n**0.5
    assert abs(float(z.var()) / 0.25 - 1) < 4 * (2 / n) ** 0.5


def test_the_hessian_is_that_of_autograd(explain):
    objective, state = explain(n_frames=2)
    generator = torch.Generator().manual_seed(0)
    precision = torch.rand(objective.frames.shape, dtype=torch.float64, generator=generator)
    objective = MyopicObjective(objective.model, objective.frames, precision, objective.prior)
    calibration = Calibration(torch.tensor([0.8, 1.2]).double(), torch.tensor([1.0, 2.0]).double(), 0.7)
    state = replace(state, calibration=calibration)
    found = laplace_precision(objective, state)
    weights = objective.scaled_data(calibration)[1]
    for t in range(2):
        jacobian = torch.autograd.functional.jacobian(
            lambda z: objective.model(state.image, z[None])[0], state.z[t]
        ).flatten(0, 1)
        expected = jacobian.T @ (weights[t].flatten()[:, None] * jacobian) + 0.7 * torch.eye(state.z.shape[1]).double()
        assert torch.allclose(found[t], expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))


def test_the_object_is_where_the_marginal_cost_is_least():
    """Which quadrature tells where a frame has a single aberration: nothing is left of what the joint mode leaves."""
    objective, state = one_piston(10.0, 40, weight=0.3)
    joint = descend(objective, state, 400, ProjectedLBFGS(), lambda *_: None)
    schedule, how = Schedule(moves=5), {"seed": 0, "follow_r0": False}
    found, evaluations = integrate_aberrations(objective, joint, 30, schedule, ProjectedLBFGS(), **how)
    before, after = (float(marginal_cost(objective, at.image)) for at in (joint, found))
    assert before > after
    assert after - least_marginal_cost(objective, found.image) < 0.05 * (before - after)
    assert evaluations >= 30 * 5


def test_aberrations_end_at_what_fits_the_object_best():
    objective, state = one_piston(1.5, 6)
    found, _ = integrate_aberrations(objective, state, 4, Schedule(), ProjectedLBFGS(), seed=0, follow_r0=False)
    slope = objective.with_changes(free=Free.ABERRATIONS).value_and_gradients(found.image, found.z, found.calibration)
    assert float(slope.aberration_gradient.abs().max()) < 1e-3  # against 1 where the prior alone moves z by its unit


def test_common_aberrations_stay_while_those_of_frames_are_sampled(three_holes, explain):
    basis = turbulent_basis(three_holes, 3, 4, 0.25, 20.0)
    objective, state = explain(ExposureModel(three_holes, GRID, basis))
    z, _ = AberrationSampler(objective, state, torch.Generator().manual_seed(0)).sample(state, 3, 0.3)
    assert torch.equal(z[:, basis.n_own :], state.z[:, basis.n_own :])
    assert not torch.equal(z, state.z)


def test_one_seed_one_result_and_a_record_of_every_round(explain):
    objective, state = explain()
    records = []
    how = {"callback": records.append, "follow_r0": True}
    first, again, other = (
        integrate_aberrations(objective, state, 4, BRIEF, ProjectedLBFGS(), seed=seed, **how)[0] for seed in (0, 0, 1)
    )
    assert torch.equal(first.image, again.image)
    assert torch.equal(first.z, again.z)
    assert not torch.equal(first.image, other.image)
    assert [record.step for record in records] == [1, 2, 3, 4] * 3
    assert all(record.stage == "integration" and 0 <= record.scalars["accepted"] <= 1 for record in records)


@pytest.mark.parametrize("astray", [False, True])
def test_what_has_gone_astray_is_sampled_in_noise_that_falls(monkeypatch, astray):
    """From three times the noise, by the same factor in every round, until four of ten are over."""
    objective, state = one_piston(10.0, 3)
    asked = []

    def rounds(objective, state, heats, schedule, generator, *, follow_r0, alone):
        asked.append((list(heats), alone))
        return iter([(state, 1.0)] * 10)

    monkeypatch.setattr(marginal, "sample_rounds", rounds)
    integrate_aberrations(objective, state, 10, BRIEF, ProjectedLBFGS(), seed=0, follow_r0=False, astray=astray)
    expected = [3.0, 3**0.75, 3**0.5, 3**0.25] + 6 * [1.0] if astray else 10 * [1.0]
    ((heats, alone),) = asked
    assert heats == pytest.approx(expected)
    assert alone is astray


def test_the_object_is_the_mean_of_the_later_rounds(monkeypatch):
    objective, state = one_piston(10.0, 10)
    settled, fit = [], sampler.settle

    def settle(*arguments):
        settled.append(fit(*arguments))
        return settled[-1]

    monkeypatch.setattr(sampler, "settle", settle)
    found, _ = integrate_aberrations(objective, state, 5, BRIEF, ProjectedLBFGS(), seed=0, follow_r0=False)
    assert len(settled) == 5
    torch.testing.assert_close(found.image, sum(one.image for one in settled[2:]) / 3)
    assert not torch.allclose(found.image, settled[-1].image)
