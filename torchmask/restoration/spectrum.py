"""The power spectrum of the object as its frames tell it, whatever its phases and theirs.

Turbulence drops out of the mean power of frames but for the mean power of their transfer functions, which aberrations
of the right strength have even where each is wrong. So while an object may still follow noise, its frames know how much
power it has, and with that how steep its slopes are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.restoration.change import Change
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import minimize_bounded
from torchmask.restoration.slopes import gradient, rate_in_light, rate_of_descent, rate_of_slopes
from torchmask.restoration.state import State

_ITERATIONS = 100
_LOWEST = 3.5  # times the spacing of frequencies: below it lies the power that the fit begins with
_STEEPEST = 10.0  # exponent, which frames of hardly more than noise do not tell
_GENTLE = 0.5  # rate by bright frames from which slopes are gentle: 0.12 to 0.36 of planets, 0.79 on of asteroids
_DOUBT = 2.0  # standard errors of which slopes have the benefit there: a ball of 0.36, error 0.23, has 0.57 with it
_GENTLE_FAINT = 0.22  # limit by faint frames, one error less: 0.03 to 0.17 of satellites, 0.28 on of balls
_OF_NOISE = 0.82  # rate found of gentle slopes below which an object follows noise: 0.3 to 0.78 of asteroids that do
_TOO_STEEP = 1.5  # times those of frames, one error less: 0.6 to 1.1 of what heat harms or leaves, 1.6 to 41 of others
_SMALLEST = 0.25  # the smallest factor on the rate found in scarce light: down to 0.125 tried
_STEEP = 0.14  # the highest rate of slopes that are steep there: 0.09 to 0.25 tried
_TELLING = math.log(3)  # error of a logarithm from which on scarce frames do not tell steep slopes: up to 13 is seen
_VAGUE = 100.0  # error of a logarithm above which nothing is known


class Power(NamedTuple):
    """An estimate of a power, with the standard error of its logarithm."""

    value: float
    error: float

    def off_by(self, errors: float) -> float:
        """Return the value so many standard errors higher."""
        return self.value * math.exp(max(-_VAGUE, min(errors * self.error, _VAGUE)))


def shows_gentle_slopes(objective: MyopicObjective, state: State, change: Change, *, faint: bool) -> bool:
    """Return whether the slopes of the object are gentle, as far as the power of its frames tells.

    Their rate is not below 0.5 by more than two standard errors then; by frames that are `faint` it is above 0.22 by
    one, even if those of the object in `state` are steep, as it may follow noise. Only the sum of its slopes is taken
    from it. Frames that change by hardly more than noise do not tell, nor does a single one.
    """
    return _tell(change) and _are_gentle(_sum_of_slopes(state), power_of_slopes(objective, state), faint=faint)


def is_too_steep(objective: MyopicObjective, state: State) -> bool:
    """Return whether the object follows noise: its squared slopes are more than those that the frames show.

    Their sum is above 1.5 times that of the frames, one standard error more.
    """
    slopes = float(torch.hypot(*gradient(state.image)).square().sum())
    return slopes > _TOO_STEEP * power_of_slopes(objective, state).off_by(1)


def rate_in_search(objective: MyopicObjective, state: State, change: Change) -> float:
    """Return the rate of slopes that the prior of a faint search suits, once its object is sharp; 0 if it has none.

    It is that of the object, 1 at most. Where that is below 0.82 although slopes are gentle, the object follows noise,
    and it is that of `rate_in_light`.
    """
    rate = rate_of_slopes(state.image)
    follows_noise = 0 < rate < _OF_NOISE and shows_gentle_slopes(objective, state, change, faint=True)
    return rate_in_light(change) if follows_noise else min(rate, 1.0)


def rate_in_noise(objective: MyopicObjective, state: State, change: Change, *, gentle: bool) -> float:
    """Return the rate of slopes that an integration suits, whose object was found together with uncertain aberrations.

    These bend to the noise of their frames, and an object that follows it has slopes that are steeper than the true
    ones. What the fit gains by that grows with the light, so from a light of 40 on slopes that are `gentle` have at
    least the rate light / 40, up to 2. Where frames change by hardly more than their noise, on the other hand, the
    prior has smoothed what it has found, and would smooth it the more. So below a chi-square of 2048 beyond noise, in a
    frame, the rate is at most 0.14 if the frames show steep slopes. Else it falls in proportion, down to a quarter, but
    no further than to 0.14. Slopes are steep there if the rate that the frames show, less one standard error, is below
    a half, and the error below a factor of three. A single frame does not tell. The limits are empirical.
    """
    rate, least = rate_of_slopes(state.image), rate_in_light(change)
    if change.is_scarce:
        steep = min(rate, _STEEP)
        return steep if _show_steep_slopes(objective, state) else max(steep, rate * max(change.shown, _SMALLEST))
    return max(rate, least) if gentle and least > 1 else rate


def rate_at_end(objective: MyopicObjective, state: State, change: Change, *, faint: bool, full: bool) -> float:
    """Return the rate that the prior of a last descent suits, for the slopes that a search has found.

    It is that of the object unless the frames show gentle slopes. Then it is that of `rate_of_descent` for what the
    frames show if that is higher, as the object follows noise.
    """
    rate, total = rate_of_slopes(state.image), _sum_of_slopes(state)
    if total == 0 or not _tell(change):
        return rate
    power = power_of_slopes(objective, state)
    gentle = _are_gentle(total, power, faint=faint)
    return rate_of_descent(max(rate, 3 * total / power.value), full=full) if gentle else rate


def power_of_slopes(objective: MyopicObjective, state: State) -> Power:
    """Return the sum of the squared slopes of the object that the frames show, below the cut-off frequency.

    Its spectrum is S = k / (1 + (nu / nu_0)^p) (Conan, Mugnier, Fusco, Michau & Rousset, Appl. Opt. 37, 4614, 1998),
    fitted to the frames' mean power P by Whittle's likelihood, the sum of ln m + P / m with m = S |h|^2 + noise. |h|^2
    is the mean power of the transfer functions of `state`. The error is that of random phases: it counts the object's
    own power once and that of noise in each frame.
    """
    frames, precision, _ = objective.scaled_data(state.with_noise_inflation(1.0).calibration)
    noise = float((1 / precision[precision > 0].double()).mean())
    power, passed = _mean_powers(objective, state, frames)
    nu_y, nu_x = objective.model.window.grid.frequencies(power.dtype, power.device)
    nu = torch.hypot(nu_y, nu_x)
    seen = (nu > 0) & (nu < min(objective.model.cutoff, 0.5))
    nu, passed, power = nu[seen], passed[seen], power[seen]
    steps = (2 * torch.sin(math.pi * nu_y)).square() + (2 * torch.sin(math.pi * nu_x)).square()
    fitted = _fit(nu, passed, power, noise)

    spectrum, by_x = _spectrum(fitted, nu)
    signal, total = passed * spectrum, float(steps[seen] @ spectrum)
    mean, slope = signal + noise, by_x @ steps[seen] / total
    variance = signal**2 + (2 * signal + noise) * noise / len(frames)
    relative = (by_x * passed / mean).T
    inverse = torch.linalg.pinv(relative.T @ relative, hermitian=True)
    spread = 2 * inverse @ (relative.T * (variance / mean**2)) @ relative @ inverse  # two frequencies hold one number
    return Power(total, float((slope @ spread @ slope).clamp(min=0).sqrt()))


@torch.no_grad()
def _mean_powers(objective: MyopicObjective, state: State, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean power (H, W) of the frames, and that of all that lies between an object and its frames."""
    point = torch.zeros_like(state.image)
    point[point.shape[0] // 2, point.shape[1] // 2] = 1.0
    power = passed = torch.zeros_like(frames[0], dtype=torch.float64)
    for part in objective.model.chunks(len(frames)):
        power = power + torch.fft.fft2(frames[part].double(), norm="ortho").abs().square().sum(0)
        passed = passed + torch.fft.fft2(objective.model(point, state.z[part]).double()).abs().square().sum(0)
    return power / len(frames), passed / len(frames)


def _spectrum(x: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
    """Return k / (1 + (nu / nu_0)^p) (F,), and its slopes (3, F) in the logarithms `x` (3,) of k, nu_0 and 1 / p."""
    exponent, ratio = torch.exp(-x[2]), nu.log() - x[1]
    above = torch.exp(exponent * ratio)
    value = torch.exp(x[0]) / (1 + above)
    fall = value * exponent * above / (1 + above)
    return value, torch.stack([value, fall, fall * ratio])


def _fit(nu: Tensor, passed: Tensor, power: Tensor, noise: float) -> Tensor:
    """Return the logarithms (3,) of k, nu_0 and 1 / p that Whittle's likelihood prefers; nu_0 fits into a frame."""
    lowest = float(nu.min())

    def cost(x: Tensor) -> tuple[float, Tensor]:
        spectrum, by_x = _spectrum(x, nu)
        expected = spectrum * passed + noise
        slope = by_x @ ((1 - power / expected) / expected * passed) / len(nu)
        return float((expected.log() + power / expected).mean()), slope

    first = (power / passed)[nu < _LOWEST * lowest].mean()
    start = torch.stack([first.log(), first.new_tensor(2 * lowest).log(), -first.new_tensor(3.0).log()])
    lower = start.new_tensor([-torch.inf, math.log(lowest), -math.log(_STEEPEST)])
    return minimize_bounded(cost, start, lower, max_iterations=_ITERATIONS).x


def _sum_of_slopes(state: State) -> float:
    return float(torch.hypot(*gradient(state.image)).sum())


def _show_steep_slopes(objective: MyopicObjective, state: State) -> bool:
    """Return whether scarce frames show that slopes are steep; see `rate_in_noise`."""
    power = power_of_slopes(objective, state)
    return power.error < _TELLING and 3 * _sum_of_slopes(state) < _GENTLE * power.off_by(1)


def _tell(change: Change) -> bool:
    """Return whether frames tell that slopes are gentle."""
    return change.n_frames > 1 and not change.is_scarce


def _are_gentle(total: float, power: Power, *, faint: bool) -> bool:
    """Return whether slopes whose sum is `total` and whose squares' sum is `power` are gentle; see
    `shows_gentle_slopes`."""
    if faint:
        return 3 * total > _GENTLE_FAINT * power.off_by(1)
    return 3 * total > _GENTLE * power.off_by(-_DOUBT)
