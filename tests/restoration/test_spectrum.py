"""The power of an object's slopes, as the power of its frames tells it."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.restoration import spectrum
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.change import Change
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.slopes import gradient, rate_of_descent, rate_of_slopes
from torchmask.restoration.spectrum import (
    Power,
    power_of_slopes,
    rate_at_end,
    rate_in_noise,
    rate_in_search,
    shows_gentle_slopes,
)
from torchmask.restoration.state import State
from torchmask.restoration.variation import TotalVariation

N_OBJECTS = 40
DARK = 5.0  # objects fall off as exp(-DARK r^2), with r = 1 in the middle of each side
ALIKE = 4 * DARK / math.pi  # area (sum of w^4) / (sum of w^2)^2 of that: so many frequencies hold one number
BRIGHT = Change(100.0, 8, 4096)


def squares_of(image):
    return float(sum((step**2).sum() for step in gradient(image)))


@pytest.fixture(scope="module")
def seen(five_holes):
    """Makes the objective and the true state of a random object of a known spectrum, far from the border."""

    def make(seed, side=64, noise=0.3, amplitude=50.0, n_frames=8, dtype=torch.float64):
        grid = Grid.nyquist(1.0, 550e-9, side, oversampling=1.2)
        basis = turbulent_basis(five_holes, 3, 0, 0.25, 20.0)
        model = ExposureModel(five_holes, grid, basis, dtype=dtype)
        generator = torch.Generator().manual_seed(seed)
        field = model.window.field
        nu_y, nu_x = field.frequencies(torch.float64)
        power = 1 / (1 + (torch.hypot(nu_y, nu_x) * 20) ** 3)
        white = torch.fft.fft2(torch.randn(field.shape, dtype=torch.float64, generator=generator), norm="ortho")
        image = amplitude * torch.fft.ifft2(white * power.sqrt(), norm="ortho").real
        y, x = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in field.shape)
        image = image * torch.exp(-DARK * (y[:, None] ** 2 + x**2))  # dark at the border
        z = torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=generator)
        blurred = model(image, z)
        frames = blurred + noise * torch.randn(blurred.shape, dtype=torch.float64, generator=generator).to(dtype)
        precision = torch.full((1, 1, 1), noise**-2, dtype=dtype)
        objective = MyopicObjective(model, frames, precision, TotalVariation())
        told = objective.neutral_calibration()
        calibration = type(told)(torch.ones_like(told.transmission), told.noise_inflation, 1.0)
        return objective, State(image, z, calibration)

    return make


def at_rate(seen, rate, **frames):
    """An object that is taken to have slopes of this rate, beside frames of what it is."""
    objective, state = seen(0, **frames)
    return objective, replace(state, image=state.image * rate_of_slopes(state.image) / rate)


def below_cutoff(objective, image):
    nu_y, nu_x = objective.model.window.field.frequencies(torch.float64)
    inside = torch.hypot(nu_y, nu_x) < min(objective.model.cutoff, 0.5)
    return torch.fft.ifft2(torch.fft.fft2(image) * inside).real


@pytest.fixture(scope="module")
def estimates(seen):
    """Estimates for random objects, as logarithms of what they are too large, and their errors."""

    def make(side, noise):
        away, errors = [], []
        for seed in range(N_OBJECTS):
            objective, state = seen(seed, side, noise=noise)
            found = power_of_slopes(objective, state)
            away.append(math.log(found.value / squares_of(below_cutoff(objective, state.image))))
            errors.append(found.error)
        return torch.tensor(away), torch.tensor(errors)

    return make


def test_the_frames_tell_the_power_of_slopes_the_better_the_more_they_show(estimates):
    """The mean of random objects is right within four standard errors, and single ones scatter by the error told.

    Their variance has the scatter of a chi-square of as many degrees of freedom, and up to as many times that as the
    shape of the objects makes frequencies alike. Errors fall with the number of frequencies.
    """
    told, scatter = [], 4 * (2 / (N_OBJECTS - 1)) ** 0.5
    for side, noise in ((64, 1.0), (64, 0.3), (96, 0.3)):
        away, errors = estimates(side, noise)
        told.append(float(errors.mean()))
        assert abs(float(away.mean())) < 4 * told[-1] / N_OBJECTS**0.5, (side, noise)
        assert 1 - scatter < float(away.var()) / told[-1] ** 2 < (1 + scatter) * ALIKE, (side, noise)
    assert told[0] > told[1] > told[2]
    assert told[2] / told[1] == pytest.approx(64 / 96, rel=0.2)


@pytest.mark.parametrize("knee", [0.02, 0.2, 3.0])
@pytest.mark.parametrize("exponent", [0.5, 3.0, 10.0])
def test_the_slopes_of_the_spectrum_are_those_by_autograd(knee, exponent):
    """At knees within the frequencies and beyond them."""
    nu = torch.linspace(0.01, 0.5, 20, dtype=torch.float64)
    x = torch.tensor([0.3, math.log(knee), -math.log(exponent)], dtype=torch.float64)
    value, by_x = spectrum._spectrum(x, nu)
    torch.testing.assert_close(value, math.exp(0.3) / (1 + (nu / knee) ** exponent), rtol=1e-12, atol=0)
    expected = torch.autograd.functional.jacobian(lambda place: spectrum._spectrum(place, nu)[0], x).T
    torch.testing.assert_close(by_x, expected, rtol=1e-10, atol=1e-300)


def test_the_fitted_spectrum_is_the_likeliest():
    """Of mean powers without scatter it is the true one; with scatter, its likelihood has no slope left."""
    nu = torch.linspace(0.01, 0.5, 500, dtype=torch.float64)
    passed, truth = 1 / (1 + 20 * nu), torch.tensor([4.0, math.log(0.06), -math.log(3.0)], dtype=torch.float64)
    power = spectrum._spectrum(truth, nu)[0] * passed + 0.1
    torch.testing.assert_close(spectrum._fit(nu, passed, power, 0.1), truth, rtol=1e-4, atol=0)
    scatter = torch.empty_like(nu).exponential_(generator=torch.Generator().manual_seed(0))
    found = spectrum._fit(nu, passed, power * scatter, 0.1).requires_grad_()
    mean = spectrum._spectrum(found, nu)[0] * passed + 0.1
    (slope,) = torch.autograd.grad((mean.log() + power * scatter / mean).mean(), found)
    assert slope.abs().max() < 1e-4


def test_more_frames_tell_the_power_of_slopes_better_as_far_as_noise_hides_it(seen):
    """Four times as many halve the error of noise, but not that of the one object that they all show."""
    ratios = []
    for noise in (1.5, 0.05):
        few, many = (sum(power_of_slopes(*seen(n, noise=noise, n_frames=t)).error for n in range(5)) for t in (8, 32))
        ratios.append(many / few)
    assert 0.5 < ratios[0] < 0.75 < ratios[1] < 1.0


@pytest.mark.parametrize("steeper", [0.9, 1.1])
def test_an_object_is_too_steep_if_its_slopes_are_above_those_of_the_frames(seen, monkeypatch, steeper):
    """Squared slopes of 1.5 times those that frames show, one standard error more, are the limit."""
    objective, state = seen(0)
    squares = squares_of(state.image)
    monkeypatch.setattr(spectrum, "power_of_slopes", lambda *given: Power(squares / 1.5 / math.exp(0.2) / steeper, 0.2))
    assert spectrum.is_too_steep(objective, state) == (steeper > 1)


def test_what_follows_noise_is_too_steep_and_the_true_object_is_not(seen):
    for seed in range(5):
        objective, state = seen(seed)
        assert not spectrum.is_too_steep(objective, state)
        rough = torch.randn(state.image.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        rough = state.image + 2 * rough * (squares_of(state.image) / squares_of(rough)) ** 0.5
        assert spectrum.is_too_steep(objective, replace(state, image=rough))


def test_the_power_of_slopes_does_not_depend_on_phases_that_are_wrong(seen):
    """Pistons that all frames have in common, which the object takes over; nor on the image itself, or the precision
    of numbers."""
    objective, state = seen(0)
    right = power_of_slopes(objective, state)
    pistons = objective.model.aberrations.parameters_of_pistons(torch.tensor([0.0, 2.0, -1.0, 3.0, 0.5]))
    for other in (replace(state, z=state.z + pistons), replace(state, image=torch.ones_like(state.image))):
        found = power_of_slopes(objective, other)
        assert abs(math.log(found.value / right.value)) < right.error
    single = power_of_slopes(*seen(0, dtype=torch.float32))
    assert single.value == pytest.approx(right.value, rel=1e-3)


def test_frames_of_noise_alone_tell_nothing(seen):
    objective, state = seen(0, noise=1e3)
    found = power_of_slopes(objective, state)
    assert found.off_by(1) > squares_of(state.image)
    assert math.isfinite(found.off_by(1))
    assert Power(2.0, 1e4).off_by(1) > 1e40


@pytest.mark.parametrize(("amplitude", "gentle"), [(50.0, True), (1000.0, False)])
def test_an_object_that_follows_noise_is_known_by_its_frames(amplitude, gentle, seen):
    """What it has found is steep either way; frames that show little, and one alone, do not tell."""
    objective, state = seen(0, amplitude=amplitude)
    rough = torch.randn(state.image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    noisy = replace(state, image=state.image + 20 * rough * (state.image.abs() > 0.1 * state.image.max()))
    assert rate_of_slopes(noisy.image) < 0.4
    for found in (state, noisy):
        assert shows_gentle_slopes(objective, found, BRIGHT, faint=False) is gentle
        for silent in (BRIGHT._replace(n_frames=1), Change(0.9, 8, 4096)):
            assert not shows_gentle_slopes(objective, found, silent, faint=False)


@pytest.mark.parametrize(("errors", "gentle"), [(1.5, True), (2.5, False)])
def test_bright_frames_tell_gentle_slopes_more_sharply(errors, gentle, seen):
    """Those of a rate of so many standard errors below a half; by faint frames they are gentle anyway."""
    objective, state = seen(0)
    total, power = float(torch.hypot(*gradient(state.image)).sum()), power_of_slopes(objective, state)
    scale = 3 * total / power.value / (0.5 * math.exp(-errors * power.error))
    objective, state = seen(0, amplitude=50 * scale, noise=0.3 * scale)
    assert shows_gentle_slopes(objective, state, BRIGHT, faint=False) is gentle
    assert shows_gentle_slopes(objective, state, BRIGHT, faint=True)


@pytest.mark.parametrize("name", ["mgs_1e6_mask", "skylab_1e7_mask"])
def test_slopes_of_planets_in_bright_frames_are_not_gentle(name, shared_stack):
    """Any aberrations of the right strength tell: the heavier prior of gentle slopes would cost a quarter of the score.

    Those of MGS, whose light is smooth, have a rate of 0.32 and are the ones nearest to the limit.
    """
    stack = shared_stack(name)
    method = MyopicDeconvolution(stack.aperture, stack.grid, 6, r0=1 / 7)
    objective = method.objective(stack.frames)
    image = torch.zeros(objective.model.window.field.shape, dtype=torch.float64)
    image[tuple(slice((n - 128) // 2, (n - 128) // 2 + 128) for n in image.shape)] = stack.object / stack.object.mean()
    shape = (len(stack.frames), objective.model.aberrations.n_parameters)
    z = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    state = State(image, z, objective.neutral_calibration())
    assert not shows_gentle_slopes(objective, state, Change(20.0, 20, 128**2), faint=False)


def test_the_rate_of_a_search_is_that_of_its_object_unless_it_follows_noise(seen, monkeypatch):
    """At most 1 then; slopes that are gentle but found to be steep have that of the light."""
    objective, state = seen(0)
    change = Change(6.0, 10, 4096)
    for own in (0.3, 0.81, 0.83, 1.7):
        found = replace(state, image=state.image * rate_of_slopes(state.image) / own)
        for gentle, expected in ((False, min(own, 1.0)), (True, 1.5 if own < 0.82 else min(own, 1.0))):
            monkeypatch.setattr(spectrum, "shows_gentle_slopes", lambda *given, answer=gentle, **how: answer)
            assert rate_in_search(objective, found, change) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("rate", "light", "expected"),
    [
        (0.8, 39.0, 0.8),
        (0.8, 41.0, 1.025),
        (0.8, 60.0, 1.5),
        (0.8, 80.0, 2.0),
        (0.8, 1e4, 2.0),
        (2.5, 1e4, 2.5),
        (0.1, 60.0, 1.5),
    ],
)
def test_gentle_slopes_have_a_higher_rate_the_more_light_has_bent_them(rate, light, expected, seen):
    """Up to 2 and never a lower one, however steep those found are; others are taken as they are."""
    objective, state = at_rate(seen, rate)
    change = Change(light / 20, 20, 4096)
    assert rate_in_noise(objective, state, change, gentle=True) == pytest.approx(expected, rel=1e-12)
    assert rate_in_noise(objective, state, change, gentle=False) == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize("n_pixels", [4096, 16384])
@pytest.mark.parametrize("n_frames", [2, 10, 200])
@pytest.mark.parametrize("gentle", [False, True])
@pytest.mark.parametrize(
    ("beyond_noise", "factor"), [(2400, 1.0), (2049, 1.0), (1638.4, 0.8), (819.2, 0.4), (400, 0.25), (-400, 0.25)]
)
def test_in_frames_of_hardly_more_than_noise_slopes_are_steeper(
    beyond_noise, factor, n_frames, n_pixels, gentle, seen, monkeypatch
):
    """However many there are, and however fine their pixels; nothing is held by the light there.

    Where the rate that frames show is below a half, less one standard error, and that error below a factor of three, it
    is at most 0.14, which others are at least if they are not steeper themselves.
    """
    change = Change(beyond_noise / n_pixels + 1 - 1 / n_frames, n_frames, n_pixels)
    assert change.is_scarce == (factor < 1)
    for rate in (0.05, 0.3, 1.6):
        objective, state = at_rate(seen, rate)
        total = float(torch.hypot(*gradient(state.image)).sum())
        for less_one, error, steep in ((0.49, 1.09, True), (0.51, 1.09, False), (0.49, 1.11, False)):
            power = Power(3 * total / less_one / math.exp(error), error)
            monkeypatch.setattr(spectrum, "power_of_slopes", lambda *given, power=power: power)
            expected = min(rate, 0.14) if steep else max(rate * factor, min(rate, 0.14))
            if factor == 1:
                expected = max(rate, min(change.light / 40, 2.0)) if gentle and change.light > 40 else rate
            assert rate_in_noise(objective, state, change, gentle=gentle) == pytest.approx(expected, rel=1e-9)


def test_a_single_frame_does_not_tell_how_much_frames_change(seen):
    assert rate_in_noise(*at_rate(seen, 0.7), Change(0.0, 1, 4096), gentle=False) == pytest.approx(0.7, rel=1e-12)


def test_a_blank_object_has_no_rate(seen):
    objective, state = seen(0)
    blank = replace(state, image=torch.zeros_like(state.image))
    assert rate_in_noise(objective, blank, Change(1.0, 8, 4096), gentle=False) == 0


def test_the_power_of_frames_tells_satellites_from_balls_and_noise_neither(seen):
    """Objects that a search has blurred, so that their own slopes are gentle, have the rate of steep ones if they are
    steep; frames of noise alone leave that of balls."""
    for amplitude, noise, expected in ((1000.0, 6.0, 0.14), (50.0, 0.3, 0.3), (1000.0, 2e4, 0.3)):
        objective, state = at_rate(seen, 1.2, amplitude=amplitude, noise=noise)
        assert rate_in_noise(objective, state, Change(0.95, 8, 4096), gentle=False) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("shown", [0.6, 1.4])
def test_the_rate_at_the_end_is_higher_for_gentle_slopes_and_that_of_the_frames_if_these_show_more(
    shown, full, seen, monkeypatch
):
    """Squared slopes that are fewer by a factor have a rate that is higher by it, for as steep an object."""
    objective, state = seen(0)
    state = replace(state, image=state.image * rate_of_slopes(state.image) / 0.4)
    squares = squares_of(state.image)
    monkeypatch.setattr(spectrum, "power_of_slopes", lambda *given: Power(squares / shown, 0.1))
    gentle_rate = rate_of_descent(0.4 * max(shown, 1.0), full=full)
    for gentle, expected in ((False, 0.4), (True, gentle_rate)):
        monkeypatch.setattr(spectrum, "_are_gentle", lambda *given, answer=gentle, **how: answer)
        assert rate_at_end(objective, state, BRIGHT, faint=False, full=full) == pytest.approx(expected, rel=1e-9)
    dark = replace(state, image=torch.zeros_like(state.image))
    assert rate_at_end(objective, dark, BRIGHT, faint=False, full=full) == 0
    single = BRIGHT._replace(n_frames=1)
    assert rate_at_end(objective, state, single, faint=False, full=full) == pytest.approx(0.4, rel=1e-9)
