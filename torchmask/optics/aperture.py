"""Apertures: masks with several holes, and full pupils."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from torchmask.io import as_tensor
from torchmask.optics import catalog
from torchmask.optics.packing import hole_diameter, random_packing
from torchmask.optics.pupil import Aperture, can_be_read
from torchmask.optics.shapes import Annulus, Disc, Shape, TelescopePupil, named_shape


class SparseAperture(Aperture):
    """A mask of N equal holes.

    Parameters
    ----------
    centers : (..., N, 2) tensor, array or sequence
        Centres (x, y) of the holes [m]; leading axes are a population of masks. A `nn.Parameter` is registered
        as that very object, so that an optimiser can move the holes; anything else becomes a buffer.
    subaperture_diameter : float
        Diameter of a disc, or flat-to-flat width of a hexagon [m].
    mask_diameter : float
        Diameter of the disc that contains the mask [m].
    shape : str or Shape
        Shape of the holes: "disc", "hexagon", "square" or an object of `torchmask.optics.shapes`.
    orientation : float
        Angle from +x to the normal of one side [rad], for hexagons and squares given by name.
    dtype : torch.dtype, optional
        Type of the centres, by default their own.
    device : torch.device, optional
        Device of the centres, by default their own.

    Raises
    ------
    ValueError
        If `centers` has a wrong shape or values that are not finite (not checked under `torch.func.vmap`), a diameter
        is not positive, or the shape of the holes is unknown.
    TypeError
        If `centers` is not floating point.

    Notes
    -----
    Holes may overlap or leave the disc, because real masks may do so slightly; see
    `torchmask.design.constraints.check_mask`.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.1, 1.0)
    >>> mask.n_subapertures, mask.centers.dtype
    (3, torch.float64)
    """

    def __init__(
        self,
        centers: Tensor | ArrayLike,
        subaperture_diameter: float,
        mask_diameter: float,
        shape: str | Shape = "disc",
        orientation: float = 0.0,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if isinstance(shape, Shape):
            if orientation != 0:
                raise ValueError(f"orientation is {orientation}, but {shape!r} has its own: leave it out")
        else:
            shape = named_shape(shape, {"orientation": orientation})
        for name, value in (("subaperture_diameter", subaperture_diameter), ("mask_diameter", mask_diameter)):
            if (many := value.numel() if isinstance(value, Tensor) else np.size(value)) != 1:
                raise ValueError(f"{name} holds {many} values: it is one number, in m, as all holes have one size")
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive, in m")
        if not isinstance(centers, Tensor):
            centers = as_tensor(centers).double()
        if centers.ndim < 2 or centers.shape[-1] != 2 or centers.shape[-2] < 1:
            raise ValueError(f"centers has shape {tuple(centers.shape)}: it must be (..., n_subapertures, 2), (x, y)")
        if not centers.is_floating_point():
            raise TypeError(f"centers has dtype {centers.dtype}: it must be floating point, in m")
        if can_be_read(centers) and not bool(torch.isfinite(centers).all()):
            raise ValueError("centers holds values that are not finite: positions in m are needed")
        if isinstance(centers, nn.Parameter):
            if dtype not in (None, centers.dtype) or not _is_on(centers, device):
                raise ValueError("centers is a Parameter of another dtype or device: convert it before passing it")
            self.centers: Tensor = centers
        else:
            self.register_buffer("centers", centers.to(dtype=dtype, device=device))
        self.subaperture_diameter: float = float(subaperture_diameter)
        self.mask_diameter: float = float(mask_diameter)
        self.shape: Shape = shape

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
        """Return a mask of the catalogue (`torchmask.optics.catalog`), such as "golay6" or "jwst_niriss_ami_7".

        Without `mask_diameter` and `fill_factor` the mask is as built, in metres on the primary mirror, and its
        diameter is that of the pupil. If both are given, the smallest circle around the holes is centred on the origin
        and the outermost holes touch the mask's edge (hexagons with the circle through their corners); Golay arrays
        need both.

        Parameters
        ----------
        name : str
            Any of `catalog.names()`; case and punctuation do not matter.
        mask_diameter : float, optional
            Diameter D of the mask [m]. Alone, it scales the mask as built so that its pupil has this diameter.
        fill_factor : float, optional
            Fill factor N d^2 / D^2. Alone, it changes only the diameter d of the holes.
        mirrored : bool
            Whether to reverse x, for instruments that look from the other side.

        Raises
        ------
        ValueError
            If the name is unknown (the message lists the known ones), a size is not positive or leaves no room, or a
            size is needed that the catalogue does not have.

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
        """Return a mask of round holes at random positions, inside the disc and without overlap.

        Parameters
        ----------
        n_subapertures : int
            Number of holes, N.
        mask_diameter : float
            Diameter D of the mask [m].
        fill_factor : float
            Fill factor N d^2 / D^2, which sets the diameter d of the holes.
        generator : torch.Generator, optional
            Source of randomness.

        Raises
        ------
        ValueError
            If the holes cannot be packed; the message gives the largest fill factor that can.

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
        """Fill factor N d^2 / D^2."""
        return self.n_subapertures * (self.subaperture_diameter / self.mask_diameter) ** 2

    def replace(
        self,
        centers: Tensor | ArrayLike | None = None,
        subaperture_diameter: float | None = None,
        mask_diameter: float | None = None,
        shape: Shape | None = None,
    ) -> SparseAperture:
        """Return a copy of the mask with some of its properties replaced.

        Examples
        --------
        >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2]], 0.1, 1.0, "hexagon")
        >>> mask.replace(centers=-mask.centers).shape == mask.shape
        True
        """
        return SparseAperture(
            self.centers if centers is None else centers,
            self.subaperture_diameter if subaperture_diameter is None else subaperture_diameter,
            self.mask_diameter if mask_diameter is None else mask_diameter,
            self.shape if shape is None else shape,
        )

    def extra_repr(self) -> str:
        return (
            f"{tuple(self.centers.shape)} {self.shape}, subaperture_diameter={self.subaperture_diameter:.6g}, "
            f"mask_diameter={self.mask_diameter:.6g}"
        )


class FullAperture(Aperture):
    """A full circular pupil without a mask, with or without a central obstruction and the vanes of a spider.

    Parameters
    ----------
    diameter : float
        Diameter of the pupil [m].
    central_obstruction : float
        Diameter of the obstruction as a fraction of `diameter`, in [0, 1).
    vane_width : float
        Width of the vanes that hold the secondary mirror [m].
    vane_angles : sequence of float
        Direction of each vane, which runs straight from the obstruction, or from the centre, to the rim [rad],
        counterclockwise from +x.

    Raises
    ------
    ValueError
        If `diameter` is not finite and positive, `central_obstruction` lies outside [0, 1), only one of `vane_width`
        and `vane_angles` is given, or a pupil cannot have such vanes (see `torchmask.optics.telescope_pupil`).

    Examples
    --------
    >>> telescope = FullAperture(2.0, central_obstruction=0.25)
    >>> round(telescope.area, 4), telescope.extent, telescope.n_subapertures
    (2.9452, 2.0, 1)
    >>> cross = [0, math.pi / 2, math.pi, 3 * math.pi / 2]
    >>> round(FullAperture(2.0, 0.25, vane_width=0.02, vane_angles=cross).area, 4)
    2.8852
    """

    def __init__(
        self,
        diameter: float,
        central_obstruction: float = 0.0,
        vane_width: float = 0.0,
        vane_angles: Sequence[float] = (),
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if not (math.isfinite(diameter) and diameter > 0):
            raise ValueError(f"diameter is {diameter}: it must be finite and positive, in m")
        if not 0 <= central_obstruction < 1:
            raise ValueError(
                f"central_obstruction is {central_obstruction}: it must be a fraction of the diameter, at least 0 and "
                "below 1"
            )
        if bool(vane_width) != (len(vane_angles) > 0):
            raise ValueError(
                f"vane_width is {vane_width} m and vane_angles are {list(vane_angles)}: vanes need both, a width and "
                "angles in rad"
            )
        self.register_buffer("centers", torch.zeros(1, 2, dtype=dtype or torch.float64, device=device))
        self.subaperture_diameter: float = float(diameter)
        self.mask_diameter: float = float(diameter)
        self.central_obstruction: float = float(central_obstruction)
        self.vane_width: float = float(vane_width)
        self.vane_angles: tuple[float, ...] = tuple(float(angle) for angle in vane_angles)
        self.shape: Shape = Annulus(self.central_obstruction) if central_obstruction > 0 else Disc()
        if self.vane_angles:
            self.shape = TelescopePupil(self.central_obstruction, self.vane_width / diameter, self.vane_angles)

    def extra_repr(self) -> str:
        text = f"diameter={self.mask_diameter:.6g}, central_obstruction={self.central_obstruction:.4g}"
        if self.vane_angles:
            angles = ", ".join(f"{angle:.4g}" for angle in self.vane_angles)
            text += f", vane_width={self.vane_width:.4g}, vane_angles=({angles})"
        return text


def _is_on(tensor: Tensor, device: torch.device | str | None) -> bool:
    """Return whether a tensor is on the device that is asked for; "cuda" is torch's current one, such as "cuda:1"."""
    if device is None:
        return True
    if torch.device(device).type != tensor.device.type:  # the other may not exist on this machine
        return False
    return torch.empty(0, device=device).device == tensor.device
