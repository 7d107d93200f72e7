"""Power spectral densities of the object and of the noise, in the convention of an unnormalised DFT."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.numbers import require, whole_number

PSD = Tensor | Callable[..., Tensor]
"""A tensor that broadcasts to (H, W) in FFT order, or a callable psd(grid, dtype, device) that returns one."""

NYQUIST = 0.5  # largest frequency that pixels show along either axis [cycles/pixel]


@dataclass(frozen=True)
class PowerLawPSD:
    """PSD of natural scenes: S_o(nu) = n_photons^2 max(|nu| / knee, 1)^(-exponent).

    Parameters
    ----------
    exponent : float
        Exponent of the power law, at least 0; between 1 and 3 for most scenes.
    n_photons : float
        Number of photons in the whole image. S_o(0) = n_photons^2 on any grid.
    knee : float
        Frequency below which the PSD is flat, one over the size of the object [cycles/pixel], at most 0.5.

    Raises
    ------
    ValueError
        If a number is not finite or out of range.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
    >>> psd = PowerLawPSD(exponent=1.5, n_photons=1e7)
    >>> float(psd(grid)[0, 0]), float(psd(grid)[0, 4])  # |nu| = 0 and 4/64
    (100000000000000.0, 12500000000000.0)
    """

    exponent: float
    n_photons: float
    knee: float = 1 / 64

    def __post_init__(self) -> None:
        require("exponent", self.exponent, ", a pure number", zero=True)
        require("n_photons", self.n_photons, ", in photons per image")
        require("knee", self.knee, ", in cycles/pixel; of an object of 64 pixels it is 1/64", most=NYQUIST)

    def __call__(
        self, grid: Grid, dtype: torch.dtype | None = torch.float64, device: torch.device | str | None = None
    ) -> Tensor:
        """Return the PSD at the frequencies of `grid`, (H, W) in FFT order [photons^2]."""
        nu_y, nu_x = grid.frequencies(dtype, device)
        return self.n_photons**2 * (torch.hypot(nu_y, nu_x) / self.knee).clamp(min=1) ** -self.exponent


@dataclass(frozen=True)
class NoisePSD:
    """White PSD of photon and read-out noise: S_n = n_photons + n_pixels readout_noise^2.

    Parameters
    ----------
    n_photons : float
        Number of photons in one exposure.
    readout_noise : float
        Read-out noise [electrons rms per pixel].
    n_pixels : int, optional
        Total number of pixels that are read out; by default that of the grid. Give it if the grid is not the image,
        such as a finer grid for an integral over frequencies.

    Raises
    ------
    ValueError
        If a number is not finite or out of range.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> psd = NoisePSD(n_photons=1e6, readout_noise=2.0)
    >>> float(psd(Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=100))[0, 0])  # 1e6 + 100^2 2^2
    1040000.0
    """

    n_photons: float
    readout_noise: float = 0.0
    n_pixels: int | None = None

    def __post_init__(self) -> None:
        require("n_photons", self.n_photons, ", in photons per exposure")
        require("readout_noise", self.readout_noise, ", in electrons rms per pixel", zero=True)
        if self.n_pixels is not None:
            object.__setattr__(self, "n_pixels", whole_number("n_pixels", self.n_pixels))

    def __call__(
        self, grid: Grid, dtype: torch.dtype | None = torch.float64, device: torch.device | str | None = None
    ) -> Tensor:
        """Return the PSD at the frequencies of `grid`, (H, W) [photons]."""
        n_pixels = math.prod(grid.shape) if self.n_pixels is None else self.n_pixels
        level = self.n_photons + n_pixels * self.readout_noise**2
        return torch.full(grid.shape, level, dtype=dtype, device=device)


def evaluate_psd(
    psd: PSD,
    grid: Grid,
    name: str,
    dtype: torch.dtype | None = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Evaluate `psd` at the frequencies of `grid` as a new tensor (H, W), differentiable in a tensor that is given.

    Raises
    ------
    TypeError
        If it is neither a tensor nor callable, or returns something other than a real floating-point tensor.
    ValueError
        If it does not broadcast to the grid, or has negative or non-finite values. Messages call the PSD `name`.
    """
    value: Any = psd if isinstance(psd, Tensor) or not callable(psd) else psd(grid, dtype, device)
    if not isinstance(value, Tensor) or not value.is_floating_point():
        given = f"{value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} is a {given}: it must be a real tensor (H, W), or psd(grid, dtype, device) giving one")
    try:
        value = value.to(dtype=dtype, device=device).expand(grid.shape).clone()
    except RuntimeError:
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}: it must broadcast to the grid's {grid.shape[0]} x {grid.shape[1]}"
        ) from None
    if not bool((torch.isfinite(value) & (value >= 0)).all()):
        raise ValueError(f"{name} holds negative or non-finite values: a PSD must be finite and at least 0")
    return value


def resample_psd(psd: Tensor, shape: tuple[int, int]) -> Tensor:
    """Interpolate `psd` (H, W) to a grid of `shape` with the same pixels, bilinearly on the frequency torus.

    Frequencies common to both grids keep their values.
    """
    for axis, size in ((-2, shape[0]), (-1, shape[1])):
        old = psd.shape[axis]
        # Integer arithmetic, so that common frequencies coincide exactly.
        position = ((torch.arange(size, device=psd.device) + size // 2) % size - size // 2) * old
        lower, weight = position // size, (position % size).to(psd.dtype) / size
        if axis == -2:
            weight = weight[:, None]
        first = psd.index_select(axis, lower % old)
        second = psd.index_select(axis, (lower + 1) % old)
        psd = first + weight * (second - first)
    return psd
