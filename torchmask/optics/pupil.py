"""The base class of apertures, and the sampling of their open area on an FFT raster.

Each sub-aperture is sampled by its own small patch of the raster. A sample holds the open fraction of its cell, so the
field changes smoothly and differentiably when a hole moves by less than a sample.
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.shape_base import Shape, vector


class PupilSamples(NamedTuple):
    """The open area of a pupil, sampled on an FFT raster with P samples per sub-aperture.

    offsets : (..., N, P, 2) position (x, y) relative to the centre of the sub-aperture [m]
    weights : (..., N, P) open fraction of the sample's cell
    index : (..., N, P) index in the flattened raster, in FFT order
    raster : (rows, columns), size of the raster
    step : (dy, dx), spacing of the samples [m]
    """

    offsets: Tensor
    weights: Tensor
    index: Tensor
    raster: tuple[int, int]
    step: tuple[float, float]


class Aperture(nn.Module):
    """Base class of all apertures: N equal sub-apertures at `centers` (..., N, 2) [m], (x, y).

    `shape` is the shape of a sub-aperture and `subaperture_diameter` its size [m], flat to flat for hexagons;
    `mask_diameter` is the diameter of the disc that holds them all [m].
    """

    centers: Tensor
    subaperture_diameter: float
    mask_diameter: float
    shape: Shape

    @property
    def n_subapertures(self) -> int:
        """Number of sub-apertures, N."""
        return self.centers.shape[-2]

    @property
    def is_full(self) -> bool:
        """Whether it is a full pupil, that is a single opening, which has no pairs of holes and makes no fringes."""
        return self.n_subapertures == 1

    @property
    def area(self) -> float:
        """Collecting area [m^2], with overlaps counted twice."""
        return self.n_subapertures * self.shape.area(self.subaperture_diameter)

    @property
    def outer_diameter(self) -> float:
        """Diameter of the circle around one sub-aperture [m]: that of a disc, corner to corner for a hexagon."""
        return self.shape.outer_diameter(self.subaperture_diameter)

    @property
    def extent(self) -> float:
        """Largest separation of two points of the aperture, outer edge to outer edge [m].

        For hexagons it is an upper bound, as if their corners lay on the longest baseline. A full pupil of this
        diameter reaches the same spatial frequencies. A population of no masks has that of one hole.
        """
        centers = self.centers.detach()
        separation = torch.linalg.vector_norm(centers[..., :, None, :] - centers[..., None, :, :], dim=-1)
        return _largest(separation) + self.outer_diameter

    @property
    def reach(self) -> float:
        """Distance of the outermost edge from the origin [m]; an upper bound for hexagons, as for `extent`."""
        return _largest(torch.linalg.vector_norm(self.centers.detach(), dim=-1)) + self.outer_diameter / 2

    def still(self) -> Self:
        """Return a copy that does not change when this aperture moves or trains."""
        centers = self.centers.detach().clone()
        if isinstance(self.centers, nn.Parameter):
            centers = nn.Parameter(centers, requires_grad=False)
        return copy.deepcopy(self, {id(self.centers): centers})

    def samples(self, grid: Grid, oversampling: int = 1) -> PupilSamples:
        """Sample the aperture on the pupil raster of a field `oversampling` times as wide as `grid`.

        The samples are grid.period / (oversampling * n_pixels) apart. Differentiable in `centers`.

        Raises
        ------
        ValueError
            If the image would be aliased, `oversampling` is not a positive whole number, or a sub-aperture is
            narrower than two samples.
        TypeError
            If the centres are in half precision.
        """
        self.require_sampling(grid)
        return sample_holes(self.centers, self.shape, self.subaperture_diameter, grid, oversampling)

    def require_sampling(self, grid: Grid) -> None:
        """Raise ValueError if the grid aliases the image. Nothing is checked under `torch.func.vmap`, which hides
        values."""
        if can_be_read(self.centers):
            grid.require_sampling(self.extent)


def sample_holes(
    centers: Tensor, shape: Shape, diameter: float, grid: Grid, oversampling: int | None = None
) -> PupilSamples:
    """Sample sub-apertures of one shape and diameter [m] at `centers` (..., N, 2) [m] as `Aperture.samples` does.

    Aliasing of the image is not checked. Without `oversampling` it is 1, and errors do not advise to raise it.
    """
    if centers.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"the centres are {centers.dtype}: float32 or float64 is needed, as by aperture.float()")
    raster, step = pupil_raster(diameter, grid, oversampling)
    cell = vector(centers, step[1], step[0])
    half = [math.ceil(shape.outer_diameter(diameter) / (2 * s)) + 1 for s in (step[1], step[0])]
    patch = torch.cartesian_prod(
        *(torch.arange(-h, h + 1, device=centers.device) for h in half)
    )  # (P, 2) whole samples, (x, y)
    nearest = torch.round(centers.detach() / cell).long()
    position = nearest[..., None, :] + patch  # (..., N, P, 2)
    offsets = position * cell - centers[..., None, :]
    weights = shape.coverage(offsets, cell, diameter)
    index = (position[..., 1] % raster[0]) * raster[1] + position[..., 0] % raster[1]
    return PupilSamples(offsets, weights, index, raster, step)


def pupil_raster(
    diameter: float, grid: Grid, oversampling: int | None = None
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return the numbers (rows, columns) of a raster's pupil samples and their steps (y, x) [m].

    Raises ValueError if a sub-aperture of this diameter [m] is narrower than two samples.
    """
    finer = 1 if oversampling is None else whole_number("oversampling", oversampling)
    raster = (grid.shape[0] * finer, grid.shape[1] * finer)
    step = (grid.period / raster[0], grid.period / raster[1])
    if diameter * (1 + 1e-9) < 2 * max(step):  # more than rounding, as of a mask that was turned
        wider = 2 * max(step) / diameter
        or_finer = "" if oversampling is None else f" or oversampling of at least {math.ceil(finer * wider)}"
        raise ValueError(
            f"a sub-aperture of {diameter:.4g} m spans {diameter / max(step):.2f} pupil samples of "
            f"{max(step):.4g} m: at least 2 are needed, so take an image at least {math.ceil(100 * wider) / 100:g} "
            f"times as wide{or_finer}"
        )
    return raster, step


def can_be_read(tensor: Tensor) -> bool:
    """Return whether Python can read the values of a tensor, which it cannot under `torch.func.vmap`."""
    try:
        bool(tensor.detach().sum() == 0)
    except RuntimeError:
        return False
    return True


def _largest(lengths: Tensor) -> float:
    """Return the largest of some lengths, 0 if there are none."""
    return float(lengths.max()) if lengths.numel() else 0.0
