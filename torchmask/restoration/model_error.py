"""The expected contribution to the chi-square of aberrations that the basis leaves out.

Turbulence has infinitely many modes. The effect of the modes beyond the basis on the frames is simulated, for the
restored object and aberrations and for turbulence of the strength that these show; the part that the modes of the basis
would fit is removed to first order. On simulated stacks this is the residual of a good fit, see docs/restoration.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.zernike import noll
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.forward import intensity
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.pupil import SampledPupil
from torchmask.restoration.state import State

_ORDERS = 5  # radial orders beyond the basis: light scattered by higher ones falls outside the usual fields
_FRAMES = 8  # number of frames simulated, spread over the stack
_FITTED_FRAMES = 2  # for the parameters alone, which differ by 2 to 3 % between frames, 0.03 % of a frame's pixels
_ROUNDING = 1e-9  # regularises tangents that are nearly parallel, relative to their squared length


class ModelError(NamedTuple):
    """Expected deviation of the chi-square of a good fit from that of noise alone.

    excess : chi-square per pixel that the modes beyond the basis add
    fitted : effective number of parameters fitted to each frame, by which its degrees of freedom are fewer
    phase : rms of the modes beyond the basis, over a sub-aperture [rad]
    """

    excess: float
    fitted: float
    phase: float


NO_MODEL_ERROR = ModelError(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LeftOut:
    """The aberrations of turbulence that a basis leaves out, white under their prior.

    own : basis of the modes that are included
    rest : basis of the `_ORDERS` radial orders beyond them, conditional on the former
    """

    own: AberrationBasis
    rest: AberrationBasis

    @classmethod
    def of(cls, aperture: Aperture, n_modes: int, r0: float, outer_scale: float) -> LeftOut:
        """Return the bases for the first `n_modes` of each sub-aperture, and turbulence of `r0` and `outer_scale` [m].

        Holes are taken as independent, as their higher modes are hardly correlated.
        """
        hole, n_sub = aperture, aperture.n_subapertures
        if isinstance(aperture, SparseAperture):
            hole = aperture.replace(centers=torch.zeros_like(aperture.centers[:1]))
        order = noll(n_modes)[0] + _ORDERS
        total = (order + 1) * (order + 2) // 2
        covariance = modal_covariance(hole, total, r0, outer_scale).cpu()
        low, both, high = covariance[:n_modes, :n_modes], covariance[:n_modes, n_modes:], covariance[n_modes:, n_modes:]
        given = high - both.T @ torch.linalg.solve(low, both)
        values, vectors = torch.linalg.eigh((given + given.T) / 2)
        mixing = pad(vectors * values.clamp(min=0).sqrt(), (0, 0, n_modes, 0))
        each = torch.eye(n_sub, dtype=mixing.dtype, device="cpu")
        rest = AberrationBasis(torch.kron(each, mixing), total)
        return cls(turbulent_basis(aperture, n_modes, 0, r0, outer_scale), rest)

    def strength(self, objective: MyopicObjective, state: State) -> float:
        """Return the variance of the restored aberrations over that expected at `r0`; 1 if no mode constrains it."""
        coefficients = objective.model.aberrations.coefficients(state.z)
        return self.own.turbulence_strength(self.own.parameters_of(coefficients)) or 1.0


def fitted_parameters(objective: MyopicObjective, state: State) -> float:
    """Return `fitted` of `ModelError` alone, for which nothing is simulated."""

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def of_frame(number: int) -> float:
        part = slice(number, number + 1)
        frame, own = objective.of_frames(part), state.of_frames(part)
        tangents, held = _tangents(frame, own, frame.model(own.image, own.z), frame.precision.sqrt())
        gram = tangents @ tangents.T
        return float(torch.linalg.solve(gram + held.diag(), gram).trace())

    chosen = _some_frames(state, _FITTED_FRAMES)
    return sum(objective.parallel(of_frame, chosen)) / len(chosen)


def expected_error(objective: MyopicObjective, state: State, left_out: LeftOut) -> ModelError:
    """Return the expected model error of a good fit such as `state`; it is the same for every call."""
    model, rest = objective.model, left_out.rest
    rest = rest if model.aberrations.motion is None else rest.in_motion(torch.zeros_like(rest.mixing[:, :0]))
    strength = left_out.strength(objective, state)
    field, kind = model.window.field, {"dtype": model.dtype, "device": model.device}
    high = SampledPupil(model.pupil.aperture, field, model.band, rest, **kind).samples()
    chosen = _some_frames(state, _FRAMES)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(len(chosen), rest.n_parameters, dtype=torch.float64, generator=generator, device="cpu")
    phases = high.phase(math.sqrt(strength) * drawn.to(model.device))

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def of_frame(number: int) -> tuple[float, float]:
        part = slice(chosen[number], chosen[number] + 1)
        return _excess_of_frame(objective.of_frames(part), state.of_frames(part), phases[number])

    tried = list(objective.parallel(of_frame, range(len(chosen))))
    excess, fitted = (sum(values) / len(tried) for values in zip(*tried, strict=True))
    variance = strength * float(rest.mixing.square().sum()) / rest.n_subapertures
    return ModelError(excess, fitted, math.sqrt(variance))


def _some_frames(state: State, most: int) -> list[int]:
    """Return at most `most` frames, spread over the stack."""
    return sorted({round(t) for t in np.linspace(0, len(state.z) - 1, most)})


def _excess_of_frame(frame: MyopicObjective, state: State, phase: Tensor) -> tuple[float, float]:
    """Return `excess` and `fitted` of `ModelError` for one frame with an additional `phase` (P,) [rad]."""
    model, samples = frame.model, frame.model.pupil.samples()
    spectrum, found = model.spectrum(state.image), samples.phase(state.z)

    def image_of(phase: Tensor) -> Tensor:
        transfer = torch.fft.rfft2(intensity(model.amplitude(samples, samples.field(phase))))
        return model.window.crop(torch.fft.irfft2(transfer * spectrum, s=model.window.field.shape))

    made, root = image_of(found), frame.precision.sqrt()
    tangents, held = _tangents(frame, state, made, root)
    change = ((image_of(found + phase) - made) * root).flatten().to(state.z)
    gram = tangents @ tangents.T
    fitted = torch.linalg.solve(gram + held.diag(), torch.cat([(tangents @ change)[:, None], gram], dim=1))
    left = change - fitted[:, 0] @ tangents
    pixels = int((root.expand_as(made) > 0).sum())
    return float(left.square().sum()) / max(pixels, 1), float(fitted[:, 1:].trace())


def _tangents(frame: MyopicObjective, state: State, made: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives (K, H W) of one frame in units of its noise, and the curvature of their priors (K,).

    The derivatives are those in its transmission, and in its background and its own aberrations where these are free;
    both are scaled to derivatives of unit length.
    """
    model, z = frame.model, state.z
    rows = [made]
    if model.background is Background.PER_FRAME:
        rows.append(torch.ones_like(made))
    n_own = model.aberrations.n_own if Free.ABERRATIONS in frame.free else 0
    if n_own:
        rows.append(Linearization(model, state.image, z).by_modes(n_own)[:, 0])
    tangents = (torch.cat(rows) * root).flatten(1).to(z)
    length = tangents.norm(dim=1).clamp(min=torch.finfo(z.dtype).tiny ** 0.5)
    weight = torch.zeros_like(z[0]) + frame.aberration_weight(state.calibration, z)
    held = torch.cat([weight.new_zeros(len(tangents) - n_own), weight[:n_own]])
    return tangents / length[:, None], held / length**2 + _ROUNDING
