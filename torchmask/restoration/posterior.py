"""How far a restoration can be trusted: standard deviations of object and aberrations, by Laplace's approximation.

Around the restoration the cost is taken as quadratic, the misfit by its Gauss-Newton Hessian in object and aberrations
jointly, so that each carries the uncertainty of the other. Total variation has no useful curvature: nearly infinite in
flat parts, zero across edges. In its place stands the Gaussian prior that the restored object suggests: independent
gradients, whose variance follows their local mean square, that of what has been lost included (by expectation
maximisation).

Samples of the posterior solve the quadratic problem with data and priors drawn anew (Papandreou & Yuille, Adv. Neural
Inf. Process. Syst. 23, 1858, 2010), by conjugate gradients.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.metrics import lowpass
from torchmask.optics.conjugate import Operator, conjugate_gradients
from torchmask.restoration.adjoint import curvature
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placement import slopes_of_frames
from torchmask.restoration.priors import divergence, gradient
from torchmask.restoration.state import State

_REACH = 0.7  # resolution elements (1 / cut-off) over which gradients are alike: 0.5 to 1.4 tried, docs/restoration.md
_ROUNDS, _FEW = 3, 6  # of expectation maximisation, and its samples, which the mean over the reach makes enough
_LEAST = 1e-6  # of the largest: dark parts have a prior too, and aberrations without curvature a scale and a hold
_BATCH = 8  # samples at once, each of which takes the memory of several stacks
_ITERATIONS = 50  # of conjugate gradients: variances of what is below the cut-off are within 3 % of their limit then


def standard_deviations(
    objective: MyopicObjective, state: State, cutoff: float, photon_share: float, n_samples: int
) -> tuple[Tensor, Tensor]:
    """Of the object (H', W') below `cutoff` [cycles/pixel], and `n_samples` (S, T, K) of the aberrations.

    The samples scatter around zero as the truth does around `state`; what is not free does not vary. The variance of
    the object is averaged over the reach of its prior, for which few samples are enough. `photon_share` is the part of
    the noise variance that is photon noise, which bright pixels have more of.
    """
    generator = torch.Generator().manual_seed(0)
    reach = _REACH / cutoff
    slope, power = objective.object_quadratic(state.image, state.z, state.calibration)
    prior = _gradient_prior(power, state.image, reach, generator)
    sizes = [min(_BATCH, n_samples - start) for start in range(0, n_samples, _BATCH)]
    drawn = [_sample(objective, state, power, prior, photon_share, size, generator) for size in sizes]
    objects, aberrations = (torch.cat(part) for part in zip(*drawn, strict=True))
    off = lowpass(_bias(state.image, slope, power, prior), cutoff).square() if Free.OBJECT in objective.free else 0.0
    variance = smooth(lowpass(objects, cutoff).square().mean(0) + off, reach)
    return variance.clamp(min=0).sqrt(), aberrations


def place_deviations(objective: MyopicObjective, state: State, cutoff: float) -> Tensor:
    """Standard deviations (2,) of the mask's turn [rad] and shrinkage, with all else as uncertain as it is.

    What object and aberrations can imitate of the frames' slopes tells nothing of the mask (Schur's complement).
    """
    generator = torch.Generator().manual_seed(0)
    _, power = objective.object_quadratic(state.image, state.z, state.calibration)
    prior = _gradient_prior(power, state.image, _REACH / cutoff, generator)
    joint = JointHessian(objective, state, power, prior, generator)
    slopes = slopes_of_frames(objective.model, state.image, state.z)
    imitated = joint.tangent.forward(*joint.solve(*joint.tangent.adjoint(joint.precision * slopes)))
    told = torch.einsum("stij,utij->su", (joint.precision * slopes).double(), (slopes - imitated).double())
    return torch.linalg.inv((told + told.T) / 2).diagonal().sqrt()


def _gradient_prior(power: Tensor, image: Tensor, reach: float, generator: torch.Generator) -> Tensor:
    """Inverse variance (H', W') of each component of the object's gradient, from its local mean over `reach` pixels."""
    known = _energy(image)
    least = _LEAST * float(known.max())
    prior = 2 / smooth(known, reach).clamp(min=least)
    for _ in range(_ROUNDS):
        drawn = _filter(_white((_FEW, *image.shape), image, generator), power.sqrt())
        drawn = drawn + _prior_noise(prior, _FEW, generator)
        lost = _energy(_solve_for_object(power, prior, drawn)).mean(0)
        prior = 2 / smooth(known + lost, reach).clamp(min=least)
    return prior


def _bias(image: Tensor, slope: Tensor, power: Tensor, prior: Tensor) -> Tensor:
    """How far the mean of the posterior lies from the restored object, whose prior was another one, for known PSFs."""
    return _solve_for_object(power, prior, -(slope + _curvature(image, prior))[None])[0]


def _solve_for_object(power: Tensor, prior: Tensor, right: Tensor) -> Tensor:
    """Objects (S, H', W') at which data and prior pull with `right` (S, H', W'), for known PSFs."""
    return conjugate_gradients(
        lambda x: _filter(x, power) + _curvature(x, prior), right, _object_preconditioner(power, prior), _ITERATIONS
    )


def _sample(
    objective: MyopicObjective,
    state: State,
    power: Tensor,
    prior: Tensor,
    photon_share: float,
    n_samples: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Samples of object (S, H', W') and aberrations (S, T, K), given the gradients' inverse variances `prior`."""
    model, precision = objective.model, objective.scaled_data(state.calibration)[1]
    joint = JointHessian(objective, state, power, prior, generator)
    brightness = model(state.image, state.z).clamp(min=0)
    share = photon_share / state.calibration.noise_inflation[:, None, None].to(brightness)
    variance = 1 + share * (brightness / brightness.mean() - 1)  # over that which the misfit assumes
    noise = (precision * variance).sqrt() * _white((n_samples, *objective.frames.shape), brightness, generator)
    by_image, by_z = joint.tangent.adjoint(noise)
    by_image = by_image + _prior_noise(prior, n_samples, generator)
    by_z = by_z + joint.z_prior.sqrt() * _white((n_samples, *state.z.shape), state.z, generator)
    return joint.solve(by_image, by_z)


class JointHessian:
    """The Hessian of the cost in object and aberrations jointly, by Gauss and Newton, with the Gaussian prior above.

    z_prior : (K,) curvature of the aberrations' prior
    """

    def __init__(
        self, objective: MyopicObjective, state: State, power: Tensor, prior: Tensor, generator: torch.Generator
    ) -> None:
        self.objective: MyopicObjective = objective
        self.prior: Tensor = prior
        self.precision: Tensor = objective.scaled_data(state.calibration)[1]
        self.tangent: Linearization = Linearization(objective.model, state.image, state.z, objective.parallel)
        self.z_prior: Tensor = torch.zeros_like(state.z[0]) + objective.aberration_weight(state.calibration, state.z)
        curved = curvature(objective.model, state.image, state.z, self.precision, generator)[0] + self.z_prior
        least = _LEAST * float(curved.max())
        self._z_curvature: Tensor = curved.clamp(min=least)
        self._hold: Tensor = torch.where(self.z_prior > 0, self.z_prior, least)
        self._settle: Operator = _object_preconditioner(power, prior)
        self._shapes = state.image.shape, state.z.shape

    def solve(self, by_image: Tensor, by_z: Tensor) -> tuple[Tensor, Tensor]:
        """Objects (S, H', W') and aberrations (S, T, K) that the Hessian takes to these; what is not free stays 0."""
        found = conjugate_gradients(self._apply, self._join(by_image, by_z), self._precondition, _ITERATIONS)
        return self._split(found)

    def _apply(self, x: Tensor) -> Tensor:
        image, z = self._split(x)
        by_image, by_z = self.tangent.adjoint(self.precision * self.tangent.forward(image, z))
        return self._join(by_image + _curvature(image, self.prior), by_z + self._hold * z)

    def _precondition(self, x: Tensor) -> Tensor:
        image, z = self._split(x)
        return self._join(self._settle(image), z / self._z_curvature)

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        image, z = self._shapes
        return x[:, : image.numel()].view(-1, *image), x[:, image.numel() :].view(-1, *z)

    def _join(self, image: Tensor, z: Tensor) -> Tensor:
        by_object, by_aberrations = (float(part in self.objective.free) for part in (Free.OBJECT, Free.ABERRATIONS))
        common = self.objective.model.aberrations.mean_common(z)
        return torch.cat([by_object * image.flatten(1), by_aberrations * common.flatten(1)], dim=1)


def _object_preconditioner(power: Tensor, prior: Tensor) -> Operator:
    """About the inverse of the Hessian in the object, which is diagonal in frequency once the prior is levelled out.

    In the variable x / scale the prior is the same everywhere, and the misfit what it is where the object is bright.
    """
    scale = prior.rsqrt()
    level = (scale**4).mean() / (scale**2).mean()
    rows, columns = prior.shape
    nu_y = torch.fft.fftfreq(rows, dtype=prior.dtype, device=prior.device)[:, None]
    nu_x = torch.fft.rfftfreq(columns, dtype=prior.dtype, device=prior.device)
    smoothness = 4 * ((math.pi * nu_y).sin() ** 2 + (math.pi * nu_x).sin() ** 2)
    inverse = 1 / (level * power + smoothness)
    return lambda x: scale * _filter(scale * x, inverse)


def _white(shape: tuple[int, ...], like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(shape, dtype=like.dtype, device="cpu", generator=generator).to(like.device)


def _prior_noise(precision: Tensor, n_samples: int, generator: torch.Generator) -> Tensor:
    """Samples (S, H', W') whose covariance is the prior's Hessian."""
    shape = (n_samples, *precision.shape)
    return divergence(*(precision.sqrt() * _white(shape, precision, generator) for _ in range(2)))


def _curvature(x: Tensor, prior: Tensor) -> Tensor:
    """The prior's Hessian times x."""
    return divergence(*(prior * slope for slope in gradient(x)))


def _filter(x: Tensor, response: Tensor) -> Tensor:
    return torch.fft.irfft2(torch.fft.rfft2(x) * response, s=x.shape[-2:])


def _energy(image: Tensor) -> Tensor:
    dy, dx = gradient(image)
    return dy**2 + dx**2


def smooth(image: Tensor, width: float) -> Tensor:
    """Convolve (..., H, W) with a Gaussian of standard deviation `width` [pixels], periodic."""
    nu_y = torch.fft.fftfreq(image.shape[-2], dtype=image.dtype, device=image.device)[:, None]
    nu_x = torch.fft.rfftfreq(image.shape[-1], dtype=image.dtype, device=image.device)
    return _filter(image, torch.exp(-2 * (math.pi * width) ** 2 * (nu_y**2 + nu_x**2)))
