"""Apertures: where light enters, and how they are laid on the samples of a pupil plane.

Each sub-aperture is sampled by its own small patch of the pupil raster that an FFT takes to the image. A
sample carries the fraction of its cell that is open, so the field follows a hole that moves by less than a
sample, and autograd follows it too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics import catalog
from torchmask.optics.packing import hole_diameter, random_packing

SHAPES = ("disc", "hexagon")


class PupilSamples(NamedTuple):
    """The open part of a pupil as samples of an FFT raster, P per sub-aperture.

    offsets : (..., N, P, 2) position (x, y) relative to the centre of the sub-aperture [m]
    weights : (..., N, P) open fraction of the sample's cell
    index : (..., N, P) position in the flattened raster, in FFT order
    raster : (rows, columns) of the raster
    step : (dy, dx) of the raster [m]
    """

    offsets: Tensor
    weights: Tensor
    index: Tensor
    raster: tuple[int, int]
    step: tuple[float, float]


class Aperture(nn.Module):
    """What every aperture offers: N equal sub-apertures at `centers` (..., N, 2) [m], (x, y).

    `mask_diameter` is the disc that holds them [m]; `subaperture_diameter` is flat to flat for hexagons.
    """

    centers: Tensor
    subaperture_diameter: float
    mask_diameter: float
    shape: str = "disc"
    orientation: float = 0.0
    central_obstruction: float = 0.0

    @property
    def n_subapertures(self) -> int:
        """Number of sub-apertures, N."""
        return self.centers.shape[-2]

    @property
    def area(self) -> float:
        """Collecting area [m^2], overlaps counted twice."""
        unit = math.pi / 4 if self.shape == "disc" else math.sqrt(3) / 2
        return self.n_subapertures * unit * self.subaperture_diameter**2 * (1 - self.central_obstruction**2)

    @property
    def extent(self) -> float:
        """Largest separation of two points of the aperture, outer edge to outer edge [m].

        For hexagons an upper bound: their corners are taken to lie on the longest baseline. A full pupil of this
        diameter reaches the same spatial frequencies.
        """
        centers = self.centers.detach()
        separation = torch.linalg.vector_norm(centers[..., :, None, :] - centers[..., None, :, :], dim=-1)
        return float(separation.max()) + self.outer_diameter

    @property
    def outer_diameter(self) -> float:
        """Diameter of the circle around one sub-aperture [m]: that of a disc, corner to corner for a hexagon."""
        return self.subaperture_diameter * (1.0 if self.shape == "disc" else 2 / math.sqrt(3))

    def samples(self, grid: Grid, oversampling: int = 1) -> PupilSamples:
        """Sample the aperture on the pupil raster of a field `oversampling` times as wide as `grid`.

        The raster step is grid.period / (oversampling * n_pixels). Differentiable in `centers`.

        Raises
        ------
        ValueError
            If the image would be aliased, `oversampling` is not a positive whole number, or a sub-aperture is
            narrower than two samples.
        """
        grid.require_sampling(self.extent)
        if oversampling != int(oversampling) or oversampling < 1:
            raise ValueError(f"oversampling is {oversampling}: it must be a whole number of at least 1")
        raster = (grid.shape[0] * oversampling, grid.shape[1] * oversampling)
        step = (grid.period / raster[0], grid.period / raster[1])
        if self.subaperture_diameter < 2 * max(step):
            needed = math.ceil(2 * grid.period / (self.subaperture_diameter * min(grid.shape)))
            raise ValueError(
                f"a sub-aperture of {self.subaperture_diameter:.4g} m spans "
                f"{self.subaperture_diameter / max(step):.2f} pupil samples of {max(step):.4g} m: at least 2 are "
                f"needed, so take oversampling of at least {needed} or an image of more pixels"
            )
        centers = self.centers
        spacing = centers.new_tensor([step[1], step[0]])
        half = [math.ceil(self.outer_diameter / (2 * s)) + 1 for s in (step[1], step[0])]
        patch = torch.cartesian_prod(
            *(torch.arange(-h, h + 1, device=centers.device) for h in half)
        )  # (P, 2) whole samples, (x, y)
        nearest = torch.round(centers.detach() / spacing).long()
        position = nearest[..., None, :] + patch  # (..., N, P, 2)
        offsets = position * spacing - centers[..., None, :]
        weights = self._coverage(offsets, spacing)
        index = (position[..., 1] % raster[0]) * raster[1] + position[..., 0] % raster[1]
        return PupilSamples(offsets, weights, index, raster, step)

    def _coverage(self, offsets: Tensor, spacing: Tensor) -> Tensor:
        """Open fraction of the cells (size `spacing`) at `offsets` from the centre of a sub-aperture."""
        radius = self.subaperture_diameter / 2
        if self.shape == "hexagon":
            angles = self.orientation + torch.arange(6, dtype=offsets.dtype, device=offsets.device) * math.pi / 3
            normals = torch.stack([angles.cos(), angles.sin()], dim=-1)
            distance = radius - (offsets[..., None, :] * normals).sum(-1)  # (..., P, 6), inwards
            return _half_plane_coverage(distance, normals, spacing).prod(-1)
        # A sample on the centre has no direction: any will do, and this one keeps the gradient finite.
        central = (offsets == 0).all(-1, keepdim=True)
        direction = torch.where(central, offsets.new_tensor([1.0, 0.0]), offsets)
        length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        normals = direction / length
        r = torch.where(central, 0, length)[..., 0]
        coverage = _half_plane_coverage(radius - r, normals, spacing)
        if self.central_obstruction > 0:
            coverage = coverage - _half_plane_coverage(radius * self.central_obstruction - r, normals, spacing)
        return coverage


def _half_plane_coverage(distance: Tensor, normal: Tensor, spacing: Tensor) -> Tensor:
    """Fraction of a rectangular cell inside a half-plane whose edge lies `distance` beyond the cell's centre.

    The exact integral of a box in the direction of `normal`: the sum of two uniform variables of widths a and b
    is below `distance`. Edges are straight on the scale of a cell.
    """
    width = normal.abs() * spacing
    # A ratio of 1e-4 between the two widths stands for an edge along the cell's side: it avoids 0/0.
    width = torch.maximum(width, 1e-4 * width.amax(-1, keepdim=True))
    a, b = width.unbind(-1)
    half_sum, half_difference = (a + b) / 2, (a - b) / 2

    def square(t: Tensor) -> Tensor:
        return t.clamp(min=0) ** 2

    d = torch.minimum(torch.maximum(distance, -half_sum), half_sum)
    area = square(d + half_sum) - square(d + half_difference) - square(d - half_difference)
    return area / (2 * a * b)


class SparseAperture(Aperture):
    """A mask of N equal holes.

    Parameters
    ----------
    centers : (..., N, 2) tensor or array
        Centres (x, y) of the holes [m]; leading axes are a population of masks. A `nn.Parameter` is registered
        as that very object, so that an optimiser can move the holes; anything else becomes a buffer.
    subaperture_diameter : float
        Diameter of a disc, or flat-to-flat width of a hexagon [m].
    mask_diameter : float
        Diameter of the disc that the mask is cut from [m].
    shape : {"disc", "hexagon"}
    orientation : float
        For hexagons, the angle from +x to the normal of one side [rad].

    Raises
    ------
    ValueError
        For a wrong shape, values that are not finite, a diameter that is not positive, an unknown hole shape.

    Notes
    -----
    Feasibility (holes inside the disc, no overlap) is not demanded here, because real masks may break it
    slightly: see `torchmask.design.constraints.check_mask`.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.1, 1.0)
    >>> mask.n_subapertures, mask.centers.dtype
    (3, torch.float64)
    """

    def __init__(
        self,
        centers: Tensor,
        subaperture_diameter: float,
        mask_diameter: float,
        shape: str = "disc",
        orientation: float = 0.0,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if shape not in SHAPES:
            raise ValueError(f"shape is {shape!r}: known shapes are {', '.join(SHAPES)}")
        if not math.isfinite(orientation):
            raise ValueError(f"orientation is {orientation}: it must be a finite angle in rad")
        for name, value in (("subaperture_diameter", subaperture_diameter), ("mask_diameter", mask_diameter)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive, in m")
        if not isinstance(centers, Tensor):
            centers = torch.as_tensor(centers, dtype=torch.float64)
        if centers.ndim < 2 or centers.shape[-1] != 2 or centers.shape[-2] < 1:
            raise ValueError(f"centers has shape {tuple(centers.shape)}: it must be (..., n_subapertures, 2), (x, y)")
        if not centers.is_floating_point():
            raise TypeError(f"centers has dtype {centers.dtype}: it must be floating point, in m")
        if not bool(torch.isfinite(centers).all()):
            raise ValueError("centers holds values that are not finite")
        if isinstance(centers, nn.Parameter):
            if dtype not in (None, centers.dtype) or device not in (None, centers.device):
                raise ValueError("dtype and device of a Parameter are its own: move it before it is handed in")
            self.centers: Tensor = centers
        else:
            self.register_buffer("centers", centers.to(dtype=dtype, device=device))
        self.subaperture_diameter: float = float(subaperture_diameter)
        self.mask_diameter: float = float(mask_diameter)
        self.shape = shape
        self.orientation: float = float(orientation)

    @classmethod
    def from_catalog(
        cls,
        name: str,
        mask_diameter: float | None = None,
        fill_factor: float | None = None,
        mirrored: bool = False,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> SparseAperture:
        """A mask of the catalogue (`torchmask.optics.catalog`), such as "golay6" or "jwst_niriss_ami_7".

        Parameters
        ----------
        name : str
            Any of `catalog.names()`; case and punctuation do not matter.
        mask_diameter, fill_factor : float, optional
            Neither: as built, in metres on the primary mirror; mask_diameter is that of the pupil.
            Both: the pattern afresh. N d^2 / D^2 = fill_factor, the smallest circle around the holes centred on the
            origin, the outermost holes touching mask_diameter [m] (hexagons with their corners' circle). Golay arrays
            need this. mask_diameter alone: the mask as built, centres and holes scaled until its pupil has this
            diameter. fill_factor alone: the centres as built, holes of another size.
        mirrored : bool
            Reverse x, for instruments that look from the other side.

        Raises
        ------
        ValueError
            For an unknown name (the known ones are listed), a size that is not positive or leaves no room, a
            Golay array without both sizes, a mask whose hole diameter no source gives without fill_factor.

        Examples
        --------
        >>> mask = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.15)
        >>> mask.n_subapertures, round(mask.fill_factor, 12)
        (6, 0.15)
        """
        return cls(**catalog.layout(name, mask_diameter, fill_factor, mirrored), dtype=dtype, device=device)

    @classmethod
    def random(
        cls,
        n_subapertures: int,
        mask_diameter: float,
        fill_factor: float,
        generator: torch.Generator | None = None,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> SparseAperture:
        """A mask of round holes at random places, inside the disc and without overlap.

        Parameters
        ----------
        n_subapertures : int
            Number of holes, N.
        mask_diameter : float
            D [m].
        fill_factor : float
            N d^2 / D^2, which sets the diameter d of the holes.
        generator : torch.Generator, optional

        Raises
        ------
        ValueError
            If the holes cannot be packed; the message says the largest fill factor that can.

        Examples
        --------
        >>> mask = SparseAperture.random(7, 1.0, 0.15, torch.Generator().manual_seed(0))
        >>> mask.centers.shape, round(mask.subaperture_diameter, 4)
        (torch.Size([7, 2]), 0.1464)
        """
        diameter = hole_diameter(n_subapertures, mask_diameter, fill_factor)
        centers = random_packing(n_subapertures, mask_diameter, fill_factor, generator)
        return cls(centers, diameter, mask_diameter, dtype=dtype, device=device)

    @property
    def fill_factor(self) -> float:
        """N d^2 / D^2."""
        return self.n_subapertures * (self.subaperture_diameter / self.mask_diameter) ** 2

    def extra_repr(self) -> str:
        return (
            f"{tuple(self.centers.shape)} {self.shape}, subaperture_diameter={self.subaperture_diameter:.6g}, "
            f"mask_diameter={self.mask_diameter:.6g}"
        )


class FullAperture(Aperture):
    """A full circular pupil, the rival of every mask.

    Parameters
    ----------
    diameter : float
        [m].
    central_obstruction : float
        Diameter of the obstruction as a fraction of `diameter`, in [0, 1).

    Raises
    ------
    ValueError
        If `diameter` is not finite and positive, or `central_obstruction` lies outside [0, 1).

    Examples
    --------
    >>> telescope = FullAperture(2.0, central_obstruction=0.25)
    >>> round(telescope.area, 4), telescope.extent, telescope.n_subapertures
    (2.9452, 2.0, 1)
    """

    def __init__(
        self,
        diameter: float,
        central_obstruction: float = 0.0,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if not (math.isfinite(diameter) and diameter > 0):
            raise ValueError(f"diameter is {diameter}: it must be finite and positive, in m")
        if not 0 <= central_obstruction < 1:
            raise ValueError(
                f"central_obstruction is {central_obstruction}: it is the fraction of the diameter that is "
                "blocked, at least 0 and below 1"
            )
        self.register_buffer("centers", torch.zeros(1, 2, dtype=dtype or torch.float64, device=device))
        self.subaperture_diameter: float = float(diameter)
        self.mask_diameter: float = float(diameter)
        self.central_obstruction: float = float(central_obstruction)

    def extra_repr(self) -> str:
        return f"diameter={self.mask_diameter:.6g}, central_obstruction={self.central_obstruction:.4g}"
