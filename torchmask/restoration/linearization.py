"""The model of the exposures to first order: what small changes of object and aberrations do to the frames."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.restoration.model import ExposureModel
from torchmask.restoration.parallel import Map


class Linearization:
    """J of `model` at an object (H', W') and aberrations (T, K), and its adjoint; both work on S changes at once.

    Amplitudes and transfer functions of all frames are kept: 24 bytes a pixel of the field, frame and wavelength.
    """

    def __init__(self, model: ExposureModel, image: Tensor, z: Tensor, parallel: Map = map) -> None:
        self.model: ExposureModel = model
        self.parallel: Map = parallel
        self.spectrum: Tensor = torch.fft.rfft2(image.to(model.basis.dtype))
        self.parts: list[slice] = list(model.chunks(len(z)))
        self.pupils: list[Tensor] = [model.pupil_field(z[part]) for part in self.parts]
        self.amplitudes: list[Tensor] = [model.amplitude(pupil) for pupil in self.pupils]
        powers = [(amplitude.real**2 + amplitude.imag**2).sum(1) for amplitude in self.amplitudes]
        self.transfers: list[Tensor] = [torch.fft.rfft2(power) for power in powers]

    def forward(self, image: Tensor, z: Tensor) -> Tensor:
        """Changes of the frames (S, T, H, W) for those of the object (S, H', W') and the aberrations (S, T, K)."""
        model, shape = self.model, self.model.field.shape
        spectra = torch.fft.rfft2(image.to(model.basis.dtype))
        rows, columns = model.grid.shape

        @torch.no_grad()
        def part_of(number: int) -> Tensor:
            pupil, amplitude, transfer = self.pupils[number], self.amplitudes[number], self.transfers[number]
            frames = []
            for spectrum, change in zip(spectra, z[:, self.parts[number]], strict=True):
                moved = model.amplitude(1j * pupil * (change.to(model.basis.dtype) @ model.basis.T))
                psf = 2 * (amplitude.real * moved.real + amplitude.imag * moved.imag).sum(1)
                frame = torch.fft.irfft2(torch.fft.rfft2(psf) * self.spectrum + transfer * spectrum, s=shape)
                frames.append(frame[:, :rows, :columns])
            return torch.stack(frames)

        return torch.cat(list(self.parallel(part_of, range(len(self.parts)))), dim=1)

    def adjoint(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """J^T of (S, T, H, W), as changes of the object (S, H', W') and of the aberrations (S, T, K)."""
        model, shape = self.model, self.model.field.shape
        conjugate = self.spectrum.conj().resolve_conj()

        @torch.no_grad()
        def part_of(number: int) -> tuple[Tensor, Tensor]:
            pupil, amplitude, transfer = self.pupils[number], self.amplitudes[number], self.transfers[number]
            by_object, by_aberrations = [], []
            for frame in frames[:, self.parts[number]]:
                back = torch.fft.rfft2(frame, s=shape)
                by_object.append((transfer.conj() * back).sum(0))
                slope = model.pull_back(pupil, amplitude, torch.fft.irfft2(back * conjugate, s=shape))
                by_aberrations.append(slope @ model.basis)
            return torch.stack(by_object), torch.stack(by_aberrations)

        objects, aberrations = zip(*self.parallel(part_of, range(len(self.parts))), strict=True)
        return torch.fft.irfft2(sum(objects[1:], objects[0]), s=shape), torch.cat(aberrations, dim=1)
