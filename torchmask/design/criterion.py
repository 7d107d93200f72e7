"""MSE_a, the error of the best linear restoration from many short exposures, in closed form and without an image.

Every sub-aperture has an independent uniform piston, so the expected squared transfer function of the mask is the sum
over its baselines of the squared OTF of one sub-aperture. The terms of that sum are compact and the sum is even in nu,
so each unordered pair of sub-apertures contributes one small patch of pixels on half the frequency plane.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn

from torchmask.design.fluctuation import mean_inverse, piston_powers
from torchmask.design.overlap import Geometry, baseline_mse
from torchmask.design.psd_layers import KeptLayers, Layers, psd_layers
from torchmask.grid import Grid
from torchmask.memory import keep_freed_memory, require_memory
from torchmask.numbers import whole_number
from torchmask.optics.aperture import FullAperture
from torchmask.optics.pupil import Aperture
from torchmask.spectra import PSD, evaluate_psd, resample_psd

_SAME = 1e-6  # relative rounding of a PSD that was in float32
_BYTES = 60  # of memory for each frequency, in one evaluation


class AsymptoticMSE(nn.Module):
    """Mean squared error of the multi-frame Wiener restoration, in the limit of many frames.

    MSE_a = mean over nu of S_o S_n / (K S_o (N^2 |h(nu)|^2 + sum_{m != n} |h(nu + nu_m - nu_n)|^2) + S_n), with h the
    OTF of one centred sub-aperture over the number of sub-apertures N, K the number of frames, S_o and S_n the PSDs.
    Baselines wrap around the frequency torus. On average over the pistons no linear restoration does better (Jensen);
    with single draws of them it may.

    Parameters
    ----------
    grid : Grid
        Grid at whose frequencies the integral is sampled. It must resolve h: use at least 256 pixels for final results.
    object_psd : callable or Tensor
        PSD of the object, at least 0: a function psd(grid, dtype, device) such as `PowerLawPSD`, or a tensor that
        broadcasts to (H, W) in FFT order. It need not be symmetric.
    noise_psd : callable or Tensor
        PSD of the noise, positive, such as `NoisePSD`.
    n_frames : int
        Number of exposures, K.

    Raises
    ------
    ValueError, TypeError
        If a PSD has a wrong shape, sign or type, or `n_frames` is below 1.

    Notes
    -----
    `forward(aperture)` returns (...), one value for each mask of the population `aperture.centers` (..., N, 2), in
    the dtype of the centres (float64 or float32) and differentiable once in them. Computing time grows with the G^2
    pixels of the grid and the 2 N^2 c^2 G^2 pixels of the patches, c = diameter of a sub-aperture / grid.period; large
    populations are split into chunks to limit memory. It raises ValueError for a full pupil and for c > 1/2. With
    `torch.func.vmap` over centres, the mapped axis is one more axis of the population. On CUDA equal calls may differ
    by rounding (atomic sums). Values follow `object_psd`, `noise_psd` and `n_frames` where these are changed.

    Examples
    --------
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> from torchmask.optics.aperture import SparseAperture
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
    >>> criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)
    >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> round(float(criterion.relative(mask)), 2)
    0.53
    """

    object_psd: Tensor
    noise_psd: Tensor

    def __init__(self, grid: Grid, object_psd: PSD, noise_psd: PSD, n_frames: int) -> None:
        super().__init__()
        n_frames = whole_number("n_frames", n_frames)
        require_memory("n_pixels", max(grid.shape), _BYTES * math.prod(grid.shape), power=2)
        self.grid: Grid = grid
        self.n_frames: int = n_frames
        self._kept = KeptLayers()
        self._object_model = None if isinstance(object_psd, Tensor) else object_psd
        self.register_buffer("object_psd", _made(object_psd, grid, "object_psd"))
        self.register_buffer("noise_psd", _made(noise_psd, grid, "noise_psd"))
        if not bool((self.noise_psd > 0).all()):
            raise ValueError("noise_psd is 0 somewhere: it must be positive, or the error would be 0 there")
        if not bool((self.object_psd > 0).any()):
            raise ValueError("object_psd is 0 everywhere: there is nothing to restore")
        keep_freed_memory()  # values of populations take and free the same arrays over and over

    def _layers(self) -> Layers:
        """Return weight and ratio (layers, H // 2 + 1, W) of the present PSDs and number of frames."""
        return self._kept.of(self.object_psd, self.noise_psd, self.n_frames, self._make_layers)

    def _make_layers(self, object_psd: Tensor, noise_psd: Tensor, n_frames: int) -> Layers:
        return psd_layers(object_psd, noise_psd, whole_number("n_frames", n_frames))

    def forward(self, aperture: Aperture) -> Tensor:
        geometry = self._geometry(aperture)
        centers = aperture.centers
        flat = centers.reshape(math.prod(centers.shape[:-2]), *centers.shape[-2:])
        weight, ratio = (part.to(centers.dtype) for part in self._layers())
        return baseline_mse(flat, weight, ratio, geometry).reshape(centers.shape[:-2])

    def relative(self, aperture: Aperture) -> Tensor:
        """Return MSE_a over the mean of the object's PSD, (...): 0 is a perfect restoration, 1 none at all."""
        return self(aperture) / self.object_psd.mean().to(aperture.centers.dtype)

    def jensen_term(self, aperture: Aperture) -> Tensor:
        """Return by how much the mean error of K exposures exceeds MSE_a, (...), not differentiable.

        `criterion(aperture) + criterion.jensen_term(aperture)` predicts the mean of `wiener_mse` over random exposures.
        The term is that of a Gamma distribution of the mean of |OTF|^2 over K exposures, with the variance that
        `torchmask.design.fluctuation` derives; to second order it is Jensen's. For K below 5 it is too small. Raises
        ValueError and TypeError as `forward` does.
        """
        with torch.no_grad():
            mean, steady = self._powers(aperture)
            weight, ratio = (part.to(mean.dtype) for part in self._layers())
            mean, steady = mean[..., None, :, :], steady[..., None, :, :]
            variance = (mean**2 - steady).clamp(min=0) / self.n_frames
            excess = mean_inverse(mean, variance, ratio) - 1 / (mean + ratio)
            return (weight * excess).sum((-3, -2, -1))

    def _powers(self, aperture: Aperture) -> tuple[Tensor, Tensor]:
        """Return E|OTF|^2 and the sum over lenses of the square of its steady part, both (..., H // 2 + 1, W)."""
        geometry, centers = self._geometry(aperture), aperture.centers
        flat = centers.reshape(math.prod(centers.shape[:-2]), *centers.shape[-2:])
        mean, steady = piston_powers(flat, geometry, self.grid.wavelength)
        return mean.reshape(*centers.shape[:-2], *mean.shape[-2:]), steady.reshape(
            *centers.shape[:-2], *mean.shape[-2:]
        )

    def floor(self, mask_diameter: float) -> Tensor:
        """Return the part of MSE_a () that no mask of `mask_diameter` [m] can change: S_o beyond its cut-off."""
        if not (math.isfinite(mask_diameter) and mask_diameter > 0):
            raise ValueError(f"mask_diameter is {mask_diameter}: it must be finite and positive, in m")
        nu_y, nu_x = self.grid.frequencies(self.object_psd.dtype, self.object_psd.device)
        beyond = torch.hypot(nu_y, nu_x) >= self._cutoff(mask_diameter)
        return (self.object_psd * beyond).mean()

    def _cutoff(self, mask_diameter: float) -> float:
        """Return the highest frequency that a mask of this diameter [m] transmits [cycles/pixel]."""
        return self.grid.cutoff(mask_diameter)

    def relative_floor(self, mask_diameter: float) -> float:
        """Return `floor` over the mean of the object's PSD: no mask of `mask_diameter` [m] has a lower `relative`."""
        return float(self.floor(mask_diameter) / self.object_psd.mean())

    def on_grid(self, n_pixels: int | tuple[int, int]) -> Self:
        """Return the same criterion with its integral sampled on another grid of the same pixel scale.

        A coarse grid makes searches fast. The image does not change: the noise keeps its level, including the read-out
        noise. A callable object PSD is evaluated again; tensors are interpolated (`resample_psd`), and so is a PSD that
        was changed.
        """
        grid, psd = replace(self.grid, n_pixels=n_pixels), self.object_psd
        model = self._object_model
        with psd.device:  # whatever the default device: PSDs are made where none is told
            if model is None or not torch.allclose(
                evaluate_psd(model, self.grid, "object_psd").to(psd), psd, rtol=_SAME, atol=0.0
            ):
                model = resample_psd(psd, grid.shape)
            return self._like(grid, model, resample_psd(self.noise_psd, grid.shape)).to(psd.dtype)

    def _like(self, grid: Grid, object_psd: PSD, noise_psd: PSD) -> Self:
        """Return the same criterion with another grid and other PSDs."""
        return type(self)(grid, object_psd, noise_psd, self.n_frames)

    def _check(self, aperture: Aperture) -> None:
        """Raise TypeError for anything but an aperture, and ValueError for devices that differ or half precision."""
        if not isinstance(aperture, Aperture):
            raise TypeError(f"aperture is a {type(aperture).__name__}: make a SparseAperture from the centres")
        centers, psd = aperture.centers, self.object_psd
        precise = (torch.float32, torch.float64)  # squares of photons overflow in others
        if centers.dtype not in precise or psd.dtype not in precise or centers.device != psd.device:
            raise ValueError(
                f"the centres are {centers.dtype} on {centers.device}, the criterion {psd.dtype} on {psd.device}: both "
                "must be on one device, in float32 or float64"
            )

    def _geometry(self, aperture: Aperture) -> Geometry:
        self._check(aperture)
        if isinstance(aperture, FullAperture):
            raise ValueError(
                "MSE_a is defined for masks (SparseAperture): a full pupil has aberrations that a piston per "
                "sub-aperture does not describe; use TurbulentMSE with the r0 of the site, or wiener_mse of random OTFs"
            )
        reach = aperture.outer_diameter
        if reach > 0.5 * self.grid.period * (1 + 1e-9):
            needed = (1 - 1e-6) * self.grid.wavelength / (2 * reach)
            raise ValueError(
                f"the OTF of a sub-aperture reaches {self.grid.cutoff(reach):.3f} cycles/pixel, above 1/2, and "
                f"overlaps itself: pixel_scale must be at most {needed:.7g} rad"
            )
        return Geometry(self.grid.shape, self.grid.period, aperture.shape, aperture.subaperture_diameter, reach)

    def extra_repr(self) -> str:
        return f"grid={self.grid}, n_frames={self.n_frames}"


def wiener_mse(otfs: Tensor, object_psd: PSD, noise_psd: PSD) -> Tensor:
    """Return the mean squared error of the multi-frame Wiener restoration for given OTFs.

    Parameters
    ----------
    otfs : (..., frame, H, W) tensor
        OTF of each exposure, complex or real, in FFT order.
    object_psd : callable or Tensor
        PSD of the object, as for `AsymptoticMSE`. A callable receives a grid of the OTFs' shape whose pixel scale and
        wavelength are 1, so it may depend on frequencies in cycles/pixel only.
    noise_psd : callable or Tensor
        PSD of the noise of one exposure, likewise.

    Returns
    -------
    Tensor
        (...), the mean over nu of S_o S_n / (S_o sum_k |h_k|^2 + S_n), and of S_o where no light and no noise arrive,
        differentiable in all arguments that are tensors.
        Its average over random pistons is at least MSE_a; OTFs that are sampled in the pupil (`OTF`) need an
        oversampling of 4 or more for that, since what they leak beyond the baselines counts as signal.

    Raises
    ------
    ValueError, TypeError
        If OTFs have no frame axis, or a PSD has a wrong shape, sign or type.

    Examples
    --------
    With perfect optics and one exposure, the error is that of the noise:

    >>> perfect = torch.ones(1, 8, 8, dtype=torch.float64)
    >>> round(float(wiener_mse(perfect, torch.tensor(100.0), torch.tensor(1.0))), 4)  # S_o S_n / (S_o + S_n)
    0.9901
    """
    if otfs.ndim < 3:
        raise ValueError(f"otfs has shape {tuple(otfs.shape)}: it must be (..., frame, H, W)")
    grid = Grid((otfs.shape[-2], otfs.shape[-1]), 1.0, 1.0)
    real = otfs.real.dtype if otfs.is_complex() else otfs.dtype
    s_o = evaluate_psd(object_psd, grid, "object_psd", real, otfs.device)
    s_n = evaluate_psd(noise_psd, grid, "noise_psd", real, otfs.device)
    power = (otfs.real**2 + otfs.imag**2 if otfs.is_complex() else otfs**2).sum(-3)
    denominator = s_o * power + s_n
    is_seen = denominator > 0
    return (s_o * torch.where(is_seen, s_n / torch.where(is_seen, denominator, 1.0), 1.0)).mean((-2, -1))


def _made(psd: PSD, grid: Grid, name: str) -> Tensor:
    """Return the values of a PSD (H, W) for a buffer, fit for a gradient whatever mode they are made in."""
    values = evaluate_psd(psd, grid, name)
    with torch.inference_mode(False):
        return values.detach().clone() if values.is_inference() else values.detach()
