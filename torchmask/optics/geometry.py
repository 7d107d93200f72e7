"""The geometry of a mask in the pupil: rotation, magnification, shear and mirroring relative to its drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.optics.aperture import SparseAperture


@dataclass(frozen=True)
class MaskGeometry:
    """The linear map from the nominal pupil coordinates of a mask to the real ones.

    On column vectors (x, y) it first reverses x if `mirrored`, then applies the symmetric stretch
    [[magnification_x, shear], [shear, magnification_y]], then rotates by `rotation`. Every invertible real matrix has
    this form.

    rotation : angle from x to y [rad]
    magnification_x : first diagonal element of the stretch
    magnification_y : second diagonal element of the stretch
    shear : off-diagonal element of the stretch
    mirrored : whether x is reversed

    Raises ValueError unless all numbers are finite and both eigenvalues of the stretch are positive.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.1, 1.0)
    >>> turned = MaskGeometry(rotation=math.pi / 2, magnification_x=1.01, magnification_y=1.01).apply(mask)
    >>> turned.centers[0].round(decimals=12).tolist(), round(turned.subaperture_diameter, 12)
    ([-0.404, 0.0], 0.101)
    """

    rotation: float = 0.0
    magnification_x: float = 1.0
    magnification_y: float = 1.0
    shear: float = 0.0
    mirrored: bool = False

    def __post_init__(self) -> None:
        values = (self.rotation, self.magnification_x, self.magnification_y, self.shear)
        positive = self.magnification_x > 0 and self.magnification_x * self.magnification_y > self.shear**2
        if not (all(map(math.isfinite, values)) and positive):
            raise ValueError(
                f"rotation, magnification_x, magnification_y and shear are {values}: finite numbers are needed, the "
                "magnifications positive and the square of the shear below their product"
            )

    @classmethod
    def from_matrix(cls, matrix: Tensor) -> MaskGeometry:
        """Return the geometry of a matrix (2, 2), by its polar decomposition. Raises ValueError if it is singular."""
        matrix = matrix.detach().double().cpu()
        mirrored = bool(torch.linalg.det(matrix) < 0)
        rotation, stretch = turn_and_stretch(matrix * matrix.new_tensor([-1.0 if mirrored else 1.0, 1.0]))
        return cls(float(rotation), float(stretch[0]), float(stretch[1]), float(stretch[2]), mirrored)

    @property
    def magnification(self) -> float:
        """Factor by which holes grow: the square root of the magnification of areas."""
        return math.sqrt(self.magnification_x * self.magnification_y - self.shear**2)

    @property
    def matrix(self) -> Tensor:
        """Matrix (2, 2), float64, that acts on column vectors (x, y)."""
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        like = {"dtype": torch.float64, "device": "cpu"}
        turn = torch.tensor([[cosine, -sine], [sine, cosine]], **like)
        stretch = torch.tensor([[self.magnification_x, self.shear], [self.shear, self.magnification_y]], **like)
        return turn @ stretch * torch.tensor([-1.0 if self.mirrored else 1.0, 1.0], **like)

    def apply(self, aperture: SparseAperture) -> SparseAperture:
        """Return the real mask. Centres follow the whole map; holes are rotated, mirrored and magnified uniformly."""
        shape = aperture.shape.mirrored() if self.mirrored else aperture.shape
        return aperture.replace(
            aperture.centers @ self.matrix.to(aperture.centers).T,
            aperture.subaperture_diameter * self.magnification,
            aperture.mask_diameter * self.magnification,
            shape.turned(self.rotation),
        )

    def __str__(self) -> str:
        mirror = ", x mirrored" if self.mirrored else ""
        return (
            f"rotation {math.degrees(self.rotation):.4f} deg, magnification {self.magnification_x:.5f} along x and "
            f"{self.magnification_y:.5f} along y, shear {self.shear:.5f}{mirror}"
        )


def turn_and_stretch(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation angle () and the stretch (3,), xx, yy and xy, of a matrix M (2, 2) of positive determinant.

    R(a)^T M is symmetric for tan a = (M_yx - M_xy) / (M_xx + M_yy). Differentiable.
    """
    angle = torch.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    cosine, sine = angle.cos(), angle.sin()
    turn_back = torch.stack([torch.stack([cosine, sine]), torch.stack([-sine, cosine])])
    stretch = turn_back @ matrix
    return angle, torch.stack([stretch[0, 0], stretch[1, 1], stretch[0, 1]])
