"""The frames of a restoration: checked, in units of their mean pixel, with the noise they have."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.observation import check_frames
from torchmask.optics.aperture import Aperture
from torchmask.restoration.noise import expected_variance

_BRIGHT_BORDER = 0.5  # of the mean pixel


@dataclass(frozen=True)
class FrameStack:
    """Frames that a restoration can work on.

    frames : (T, H, W) in units of `unit`, where a pixel is 1 on average; invalid pixels are filled in
    valid : (T, H, W) bool, False where a pixel carries no weight
    unit : electrons
    variance : mean noise variance of a pixel [electrons^2]
    """

    frames: Tensor
    valid: Tensor
    unit: float
    variance: float

    @classmethod
    def of(
        cls,
        frames: Tensor | np.ndarray,
        valid: Tensor | np.ndarray | None,
        grid: Grid,
        aperture: Aperture,
        readout_noise: float | None,
    ) -> FrameStack:
        """Check `frames` (T, H, W) [electrons] and measure their noise.

        `grid` is that of the shortest wavelength; `readout_noise` [electrons rms] may be None. Raises ValueError as
        `check_frames` and `expected_variance` do; warns if the object seems to reach beyond the field.
        """
        frames, valid = check_frames(frames, valid, grid)
        unit = float(frames.mean())
        variance = expected_variance(frames, grid, aperture, readout_noise, valid)
        if border_brightness(frames) > _BRIGHT_BORDER:
            warnings.warn("the frames are bright at the border: does the object reach beyond the field?", stacklevel=3)
        return cls(frames / unit, valid, unit, variance)

    def __len__(self) -> int:
        return len(self.frames)

    def to(self, dtype: torch.dtype, device: torch.device) -> FrameStack:
        """The stack in another precision, elsewhere."""
        return FrameStack(self.frames.to(device, dtype), self.valid.to(device), self.unit, self.variance)

    @property
    def precision(self) -> Tensor:
        """Inverse noise variance of the pixels in units of the stack, (T, H, W), or (1, 1, 1) where all are valid."""
        weight = self.valid.new_ones(1, 1, 1) if bool(self.valid.all()) else self.valid
        return weight.to(self.frames) * (self.unit**2 / self.variance)

    @property
    def change(self) -> float:
        """Chi-square per pixel of the frames against their mean, each with its own light."""
        moved = self.frames - self.frames.mean((1, 2), keepdim=True) * self.frames.mean(0)
        return float((moved**2 * self.precision).mean())

    @property
    def photon_share(self) -> float:
        """The part of the noise variance that is photon noise, at most 1."""
        return min(1.0, self.unit / self.variance)


def border_brightness(frames: Tensor) -> float:
    """Mean of the mean frame's outermost pixels over the mean of all."""
    mean = frames.mean(0)
    border = torch.cat([mean[0], mean[-1], mean[1:-1, 0], mean[1:-1, -1]])
    return float(border.mean() / mean.mean())
