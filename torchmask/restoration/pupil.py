"""The open samples of a pupil: the complex field at every wavelength from a few parameters of its phase."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pupil import sample_holes
from torchmask.optics.unrounded import product
from torchmask.optics.zernike import zernike_basis
from torchmask.restoration.aberrations import AberrationBasis


class OpenSamples(NamedTuple):
    """The P open samples of a pupil, concatenated over wavelengths.

    weights : (P,) amplitude, scaled so that every PSF has unit sum
    index : (P,) index in the flattened rasters of all wavelengths
    basis : (P, K) phase [rad] of one unit of each aberration parameter
    positions : (P, 2) position (x, y) in the pupil as a spatial frequency [cycles/pixel]
    chromaticity : (P,) phase [rad] of a path difference of 1 rad at the wavelength of the grid
    """

    weights: Tensor
    index: Tensor
    basis: Tensor
    positions: Tensor
    chromaticity: Tensor

    def phase(self, z: Tensor) -> Tensor:
        """Return the phase (T, P) [rad] of the parameters z (T, K)."""
        return product(z.to(self.basis.dtype), self.basis.T)

    def field(self, phase: Tensor) -> Tensor:
        """Return the complex field (T, P) of a phase (T, P) [rad]."""
        return torch.complex(self.weights * phase.cos(), self.weights * phase.sin())  # faster than torch.polar


class SampledPupil(nn.Module):
    """An aperture sampled on rasters whose FFT is the focal amplitude, one raster for each wavelength of a band.

    `samples()` uses the present centres of the aperture: it is differentiable in them if they require a gradient, and
    resamples the aperture when they have changed. The matrix of the aberration basis stays fixed.

    Parameters
    ----------
    aperture : Aperture
        One aperture, centres (N, 2).
    field : Grid
        Grid of the images.
    band : Band
        Wavelengths of the light.
    aberrations : AberrationBasis
        Basis of the phase in each sub-aperture.

    Raises
    ------
    ValueError
        If the shortest wavelength undersamples the image, or a sub-aperture is narrower than two samples.
    """

    weights: Tensor
    index: Tensor
    basis: Tensor
    positions: Tensor
    chromaticity: Tensor
    centers: Tensor

    def __init__(
        self,
        aperture: Aperture,
        field: Grid,
        band: Band,
        aberrations: AberrationBasis,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.aperture: Aperture = aperture
        self.grid: Grid = field
        self.band: Band = band
        self.aberrations: AberrationBasis = aberrations
        kwargs = {"dtype": dtype or aperture.centers.dtype, "device": device}
        with torch.inference_mode(False), torch.no_grad():  # it may train later, whatever mode it is made in
            for name, values in self._sample_where_it_lies()._asdict().items():
                values = values.to(device) if name == "index" else values.to(**kwargs)
                self.register_buffer(name, values, persistent=False)
            self.register_buffer("centers", aperture.centers.detach().clone(), persistent=False)
        self.register_load_state_dict_post_hook(_forget)

    @property
    def n_rasters(self) -> int:
        """Number of rasters: one for each wavelength at each instant of a frame."""
        return len(self.band.wavelengths) * len(self.aberrations.instants)

    def samples(self) -> OpenSamples:
        """Return the open samples of the aperture at its present centres."""
        centers = self.aperture.centers
        if centers.requires_grad and torch.is_grad_enabled():
            self._require_sampling()
            return self.samples_at(centers)
        if not torch.equal(centers, self.centers):
            with torch.inference_mode(False), torch.no_grad():
                for name, values in self._sample_where_it_lies()._asdict().items():
                    setattr(self, name, values.to(self.index if name == "index" else self.basis))
                self.centers = centers.detach().clone()
        return OpenSamples(self.weights, self.index, self.basis, self.positions, self.chromaticity)

    def samples_at(self, centers: Tensor, *, with_closed: bool = False) -> OpenSamples:
        """Return the open samples of the same sub-apertures at other `centers` (N, 2) [m], differentiable in them.

        `with_closed` adds samples of weight 0 around each hole, so that there are as many wherever it stands. It does
        not check for undersampling of the image.
        """
        sampled = self._sample(centers, with_closed)
        return OpenSamples(
            *(v.to(self.index if name == "index" else self.basis) for name, v in sampled._asdict().items())
        )

    def _sample_where_it_lies(self) -> OpenSamples:
        self._require_sampling()
        return self._sample(self.aperture.centers)

    def _require_sampling(self) -> None:
        self.aperture.require_sampling(replace(self.grid, wavelength=self.band.shortest))

    def _sample(self, centers: Tensor, with_closed: bool = False) -> OpenSamples:
        pixels = math.prod(self.grid.shape)
        parts = []
        instants = self.aberrations.instants
        bands = zip(self.band.wavelengths, self.band.shares, strict=True)
        for number, ((wavelength, share), instant) in enumerate(itertools.product(bands, instants)):
            part = self._sample_at(centers, wavelength, instant, with_closed)
            weights = math.sqrt(share / len(instants)) * part.weights
            parts.append(part._replace(weights=weights, index=part.index + number * pixels))
        return OpenSamples(*(torch.cat(values) for values in zip(*parts, strict=True)))

    def _sample_at(self, centers: Tensor, wavelength: float, instant: float, with_closed: bool) -> OpenSamples:
        aperture, grid = self.aperture, replace(self.grid, wavelength=wavelength)
        samples = sample_holes(centers, aperture.shape, aperture.subaperture_diameter, grid)
        modes = zernike_basis(samples, aperture, self.aberrations.n_modes)  # (N, P, J)
        chosen = None if with_closed else (samples.weights.flatten() > 0).nonzero().flatten()

        def kept(values: Tensor) -> Tensor:  # (N, P, ...), as one list of samples
            return values.flatten(0, 1) if chosen is None else values.flatten(0, 1).index_select(0, chosen)

        mixing = self.aberrations.mixing_at(instant).to(modes).unflatten(0, (len(modes), self.aberrations.n_modes))
        ratio = self.grid.wavelength / wavelength
        basis = ratio * product(modes, mixing)  # (N, P, K)
        if self.aberrations.offsets is not None:
            basis = basis + self.aberrations.offsets.to(basis)[:, None]
        weights = kept(samples.weights)
        # By Parseval's theorem this gives every PSF unit sum for any phase, unless holes share a cell.
        scale = weights.norm() * math.prod(grid.shape) ** 0.5
        positions = kept(samples.offsets + centers[:, None]) / grid.period
        chromaticity = weights.new_full((len(weights),), ratio)
        return OpenSamples(weights / scale, kept(samples.index), kept(basis), positions, chromaticity)


def _forget(pupil: SampledPupil, keys: object) -> None:
    """Force new samples after loading a state dict, which may have another aberration basis."""
    pupil.centers.fill_(math.nan)
