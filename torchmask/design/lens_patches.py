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

    values (M, B, L, rows, columns) T on the pixels of each one's patch, in M modes; `root` (B, L, rows, columns) the
    square root of the T that the light there sees, for `lens_sum`; `scale` (B, L, rows, columns) the phases of
    that light over those at the reference wavelength, None for 1; `index` (B, L, rows, columns) the pixels of the
    plane; `baseline`, `turns`, `corner`, `size` (B, L, 2) [pixels], that on the frequency torus, with nu_y >= 0 (sign
    (B, L, 1) times that of the pair), what had to be taken off it, the first pixel, and the columns and rows that may
    hold light; `middle` (B, L, 2) [m] between the holes
    """

    values: Tensor
    root: Tensor
    scale: Tensor | None
    index: Tensor
    baseline: Tensor
    turns: Tensor
    corner: Tensor
    size: Tensor
    sign: Tensor
    middle: Tensor


class Colour(NamedTuple):
    """One wavelength of a band: its phases over those at the reference wavelength, its share of the light, its patches,
    and the exact T (rows * columns) of a hole with itself."""

    scale: float
    share: float
    plan: PatchPlan
    splines: SplinePatches
    slices: Tensor
    central: Tensor


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
        shares = torch.tensor(band.shares, dtype=torch.float64)
        # (M, wavelengths * pixels of the plane): what each wavelength adds to each mode
        self.modes: Tensor = (modes * shares[:, None]).flatten(1).to(device, dtype)
        self.n_pixels: int = 0  # of the patches of a lens, one for each wavelength
        self.colours: list[Colour] = []
        for wavelength, share in zip(band.wavelengths, band.shares, strict=True):
            scale = reference / wavelength
            own = geometry._replace(period=geometry.period / scale)
            plan = cached_plan(own, 1, dtype, device)
            splines = SplinePatches((float(plan.reach[0]), float(plan.reach[1])), (len(plan.column), len(plan.row)))
            pixels = [own.period / side for side in self.size]
            x, y = splines.lattice()
            places = torch.stack(torch.meshgrid(x * pixels[0], y * pixels[1], indexing="xy"), -1)
            slices = splines.slices(geometry.shape.otf(places, geometry.diameter)[None]).to(device, dtype)
            self.n_pixels += len(plan.row) * len(plan.column)
            first = (-plan.reach).ceil().double().cpu()
            x = (first[0] + torch.arange(len(plan.column))) * pixels[0]
            y = (first[1] + torch.arange(len(plan.row))) * pixels[1]
            places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
            central = geometry.shape.otf(places, geometry.diameter).flatten().to(device, dtype)
            self.colours.append(Colour(scale, share, plan, splines, slices, central))

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
        if len(self.colours) == 1:
            lens, corner = self._lens(self.colours[0], baseline, turns)
            values, root, scale = lens[None], lens.clamp(min=_NOTHING).sqrt(), None
            extent = size.new_tensor(lens.shape[:1:-1]).expand_as(corner)
        else:
            values, root, scale, corner, extent = self._merged(baseline, turns)
        index = self.plane.index(corner, *values.shape[-2:])
        return Lenses(values, root, scale, index, baseline, turns, corner, extent, sign, middle)

    def _lens(self, colour: Colour, baseline: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
        """Return T (B, L, rows, columns) at one wavelength, and the first pixel of the patch (B, L, 2)."""
        place = (baseline + turns) * colour.scale - turns
        corner = (place.detach() - colour.plan.reach).ceil()
        values = colour.splines.weights(corner - place) @ colour.slices
        values[:, 0] = colour.central  # N holes share it: what a spline makes of its edge would count N times
        return values.unflatten(-1, (len(colour.plan.row), len(colour.plan.column))), corner

    def _merged(self, baseline: Tensor, turns: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return values, root, scale, corner and size of the lenses of all wavelengths together."""
        lenses = [self._lens(colour, baseline, turns) for colour in self.colours]
        corner = torch.stack([own for _, own in lenses]).amin(0)
        ends = torch.stack([own + own.new_tensor(lens.shape[:1:-1]) for lens, own in lenses])
        size = (ends.amax(0) - corner).nan_to_num(1.0)
        columns, rows = size.amax((0, 1)).long().tolist()
        first = torch.arange(corner[..., 0].numel(), device=corner.device).view(*corner.shape[:2], 1) * (rows * columns)
        sources, targets, lights = [], [], []
        for number, (colour, (lens, own)) in enumerate(zip(self.colours, lenses, strict=True)):
            n_rows, n_columns = lens.shape[-2:]
            sources.append((self.plane.index(own, n_rows, n_columns) + number * self.plane.n_pixels).flatten())
            x, y = (own - corner).nan_to_num(0.0).long()[..., None].unbind(2)
            row = first + (y + torch.arange(n_rows, device=y.device)) * columns
            column = x + torch.arange(n_columns, device=x.device)
            targets.append((row[..., :, None] + column[..., None, :]).flatten())
            lens = lens.flatten()
            positive = lens * lens * torch.rsqrt(lens * lens + _FAINT**2)  # a spline overshoots
            light = colour.share * positive
            lights.append(torch.stack([light, light * (positive + _NOTHING).sqrt(), light * colour.scale]))
        source, target, lens = torch.cat(sources), torch.cat(targets), torch.cat([lens.flatten() for lens, _ in lenses])
        dark = lens.new_zeros(first.numel() * rows * columns)

        def merged(light: Tensor) -> Tensor:
            return dark.scatter_add(0, target, light).view(*corner.shape[:2], rows, columns)

        values = torch.stack([merged(mode.index_select(0, source) * lens) for mode in self.modes])
        total, roots, phases = (merged(moment) for moment in torch.cat(lights, 1))
        total = total + _NOTHING
        return values, roots / total, (phases + _NOTHING) / total, corner, size


def _pairs(n: int, device: torch.device) -> Tensor:
    """Return the holes (2, L) of each lens: one with itself, which stands for all such, and then all pairs."""
    zero = torch.zeros(2, 1, dtype=torch.long, device=device)
    return torch.cat([zero, torch.triu_indices(n, n, 1, device=device)], 1)
