"""What goes on from one descent of a restoration to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchmask.optics.geometry import MaskGeometry


@dataclass(frozen=True)
class Calibration:
    """What is brought up to date between two descents and stays as it is during one.

    transmission : (T,) of the frames, 1 on average
    noise_inflation : (T,) divides a frame's precision: variance of its residuals over that of its noise, at least 1,
        or what is made of it
    aberration_weight : of ||z||^2 / 2 in the cost, which follows the strength of the turbulence; 0: no prior
    """

    transmission: Tensor
    noise_inflation: Tensor
    aberration_weight: float

    def of_frames(self, part: slice | Tensor) -> Calibration:
        """That of some of the frames."""
        return replace(self, transmission=self.transmission[part], noise_inflation=self.noise_inflation[part])


@dataclass(frozen=True)
class State:
    """Object and aberrations so far, and the calibration they go with.

    image : (H', W') object in units of the stack's mean pixel
    z : (T, K) parameters of the aberrations, the common ones the same in every frame
    geometry : how the mask lies against what is told, as far as it has been found
    """

    image: Tensor
    z: Tensor
    calibration: Calibration
    geometry: MaskGeometry = field(default_factory=MaskGeometry)

    def of_frames(self, part: slice | Tensor) -> State:
        """The same object with the aberrations of some of the frames."""
        return replace(self, z=self.z[part], calibration=self.calibration.of_frames(part))

    def calibrated(
        self,
        *,
        transmission: Tensor | None = None,
        noise_inflation: Tensor | None = None,
        aberration_weight: float | None = None,
    ) -> State:
        """The state with some of its calibration replaced."""
        now = self.calibration
        new = Calibration(
            now.transmission if transmission is None else transmission,
            now.noise_inflation if noise_inflation is None else noise_inflation,
            now.aberration_weight if aberration_weight is None else aberration_weight,
        )
        return replace(self, calibration=new)

    def with_noise_inflation(self, value: float) -> State:
        """The state with the same noise inflation for all frames."""
        return self.calibrated(noise_inflation=torch.full_like(self.calibration.noise_inflation, value))
