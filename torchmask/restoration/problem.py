"""The joint problem of object and aberrations as a bound-constrained minimiser sees it: one scaled vector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmask.restoration.lbfgsb import minimize_bounded
from torchmask.restoration.model import ExposureModel
from torchmask.restoration.parallel import Map
from torchmask.restoration.priors import total_variation, total_variation_curvature

_CORRECTIONS = 20
_OBJECT_STEP = 0.3  # of the object's scale against that of the aberrations: measured, a factor of 3 either way is worse
_LEAST_CURVATURE = 1e-6  # of the largest: directions that neither data nor prior hold are left with a finite scale
_LEAST_GAIN = 1e-3
_PROBE_SEED = 0


@dataclass(frozen=True)
class State:
    """What goes on from one restart to the next.

    image : (H', W') object in units of the stack's mean pixel
    z : (T, K) aberrations, the last `model.n_static` of them the same in every frame
    gains : (T,) transmission of the frames, 1 on average
    prior : weight of ||z||^2 / 2, which follows the strength of the turbulence
    excess : (T,) divides a frame's precision: variance of its residuals over that of its noise, at least 1, or what is
        made of it
    """

    image: Tensor
    z: Tensor
    gains: Tensor
    prior: float
    excess: Tensor


@dataclass(frozen=True)
class JointProblem:
    """1/2 sum precision/excess (gain * forward - frames)^2 + tv_weight TV(image) + prior/2 |z - centre|^2, image >= 0.

    frames : (T, H, W) in units of their mean; precision : (T or 1, H or 1, W or 1)
    centre : (T, K) expected aberrations
    free : which of "object" and "aberrations" may change
    static : whether those aberrations may change that are common to all frames
    parallel : how to go over the frames, as `map` does
    """

    model: ExposureModel
    frames: Tensor
    precision: Tensor
    centre: Tensor
    tv_weight: float
    free: tuple[str, ...] = ("object", "aberrations")
    static: bool = True
    parallel: Map = map

    def of_frames(self, part: slice | Tensor, **changes: Any) -> JointProblem:
        """The problem of some of the frames, with other fields changed as `dataclasses.replace` does."""
        precision = self.precision[part] if len(self.precision) > 1 else self.precision
        return replace(self, frames=self.frames[part], precision=precision, centre=self.centre[part], **changes)

    def scaled_data(self, state: State) -> tuple[Tensor, Tensor]:
        """Frames and precision with the gains divided out of the model: (frames / g, precision g^2 / excess)."""
        gains = state.gains[:, None, None].to(self.frames)
        return self.frames / gains, self.precision * (gains**2 / state.excess[:, None, None].to(gains))

    def prior(self, state: State) -> float | Tensor:
        """Weight of a frame's (z - centre)^2 / 2: common aberrations do not follow the turbulence, and count once."""
        n_static = self.model.n_static
        if not n_static:
            return state.prior
        weight = torch.full_like(state.z[0], state.prior)
        weight[-n_static:] = 1 / len(state.z) if state.prior else 0.0
        return weight

    def scales(self, state: State) -> tuple[Tensor, Tensor]:
        """Units in which the diagonal of the Hessian is about one, for image (H', W') and z (K,).

        Curvature of the aberrations is measured by probes; that of the object by the energy of the PSFs and
        the quadratic that majorises TV, which tells flat pixels from edges.
        """
        generator = torch.Generator().manual_seed(_PROBE_SEED)
        curvature, pixel = self.model.curvature(state.image, state.z, self.scaled_data(state)[1], generator)
        curvature = curvature + self.prior(state)
        z_scale = curvature.clamp(min=_LEAST_CURVATURE * float(curvature.max())).rsqrt()
        image_curvature = pixel + self.tv_weight * total_variation_curvature(state.image)
        return _OBJECT_STEP * image_curvature.rsqrt(), z_scale

    def cost(self, state: State, image: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The cost with the gains and prior of `state`, and its gradients in image and z (zero where not free)."""
        return self._cost(self.scaled_data(state), state, image, z)

    def _cost(
        self, data: tuple[Tensor, Tensor], state: State, image: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        frames, precision = data
        by_object, by_aberrations = ("object" in self.free), ("aberrations" in self.free)
        misfit = self.model.misfit(
            image,
            z,
            frames,
            precision,
            want_object=by_object,
            want_aberrations=by_aberrations,
            parallel=self.parallel,
        )
        variation, slope = total_variation(image)
        away = z - self.centre
        value = misfit.value.sum() + self.tv_weight * variation + 0.5 * (self.prior(state) * away**2).sum()
        image_gradient = torch.zeros_like(image)
        z_gradient = torch.zeros_like(z)
        if misfit.object_gradient is not None:
            image_gradient = misfit.object_gradient + self.tv_weight * slope
        if misfit.aberration_gradient is not None:
            z_gradient = misfit.aberration_gradient + self.prior(state) * away
            if self.model.n_static:  # of a function of their mean, which keeps equal what is equal
                common = z_gradient[:, -self.model.n_static :]
                common[:] = common.mean(0) if self.static else 0.0
        return value, image_gradient, z_gradient

    def object_quadratic(self, state: State) -> tuple[Tensor, Tensor]:
        """The misfit around `state` as a function of the object: gradient (H', W') and Hessian over frequencies.

        The gradient is exact, the Hessian (H', W'/2 + 1) that of a full field, which is diagonal in frequency.
        """
        frames, precision = self.scaled_data(state)
        slope = self.model.misfit(
            state.image, state.z, frames, precision, want_aberrations=False, parallel=self.parallel
        ).object_gradient
        assert slope is not None
        power = torch.zeros_like(torch.fft.rfft2(state.image).real)
        for part in self.model.chunks(len(state.z)):
            transfer = torch.fft.rfft2(self.model.psf(state.z[part]))
            weight = precision[part].mean((1, 2), keepdim=True)
            power += ((transfer.real**2 + transfer.imag**2) * weight).sum(0).to(power)
        return slope, power

    def frame_costs(self, state: State) -> Tensor:
        """Misfit and prior of each frame, (T,)."""
        frames, precision = self.scaled_data(state)
        misfit = self.model.misfit(state.image, state.z, frames, precision, want_object=False, want_aberrations=False)
        return misfit.value.to(state.z) + 0.5 * (self.prior(state) * (state.z - self.centre) ** 2).sum(1)

    def descend(self, state: State, n_iterations: int, progress: Callable[[float, int, Any], None]) -> State:
        """L-BFGS from `state`; `progress(cost, evaluations, function giving (image, z))` after every iteration."""
        image_scale, z_scale = self.scales(state)
        data = self.scaled_data(state)
        n, seen = state.image.numel(), 0

        def split(x: Tensor) -> tuple[Tensor, Tensor]:
            return x[:n].view_as(state.image) * image_scale, x[n:].view_as(state.z) * z_scale

        def cost(x: Tensor) -> tuple[float, Tensor]:
            value, image_gradient, z_gradient = self._cost(data, state, *split(x))
            return float(value), torch.cat([(image_gradient * image_scale).flatten(), (z_gradient * z_scale).flatten()])

        def after(x: Tensor, value: float, evaluations: int) -> None:
            nonlocal seen
            seen, new = evaluations, evaluations - seen
            progress(value, new, lambda: split(x))

        start = torch.cat([(state.image / image_scale).flatten(), (state.z / z_scale).flatten()])
        lower = torch.full_like(start, -torch.inf)
        lower[:n] = 0
        found = minimize_bounded(
            cost, start, lower, max_iterations=n_iterations, n_corrections=_CORRECTIONS, callback=after
        )
        image, z = split(found.x)
        return replace(state, image=image, z=z)

    def calibrate(self, state: State) -> State:
        """The state with the gains that fit best, 1 on average, and the excess that is left then."""
        gains, chi_square = self.fit_of_frames(state)
        return replace(state, gains=gains / gains.mean(), excess=chi_square.clamp(min=1))

    def fit_of_frames(self, state: State) -> tuple[Tensor, Tensor]:
        """The gain (T,) at which each frame fits best, and what its residuals are then: chi-square per pixel (T,)."""
        gains, squares = [], []
        for part in self.model.chunks(len(state.z)):
            frames, model = self.frames[part], self.model(state.image, state.z[part])
            precision = (self.precision[part] if len(self.precision) > 1 else self.precision).expand_as(frames)
            gain = (precision * model * frames).sum((1, 2)) / (precision * model**2).sum((1, 2))
            gains.append(gain)
            error = (precision * (frames - gain[:, None, None] * model) ** 2).sum((1, 2))
            squares.append(error / (precision > 0).sum((1, 2)).clamp(min=1))
        return torch.cat(gains).to(state.z).clamp(min=_LEAST_GAIN), torch.cat(squares).to(state.z)
