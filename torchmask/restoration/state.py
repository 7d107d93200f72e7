"""The state of a restoration that is passed from one descent to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from torch import Tensor

from torchmask.optics.geometry import MaskGeometry

LEAST_TRANSMISSION = 1e-3


class Modes(Enum):
    """Aberrations that the parameters of a state stand for."""

    STILL = "those of snapshots"
    MOVING = "the same, which change during the exposure"
    FINER = "more of them, after the search"


@dataclass(frozen=True)
class Calibration:
    """Quantities that are updated between two descents and fixed during one.

    transmission : (T,) transmission of the frames, 1 on average, none below `LEAST_TRANSMISSION`
    noise_inflation : (T,) factor by which a frame's precision is divided, from the variance of its residuals over that
        of its noise, at least 1
    aberration_weight : weight of ||z||^2 / 2 in the cost, which follows the strength of the turbulence; 0: no prior
    """

    transmission: Tensor
    noise_inflation: Tensor
    aberration_weight: float

    def of_frames(self, part: slice | Tensor) -> Calibration:
        """Return the calibration of some of the frames."""
        return replace(self, transmission=self.transmission[part], noise_inflation=self.noise_inflation[part])


@dataclass(frozen=True)
class State:
    """Current estimate of object and aberrations, and the calibration that belongs to it.

    image : (H', W') object in units of the stack's mean pixel
    z : (T, K) parameters of the aberrations; the common ones are equal in all frames
    geometry : rotation and magnification of the mask relative to the given centres, as far as estimated
    modes : aberrations that `z` stands for
    """

    image: Tensor
    z: Tensor
    calibration: Calibration
    geometry: MaskGeometry = field(default_factory=MaskGeometry)
    modes: Modes = Modes.STILL

    def of_frames(self, part: slice | Tensor) -> State:
        """Return the same object with the aberrations of some of the frames."""
        return replace(self, z=self.z[part], calibration=self.calibration.of_frames(part))

    def calibrated(
        self,
        *,
        transmission: Tensor | None = None,
        noise_inflation: Tensor | None = None,
        aberration_weight: float | None = None,
    ) -> State:
        """Return the state with parts of its calibration replaced."""
        now = self.calibration
        new = Calibration(
            now.transmission if transmission is None else transmission,
            now.noise_inflation if noise_inflation is None else noise_inflation,
            now.aberration_weight if aberration_weight is None else aberration_weight,
        )
        return replace(self, calibration=new)

    def with_noise_inflation(self, value: float) -> State:
        """Return the state with the same noise inflation for all frames."""
        return self.calibrated(noise_inflation=torch.full_like(self.calibration.noise_inflation, value))
