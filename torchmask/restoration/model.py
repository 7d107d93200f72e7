"""The image-formation model that a restoration inverts, and its misfit to the frames with an adjoint of its own.

The object lives on a field somewhat wider than the frames (the margin), so that light may come from outside the
field and leave it; only the pixels of the frames are compared. Aberrations are given in a linear parametrisation
`z` of the phase, usually the whitened Zernike coefficients. A broad band is a few wavelengths, whose PSFs on the same
pixels of the sky add up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.zernike import zernike_basis
from torchmask.restoration.parallel import Map

_CHUNK = 2**20  # bytes of one complex work array: it stays in a core's cache


class Misfit(NamedTuple):
    """Half the weighted squared residuals, (T,), and the gradients of their sum; None where not asked for."""

    value: Tensor
    object_gradient: Tensor | None
    aberration_gradient: Tensor | None


class ExposureModel(nn.Module):
    """Frames y_t = window(h_t * o), h_t = sum_w weight_w |FFT(P_w exp(i B_w z_t))|^2 with unit sum.

    Parameters
    ----------
    aperture : Aperture
        One aperture, centres (N, 2).
    grid : Grid
        Of the frames, H x W.
    n_modes : int
        J, Zernike modes per sub-aperture.
    mixing : Tensor, optional
        (N J, K): coefficients = mixing @ z, sub-aperture by sub-aperture. None means the coefficients themselves.
    margin : float
        The object's field is at least (1 + margin) times as wide as the frames.
    wavelengths, weights : sequence of float, optional
        [m], and the share of the light of each (any positive numbers; None: equal). None: that of the grid alone.
        Aberrations are path differences: coefficients are rad at the wavelength of the grid.
    n_static : int
        The last `n_static` of the K aberrations are common to all frames: those who fit z keep them equal.

    Raises
    ------
    ValueError
        If `weights` do not belong to `wavelengths`, one of either is not finite and positive, or the shortest
        wavelength undersamples the image.

    Notes
    -----
    `forward(object, z)` takes an object (H', W') on `field` and z (T, K), and returns frames (T, H, W), differentiable
    by autograd. `misfit` compares with given frames at the cost of six FFTs a frame (and two more for every further
    wavelength) and a memory that does not grow with T; `weighted_misfit` is the same as a node of an autograd graph.

    The attenuation of the image by the cells of the pupil samples, which `PSF` divides out, is left in: on a field of
    this size it stands in for the light that leaves the field, and fits end-to-end simulations better.
    """

    weights: Tensor
    index: Tensor
    basis: Tensor
    mixing: Tensor
    positions: Tensor
    chromaticity: Tensor

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        n_modes: int,
        mixing: Tensor | None = None,
        margin: float = 0.25,
        *,
        wavelengths: Sequence[float] | None = None,
        weights: Sequence[float] | None = None,
        n_static: int = 0,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.grid: Grid = grid
        self.n_modes: int = n_modes
        rows, columns = (fast_size(math.ceil(side * (1 + margin))) for side in grid.shape)
        self.field: Grid = Grid((rows, columns), grid.pixel_scale, grid.wavelength)
        band = _band(grid, wavelengths, weights)
        self.n_wavelengths: int = len(band)
        self.n_static: int = n_static
        self.shortest_wavelength: float = min(wavelength for wavelength, _ in band)
        kwargs = {"dtype": dtype or aperture.centers.dtype, "device": device}
        if mixing is None:
            n = aperture.n_subapertures * n_modes
            mixing = torch.eye(n, dtype=aperture.centers.dtype, device=aperture.centers.device)
        self.register_buffer("mixing", mixing.to(**kwargs))
        # The samples of all wavelengths stand in one row, each indexing a raster of its own.
        parts = [self._sample(aperture, n_modes, mixing, wavelength) for wavelength, _ in band]
        amplitudes = [math.sqrt(share) * amplitude for (_, share), (amplitude, *_) in zip(band, parts, strict=True)]
        indices = [part[1] + number * rows * columns for number, part in enumerate(parts)]
        self.register_buffer("weights", torch.cat(amplitudes).to(**kwargs))
        self.register_buffer("index", torch.cat(indices).to(device=device))
        self.register_buffer("basis", torch.cat([part[2] for part in parts]).to(**kwargs))
        self.register_buffer("positions", torch.cat([part[3] for part in parts]).to(**kwargs))  # (P, 2), cycles/pixel
        ratios = [
            part[0].new_full((len(part[0]),), grid.wavelength / w) for (w, _), part in zip(band, parts, strict=True)
        ]
        self.register_buffer("chromaticity", torch.cat(ratios).to(**kwargs))  # (P,), phase of a path of 1 rad

    def _sample(
        self, aperture: Aperture, n_modes: int, mixing: Tensor, wavelength: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Amplitude, index, basis and position (x, y) [cycles/pixel] of the open samples at one wavelength."""
        field = replace(self.field, wavelength=wavelength)
        samples = aperture.samples(field)
        basis = zernike_basis(samples, aperture, n_modes).detach()  # (N, P, J)
        open_cell = samples.weights > 0
        mixing = mixing.to(basis).unflatten(0, (len(basis), n_modes))
        mixed = torch.einsum("npj,njk->npk", basis, mixing)[open_cell]
        weights = samples.weights.detach()[open_cell]
        # Parseval: this makes the sum of every PSF 1, whatever the phase, as long as holes share no cell.
        scale = float(weights.norm()) * math.prod(field.shape) ** 0.5
        positions = (samples.offsets + aperture.centers[:, None]).detach()[open_cell] / field.period
        return weights / scale, samples.index[open_cell], mixed * (self.grid.wavelength / wavelength), positions

    @property
    def n_parameters(self) -> int:
        """K, the number of aberrations of a frame."""
        return self.basis.shape[1]

    def unwrapped(self, z: Tensor, centre: Tensor) -> Tensor:
        """z (T, K) with full waves taken off the holes' pistons where that brings it closer to `centre`.

        Frames of one wavelength do not change; those of several would, and are left alone.
        """
        if self.n_wavelengths > 1 or len(self.mixing) == self.n_modes:  # one hole, whose piston is that of all
            return z
        own = self.n_parameters - self.n_static
        waves = 2 * math.pi * torch.linalg.pinv(self.mixing[:, :own].to(z))[:, :: self.n_modes]  # (own, N)
        z = z.clone()
        for _ in range(2):  # a wave off one hole may ask for one off its neighbour
            for wave in waves.T:
                away = z[:, :own] - centre[:, :own]
                z[:, :own] -= (away @ wave / wave.square().sum()).round()[:, None] * wave
        return z

    def chunks(self, n_frames: int) -> Iterator[slice]:
        """Slices of the frames whose work arrays stay small."""
        frame = 2 * self.basis.element_size() * self.n_wavelengths * math.prod(self.field.shape)
        size = max(1, _CHUNK // frame)
        return (slice(start, min(start + size, n_frames)) for start in range(0, n_frames, size))

    def pupil_field(self, z: Tensor) -> Tensor:
        """Complex field (T, P) on the open samples of the pupil."""
        return self._field(self._phase(z))

    def _phase(self, z: Tensor) -> Tensor:
        return z.to(self.basis.dtype) @ self.basis.T

    def _field(self, phase: Tensor) -> Tensor:
        return torch.complex(self.weights * phase.cos(), self.weights * phase.sin())  # faster than torch.polar

    def amplitude(self, field: Tensor) -> Tensor:
        """Focal amplitude (T, wavelength, H', W') of a pupil field (T, P)."""
        rasters = (self.n_wavelengths, *self.field.shape)
        pupil = field.new_zeros(len(field), math.prod(rasters)).index_add(1, self.index, field)
        return torch.fft.fft2(pupil.unflatten(1, rasters))

    def psf(self, z: Tensor) -> Tensor:
        """PSFs (T, H', W') of unit sum, origin at [0, 0], for z (T, K)."""
        return _intensity(self.amplitude(self.pupil_field(z)))

    def forward(self, image: Tensor, z: Tensor) -> Tensor:
        """Frames (T, H, W) of the object `image` (H', W') through the aberrations z (T, K)."""
        spectrum = torch.fft.rfft2(image.to(self.basis.dtype))
        frames = torch.fft.irfft2(torch.fft.rfft2(self.psf(z)) * spectrum, s=self.field.shape)
        return frames[..., : self.grid.shape[0], : self.grid.shape[1]]

    @torch.no_grad()
    def misfit(
        self,
        image: Tensor,
        z: Tensor,
        frames: Tensor,
        precision: Tensor,
        *,
        want_object: bool = True,
        want_aberrations: bool = True,
        parallel: Map = map,
    ) -> Misfit:
        """1/2 sum precision (forward - frames)^2 of every frame, and its gradients.

        Parameters
        ----------
        image : (H', W') tensor
        z : (T, K) tensor
        frames : (T, H, W) tensor
        precision : tensor that broadcasts to the frames' shape, with its first axis of length T or 1
            Inverse noise variance of each pixel, 0 where a pixel is not valid.
        want_object, want_aberrations : bool
            Which gradients to compute.
        parallel : callable
            Goes over the frames, a few at a time, as `map` does.
        """
        shape = self.field.shape
        spectrum = torch.fft.rfft2(image.to(self.basis.dtype))
        conjugate = spectrum.conj().resolve_conj()
        phase = self._phase(z)  # of all frames at once: one large matrix product is faster than many small ones

        @torch.no_grad()  # which holds for one thread only
        def compare(part: slice) -> tuple[Tensor, Tensor | None, Tensor | None]:
            pupil = self._field(phase[part])
            amplitude = self.amplitude(pupil)
            transfer = torch.fft.rfft2(_intensity(amplitude))
            model = torch.fft.irfft2(transfer * spectrum, s=shape)
            error = model[:, : self.grid.shape[0], : self.grid.shape[1]] - frames[part]
            residual = error * (precision[part] if len(precision) > 1 else precision)
            value = 0.5 * torch.linalg.vecdot(residual.flatten(1), error.flatten(1)).double()
            if not (want_object or want_aberrations):
                return value, None, None
            back = torch.fft.rfft2(residual, s=shape)
            by_object = (transfer.conj() * back).sum(0) if want_object else None
            if not want_aberrations:
                return value, by_object, None
            psf_gradient = torch.fft.irfft2(back * conjugate, s=shape)
            return value, by_object, self.pull_back(pupil, amplitude, psf_gradient)

        values, by_object, slopes = zip(*parallel(compare, self.chunks(len(z))), strict=True)
        return Misfit(
            torch.cat(values),
            torch.fft.irfft2(sum(by_object[1:], by_object[0]), s=shape).to(image.dtype) if want_object else None,
            (torch.cat(slopes) @ self.basis).to(z.dtype) if want_aberrations else None,
        )

    def pull_back(self, field: Tensor, amplitude: Tensor, psf_gradient: Tensor) -> Tensor:
        """Gradient with respect to the phase (T, P) from that with respect to the PSF (T, H', W')."""
        back = torch.fft.ifft2(amplitude * psf_gradient[:, None], norm="forward").flatten(1).index_select(1, self.index)
        return 2 * (back.imag * field.real - back.real * field.imag)

    @torch.no_grad()
    def curvature(
        self, image: Tensor, z: Tensor, precision: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, float]:
        """Diagonal of the Gauss-Newton Hessian of `misfit`: mean over frames for each z (K,), and for one object pixel.

        J^T W J is the covariance of J^T W^(1/2) n with white noise n, so one draw of noise per frame suffices for
        a diagonal that is averaged over frames (Bekas, Kokiopoulou & Saad, Appl. Numer. Math. 57, 1214, 2007).
        """
        shape = self.field.shape
        conjugate = torch.fft.rfft2(image.to(self.basis.dtype)).conj().resolve_conj()
        total, pixel = torch.zeros_like(z[0]), 0.0
        for part in self.chunks(len(z)):
            field = self.pupil_field(z[part])
            amplitude = self.amplitude(field)
            weight = (precision[part] if len(precision) > 1 else precision).expand(len(field), *self.grid.shape)
            for _ in range(4):
                noise = (
                    torch.randn(weight.shape, dtype=weight.dtype, device="cpu", generator=generator).to(weight)
                    * weight.sqrt()
                )
                back = torch.fft.irfft2(torch.fft.rfft2(noise, s=shape) * conjugate, s=shape)
                gradient = self.pull_back(field, amplitude, back) @ self.basis
                total += (gradient**2).sum(0).to(z.dtype) / 4
            energy = (_intensity(amplitude) ** 2).sum((1, 2))
            pixel += float((energy * weight.mean((1, 2))).sum())
        return total / len(z), pixel


def _intensity(amplitude: Tensor) -> Tensor:
    """(T, H', W') of amplitudes (T, wavelength, H', W')."""
    power = amplitude.real**2 + amplitude.imag**2
    return power[:, 0] if power.shape[1] == 1 else power.sum(1)


def _band(
    grid: Grid, wavelengths: Sequence[float] | None, weights: Sequence[float] | None
) -> list[tuple[float, float]]:
    """Wavelengths [m] with their shares of the light, which sum to 1."""
    if wavelengths is None:
        if weights is not None:
            raise ValueError("weights are given without wavelengths: give both")
        return [(grid.wavelength, 1.0)]
    shares = [1.0] * len(wavelengths) if weights is None else [float(weight) for weight in weights]
    if not len(wavelengths) or len(shares) != len(wavelengths):
        raise ValueError(
            f"{len(wavelengths)} wavelengths have {len(shares)} weights: as many, and at least 1, are needed"
        )
    for name, values in (("wavelengths", wavelengths), ("weights", shares)):
        if not all(math.isfinite(value) and value > 0 for value in values):
            raise ValueError(f"{name} are {list(values)}: they must be finite and positive")
    return [(float(wavelength), share / sum(shares)) for wavelength, share in zip(wavelengths, shares, strict=True)]


class _WeightedMisfit(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, model: ExposureModel, image: Tensor, z: Tensor, frames: Tensor, precision: Tensor) -> Tensor:
        wanted = ctx.needs_input_grad
        result = model.misfit(image, z, frames, precision, want_object=wanted[1], want_aberrations=wanted[2])
        ctx.gradients = result.object_gradient, result.aberration_gradient
        return result.value.sum().to(image.dtype)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> Any:
        by_object, by_aberrations = (None if g is None else grad[0] * g for g in ctx.gradients)
        return None, by_object, by_aberrations, None, None


def weighted_misfit(model: ExposureModel, image: Tensor, z: Tensor, frames: Tensor, precision: Tensor) -> Tensor:
    """The sum of `model.misfit` as a scalar that autograd differentiates in `image` and `z`, once."""
    return _WeightedMisfit.apply(model, image, z, frames, precision)  # type: ignore[no-any-return]


def fast_size(n: int) -> int:
    """The least even number of at least `n` without prime factors beyond 5: a fast FFT.

    >>> fast_size(128), fast_size(154)
    (128, 160)
    """
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1 and n % 2 == 0:
            return n
        n += 1
