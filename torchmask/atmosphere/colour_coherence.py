"""Coherence under turbulence of the light of two wavelengths from the same holes at the same spatial frequency.

Light whose phases are a and a' times those at the reference wavelength comes from baselines b / a and b / a', that is
from different points of the holes, and its phases differ by (a - a') phi. Relative to the geometric mean of the |OTF|^2
of either wavelength, their product keeps exp(-k), with k even in a - a'. It is least where both wavelengths have the
same lens of a hole, and 10 to 20 per cent larger elsewhere; so it is computed for lenses whose places stand for all.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.atmosphere.lens_coherence import PolarTable, lens_densities, lens_drift
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import difference_variance
from torchmask.optics.band import Band
from torchmask.optics.shape_base import Shape

_BASELINES = (16, 16)
_STEPS = (0.15, 0.5, 1.0)  # fractions of the largest a - a' at which k is computed
_PER_HOLE, _PER_R0 = 12, 6
_THINNEST = 0.75  # of a hole's reach: thinner lenses, further out, transmit almost nothing
_ASIDE = 0.45  # of a hole's reach, across the baseline: there k is about its mean over all places 0.3 of it away
_LOST = 1e-2  # fraction of the light in modes that are left out


class ColourCoherence:
    """Coherence between the wavelengths of a band, at any baseline up to `longest` [m], for holes of one shape."""

    def __init__(
        self, shape: Shape, diameter: float, seeing: Seeing, band: Band, reference: float, longest: float
    ) -> None:
        self.scales: Tensor = reference / torch.tensor(band.wavelengths, dtype=torch.float64)
        self.shares: Tensor = torch.tensor(band.shares, dtype=torch.float64)
        widest = self.scales.max() - self.scales.min()
        isotropic = shape.is_round and seeing.is_isotropic
        nodes = PolarTable.nodes((_BASELINES[0], 1 if isotropic else _BASELINES[1]), longest, 2.0).flatten(0, 1)
        # lenses further apart than twice a hole's reach have no frequency in common
        met = 2 * _THINNEST * shape.outer_diameter(diameter) / nodes.norm(dim=-1).clamp(min=1e-9)
        steps = torch.minimum(met, widest)[:, None] * torch.tensor(_STEPS, dtype=torch.float64)
        lost = torch.stack([_lost(shape, diameter, seeing, nodes, step) for step in steps.T], -1)
        powers = torch.stack([steps**0, steps], -1)
        factors = torch.linalg.lstsq(powers, (lost / steps**2)[..., None]).solution[..., 0].T
        factors = factors.unflatten(-1, (_BASELINES[0], -1))
        self.factors: PolarTable = PolarTable(factors.expand(-1, -1, _BASELINES[1]).contiguous(), longest, 2.0)

    def between(self, baselines: Tensor) -> Tensor:
        """Return exp(-k) (P, W, W) for all pairs of wavelengths at baselines (P, 2) [m]."""
        one, other = self.scales[:, None], self.scales
        middle = baselines[:, None, None] / ((one + other) / 2)[..., None]  # of those of the two wavelengths
        second, third = self.factors(middle.flatten(0, 2)).unflatten(1, middle.shape[:3])
        return torch.exp(-colour_loss(second, third, one, other))

    def modes(self, baselines: Tensor) -> Tensor:
        """Return M modes (M, W, P) whose outer products in W, summed over M, approximate exp(-k)."""
        root = self.shares.sqrt()
        size, vectors = torch.linalg.eigh(self.between(baselines) * root[:, None] * root)
        size = size.clamp(min=0)
        left_out = size.cumsum(-1) / size.sum(-1, keepdim=True)
        n = max(1, int((left_out > _LOST).sum(-1).max()))
        modes = vectors[..., -n:] * size[:, None, -n:].sqrt() / root[:, None]
        return modes.permute(2, 1, 0)


def colour_loss(second: Tensor, third: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Return k (...) of light whose phases are `one` and `other` times those at the reference wavelength.

    second, third : `ColourCoherence.factors` at the mean of the baselines of both, k for a + a' = 2 over (a - a')^2
    """
    step = (one - other).abs()
    return (second + third * step / ((one + other) / 2)).clamp(min=0) * step**2


def _lost(shape: Shape, diameter: float, seeing: Seeing, baselines: Tensor, step: Tensor) -> Tensor:
    """Return k (P,) at baselines (P, 2) [m], for phases that differ by `step` (P,) times those at the reference."""
    one, other = (1 + step / 2)[:, None], (1 - step / 2)[:, None]
    reach = shape.outer_diameter(diameter)
    first, second = baselines / one, baselines / other
    apart = (first - second) / 2
    aside = baselines.flip(-1) * baselines.new_tensor([-1.0, 1.0])
    aside = _ASIDE * reach * aside / aside.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    places = aside + apart, aside - apart
    per_hole = max(_PER_HOLE, math.ceil(_PER_R0 * diameter / seeing.r0))
    separations, alike = lens_densities(shape, diameter, places[0], per_hole)
    mirrored = lens_densities(shape, diameter, places[1], per_hole)[1]
    crossed = lens_densities(shape, diameter, places[0], per_hole, places[1])[1]
    drift, shares = lens_drift(seeing)
    furthest = float(baselines.norm(dim=-1).max()) / float(other.min()) + 4 * reach + float(drift.norm(dim=-1).max())
    structure = seeing.structure(furthest)

    def kept(b: Tensor, c: Tensor, scale: Tensor, other_scale: Tensor, densities: Tensor) -> Tensor:
        total = torch.zeros(len(b), dtype=torch.float64)
        for lag, share in zip(drift, shares, strict=True):
            variance = difference_variance(structure, separations + lag, b[:, None], c[:, None], scale, other_scale)
            total += share * (torch.exp(-variance / 2) * densities).sum(-1)
        return total

    alone = torch.sqrt(kept(first, first, one, one, alike) * kept(second, second, other, other, mirrored))
    together = kept(first, second, one, other, crossed).clamp(min=1e-30)
    return torch.log(alone / together)
