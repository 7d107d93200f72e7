"""The base class of hole shapes, and helpers for its subclasses.

A `Shape` describes the outline of a hole about its centre, such as a hexagon and its orientation, but not its size: the
size, `diameter` [m], is an argument of every method. All code that depends on the shape of a hole uses this interface,
so a new shape takes only one class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Pullback = Callable[[Tensor], Tensor]


class Circle(NamedTuple):
    """A circular edge of `radius` [m] around the centre of a hole."""

    radius: float


class Corners(NamedTuple):
    """A polygonal edge: `points` (n, 2) [m] from the centre of a hole, counterclockwise."""

    points: Array


Contour = Circle | Corners


class Patches(Protocol):
    """Function that returns OTF^2 (..., K, K) at x (..., 1, K) and y (..., K, 1), in units of the hole's diameter.

    It also returns a pullback, which converts the gradient of a loss with respect to the patches, (..., K, K), into
    that with respect to a common shift (x, y) of each patch, (..., 2). The pullback may be called once, and only if
    `differentiate` is true.
    """

    def __call__(self, x: Tensor, y: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]: ...


@dataclass(frozen=True)
class Shape(ABC):
    """The shape of a hole about its centre. Lengths are in metres, and `diameter` is the size of the hole.

    To add a shape, write a frozen dataclass whose fields are numbers or tuples of them, with a `name` (used in files)
    and the abstract methods; a subclass of `torchmask.optics.polygons.Polygon` needs only one of them. Methods that
    take tensors accept any leading axes, keep dtype and device, and are differentiable.
    """

    name: ClassVar[str]
    is_round: ClassVar[bool] = False  # whether rotation leaves the shape unchanged
    has_noll_modes: ClassVar[bool] = False  # whether Noll's polynomials are orthonormal over the open area
    known: ClassVar[dict[str, type[Shape]]] = {}

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "name" in vars(cls):
            other = Shape.known.get(cls.name, cls)
            if other.__qualname__ != cls.__qualname__:  # a notebook may define the same class again
                raise ValueError(f"{other.__qualname__} is called {cls.name!r} already: choose another name")
            Shape.known[cls.name] = cls

    def __str__(self) -> str:
        return self.name

    @property
    def plural(self) -> str:
        """Plural of the name, with how the diameter is measured where that is not obvious."""
        return f"{self.name}s"

    @property
    def parameters(self) -> dict[str, Any]:
        """Fields of the dataclass, which files hold besides the name."""
        return asdict(self)

    @property
    def fineness(self) -> float:
        """Size of the finest structure, on which modes vary, as a fraction of the diameter."""
        return 1.0

    @property
    def without_vanes(self) -> Shape:
        """The shape without thin vanes across it."""
        return self

    @property
    def askew(self) -> float:
        """Angle [rad] by which to turn the shape so that no side lies along x."""
        return 0.0

    @abstractmethod
    def turned(self, angle: float) -> Self:
        """Return the shape turned by `angle` [rad], counterclockwise."""

    @abstractmethod
    def mirrored(self) -> Self:
        """Return the shape with x reversed."""

    @abstractmethod
    def area(self, diameter: float) -> float:
        """Return the open area [m^2]."""

    @abstractmethod
    def outer_diameter(self, diameter: float) -> float:
        """Return the diameter of the smallest circle around the centre that contains the hole [m]."""

    @abstractmethod
    def outline(self, diameter: float) -> tuple[Contour, ...]:
        """Return the outer edge, followed by the edges of any obstructions within it."""

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        """Return the shape and its diameter [m] for this outline, or None if it is that of another shape.

        Every corner must agree to `tolerance` [m]. Override it in shapes that are to be read from drawings.
        """
        return None

    @abstractmethod
    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        """Return the open fraction (...) of rectangular cells of size `cell` (2,) [m] at `offsets` (..., 2) [m]."""

    @abstractmethod
    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        """Return the overlap (...) of the hole with itself displaced by `shift` (..., 2) [m], over the open area.

        It is 1 at zero shift, with gradient 0.
        """

    @abstractmethod
    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        """Return points (Q, 2) [m] and weights (Q,) for means over the open area, float64 on the CPU.

        The mean is exact for polynomials up to `degree`.
        """

    @abstractmethod
    def amplitude(self, frequency: Array, diameter: float) -> Array:
        """Return the Fourier transform of the open area, 1 at 0, at `frequency` (..., 2) [1/m].

        A frequency is an angle on the sky divided by the wavelength. The result is complex for shapes that differ from
        themselves turned by 180 degrees.
        """

    @abstractmethod
    def separation(self, difference: Tensor) -> Tensor:
        """Return the diameter (...) [m] at which two holes with centres `difference` (..., 2) [m] apart touch.

        Subtracting the actual diameter gives the gap between the holes. It is exact where sides face each other and
        elsewhere never exceeds the true gap, provided the diameter is the smallest width of the hole.
        """

    @abstractmethod
    def clearance(self, centers: Tensor, diameter: float, disc_diameter: float) -> Tensor:
        """Return the distance (...) [m] of holes at `centers` (..., 2) [m] from the rim of a disc around the origin.

        It is negative for holes that cross the rim.
        """

    @abstractmethod
    def center_radius(self, diameter: float, disc_diameter: float) -> float:
        """Return the largest distance [m] of a centre from the origin with the hole inside a disc around the origin."""

    @abstractmethod
    def chords(self, height: Array, diameter: float) -> tuple[Array, Array]:
        """Return x [m] where a horizontal line `height` [m] above the centre enters and leaves the outer edge.

        Both are 0 if the line misses it. The support of the overlap of two equal holes has the same shape and twice the
        diameter, so chords, clearance and outline apply to it too.
        """

    def patches(self, dtype: torch.dtype, device: torch.device) -> Patches:
        """Return a function for OTF^2 and its derivative, used by `AsymptoticMSE`.

        It uses autograd unless a shape overrides it with a faster one.
        """
        return partial(_squared_otf, self)


def _squared_otf(shape: Shape, x: Tensor, y: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]:
    shift = x.new_zeros(*x.shape[:-2], 1, 1, 2, requires_grad=differentiate)
    with torch.enable_grad() if differentiate else nullcontext():
        value = shape.otf(shift + torch.stack(torch.broadcast_tensors(x, y), dim=-1), 1.0) ** 2

    def pullback(grad: Tensor) -> Tensor:
        return torch.autograd.grad(value, shift, grad)[0][..., 0, 0, :]

    return value.detach().clone(), pullback


def no_pullback(grad: Tensor) -> Tensor:
    """Raise RuntimeError; returned as the pullback of patches that are not to be differentiated."""
    raise RuntimeError("the patches were made without derivatives: call with differentiate=True")


def vector(like: Tensor, *numbers: float) -> Tensor:
    """Return numbers as a vector (n,) like a tensor, made where that lies: nothing waits for a copy from the host."""
    return torch.stack([torch.full((), number, dtype=like.dtype, device=like.device) for number in numbers])


def safe_length(vector: Tensor) -> Tensor:
    """Return the length along the last axis, with a gradient along the first component at zero length."""
    zero = (vector == 0).all(-1)
    x, y = vector.unbind(-1)
    return torch.where(zero, x, torch.hypot(torch.where(zero, 1.0, x), y))


def half_plane_coverage(distance: Tensor, normal: Tensor, cell: Tensor) -> Tensor:
    """Return the fraction of a rectangular cell inside a half-plane whose edge lies `distance` beyond its centre.

    It is exact: the probability that the sum of two uniform variables, whose widths a and b are those of the cell along
    `normal`, is below `distance`. Edges are taken as straight on the scale of a cell.
    """
    width = normal.abs() * cell
    # For an edge parallel to a side of the cell, a small width instead of 0 avoids 0/0.
    width = torch.maximum(width, 1e-4 * width.amax(-1, keepdim=True))
    a, b = width.unbind(-1)
    half_sum, half_difference = (a + b) / 2, (a - b) / 2

    def square(t: Tensor) -> Tensor:
        return t.clamp(min=0) ** 2

    d = torch.minimum(torch.maximum(distance, -half_sum), half_sum)
    area = square(d + half_sum) - square(d + half_difference) - square(d - half_difference)
    return area / (2 * a * b)
