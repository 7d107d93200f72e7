"""E|OTF|^2 of masks under turbulence on the frequency plane, differentiable in the places of the holes.

At a frequency near the baseline of two holes the pupil overlaps its copy in one lens, midway between the holes.
E|OTF|^2 is the sum over all pairs of lenses of the coherence between them: of each lens with itself, which depends on
the frequency and the transmission of the lens (`torchmask.atmosphere.lens_coherence`), and of lenses of different
pairs of holes whose baselines nearly agree (`torchmask.design.lens_pairs`, `torchmask.design.central_lenses`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial, reduce

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence
from torchmask.atmosphere.lens_coherence import lens_amplitude
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.apart import make_apart
from torchmask.design.central_lenses import CentralLenses
from torchmask.design.fluctuation import steady_lenses
from torchmask.design.frequency_plane import FrequencyPlane, half_plane
from torchmask.design.lens_pairs import LensPairs
from torchmask.design.lens_patches import LensPatches
from torchmask.design.overlap import Geometry
from torchmask.design.pair_coherence import PairCoherence
from torchmask.memory import AtATime
from torchmask.optics.band import Band

_CHUNK = AtATime(processor=2**20, gpu=2**24)  # pixels of lenses


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
        colours = None
        if len(scales) > 1:
            colours = ColourCoherence(geometry.shape, geometry.diameter, seeing, band, reference, furthest)
        amplitude = partial(lens_amplitude, geometry.shape, geometry.diameter, seeing, furthest)
        make_patches = partial(LensPatches, geometry, band, reference, colours, dtype=dtype, device=device)
        self.patches: LensPatches = make_patches(amplitude)
        self._make_steady: Callable[[], LensPatches] = partial(make_patches, partial(amplitude, steady=True))
        self.plane: FrequencyPlane = self.patches.plane
        self.pixel: Tensor = torch.tensor([geometry.period / side for side in geometry.grid[::-1]], dtype=dtype)
        self.pixel = self.pixel.to(device)
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
        return max(1, _CHUNK.on(self.pixel.device) // ((1 + n * (n - 1) // 2) * self.patches.n_pixels))

    def _transfer(self, centers: Tensor) -> Tensor:
        lenses = self.patches(centers)
        power = reduce(torch.add, (mode * mode for mode in lenses.kept))  # one mode is not copied, as a sum would
        power[:, 0] *= centers.shape[1] / 2  # every patch counts twice in the end, at nu and at -nu
        alone = self.plane.summed(lenses.index, power)
        together = alone.addcmul_(self.pairs(lenses, centers), self.far)
        return self.plane.folded(together) + self.central(centers)

    def steady(self, centers: Tensor) -> Tensor:
        """Return N^4 times the sum over lenses of the square of the steady part of |OTF|^2 (B, H // 2 + 1, W)."""
        found = []
        for mask in centers.split(1):
            lenses = self._steady_patches(mask)
            power = steady_lenses(lenses, centers.shape[1])
            found.append(self.plane.folded(self.plane.summed(lenses.index, power)))
        return torch.cat(found).unflatten(1, (-1, self.plane.n_columns))

    @cached_property
    def _steady_patches(self) -> LensPatches:
        return make_apart(self._make_steady)
