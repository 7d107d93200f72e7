"""The exposure model to first order: changes of the frames for small changes of object and aberrations."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

from torchmask.memory import AtATime
from torchmask.restoration.adjoint import pull_back
from torchmask.restoration.forward import ExposureModel, intensity
from torchmask.restoration.parallel import Map
from torchmask.restoration.pupil import OpenSamples

_AT_A_TIME = AtATime(processor=1, gpu=2**28)  # bytes of the amplitudes of several changes: on a processor, of one


class Linearization:
    """Jacobian J of `model` at an object (H', W') and aberrations (T, K), and its adjoint, for S changes at once.

    It stores amplitudes and transfer functions of all frames, 24 bytes per pixel of the field, frame and wavelength.
    """

    @torch.no_grad()
    def __init__(self, model: ExposureModel, image: Tensor, z: Tensor, parallel: Map = map) -> None:
        self.model: ExposureModel = model
        self.parallel: Map = parallel
        self.samples: OpenSamples = model.pupil.samples()
        self.spectrum: Tensor = model.spectrum(image)
        self.parts: list[slice] = list(model.chunks(len(z)))
        self.fields: list[Tensor] = [self.samples.field(self.samples.phase(z[part])) for part in self.parts]
        self.amplitudes: list[Tensor] = [model.amplitude(self.samples, field) for field in self.fields]
        self.transfers: list[Tensor] = [torch.fft.rfft2(intensity(amplitude)) for amplitude in self.amplitudes]

    def forward(self, image: Tensor, z: Tensor) -> Tensor:
        """Return J times changes of the object (S, H', W') and the aberrations (S, T, K), as frames (S, T, H, W)."""
        spectra = self.model.spectrum(image)[:, None]

        @torch.no_grad()
        def part_of(number: int) -> Tensor:
            size, changes, frames = self._at_a_time(number), z[:, self.parts[number]], []
            for spectrum, change in zip(spectra.split(size), changes.split(size), strict=True):
                moved = self._moved(number, self.samples.phase(change)) + self.transfers[number] * spectrum
                frames.append(self._seen(moved))
            return torch.cat(frames)

        return torch.cat(list(self.parallel(part_of, range(len(self.parts)))), dim=1)

    def by_modes(self, n_own: int) -> Tensor:
        """Return the derivatives (n_own, T, H, W) of all frames in the first parameters of each, its own aberrations.

        It is `forward` of one change for each, without the transforms of an object that stays.
        """
        phases = self.samples.basis[:, :n_own].T[:, None]

        @torch.no_grad()
        def part_of(number: int) -> Tensor:
            some = phases.split(self._at_a_time(number))
            return torch.cat([self._seen(self._moved(number, phase)) for phase in some])

        return torch.cat(list(self.parallel(part_of, range(len(self.parts)))), dim=1)

    def _at_a_time(self, number: int) -> int:
        """Return how many changes of the frames of this part to work on at a time."""
        amplitude = self.amplitudes[number]
        return max(1, _AT_A_TIME.on(amplitude.device) // (amplitude.numel() * amplitude.itemsize))

    def _moved(self, number: int, phases: Tensor) -> Tensor:
        """Return changes of the spectra (S, t, H', W'/2 + 1) of the frames of a part for phases (S, t or 1, P)."""
        amplitude, fields = self.amplitudes[number], 1j * self.fields[number] * phases
        moved = self.model.amplitude(self.samples, fields.flatten(0, 1)).unflatten(0, fields.shape[:2])
        psf = 2 * (amplitude.real * moved.real + amplitude.imag * moved.imag).sum(2)
        return torch.fft.rfft2(psf) * self.spectrum

    def _seen(self, spectra: Tensor) -> Tensor:
        """Return the frames (..., H, W) of spectra (..., H', W'/2 + 1)."""
        window = self.model.window
        return window.crop(torch.fft.irfft2(spectra, s=window.field.shape))

    def adjoint(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return J^T times frames (S, T, H, W), as objects (S, H', W') and aberrations (S, T, K)."""
        model, samples, shape = self.model, self.samples, self.model.window.field.shape
        conjugate = self.spectrum.conj().resolve_conj()

        @torch.no_grad()
        def part_of(number: int) -> tuple[Tensor, Tensor]:
            field, amplitude, transfer = self.fields[number], self.amplitudes[number], self.transfers[number]
            by_object, by_aberrations = [], []
            for frame in frames[:, self.parts[number]]:
                back = torch.fft.rfft2(frame, s=shape)
                by_object.append((transfer.conj() * back).sum(0))
                slope = pull_back(samples, field, amplitude, torch.fft.irfft2(back * conjugate, s=shape))
                by_aberrations.append(slope @ samples.basis)
            return torch.stack(by_object), torch.stack(by_aberrations)

        objects, aberrations = zip(*self.parallel(part_of, range(len(self.parts))), strict=True)
        return model.spectrum_adjoint(reduce(torch.add, objects)), torch.cat(aberrations, dim=1)
