"""What the aberrations that a basis leaves out add to the chi-square of frames that are otherwise explained.

Turbulence has no last mode. What the modes beyond the basis do to the frames is drawn at random, for the object and the
aberrations that were found and turbulence as strong as these say it is; what the modes of the basis would fit of it is
taken off, to first order. On simulated stacks that is what a good fit leaves: docs/restoration.md.
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

_ORDERS = 5  # radial orders beyond the basis: light that higher ones scatter falls beside the usual fields
_FRAMES = 8  # that are tried, spread over the stack
_ROUNDING = 1e-9  # of a change's squared length, which holds those that are alike


class ModelError(NamedTuple):
    """What to expect of the chi-square of explained frames.

    excess : added to the chi-square per pixel by what the basis leaves out
    fitted : numbers of each frame that its noise takes part in, which its degrees of freedom lack
    phase : rms of what the basis leaves out, over a sub-aperture [rad]
    """

    excess: float
    fitted: float
    phase: float


NO_MODEL_ERROR = ModelError(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LeftOut:
    """The aberrations of turbulence that have no place in a basis, white under their prior.

    own : of the modes of the basis; rest : of the `_ORDERS` radial orders beyond them, given the former
    """

    own: AberrationBasis
    rest: AberrationBasis

    @classmethod
    def of(cls, aperture: Aperture, n_modes: int, r0: float, outer_scale: float) -> LeftOut:
        """For the first `n_modes` of each sub-aperture, and turbulence of `r0` and `outer_scale` [m].

        Holes are taken one by one: what is beyond the first modes of one says nothing of another.
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
        """Variance of the aberrations found over that at `r0`; 1 where no mode tells."""
        coefficients = objective.model.aberrations.coefficients(state.z)
        return self.own.turbulence_strength(self.own.parameters_of(coefficients)) or 1.0


def expected_error(objective: MyopicObjective, state: State, left_out: LeftOut) -> ModelError:
    """What a fit such as `state` leaves if nothing is wrong with it; always the same for the same state."""
    model, rest = objective.model, left_out.rest
    rest = rest if model.aberrations.motion is None else rest.in_motion(torch.zeros_like(rest.mixing[:, :0]))
    strength = left_out.strength(objective, state)
    field, kind = model.window.field, {"dtype": model.dtype, "device": model.device}
    high = SampledPupil(model.pupil.aperture, field, model.band, rest, **kind).samples()
    chosen = sorted({round(t) for t in np.linspace(0, len(state.z) - 1, _FRAMES)})
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(len(chosen), rest.n_parameters, dtype=torch.float64, generator=generator, device="cpu")
    phases = high.phase(math.sqrt(strength) * drawn.to(model.device))

    @torch.no_grad()  # which holds for one thread only
    def of_frame(number: int) -> tuple[float, float]:
        part = slice(chosen[number], chosen[number] + 1)
        return _excess_of_frame(objective.of_frames(part), state.of_frames(part), phases[number])

    tried = list(objective.parallel(of_frame, range(len(chosen))))
    excess, fitted = (sum(values) / len(tried) for values in zip(*tried, strict=True))
    variance = strength * float(rest.mixing.square().sum()) / rest.n_subapertures
    return ModelError(excess, fitted, math.sqrt(variance))


def _excess_of_frame(frame: MyopicObjective, state: State, phase: Tensor) -> tuple[float, float]:
    """The excess and the count of `ModelError` for one frame whose light has another `phase` (P,) [rad] besides."""
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
    """Changes (K, H W) of one frame in units of its noise, and how strongly a prior holds each, both to unit length.

    They are those by its transmission, its background and its own aberrations, where these are free.
    """
    model, z = frame.model, state.z
    rows = [made]
    if model.background is not Background.NONE:
        rows.append(torch.ones_like(made))
    n_own = model.aberrations.n_own if Free.ABERRATIONS in frame.free else 0
    if n_own:
        still = torch.zeros_like(state.image).expand(n_own, *state.image.shape)
        each = torch.eye(n_own, z.shape[1], dtype=z.dtype, device=z.device)[:, None]
        rows.append(Linearization(model, state.image, z).forward(still, each)[:, 0])
    tangents = (torch.cat(rows) * root).flatten(1).to(z)
    length = tangents.norm(dim=1).clamp(min=torch.finfo(z.dtype).tiny ** 0.5)
    weight = torch.zeros_like(z[0]) + frame.aberration_weight(state.calibration, z)
    held = torch.cat([weight.new_zeros(len(tangents) - n_own), weight[:n_own]])
    return tangents / length[:, None], held / length**2 + _ROUNDING
