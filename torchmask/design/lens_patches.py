"""The lenses of masks on patches of pixels, for one wavelength or a band of them.

A pair of holes transmits light of the wavelength a^-1 (of the reference) at frequencies near its baseline times a: the
lenses of a band lie side by side. The light of two wavelengths that meet at one frequency is coherent in part only,
as the frequency says (`torchmask.atmosphere.colour_coherence`); its modes make of the band a few lenses of which each
is coherent with itself and none with another. Of each wavelength turbulence leaves an amplitude of its own
(`torchmask.atmosphere.lens_coherence`), as lenses of two wavelengths that meet may have very unlike sizes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence
from torchmask.atmosphere.lens_coherence import PolarTable, lens_sum
from torchmask.design.frequency_plane import FrequencyPlane
from torchmask.design.overlap import Geometry, PatchPlan, cached_plan
from torchmask.design.spline_patches import SplinePatches
from torchmask.optics.band import Band

_NOTHING = 1e-12  # of T
_BEYOND = 3.0  # steps of the splines' lattice: cut off there, they make no step as pixels come into a lens


class Lenses(NamedTuple):
    """The lenses (B, L) of masks: L - 1 pairs of holes after those of the holes with themselves.

    values (M, B, L, rows, columns) T on the pixels of each one's patch, in M modes; `kept` the same times the
    amplitude that turbulence leaves of each wavelength; `index` (B, L, rows, columns) the pixels of the plane;
    `baseline`, `turns`, `corner` (B, L, 2) [pixels], that on the frequency torus, with nu_y >= 0 (sign (B, L, 1) times
    that of the pair), what had to be taken off it, and the first pixel; `ends` (B, L, rows, 2) [pixels] the first
    column of each row of the patch that may hold light, and the one after the last; `middle` (B, L, 2) [m] between the
    holes
    """

    values: Tensor
    kept: Tensor
    index: Tensor
    baseline: Tensor
    turns: Tensor
    corner: Tensor
    ends: Tensor
    sign: Tensor
    middle: Tensor


class Colour(NamedTuple):
    """One wavelength of a band: its phases over those at the reference wavelength, its patches, the pixels (2,) over a
    hole's outer diameter, the exact T (rows * columns) of a hole with itself, and the factors (parts, pixels of the
    plane) of its amplitude, if there are any."""

    scale: float
    plan: PatchPlan
    splines: SplinePatches
    slices: Tensor
    pixel: list[float]
    central: Tensor
    factors: Tensor | None


class Patch(NamedTuple):
    """The lenses (B, L) of one wavelength: T and what turbulence leaves of it (B, L, rows, columns), the pixels of the
    plane, the first pixel (B, L, 2), and where it lies from the middle."""

    values: Tensor
    kept: Tensor
    index: Tensor
    corner: Tensor
    offset: Tensor


class LensPatches:
    """The lenses of any masks with the holes of one geometry, in one band.

    coherence : what its wavelengths have in common; None for one wavelength
    amplitude : makes the table of `lens_amplitude` for phases of a scale; None: turbulence leaves lenses as they are
    """

    def __init__(
        self,
        geometry: Geometry,
        band: Band,
        reference: float,
        coherence: ColourCoherence | None,
        amplitude: Callable[[float], PolarTable] | None,
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
        for wavelength in band.wavelengths:
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
            factors = None
            if amplitude is not None:
                factors = amplitude(scale)(self.plane.baselines / scale).to(device, dtype)
            unit = [size / geometry.reach for size in pixels]
            self.colours.append(Colour(scale, plan, splines, slices, unit, central, factors))

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
        patches = [self._patch(colour, baseline, turns) for colour in self.colours]
        if len(patches) == 1:
            lens, kept, index, corner, offset = patches[0]
            ends = _disc_ends(offset.detach(), self.colours[0])
            return Lenses(lens[None], kept[None], index, baseline, turns, corner, ends, sign, middle)
        values, kept, corner, size = self._merged(patches)
        index = self.plane.index(corner, *values.shape[-2:])
        ends = _box_ends(size, values.shape[-2])
        return Lenses(values, kept, index, baseline, turns, corner, ends, sign, middle)

    def _patch(self, colour: Colour, baseline: Tensor, turns: Tensor) -> Patch:
        place = (baseline + turns) * colour.scale - turns
        corner = (place.detach() - colour.plan.reach).ceil()
        offset, shape = corner - place, (len(colour.plan.row), len(colour.plan.column))
        flat = colour.splines.patches(colour.slices, offset)
        flat[:, 0] = colour.central  # N holes share it: what a spline makes of its edge would count N times
        values, index = flat.unflatten(-1, shape), self.plane.index(corner, *shape)
        if colour.factors is None:
            return Patch(values, values, index, corner, offset)
        x = ((offset[..., :1] + colour.plan.column) * colour.pixel[0])[..., None, :]
        y = ((offset[..., 1:] + torch.arange(shape[0], device=offset.device)) * colour.pixel[1])[..., :, None]
        pixels, root = index, values.clamp(min=_NOTHING).sqrt()
        if turns.any():  # turbulence acts over the whole baseline, not over what is left of it on the torus
            pixels = self.plane.nearest(corner + turns, *shape)
        pixels = pixels.flatten()
        amplitude = lens_sum((part.index_select(0, pixels).view_as(root) for part in colour.factors), root, x, y)
        return Patch(values, values * amplitude, index, corner, offset)

    def _merged(self, patches: list[Patch]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return values, what is kept of them, corner and size of the lenses of all wavelengths together."""
        corner = torch.stack([patch.corner for patch in patches]).amin(0)
        ends = [patch.corner + corner.new_tensor(patch.values.shape[:1:-1]) for patch in patches]
        size = (torch.stack(ends).amax(0) - corner).nan_to_num(1.0)
        columns, rows = size.amax((0, 1)).long().tolist() if len(size) else (1, 1)  # a population may be empty
        first = torch.arange(corner[..., 0].numel(), device=corner.device).view(*corner.shape[:2], 1) * (rows * columns)
        sources, targets = [], []
        for number, patch in enumerate(patches):
            n_rows, n_columns = patch.values.shape[-2:]
            sources.append((patch.index + number * self.plane.n_pixels).flatten())
            x, y = (patch.corner - corner).nan_to_num(0.0).long()[..., None].unbind(2)
            row = first + (y + torch.arange(n_rows, device=y.device)) * columns
            column = x + torch.arange(n_columns, device=x.device)
            targets.append((row[..., :, None] + column[..., None, :]).flatten())
        source, target = torch.cat(sources), torch.cat(targets)
        shares = [mode.index_select(0, source) for mode in self.modes]
        dark = corner.new_zeros(first.numel() * rows * columns)

        def merged(lens: Tensor) -> Tensor:
            parts = [dark.scatter_add(0, target, share * lens) for share in shares]
            return torch.stack(parts).unflatten(1, (*corner.shape[:2], rows, columns))

        values, kept = (
            torch.cat([one.flatten() for one in ones]) for ones in zip(*(p[:2] for p in patches), strict=True)
        )
        return merged(values), merged(kept), corner, size


def _disc_ends(offset: Tensor, colour: Colour) -> Tensor:
    """Return the ends (B, L, rows, 2) of the rows of patches whose first pixel lies at `offset` (B, L, 2) [pixels] from
    the middle of a disc as wide as the patches, and as much wider as splines go on beyond its edge."""
    plan, beyond = colour.plan, _BEYOND / colour.splines.parts
    x, y = offset[..., :1], offset[..., 1:] + torch.arange(len(plan.row), device=offset.device)
    half = (plan.reach[0] + beyond) * (1 - (y / (plan.reach[1] + beyond)) ** 2).clamp(min=0).sqrt()
    ends = torch.stack([(-half - x).ceil(), (half - x).floor() + 1], -1)
    return ends.nan_to_num(0.0).clamp(0, len(plan.column)).long()


def _box_ends(size: Tensor, n_rows: int) -> Tensor:
    """Return the ends (B, L, rows, 2) of the rows of patches of which `size` (B, L, 2) columns and rows hold light."""
    lit = torch.arange(n_rows, device=size.device) < size[..., 1:]
    last = torch.where(lit, size[..., :1], 0.0).long()
    return torch.stack([torch.zeros_like(last), last], -1)


def _pairs(n: int, device: torch.device) -> Tensor:
    """Return the holes (2, L) of each lens: one with itself, which stands for all such, and then all pairs."""
    zero = torch.zeros(2, 1, dtype=torch.long, device=device)
    return torch.cat([zero, torch.triu_indices(n, n, 1, device=device)], 1)
