"""The lenses of masks on patches of pixels, for one wavelength or a band of them.

A pair of holes transmits light of the wavelength a^-1 (of the reference) at frequencies near its baseline times a: the
lenses of a band lie side by side. The light of two wavelengths that meet at one frequency is coherent in part only,
as the frequency says (`torchmask.atmosphere.colour_coherence`); its modes make of the band a few lenses of which each
is coherent with itself and none with another.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence
from torchmask.design.frequency_plane import FrequencyPlane
from torchmask.design.overlap import Geometry, PatchPlan, cached_plan
from torchmask.design.spline_patches import SplinePatches
from torchmask.optics.band import Band

_NOTHING = 1e-12  # of T
_FAINT = 1e-4  # of T: light that does not say which wavelength it has


class Lenses(NamedTuple):
    """The lenses (B, L) of masks: L - 1 pairs of holes after those of the holes with themselves.

    values (B, L, M, rows, columns) T on the pixels of each one's patch, in M modes; `root` (B, L, rows, columns) the
    square root of the T that the light there sees, for `lens_functions`; `scale` (B, L, rows, columns) the phases of
    that light over those at the reference wavelength, None for 1; `baseline`, `turns`, `corner` (B, L, 2) [pixels],
    that on the frequency torus, with nu_y >= 0 (sign (B, L, 1) times that of the pair), what had to be taken off it,
    and the first pixel; `middle` (B, L, 2) [m] between the holes
    """

    values: Tensor
    root: Tensor
    scale: Tensor | None
    baseline: Tensor
    turns: Tensor
    corner: Tensor
    sign: Tensor
    middle: Tensor


class Colour(NamedTuple):
    """One wavelength of a band: its phases over those at the reference wavelength, its share of the light, its patches,
    the exact T (rows * columns) of a hole with itself, and the modes (M, n_plane) that it takes part in."""

    scale: float
    share: float
    plan: PatchPlan
    splines: SplinePatches
    slices: Tensor
    central: Tensor
    modes: Tensor


class LensPatches:
    """The lenses of any masks with the holes of one geometry, in one band."""

    def __init__(
        self,
        geometry: Geometry,
        band: Band,
        reference: float,
        coherence: ColourCoherence | None,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.size: tuple[int, int] = (geometry.grid[1], geometry.grid[0])
        self.period: float = geometry.period
        self.plane: FrequencyPlane = FrequencyPlane.of(geometry, reference / band.shortest, device)
        modes = torch.ones(1, 1, len(self.plane.baselines), dtype=torch.float64)
        if coherence is not None:
            modes = coherence.modes(self.plane.baselines)
        self.n_modes: int = len(modes)
        self.n_layers: int = 1 if len(band.wavelengths) == 1 else 4 * (self.n_modes + 3)  # patches of a band are wider
        self.n_pixels: int = 0  # of a patch of one wavelength
        self.colours: list[Colour] = []
        for index, (wavelength, share) in enumerate(zip(band.wavelengths, band.shares, strict=True)):
            scale = reference / wavelength
            own = geometry._replace(period=geometry.period / scale)
            plan = cached_plan(own, 1, dtype, device)
            splines = SplinePatches((float(plan.reach[0]), float(plan.reach[1])), (len(plan.column), len(plan.row)))
            pixels = [own.period / side for side in self.size]
            x, y = splines.lattice()
            places = torch.stack(torch.meshgrid(x * pixels[0], y * pixels[1], indexing="xy"), -1)
            slices = splines.slices(geometry.shape.otf(places, geometry.diameter)[None]).to(device, dtype)
            self.n_pixels = max(self.n_pixels, len(plan.row) * len(plan.column))
            first = (-plan.reach).ceil().double().cpu()
            x = (first[0] + torch.arange(len(plan.column))) * pixels[0]
            y = (first[1] + torch.arange(len(plan.row))) * pixels[1]
            places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
            central = geometry.shape.otf(places, geometry.diameter).flatten().to(device, dtype)
            own_modes = modes[:, index].to(device, dtype)
            self.colours.append(Colour(scale, share, plan, splines, slices, central, own_modes))

    def __call__(self, centers: Tensor) -> Lenses:
        """Return the lenses of masks with `centers` (B, N, 2) [m]."""
        n = centers.shape[1]
        first, second = _pairs(n, centers.device)
        one, other = centers.index_select(1, first), centers.index_select(1, second)
        nu = (one - other) / self.period
        turns = nu.detach().round()
        nu = nu - turns
        sign = torch.copysign(torch.ones_like(nu[..., 1:]), nu[..., 1:]).detach()
        size = nu.new_tensor(self.size)
        baseline, turns = nu * sign * size, turns * sign * size
        middle = (one + other) / 2
        if len(self.colours) == 1 and self.colours[0].scale == 1:
            values, corner = self._lens(self.colours[0], baseline, turns)
            root = values.clamp(min=_NOTHING).sqrt()
            return Lenses(values[:, :, None], root, None, baseline, turns, corner, sign, middle)
        values, root, scale, corner = self._merged(baseline, turns)
        return Lenses(values, root, scale, baseline, turns, corner, sign, middle)

    def _lens(self, colour: Colour, baseline: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
        """Return T (B, L, rows, columns) at one wavelength, and the first pixel of the patch (B, L, 2)."""
        place = (baseline + turns) * colour.scale - turns
        corner = (place.detach() - colour.plan.reach).ceil()
        values = colour.splines.weights(corner - place) @ colour.slices
        values[:, 0] = colour.central  # N holes share it: what a spline makes of its edge would count N times
        return values.unflatten(-1, (len(colour.plan.row), len(colour.plan.column))), corner

    def _merged(self, baseline: Tensor, turns: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return values, root, scale and corner of the lenses of all wavelengths together."""
        lenses = [self._lens(colour, baseline, turns) for colour in self.colours]
        corners = torch.stack([corner for _, corner in lenses])
        ends = torch.stack([corner + corner.new_tensor(lens.shape[:1:-1]) for lens, corner in lenses])
        corner = corners.amin(0)
        columns, rows = (ends.amax(0) - corner).nan_to_num(1.0).amax((0, 1)).long().tolist()
        layers = baseline.new_zeros(*baseline.shape[:2], self.n_modes + 3, rows * columns)
        for colour, (lens, own) in zip(self.colours, lenses, strict=True):
            n_rows, n_columns = lens.shape[-2:]
            at = self.plane.index(own, n_rows, n_columns).flatten(2)
            lens = lens.flatten(2)
            modes = colour.modes[:, at] * (colour.share * lens)  # (M, B, L, pixels)
            positive = lens * lens * torch.rsqrt(lens * lens + _FAINT**2)  # a spline overshoots
            light = colour.share * positive
            moments = torch.stack([light, light * (positive + _NOTHING).sqrt(), light * colour.scale])
            shift = (own - corner).nan_to_num(0.0).long()
            index = (shift[..., 1:] + torch.arange(n_rows, device=at.device))[..., None] * columns
            index = index + (shift[..., :1] + torch.arange(n_columns, device=at.device))[..., None, :]
            source = torch.cat([modes, moments]).movedim(0, 2)
            layers = layers.scatter_add(3, index.flatten(2)[:, :, None].expand_as(source), source)
        layers = layers.unflatten(-1, (rows, columns))
        values, (total, roots, phases) = layers[:, :, :-3], layers[:, :, -3:].unbind(2)
        total = total + _NOTHING
        scale = (phases + _NOTHING) / total
        return values, roots / total, scale, corner


def _pairs(n: int, device: torch.device) -> Tensor:
    """Return the holes (2, L) of each lens: one with itself, which stands for all such, and then all pairs."""
    zero = torch.zeros(2, 1, dtype=torch.long, device=device)
    return torch.cat([zero, torch.triu_indices(n, n, 1, device=device)], 1)
