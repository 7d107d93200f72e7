"""Standard deviations of the restored object and aberrations, by Laplace's approximation.

The cost is approximated as quadratic around the restoration, with the Gauss-Newton Hessian of the misfit in object and
aberrations jointly, so that each includes the uncertainty of the other. Total variation has no useful curvature: it is
nearly infinite in flat parts and zero across edges. It is replaced by the Gaussian prior that the restored object
suggests: gradients whose local variance is about the likeliest for the frames (by expectation maximisation).

That overstates errors, as objects are positive and have more edges and even parts than a Gaussian one. So inverse
variances are a few times the likeliest, by a factor found by trial. Errors are smaller still where objects are even,
such as blocks, which total variation is made for and whose parts it finds as even as they are: `evenness` tells by how
much, a rule found by trial too.

A sample of the posterior is the solution of the quadratic problem with perturbed data and priors (Papandreou & Yuille,
Adv. Neural Inf. Process. Syst. 23, 1858, 2010), by conjugate gradients.
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
from torchmask.restoration.slopes import divergence, gradient
from torchmask.restoration.state import State
from torchmask.restoration.structure import smooth

_REACH = 0.7  # smoothing of the gradients' variance [1 / cut-off]: 0.5 to 1.4 tried, see docs/tried.md
_ROUNDS, _FEW = 8, 6  # rounds and samples of expectation maximisation; few suffice, as they are smoothed
_LEAST = 1e-6  # of the largest value: minimum, for a finite prior in dark parts and a finite scale of all aberrations
_FLAT = 0.1  # of the gradients' root mean square: a pixel with less is even
_BRIGHT = 0.1  # of the peak: pixels that are asked
_EVEN = 3.5  # by how much errors are smaller, in the logarithm, if all light is in such: 1 to 5 tried
_TIGHTER = 2.5  # factor of the likeliest inverse variance, for errors of the object: 1 to 3 tried
_BATCH = 8  # samples drawn at once, each of which takes the memory of several stacks
_ITERATIONS = 50  # of conjugate gradients: variances below the cut-off are then within 3 % of their limit


def standard_deviations(
    objective: MyopicObjective, state: State, cutoff: float, photon_share: Tensor | float, n_samples: int
) -> tuple[Tensor, Tensor]:
    """Return standard deviations (H', W') of the object below `cutoff` [cycles/pixel], and samples of the aberrations.

    The `n_samples` samples (S, T, K) scatter around zero as the truth does around `state`; what is not free does not
    vary. They are drawn from one seed, whatever that of the restoration. The variance of the object is smoothed by the
    width of its prior, so that few samples suffice. `photon_share` is the fraction of the noise variance that is photon
    noise, which is larger in bright pixels.
    """
    generator = torch.Generator().manual_seed(0)
    reach = _REACH / cutoff
    slope, power = objective.object_quadratic(state.image, state.z, state.calibration)
    prior = _TIGHTER * _gradient_prior(power, state.image, slope, reach, generator)
    sizes = [min(_BATCH, n_samples - start) for start in range(0, n_samples, _BATCH)]
    drawn = [_sample(objective, state, power, prior, photon_share, size, generator) for size in sizes]
    objects, aberrations = (torch.cat(part) for part in zip(*drawn, strict=True))
    off = lowpass(_bias(state.image, slope, power, prior), cutoff).square() if Free.OBJECT in objective.free else 0.0
    variance = smooth(lowpass(objects, cutoff).square().mean(0) + off, reach)
    return variance.clamp(min=0).sqrt(), aberrations


def evenness(image: Tensor) -> float:
    """Return the factor, at most 1, by which to multiply `standard_deviations` of an object as even as `image`.

    It is exp(-3.5 q^2), where q is the share of the light in even pixels, whose gradient is below a tenth of its root
    mean square, by light, of all pixels above a tenth of the peak. The rule was found by trial (docs/tried.md). It does
    not hold where light is faint, as the prior makes any object even there.
    """
    light = torch.where(image > _BRIGHT * image.max(), image, 0.0)
    gradients, total = _energy(image), float(light.sum())
    is_even = gradients * total < _FLAT**2 * (gradients * light).sum()
    share = float((light * is_even).sum()) / total if total > 0 else 0.0
    return math.exp(-_EVEN * share**2)


def place_deviations(objective: MyopicObjective, state: State, cutoff: float) -> Tensor:
    """Return standard deviations (2,) of the mask's rotation [rad] and shrinkage, marginal over object and aberrations.

    Changes of the frames that object and aberrations can imitate carry no information on the mask (Schur complement).
    """
    generator = torch.Generator().manual_seed(0)
    slope, power = objective.object_quadratic(state.image, state.z, state.calibration)
    prior = _gradient_prior(power, state.image, slope, _REACH / cutoff, generator)
    joint = JointHessian(objective, state, power, prior, generator)
    slopes = slopes_of_frames(objective.model, state.image, state.z)
    imitated = joint.tangent.forward(*joint.solve(*joint.tangent.adjoint(joint.precision * slopes)))
    told = torch.einsum("stij,utij->su", (joint.precision * slopes).double(), (slopes - imitated).double())
    return torch.linalg.inv((told + told.T) / 2).diagonal().sqrt()


def _gradient_prior(power: Tensor, image: Tensor, slope: Tensor, reach: float, generator: torch.Generator) -> Tensor:
    """Return the inverse variance (H', W') of the object's gradients, smoothed by `reach` pixels in every round.

    It is about the likeliest for known PSFs: expectation maximisation needs the mean square of the gradients under the
    posterior, that of its mean and what is lost in it. Where a prior is even, their mean square is 1 / prior, not
    2 / prior, since the two components of a pixel's gradient have one degree of freedom.
    """
    known = _energy(image)
    least = _LEAST * float(known.max())
    prior = 1 / smooth(known, reach).clamp(min=least)
    for _ in range(_ROUNDS):
        drawn = _filter(_white((_FEW, *image.shape), image, generator), power.sqrt())
        drawn = drawn + _prior_noise(prior, _FEW, generator)
        towards_mean = -(slope + _curvature(image, prior))
        bias, *lost = _solve_for_object(power, prior, torch.cat([towards_mean[None], drawn]))
        energy = _energy(image + bias) + _energy(torch.stack(lost)).mean(0)
        prior = 1 / smooth(energy, reach).clamp(min=least)
    return prior


def _bias(image: Tensor, slope: Tensor, power: Tensor, prior: Tensor) -> Tensor:
    """Return the posterior mean minus the restored object, for known PSFs; they differ as their priors do."""
    return _solve_for_object(power, prior, -(slope + _curvature(image, prior))[None])[0]


def _solve_for_object(power: Tensor, prior: Tensor, right: Tensor) -> Tensor:
    """Solve for the objects (S, H', W') whose gradient of misfit and prior is `right` (S, H', W'), for known PSFs."""
    return conjugate_gradients(
        lambda x: _filter(x, power) + _curvature(x, prior), right, _object_preconditioner(power, prior), _ITERATIONS
    )


def _sample(
    objective: MyopicObjective,
    state: State,
    power: Tensor,
    prior: Tensor,
    photon_share: Tensor | float,
    n_samples: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Draw samples of object (S, H', W') and aberrations (S, T, K), given the gradients' inverse variances `prior`."""
    model, precision = objective.model, objective.scaled_data(state.calibration)[1]
    joint = JointHessian(objective, state, power, prior, generator)
    brightness = model(state.image, state.z).clamp(min=0)
    share = photon_share / state.calibration.noise_inflation[:, None, None].to(brightness)
    variance = 1 + share * (brightness / brightness.mean() - 1)  # relative to the one that the misfit assumes
    noise = (precision * variance).sqrt() * _white((n_samples, *objective.frames.shape), brightness, generator)
    by_image, by_z = joint.tangent.adjoint(noise)
    by_image = by_image + _prior_noise(prior, n_samples, generator)
    by_z = by_z + joint.z_prior.sqrt() * _white((n_samples, *state.z.shape), state.z, generator)
    return joint.solve(by_image, by_z)


class JointHessian:
    """Gauss-Newton Hessian of the cost in object and aberrations jointly, with the Gaussian prior of this module.

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
        """Solve for objects (S, H', W') and aberrations (S, T, K) with this right-hand side; what is not free is 0."""
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
    """Return an approximate inverse of the Hessian in the object.

    In the variable x / scale the prior is uniform, so that the Hessian is nearly diagonal in frequency; the misfit is
    taken as it is where the object is bright.
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
    """Draw samples (S, H', W') whose covariance is the prior's Hessian."""
    shape = (n_samples, *precision.shape)
    return divergence(*(precision.sqrt() * _white(shape, precision, generator) for _ in range(2)))


def _curvature(x: Tensor, prior: Tensor) -> Tensor:
    """Return the prior's Hessian times x."""
    return divergence(*(prior * slope for slope in gradient(x)))


def _filter(x: Tensor, response: Tensor) -> Tensor:
    return torch.fft.irfft2(torch.fft.rfft2(x) * response, s=x.shape[-2:])


def _energy(image: Tensor) -> Tensor:
    dy, dx = gradient(image)
    return dy**2 + dx**2
