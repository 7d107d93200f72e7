"""The pupil's field in each frame of a known object, by relaxed averaged alternating reflections.

A descent in the modes of a phase stops at walls of one wave, or with a part of the pupil turned into its twin. The
field has no walls: on the way it may have any amplitude. So it goes back and forth between two sets, the fields with
the amplitude of the pupil and those whose PSF gives the frame, and reflections at both lead it out of places where
mere projections stop (Luke, Inverse Problems 21, 37, 2005). Where the object hides frequencies of the PSF from the
frame, or noise does, the second projection leaves them as they are.

While the phases of a frame are not found the gap between the two sets goes up and down. It falls within some tens of
reflections once they are. In noise it grows again then, as the field begins to follow the frame, and more reflections
seldom find anything better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.optics.conjugate import conjugate_gradients
from torchmask.restoration.candidates import with_candidates
from torchmask.restoration.cuda_graphs import graphed
from torchmask.restoration.forward import ExposureModel, intensity
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.pupil import OpenSamples
from torchmask.restoration.state import State

STEPS = 8  # conjugate-gradient steps of a projection onto the frames, from where the one before has ended
_RELAXATION = 0.9  # of the reflections; 1 has no attraction to the present field
_STIFFNESS = 3e3  # holds focal amplitudes, of unit norm, where they are while their PSF is fitted to a frame
_DARK = 1e-6  # intensity below which a PSF of unit sum is free to change as if it had so much
LAST = 10  # projections at the end, without reflections
_LOOK = 10  # reflections from one look at the gap to the next
_FIRST_LOOKS = 2  # at the beginning, where it always falls
_LOOKS_BEFORE = 3  # which tell what it is while phases are not found, at least
_LOOKS_AT_REST = 5  # in which it has not been lower than before
_FALLEN = 0.65  # fraction of the median before to which it falls when phases are found


class Retrieved(NamedTuple):
    """Fields (T, P) at the open samples, of any amplitude, and the number of reflections (T,) that each took.

    The `LAST` projections of each are not counted.
    """

    fields: Tensor
    n_reflections: Tensor


@torch.no_grad()
def retrieve_fields(objective: MyopicObjective, state: State, n_reflections: int) -> Retrieved:
    """Return the fields to which `state` leads by `n_reflections`, or fewer where phases are found before.

    The hundredth reflection is the first that can tell. The light must have one wavelength and frames be snapshots:
    there is one raster of the pupil.
    """
    single = with_candidates(objective, 1)
    frames, precision, unit = single.scaled_data(state.calibration)
    away = frames - single.model(state.image, state.z)
    frames = frames - single.model.background.level(away, precision, unit)
    spectrum, samples = single.model.spectrum(state.image), single.model.pupil.samples()

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def of_part(part: slice) -> Retrieved:
        chunk = _Frames(single.model, samples, spectrum, frames[part], precision[part])
        return chunk.reflect(samples.field(samples.phase(state.z[part])), n_reflections)

    parts = single.parallel(of_part, single.model.chunks(len(state.z)))
    return Retrieved(*(torch.cat(column) for column in zip(*parts, strict=True)))


@dataclass(frozen=True)
class _Frames:
    """A few frames (t, H, W) with their precision, and the spectrum of the object behind them."""

    model: ExposureModel
    samples: OpenSamples
    spectrum: Tensor
    frames: Tensor
    precision: Tensor

    def reflect(self, field: Tensor, n_reflections: int) -> Retrieved:
        """Return the fields to which reflections lead from `field` (t, P)."""
        found, spent = field.clone(), torch.full((len(field),), n_reflections, device="cpu")
        chunk, left = self, torch.arange(len(field), device=field.device)
        fit_frames = graphed(chunk._fit_frames, field.device)
        now = self.model.raster(self.samples, field)
        pull, gaps = torch.zeros_like(now[:, 0].real), now.real.new_empty(0, len(now))
        for number in range(n_reflections):
            fitted, pull = fit_frames(now, pull)
            if number % _LOOK == 0:
                gaps = torch.cat([gaps, chunk._gap(fitted)[None]])
                ends = _has_fallen(gaps)
                if bool(ends.any()):
                    found[left[ends]] = chunk._of(ends)._end(fitted[ends], pull[ends])
                    spent[left[ends].cpu()] = number + 1
                    chunk, left, now, fitted = chunk._of(~ends), left[~ends], now[~ends], fitted[~ends]
                    pull, gaps, fit_frames = pull[~ends], gaps[:, ~ends], graphed(chunk._fit_frames, field.device)
                if not len(left):
                    return Retrieved(found, spent)
            mirrored = 2 * fitted - now
            reflected = 2 * chunk._fit_pupil(mirrored) - mirrored
            now = _RELAXATION * (reflected + now) / 2 + (1 - _RELAXATION) * fitted
        found[left] = chunk._end(now, pull)
        return Retrieved(found, spent)

    def _of(self, some: Tensor) -> _Frames:
        """Return some of the frames, by booleans (t,)."""
        return replace(self, frames=self.frames[some], precision=self.precision[some])

    def _end(self, raster: Tensor, pull: Tensor) -> Tensor:
        """Return the fields (t, P) to which mere projections lead."""
        for _ in range(LAST):
            raster, pull = self._fit_frames(self._fit_pupil(raster), pull)
        return raster.flatten(1)[:, self.samples.index]

    def _gap(self, raster: Tensor) -> Tensor:
        """Return how far rasters (t, 1, H', W') are from having the amplitude of the pupil (t,), relative."""
        return (raster - self._fit_pupil(raster)).flatten(1).norm(dim=1) / raster.flatten(1).norm(dim=1)

    def _fit_pupil(self, raster: Tensor) -> Tensor:
        """Return the nearest rasters (t, 1, H', W') with the amplitude of the pupil."""
        field = self.samples.weights * torch.sgn(raster.flatten(1)[:, self.samples.index])
        return self.model.raster(self.samples, field)

    def _fit_frames(self, raster: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
        """Return rasters (t, 1, H', W') nearby whose PSFs give the frames, and the frames' pull (t, H', W') on them.

        The focal amplitude keeps its phase. Its distance from where it was, times `_STIFFNESS`, and the misfit have the
        least sum: a linear problem for the change of the intensity, as long as that is small. The pull on a pixel, its
        change times what holds it, hardly differs between one projection and the next, which goes on from it.
        """
        focal = torch.fft.fft2(raster)
        power = intensity(focal)
        held = 0.5 * _STIFFNESS / (power + _DARK)

        def forces(change: Tensor) -> Tensor:
            return held * change + self._back(self.precision * self._imaged(change))

        before = pull / held
        left = self._back(self.precision * (self.frames - self._imaged(power + before))) - pull
        change = before + conjugate_gradients(forces, left, lambda x: x / held, STEPS)
        amplitude = (power + change).clamp(min=0).sqrt()
        return torch.fft.ifft2(amplitude[:, None] * torch.sgn(focal)), held * change

    def _imaged(self, psf: Tensor) -> Tensor:
        """Return the frames (t, H, W) of PSFs (t, H', W')."""
        spectrum = torch.fft.rfft2(psf) * self.spectrum
        return self.model.window.crop(torch.fft.irfft2(spectrum, s=psf.shape[-2:]))

    def _back(self, frames: Tensor) -> Tensor:
        """Apply the adjoint of `_imaged`."""
        spectrum = torch.fft.rfft2(self.model.window.embed(frames)) * self.spectrum.conj()
        return torch.fft.irfft2(spectrum, s=self.model.window.field.shape)


def _has_fallen(gaps: Tensor) -> Tensor:
    """Return whether the gap of each frame (t,) has fallen and falls no more, by all looks at it so far (n, t)."""
    looks = gaps[_FIRST_LOOKS:]
    if len(looks) <= _LOOKS_BEFORE + _LOOKS_AT_REST:
        return torch.zeros_like(gaps[0], dtype=torch.bool)
    least, when = looks.min(0)
    number = torch.arange(len(looks), device=gaps.device)[:, None]
    before = looks.masked_fill(number >= when, torch.nan).nanmedian(0).values
    return (when >= _LOOKS_BEFORE) & (len(looks) - 1 - when >= _LOOKS_AT_REST) & (least < _FALLEN * before)
