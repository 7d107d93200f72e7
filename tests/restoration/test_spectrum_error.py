"""The error of the power of slopes against a direct computation, and the noise that it is told from."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.restoration import spectrum
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.spectrum import power_of_slopes
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation


def seen(five_holes, noise, n_frames, precision=None):
    """Objective and state of a random object with a falling spectrum."""
    model = ExposureModel(
        five_holes, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2), turbulent_basis(five_holes, 3, 0, 0.25, 20.0)
    )
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    nu = torch.hypot(*model.window.field.frequencies(torch.float64))
    spread = 50 * (1 + (20 * nu) ** 3).rsqrt()
    image = torch.fft.ifft2(torch.fft.fft2(normal(*model.window.field.shape)) * spread).real
    z = normal(n_frames, model.aberrations.n_parameters)
    frames = model(image, z) + noise * normal(n_frames, 32, 32)
    precision = torch.full((1, 1, 1), noise**-2, dtype=torch.float64) if precision is None else precision
    ones = torch.ones(n_frames, dtype=torch.float64)
    return MyopicObjective(model, frames, precision, TotalVariation()), State(image, z, Calibration(ones, ones, 1.0))


@pytest.mark.parametrize(("noise", "n_frames"), [(0.05, 2), (1.0, 2), (1.0, 20), (8.0, 6)])
def test_the_error_of_the_power_of_slopes_is_that_of_its_fit_to_random_powers(noise, n_frames, five_holes):
    """To first order: how the sum of squared slopes moves with the mean power at each frequency, times the scatter of
    that, added in squares over one half of the frequencies, as the other half is the same.

    At a frequency the object is one complex normal number a of power s, and frames are a + n_t with noise n_t of power
    n. The mean of |a + n_t|^2 over T frames has the variance s^2 + (2 s n + n^2) / T. A fit by likelihood, the sum of
    ln m + P / m, moves by (sum m' m'^T / m^2)^-1 m' / m^2 times what a power P moves, m' its slopes.
    """
    objective, state = seen(five_holes, noise, n_frames)
    power, passed = spectrum._mean_powers(objective, state, objective.frames)
    nu_y, nu_x = (nu.expand(32, 32) for nu in objective.model.window.grid.frequencies(torch.float64))
    nu = torch.hypot(nu_y, nu_x)
    below = (nu > 0) & (nu < objective.model.cutoff)
    half = below & ((nu_x > 0) | ((nu_x == 0) & (nu_y > 0)))
    assert 2 * int(half.sum()) == int(below.sum())
    x = spectrum._fit(nu[below], passed[below], power[below], noise**2)

    def mean(x):
        return passed[half] * torch.exp(x[0]) / (1 + (nu[half] / torch.exp(x[1])) ** torch.exp(-x[2]))

    def total(x):
        squares = 4 * ((math.pi * nu_y[half]).sin() ** 2 + (math.pi * nu_x[half]).sin() ** 2)
        return 2 * (squares * mean(x) / passed[half]).sum()

    signal, slopes = mean(x), torch.autograd.functional.jacobian(mean, x)
    expected = signal + noise**2
    moves = torch.linalg.solve(slopes.T @ (slopes / expected[:, None] ** 2), (slopes / expected[:, None] ** 2).T)
    scatter = signal**2 + (2 * signal * noise**2 + noise**4) / n_frames
    by_power = torch.autograd.functional.jacobian(total, x) @ moves / total(x)
    found = power_of_slopes(objective, state)
    assert found.value == pytest.approx(float(total(x)), rel=1e-9)
    assert found.error == pytest.approx(float((by_power**2 * scatter).sum().sqrt()), rel=1e-6)


def test_the_power_of_slopes_is_told_from_the_noise_as_given(five_holes):
    """Which is the mean variance of valid pixels, whatever the noise that a descent has assumed."""
    generator = torch.Generator().manual_seed(1)
    variance = 0.1 + torch.rand(4, 32, 32, dtype=torch.float64, generator=generator)
    valid = torch.rand(4, 32, 32, generator=generator) > 0.1
    even, uneven = 1 / variance[valid].mean(), torch.where(valid, 1 / variance, 0.0)
    expected = power_of_slopes(*seen(five_holes, 0.7, 4, even.expand(4, 32, 32)))
    objective, state = seen(five_holes, 0.7, 4, uneven)
    for assumed in (state, state.with_noise_inflation(9.0)):
        found = power_of_slopes(objective, assumed)
        assert found.value == pytest.approx(expected.value, rel=1e-9)
        assert found.error == pytest.approx(expected.error, rel=1e-9)
