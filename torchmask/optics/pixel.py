"""The response of a detector's pixels, which blurs every image in the same way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor


class PixelResponse(Protocol):
    """Response of a pixel to each spatial frequency."""

    def transfer(self, nu_y: Tensor, nu_x: Tensor) -> Tensor:
        """Return the transfer function (H, W), 1 at zero, at frequencies (H, 1) and (1, W) [cycles/pixel]."""
        ...


def require_response(pixel: PixelResponse | None) -> None:
    """Raise TypeError unless a pixel is a response, or None."""
    if pixel is not None and not callable(getattr(pixel, "transfer", None)):
        raise TypeError(f"pixel is {pixel!r}: a response such as SquarePixel(0.9) is needed, or None for points")


@dataclass(frozen=True)
class SquarePixel:
    """Pixels that are uniformly sensitive within a square, whose transfer function is a product of two sincs.

    fill_factor : sensitive fraction of the pixel's area

    Raises ValueError unless `fill_factor` lies in (0, 1].

    Examples
    --------
    >>> nu = torch.tensor([0.0, 0.5])
    >>> round(float(SquarePixel().transfer(nu[:, None], nu)[0, 1]), 4)  # 2 / pi at Nyquist
    0.6366
    """

    fill_factor: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.fill_factor <= 1:
            raise ValueError(f"fill_factor is {self.fill_factor}: it must be a fraction, above 0 and at most 1")

    def __str__(self) -> str:
        return f"square, fill factor {self.fill_factor:.4g}"

    def transfer(self, nu_y: Tensor, nu_x: Tensor) -> Tensor:
        """Return sinc(w nu_y) sinc(w nu_x), with w the side of the square in pixels."""
        width = math.sqrt(self.fill_factor)
        return torch.sinc(width * nu_y) * torch.sinc(width * nu_x)


@dataclass(frozen=True, eq=False)
class MappedPixel:
    """Pixels whose response is given by a map that may extend beyond one pixel.

    sensitivity : (rows, columns), a map centred on the pixel, not negative, in any unit
    samples : number of samples of the map per pixel along each axis

    Raises ValueError if the map is not two-dimensional, is zero everywhere, or has negative or non-finite values, or if
    `samples` is below 1.

    Examples
    --------
    >>> nu = torch.fft.rfftfreq(8)
    >>> fine = MappedPixel(torch.ones(64, 64), samples=64).transfer(nu[:, None], nu)
    >>> torch.allclose(fine, SquarePixel().transfer(nu[:, None], nu).to(fine), atol=1e-3)
    True
    """

    sensitivity: Tensor
    samples: int

    def __post_init__(self) -> None:
        if self.sensitivity.ndim != 2 or self.samples < 1:
            raise ValueError(
                f"sensitivity has shape {tuple(self.sensitivity.shape)} and samples is {self.samples}: a map (rows, "
                "columns) with at least 1 sample per pixel is needed"
            )
        total = float(self.sensitivity.sum())
        if not (0 < total < math.inf and float(self.sensitivity.min()) >= 0):
            raise ValueError("sensitivity must be finite, nowhere negative and somewhere positive")

    def __str__(self) -> str:
        rows, columns = self.sensitivity.shape
        return f"map of {rows} x {columns} samples, {self.samples} per pixel"

    def transfer(self, nu_y: Tensor, nu_x: Tensor) -> Tensor:
        """Return the normalised Fourier transform of the map, complex (H, W)."""
        weights = (self.sensitivity / self.sensitivity.sum()).to(nu_y)
        by_y, by_x = (
            torch.exp(-2j * math.pi * nu.reshape(-1, 1) * self._places(size).to(nu))
            for nu, size in zip((nu_y, nu_x), weights.shape, strict=True)
        )
        return by_y @ weights.to(by_y) @ by_x.T

    def _places(self, size: int) -> Tensor:
        """Return the positions of the samples along one axis [pixels]."""
        return (torch.arange(size, device="cpu") - (size - 1) / 2) / self.samples


@dataclass(frozen=True)
class JitteredPixel:
    """Pixels before which the image jitters while a frame lasts, as by vibrations of the telescope.

    Motion that is fast and normally distributed convolves every image with a Gaussian, so that it is a part of the
    response of the pixels.

    rms : standard deviation of the motion along each axis [pixels]
    pixel : response of the pixels at rest; None: they are points

    Raises ValueError unless `rms` is finite and not negative.

    Examples
    --------
    >>> nu = torch.tensor([0.0, 0.5])
    >>> round(float(JitteredPixel(0.3).transfer(nu[:, None], nu)[0, 1]), 4)  # exp(-2 pi^2 0.3^2 0.5^2)
    0.6414
    """

    rms: float
    pixel: PixelResponse | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rms) and self.rms >= 0):
            raise ValueError(f"rms is {self.rms}: it must be finite and at least 0, in pixels")

    def __str__(self) -> str:
        return f"{self.pixel or 'points'}, jitter of {self.rms:.4g} pixels rms"

    def transfer(self, nu_y: Tensor, nu_x: Tensor) -> Tensor:
        """Return exp(-2 pi^2 rms^2 (nu_y^2 + nu_x^2)) times the transfer function of the pixels at rest."""
        blur = torch.exp(-2 * (math.pi * self.rms) ** 2 * (nu_y**2 + nu_x**2))
        return blur if self.pixel is None else blur * self.pixel.transfer(nu_y, nu_x)


def square_pixel(pixel_fill: float) -> SquarePixel | None:
    """Return square pixels, or None, which means points, for a fill factor of 0. Raises ValueError above 1 or below 0.

    The error names the number by its name in instruments and options, where a fill factor is that of a mask.

    Examples
    --------
    >>> square_pixel(0.8), square_pixel(0.0)
    (SquarePixel(fill_factor=0.8), None)
    """
    if not 0 <= pixel_fill <= 1:
        raise ValueError(f"pixel_fill is {pixel_fill}: it must be a fraction, from 0 for points to 1 without gaps")
    return SquarePixel(pixel_fill) if pixel_fill else None


def jittered(pixel: PixelResponse | None, rms: float) -> PixelResponse | None:
    """Return pixels with a jitter of `rms` [pixels] in place of what they have; with 0 they are at rest.

    Examples
    --------
    >>> print(jittered(SquarePixel(), 0.2), jittered(JitteredPixel(0.3, SquarePixel()), 0.0), sep="; ")
    square, fill factor 1, jitter of 0.2 pixels rms; square, fill factor 1
    """
    at_rest = pixel.pixel if isinstance(pixel, JitteredPixel) else pixel
    return JitteredPixel(rms, at_rest) if rms else at_rest


def pixel_record(pixel: PixelResponse | None) -> dict[str, Any]:
    """Return a pixel response as values for a file, none of them for points.

    Raises ValueError for a response that is neither a `SquarePixel` nor a `MappedPixel`, at rest or jittered.
    """
    if pixel is None:
        return {}
    if isinstance(pixel, SquarePixel):
        return {"pixel_fill": pixel.fill_factor}
    if isinstance(pixel, MappedPixel):
        return {"pixel_map": pixel.sensitivity, "pixel_samples": pixel.samples}
    if isinstance(pixel, JitteredPixel):
        return {"pixel_jitter": pixel.rms} | pixel_record(pixel.pixel)
    raise ValueError(f"a {type(pixel).__name__} cannot be written to a file: give a SquarePixel or a MappedPixel")


def read_pixel(record: Mapping[str, Any]) -> PixelResponse | None:
    """Return the pixel response that a `pixel_record` describes. Raises ValueError for numbers out of range."""
    if "pixel_jitter" in record:
        at_rest = {name: value for name, value in record.items() if name != "pixel_jitter"}
        return JitteredPixel(float(record["pixel_jitter"]), read_pixel(at_rest))
    if "pixel_fill" in record:
        return SquarePixel(float(record["pixel_fill"]))
    if "pixel_map" in record:
        return MappedPixel(torch.as_tensor(record["pixel_map"]), int(record["pixel_samples"]))
    return None
