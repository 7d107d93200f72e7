"""What a hole shape must know, and what follows from it.

A `Shape` is the form of a hole about its centre, with what belongs to the form (the orientation of a hexagon) and
without its size: the size, `diameter` [m], goes with every call. Everything in the library that depends on the form
of a hole asks its shape, so that one class adds a new form to all of it.
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
    """An edge around the centre of a hole, of `radius` [m]."""

    radius: float


class Corners(NamedTuple):
    """A polygonal edge: `points` (n, 2) [m] from the centre of a hole, counterclockwise."""

    points: Array


Contour = Circle | Corners


class Patches(Protocol):
    """OTF^2 at the pixels x (..., 1, K) by y (..., K, 1), in units of the hole's diameter: (..., K, K).

    The pullback that comes with it takes the derivatives of a loss by the patches, (..., K, K), to those by the common
    shift of each patch's (x, y), (..., 2). It may be called once, and only if `differentiate`.
    """

    def __call__(self, x: Tensor, y: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]: ...


@dataclass(frozen=True)
class Shape(ABC):
    """The form of a hole about its centre; lengths are in metres, and `diameter` says how large it is.

    A shape of your own is a frozen dataclass whose fields are numbers, with a `name` (under which files know it) and
    the abstract methods; a polygon needs one of them (`torchmask.optics.polygons.Polygon`). Methods that take tensors
    follow their dtype, device and gradient, and take any leading axes.
    """

    name: ClassVar[str]
    is_round: ClassVar[bool] = False  # a turn about the centre changes nothing
    has_noll_modes: ClassVar[bool] = False  # Noll's polynomials are orthonormal over the open area as they are
    known: ClassVar[dict[str, type[Shape]]] = {}

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "name" in vars(cls):
            other = Shape.known.get(cls.name, cls)
            if other.__qualname__ != cls.__qualname__:  # a class may be defined once more, as in a notebook
                raise ValueError(f"{other.__qualname__} is called {cls.name!r} already: files must tell shapes apart")
            Shape.known[cls.name] = cls

    def __str__(self) -> str:
        return self.name

    @property
    def plural(self) -> str:
        """Several of them in words, with what their diameter measures where that is no diameter."""
        return f"{self.name}s"

    @property
    def parameters(self) -> dict[str, float]:
        """What besides the name a file must hold: the fields of the dataclass."""
        return asdict(self)

    @property
    def fineness(self) -> float:
        """Size of the finest structure over that of the hole, at most 1: modes vary on this scale."""
        return 1.0

    @property
    def askew(self) -> float:
        """An angle [rad] by which the shape may be turned so that no side lies along x."""
        return 0.0

    @abstractmethod
    def turned(self, angle: float) -> Self:
        """The shape turned by `angle` [rad], counterclockwise."""

    @abstractmethod
    def mirrored(self) -> Self:
        """The shape with x reversed."""

    @abstractmethod
    def area(self, diameter: float) -> float:
        """Open area [m^2]."""

    @abstractmethod
    def outer_diameter(self, diameter: float) -> float:
        """Diameter of the circle around the centre that just holds the hole [m]."""

    @abstractmethod
    def outline(self, diameter: float) -> tuple[Contour, ...]:
        """The outer edge, and then the edges of what is blocked within it."""

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        """The shape and its diameter of which this is the outline, corner by corner; None if there is none.

        Shapes that are to be read from drawings override it.
        """
        return None

    @abstractmethod
    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        """Open fraction (...) of the rectangular cells of size `cell` (2,) [m] at `offsets` (..., 2) [m]."""

    @abstractmethod
    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        """Overlap (...) of the hole with itself displaced by `shift` (..., 2) [m]: 1 at zero, with gradient 0."""

    @abstractmethod
    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        """Points (Q, 2) [m] and weights (Q,) of the mean over the open area, exact for polynomials up to `degree`.

        float64, on the CPU.
        """

    @abstractmethod
    def amplitude(self, frequency: Array, diameter: float) -> Array:
        """Fourier transform over the open area, 1 at 0, at `frequency` (..., 2) [1/m], an angle on the sky over the
        wavelength."""

    @abstractmethod
    def separation(self, difference: Tensor) -> Tensor:
        """The diameter (...) [m] at which two holes whose centres differ by `difference` (..., 2) [m] touch.

        Less the diameter it is the gap between the holes: exact where sides face each other, and elsewhere never more
        than the true one, as long as the diameter is the width of the hole at its narrowest.
        """

    @abstractmethod
    def clearance(self, centers: Tensor, diameter: float, disc_diameter: float) -> Tensor:
        """Signed distance (...) [m] of holes at `centers` (..., 2) from the rim of a disc around the origin."""

    @abstractmethod
    def center_radius(self, diameter: float, disc_diameter: float) -> float:
        """Radius [m] beyond which no centre can lie if the hole is to be inside a disc around the origin."""

    @abstractmethod
    def chords(self, height: Array, diameter: float) -> tuple[Array, Array]:
        """Where a horizontal line `height` [m] above the centre enters and leaves what the outer edge holds.

        Both are 0 where it does not meet it. The frequencies that two equal holes share fill the same form at twice
        the diameter, so chords, clearance and outline describe them as well.
        """

    def patches(self, dtype: torch.dtype, device: torch.device) -> Patches:
        """OTF^2 with its derivative, for `AsymptoticMSE`: by autograd, unless a shape knows a faster way."""
        return partial(_squared_otf, self)


def _squared_otf(shape: Shape, x: Tensor, y: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]:
    shift = x.new_zeros(*x.shape[:-2], 1, 1, 2, requires_grad=differentiate)
    with torch.enable_grad() if differentiate else nullcontext():
        value = shape.otf(shift + torch.stack(torch.broadcast_tensors(x, y), dim=-1), 1.0) ** 2

    def pullback(grad: Tensor) -> Tensor:
        return torch.autograd.grad(value, shift, grad)[0][..., 0, 0, :]

    return value.detach().clone(), pullback


def no_pullback(grad: Tensor) -> Tensor:
    """What stands for a pullback where none was asked for."""
    raise RuntimeError("the patches were made without what their derivatives need")


def safe_length(vector: Tensor) -> Tensor:
    """Length along the last axis; at zero, where any direction would do, the gradient is along the first axis."""
    zero = (vector == 0).all(-1)
    x, y = vector.unbind(-1)
    return torch.where(zero, x, torch.hypot(torch.where(zero, 1.0, x), y))


def half_plane_coverage(distance: Tensor, normal: Tensor, cell: Tensor) -> Tensor:
    """Fraction of a rectangular cell inside a half-plane whose edge lies `distance` beyond the cell's centre.

    The exact integral of a box in the direction of `normal`: the sum of two uniform variables of widths a and b
    is below `distance`. Edges are straight on the scale of a cell.
    """
    width = normal.abs() * cell
    # A ratio of 1e-4 between the two widths stands for an edge along the cell's side: it avoids 0/0.
    width = torch.maximum(width, 1e-4 * width.amax(-1, keepdim=True))
    a, b = width.unbind(-1)
    half_sum, half_difference = (a + b) / 2, (a - b) / 2

    def square(t: Tensor) -> Tensor:
        return t.clamp(min=0) ** 2

    d = torch.minimum(torch.maximum(distance, -half_sum), half_sum)
    area = square(d + half_sum) - square(d + half_difference) - square(d - half_difference)
    return area / (2 * a * b)
