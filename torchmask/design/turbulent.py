"""The error of a restoration from real exposures: turbulence inside the holes, time, pixels and sky, in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.lens_coherence import PolarTable
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import mean_square_otf, steady_square_otf
from torchmask.design.apart import make_apart
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.early_gradient import by_chunks
from torchmask.design.frequency_plane import half_plane
from torchmask.design.mask_transfer import MaskTransfer
from torchmask.design.overlap import Geometry
from torchmask.design.psd_layers import Layers
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.optics.pupil import Aperture
from torchmask.optics.shape_base import Shape
from torchmask.spectra import PSD

_KEPT = 8  # tables of as many kinds of holes
_PUPIL = (40, 16)  # distances and directions at which a full pupil is measured
_NOTHING = 1e-12  # of T
_DARKEST = 1e-12  # response of a pixel: a frequency that it does not see


class TurbulentMSE(AsymptoticMSE):
    """Mean squared error of the multi-frame Wiener restoration under real turbulence, in the limit of many frames.

    As `AsymptoticMSE`, with E|OTF|^2 under von Karman turbulence and a finite exposure (Korff's integral, see
    `torchmask.atmosphere.transfer`) in place of independent pistons on holes without turbulence inside them. The
    error of K exposures, on average, is above it by `jensen_term`.

    Parameters
    ----------
    grid, object_psd, noise_psd, n_frames
        As for `AsymptoticMSE`.
    r0 : float, optional
        Fried's parameter at the wavelength of the grid [m]. None: independent uniform pistons, which is `AsymptoticMSE`
        exactly; it knows neither full pupils nor exposures.
    outer_scale : float
        Outer scale of the turbulence [m].
    exposure : float
        Exposure time of a frame [s].
    wind : float or (float, float)
        Speed of the wind [m/s], all directions being equally likely, or its velocity (vx, vy).
    pixel : PixelResponse, optional
        Response of the detector's pixels, such as `SquarePixel()`; None for pixels that are points.
    wavelengths, weights : sequence of float, optional
        Wavelengths of a broad band [m] and the share of the light at each (None: equal), such as those of
        `Band.top_hat`; without them, all light has the wavelength of the grid, to which r0 belongs in any case. Seven
        do for a width of 20 %.
    sky : float
        Light of the sky [electrons per pixel and exposure]. It adds to the noise as many times as there are pixels:
        those of `NoisePSD(n_pixels=)`, or else of the grid.

    Raises
    ------
    ValueError, TypeError
        As `AsymptoticMSE`, `Seeing` and `Band.of`; for an exposure, outer scale or band without r0, a wind without an
        exposure, weights without wavelengths, and a sky that is negative. In a call, ValueError for a full pupil that
        the pixels undersample at the band's shortest wavelength, as `PSF` does.

    Notes
    -----
    `forward(aperture)` returns (...), one value for each mask of the population `aperture.centers` (..., N, 2), in
    their dtype and differentiable in them; full pupils, with a central obstruction and vanes or without, are answered
    too. The first call for a kind of hole makes tables, which takes seconds (longer for a wind of known direction and
    for holes that are not round); those of the last 8 kinds are kept. E|OTF|^2 of masks is within 3 % of Korff's
    integral for holes of 0.4 to 1.5 r0, exposures up to 2 tau0 and bands up to 20 % wide, where it is above 2 % of what
    one pair of holes gives at most, and within 5 % below, but for single frequencies (4.9 and 13 % were found by
    looking for the worst); that of full pupils, which is interpolated, within 2 % where it is above 1e-4 (4 % with
    vanes of D/25, or with an outer scale of 5 D). Baselines of masks beyond the frequency torus alias as in MSE_a;
    those of full pupils are refused. A value takes 7 to 20 times as long as that of MSE_a, 35 to 120 times for 7
    wavelengths over 20 % with an exposure, and its gradient two to three times the value.

    Examples
    --------
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> from torchmask.optics.aperture import FullAperture, SparseAperture
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
    >>> criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e6), NoisePSD(1e6), n_frames=20, r0=0.15)
    >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.15, 1.0)
    >>> round(float(criterion.relative(mask)), 2), round(float(criterion.relative(FullAperture(1.0))), 2)
    (0.66, 0.08)
    """

    def __init__(
        self,
        grid: Grid,
        object_psd: PSD,
        noise_psd: PSD,
        n_frames: int,
        r0: float | None = None,
        outer_scale: float = math.inf,
        exposure: float = 0.0,
        wind: float | tuple[float, float] = 0.0,
        wavelengths: Sequence[float] | None = None,
        weights: Sequence[float] | None = None,
        pixel: PixelResponse | None = None,
        sky: float = 0.0,
    ) -> None:
        super().__init__(grid, object_psd, noise_psd, n_frames)
        if not (math.isfinite(sky) and sky >= 0):
            raise ValueError(f"sky is {sky}: it must be finite and not negative, in electrons per pixel")
        if wavelengths is None and weights is not None:
            raise ValueError(f"weights are {list(weights)} without wavelengths: give both, or neither")
        self.band: Band | None = None
        if wavelengths is not None:
            self.band = Band.given(Band.of(wavelengths, weights), grid.wavelength)
        if r0 is None and (exposure != 0 or math.isfinite(outer_scale) or self.band is not None):
            raise ValueError(
                f"r0 is None, for independent pistons, but outer_scale is {outer_scale}, exposure {exposure} and "
                f"wavelengths {wavelengths}: they need turbulence, so give its r0 in m at the grid's wavelength"
            )
        if exposure == 0 and np.any(np.asarray(wind) != 0):
            raise ValueError(
                f"wind is {wind} but exposure is 0: an instant feels no wind, so give the exposure in s, or no wind"
            )
        self.seeing: Seeing | None = None if r0 is None else Seeing(r0, outer_scale, exposure, wind)
        self.pixel: PixelResponse | None = pixel
        self.noise_psd += sky * (getattr(noise_psd, "n_pixels", None) or math.prod(grid.shape))
        self._tables: dict[tuple[Any, ...], Any] = {}

    def _make_layers(self, object_psd: Tensor, noise_psd: Tensor, n_frames: int) -> Layers:
        weight, ratio = super()._make_layers(object_psd, noise_psd, n_frames)
        if self.pixel is None:
            return weight, ratio
        nu_y, nu_x = self.grid.frequencies(ratio.dtype, ratio.device)
        response = self.pixel.transfer(nu_y, nu_x).abs()[: ratio.shape[-2]] ** 2
        return weight / response.clamp(min=_DARKEST), ratio / response.clamp(min=_DARKEST)

    def _like(self, grid: Grid, object_psd: PSD, noise_psd: PSD) -> TurbulentMSE:
        # the sky is in the noise already
        seeing = {} if self.seeing is None else asdict(self.seeing)
        lengths, shares = (None, None) if self.band is None else (self.band.wavelengths, self.band.shares)
        return type(self)(
            grid,
            object_psd,
            noise_psd,
            self.n_frames,
            **seeing,
            wavelengths=lengths,
            weights=shares,
            pixel=self.pixel,
        )

    def forward(self, aperture: Aperture) -> Tensor:
        if self.seeing is None:
            return super().forward(aperture)
        self._check(aperture)
        if aperture.is_full:
            return self._error(self._half_power(aperture))
        transfer, n, centers = self._table(aperture, self._mask_transfer), aperture.n_subapertures, aperture.centers
        flat = centers.reshape(math.prod(centers.shape[:-2]), n, 2)
        found = by_chunks(lambda some: self._error(transfer(some) / n**2), flat, transfer.n_masks(n))
        return found.reshape(centers.shape[:-2])

    def _error(self, power: Tensor) -> Tensor:
        """Return the mean squared error (...) for E|OTF|^2 (..., H // 2 + 1, W)."""
        weight, ratio = (part.to(power.dtype) for part in self._layers())
        return (weight / (power[..., None, :, :] + ratio)).sum((-3, -2, -1))

    def expected_power(self, aperture: Aperture) -> Tensor:
        """Return E|OTF|^2 (..., H, W) in FFT order, 1 at zero frequency, of everything but the pixels.

        Raises ValueError where r0 is None.
        """
        if self.seeing is None:
            raise ValueError("r0 is None: E|OTF|^2 is known for turbulence, so make the criterion with its r0 in m")
        half = self._half_power(aperture)
        rows = self.grid.shape[0]
        opposite = half[..., 1 : rows - rows // 2, :].flip(-2, -1).roll(1, -1)
        return torch.cat([half, opposite], -2)

    def _powers(self, aperture: Aperture) -> tuple[Tensor, Tensor]:
        if self.seeing is None:
            return super()._powers(aperture)
        mean = self._half_power(aperture)
        centers = aperture.centers
        if aperture.is_full:
            return mean, self._table(aperture, self._pupil_steady).to(mean).expand_as(mean)
        flat = centers.reshape(math.prod(centers.shape[:-2]), *centers.shape[-2:])
        steady = self._table(aperture, self._mask_transfer).steady(flat) / aperture.n_subapertures**4
        return mean, steady.reshape(mean.shape)

    def _half_power(self, aperture: Aperture) -> Tensor:
        """Return E|OTF|^2 (..., H // 2 + 1, W) at nu_y >= 0."""
        self._check(aperture)
        centers = aperture.centers
        if aperture.is_full:
            nowhere = 0 * centers.sum((-2, -1))  # the same wherever the pupil lies: with a gradient, of 0
            return self._table(aperture, self._pupil_power).to(centers) + nowhere[..., None, None]
        flat = centers.reshape(math.prod(centers.shape[:-2]), *centers.shape[-2:])
        power = self._table(aperture, self._mask_transfer)(flat) / aperture.n_subapertures**2
        return power.reshape(*centers.shape[:-2], *power.shape[-2:])

    def _table(self, aperture: Aperture, make: Any) -> Any:
        """Return what `make` computes for apertures of this kind, kept from the last time if it is known."""
        dtype, device = aperture.centers.dtype, aperture.centers.device
        key = (make.__name__, aperture.shape, aperture.subaperture_diameter, dtype, device)
        if key not in self._tables:
            if len(self._tables) >= _KEPT:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = make_apart(make, aperture)
        return self._tables[key]

    def _mask_transfer(self, aperture: Aperture) -> MaskTransfer:
        assert self.seeing is not None
        dtype, device = aperture.centers.dtype, aperture.centers.device
        band, grid, seeing = Band.given(self.band, self.grid.wavelength), self.grid, self.seeing
        self._check_sampling(aperture, band)
        if len(band.wavelengths) == 1:  # its tables are best at the wavelength of the light
            grid = replace(grid, wavelength=band.shortest)
            seeing = replace(seeing, r0=seeing.r0 * (grid.wavelength / self.grid.wavelength) ** 1.2)
        geometry, longest = self._geometry(aperture)._replace(period=grid.period), math.sqrt(0.5) * grid.period
        return MaskTransfer(geometry, seeing, band, grid.wavelength, longest, dtype, device)

    def _pupil_power(self, aperture: Aperture) -> Tensor:
        """Return E|OTF|^2 of a full pupil (H // 2 + 1, W)."""
        return self._between(aperture, mean_square_otf)

    def _pupil_steady(self, aperture: Aperture) -> Tensor:
        """Return the square of the steady part of |OTF|^2 of a full pupil (H // 2 + 1, W)."""
        return self._between(aperture, lambda *known: steady_square_otf(*known) ** 2)

    def _between(self, aperture: Aperture, function: Callable[..., Tensor]) -> Tensor:
        """Return a function of a full pupil, by its integral at some frequencies; over T it is smooth in between.

        Thin vanes take as much of it as of T^2.
        """
        assert self.seeing is not None
        band = Band.given(self.band, self.grid.wavelength)
        lengths = [wavelength / self.grid.wavelength for wavelength in band.wavelengths]
        reach = aperture.outer_diameter / min(lengths)
        round_ = aperture.shape.is_round and self.seeing.is_isotropic

        def still(baselines: Tensor, shape: Shape = aperture.shape) -> Tensor:
            parts = [shape.otf(baselines * length, aperture.subaperture_diameter) for length in lengths]
            return torch.stack([share * part for share, part in zip(band.shares, parts, strict=True)]).sum(0)

        nodes = PolarTable.nodes(_PUPIL[:1] + (1 if round_ else _PUPIL[1],), reach, 1.5)
        nodes[-1] *= 1 - 1e-6
        smooth = aperture.shape.without_vanes
        transfer = still(nodes)
        kept = torch.zeros_like(transfer).flatten()
        known = transfer.flatten() > 1e-4
        frequencies = nodes.flatten(0, 1)[known] / self.grid.period
        one = aperture.still()
        if isinstance(one, SparseAperture):  # of a population any does
            one = one.replace(centers=one.centers.new_zeros(1, 2))
        found = function(one, self.grid, frequencies, self.seeing, band)
        kept[known] = found * (still(nodes, smooth) / transfer**2).flatten()[known]
        kept = kept.unflatten(0, transfer.shape)
        if round_:
            kept = kept.expand(-1, _PUPIL[1]).contiguous()
        baselines = half_plane(Geometry(self.grid.shape, self.grid.period, aperture.shape, 1.0, reach))
        ratio = still(baselines) ** 2 / still(baselines, smooth).clamp(min=_NOTHING)
        return (ratio * PolarTable(kept, reach, 1.5)(baselines)).reshape(-1, self.grid.shape[1])

    @property
    def _bluest_grid(self) -> Grid:
        """The grid at the band's shortest wavelength, which samples the image most coarsely."""
        return self.grid if self.band is None else replace(self.grid, wavelength=self.band.shortest)

    def _cutoff(self, mask_diameter: float) -> float:
        return self._bluest_grid.cutoff(mask_diameter)

    def _check(self, aperture: Aperture) -> None:
        super()._check(aperture)
        if self.seeing is not None and aperture.is_full:  # its table has no folds from beyond the torus
            self._bluest_grid.require_sampling(aperture.outer_diameter)

    def _check_sampling(self, aperture: Aperture, band: Band) -> None:
        highest = self._cutoff(aperture.outer_diameter)
        if highest > 0.5 * (1 + 1e-9):
            raise ValueError(
                f"the OTF of a sub-aperture reaches {highest:.3f} cycles/pixel at the band's shortest "
                f"wavelength, {band.shortest} m, above 1/2, and overlaps itself: pixel_scale must be at most "
                f"{(1 - 1e-6) * band.shortest / (2 * aperture.outer_diameter):.7g} rad"
            )

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, seeing={self.seeing}, band={self.band}"
