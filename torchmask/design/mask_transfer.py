"""E|OTF|^2 of masks under turbulence on the frequency plane, differentiable in the places of the holes.

At a frequency near the baseline of two holes the pupil overlaps its copy in one lens, midway between the holes.
E|OTF|^2 is the sum over all pairs of lenses of the coherence between them: of each lens with itself, which depends on
the frequency and the transmission of the lens (`torchmask.atmosphere.lens_coherence`), and of lenses of different
pairs of holes whose baselines nearly agree (`torchmask.design.lens_pairs`, `torchmask.design.central_lenses`).
"""

from __future__ import annotations

from functools import cached_property, partial

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence
from torchmask.atmosphere.lens_coherence import lens_coherence, lens_sum
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.central_lenses import CentralLenses
from torchmask.design.fluctuation import steady_lenses
from torchmask.design.frequency_plane import FrequencyPlane, half_plane
from torchmask.design.lens_pairs import LensPairs
from torchmask.design.lens_patches import Lenses, LensPatches
from torchmask.design.overlap import Geometry
from torchmask.design.pair_coherence import PairCoherence
from torchmask.optics.band import Band

_CHUNK = 2**20  # pixels of lenses in work at a time: few enough for memory, enough to amortise launches


class MaskTransfer:
    """E|OTF|^2 of any masks with the holes of one geometry, on one grid, under one turbulence and in one band.

    Its tables take a second to make, and hold for any number and places of holes. `reference` [m] is the wavelength of
    the seeing and of the geometry, that of the light if it has only one; `longest` [m] is the longest baseline on the
    frequency torus.
    """

    def __init__(
        self,
        geometry: Geometry,
        seeing: Seeing,
        band: Band,
        reference: float,
        longest: float,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        scales = [reference / wavelength for wavelength in band.wavelengths]
        furthest = longest * max(1.0, *scales)
        colours = spread = None
        if len(scales) > 1:
            spread = tuple(sorted({min(scales), sum(scales) / len(scales), max(scales)}))
            colours = ColourCoherence(geometry.shape, geometry.diameter, seeing, band, reference, furthest)
        self.patches: LensPatches = LensPatches(geometry, band, reference, colours, dtype, device)
        self.plane: FrequencyPlane = self.patches.plane
        self.pixel: Tensor = torch.tensor([geometry.period / side for side in geometry.grid[::-1]], dtype=dtype)
        self.pixel = self.pixel.to(device)
        self.reach: float = geometry.reach
        self._coherence = partial(lens_coherence, geometry.shape, geometry.diameter, seeing, furthest, spread)
        self.factors: Tensor = self._coherence()(self.plane.baselines).to(device, dtype)
        self.central: CentralLenses = CentralLenses(
            geometry, seeing, band, reference, longest, half_plane(geometry), dtype, device
        )
        coherence = PairCoherence(geometry, seeing, colours, furthest, dtype, device)
        self.pairs: LensPairs = LensPairs(geometry, coherence, self.plane, self.pixel)
        self.far: Tensor = coherence.far(*self.plane.baselines.to(device).unbind(-1)).to(dtype)

    def __call__(self, centers: Tensor) -> Tensor:
        """Return N^2 E|OTF|^2 (B, H // 2 + 1, W) of masks with `centers` (B, N, 2) [m]."""
        parts = [self._transfer(chunk) for chunk in centers.split(self.n_masks(centers.shape[1]))]
        return torch.cat(parts).unflatten(1, (-1, self.plane.n_columns))

    def n_masks(self, n: int) -> int:
        """Return how many masks of `n` holes to work on at a time."""
        return max(1, _CHUNK // ((1 + n * (n - 1) // 2) * self.patches.n_pixels))

    def _transfer(self, centers: Tensor) -> Tensor:
        lenses = self.patches(centers)
        power = (lenses.values**2).sum(0)
        power[:, 0] *= centers.shape[1] / 2  # every patch counts twice in the end, at nu and at -nu
        alone = self.plane.summed(lenses.index, power * self._kept(lenses, self.factors))
        together = alone.addcmul_(self.pairs(lenses, centers), self.far)
        return self.plane.folded(together) + self.central(centers)

    def steady(self, centers: Tensor) -> Tensor:
        """Return N^4 times the sum over lenses of the square of the steady part of |OTF|^2 (B, H // 2 + 1, W)."""
        found = []
        for mask in centers.split(1):
            lenses = self.patches(mask)
            power = steady_lenses(lenses, centers.shape[1]) * self._kept(lenses, self._steady_factors)
            found.append(self.plane.folded(self.plane.summed(lenses.index, power)))
        return torch.cat(found).clamp(min=0).unflatten(1, (-1, self.plane.n_columns))

    @cached_property
    def _steady_factors(self) -> Tensor:
        return self._coherence(steady=True)(self.plane.baselines).to(self.factors)

    def _kept(self, lenses: Lenses, factors: Tensor) -> Tensor:
        """Return the coherence (B, L, rows, columns) of lenses with themselves, by `factors` (parts, pixels)."""
        index = lenses.index.flatten()
        parts = [factor.index_select(0, index).view_as(lenses.root) for factor in factors]
        return lens_sum(parts, lenses.root, *self._places(lenses, *lenses.root.shape[-2:]), lenses.scale)

    def _places(self, lenses: Lenses, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        """Return the distance of the pixels from the lenses' baselines, x and y, over the holes' outer diameter."""
        x = lenses.corner[..., :1] + torch.arange(columns, device=self.pixel.device)
        y = lenses.corner[..., 1:] + torch.arange(rows, device=self.pixel.device)
        x, y = x[..., None, :], y[..., :, None]
        base_x, base_y = lenses.baseline[..., None, None].unbind(2)
        if lenses.scale is not None:
            turn_x, turn_y = lenses.turns[..., None, None].unbind(2)
            x = (x + turn_x) / lenses.scale - turn_x
            y = (y + turn_y) / lenses.scale - turn_y
        unit = (self.pixel / self.reach).tolist()
        return (x - base_x) * unit[0], (y - base_y) * unit[1]
