"""The frames of a restoration: checked, in units of their mean pixel, with the noise they have."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.observation import check_frames
from torchmask.optics.aperture import Aperture
from torchmask.restoration.background import Background, check_known_level
from torchmask.restoration.noise import check_errors, expected_variance

Array = Tensor | np.ndarray

_BRIGHT_BORDER = 0.5  # of the mean pixel
_EVEN_LIGHT = 0.6  # of all light: in the darkest part it may be a wide object as well as a sky


@dataclass(frozen=True)
class FrameStack:
    """Frames that a restoration can work on.

    frames : (T, H, W) in units of `unit`; invalid pixels are filled in, and a background that is given is taken off
    valid : (T, H, W) bool, False where a pixel carries no weight
    unit : electrons of a mean pixel, without the background
    variance : mean noise variance of a pixel [electrons^2], with that of the background
    known : the background that is given [electrons], broadcasts to the frames
    free : the one that is not, `NONE` or `PER_FRAME`
    errors : (T, H, W) standard deviations of the pixels [electrons] where they were measured; None: all are alike
    """

    frames: Tensor
    valid: Tensor
    unit: float
    variance: float
    known: Tensor = field(default_factory=lambda: torch.zeros(1, 1, 1, device="cpu"))
    free: Background = Background.NONE
    errors: Tensor | None = None

    @classmethod
    def of(
        cls,
        frames: Array,
        valid: Array | None,
        grid: Grid,
        aperture: Aperture,
        readout_noise: float | None,
        background: Background | float | Tensor = Background.NONE,
        errors: Array | None = None,
    ) -> FrameStack:
        """Check `frames` (T, H, W) [electrons] and measure their noise.

        `grid` is that of the shortest wavelength; `readout_noise` [electrons rms] may be None. Raises ValueError as
        `check_frames`, `check_errors` and `expected_variance` do; warns if the object seems to reach beyond the field.
        """
        frames, valid = check_frames(frames, valid, grid)
        errors = None if errors is None else check_errors(errors, frames, valid)
        variance = expected_variance(frames, grid, aperture, readout_noise, valid, errors)
        free = background.of(frames) if isinstance(background, Background) else Background.NONE
        known = check_known_level(0.0 if isinstance(background, Background) else background, frames)
        frames = frames - known
        guess = free.first_guess(frames)
        light = frames - guess
        unit = float(light.mean())
        if not unit > 0:
            raise ValueError("the frames hold nothing but their background: there is no object to restore")
        if border_brightness(light) > _BRIGHT_BORDER or float(guess.mean()) > _EVEN_LIGHT * float(frames.mean()):
            warnings.warn(
                "the frames are bright at the border: does the object reach beyond the field? If that is a sky, give "
                "what is known of it as background [electrons per pixel]",
                stacklevel=3,
            )
        return cls(frames / unit, valid, unit, variance, known, free, errors)

    def __len__(self) -> int:
        return len(self.frames)

    def to(self, dtype: torch.dtype, device: torch.device) -> FrameStack:
        """The stack in another precision, elsewhere."""
        return replace(
            self,
            frames=self.frames.to(device, dtype),
            valid=self.valid.to(device),
            known=self.known.to(device, dtype),
            errors=None if self.errors is None else self.errors.to(device, dtype),
        )

    @property
    def precision(self) -> Tensor:
        """Inverse noise variance of the pixels in units of the stack, (T, H, W), or (1, 1, 1) where all are alike."""
        if self.errors is not None:
            return torch.where(self.valid, self.unit / self.errors, 0).square()
        weight = self.valid.new_ones(1, 1, 1) if bool(self.valid.all()) else self.valid
        return weight.to(self.frames) * (self.unit**2 / self.variance)

    @property
    def change(self) -> float:
        """Chi-square per pixel of the frames against their mean, each with its own light."""
        light = self.frames - self.free.first_guess(self.frames)
        moved = light - light.mean((1, 2), keepdim=True) * light.mean(0)
        return float((moved**2 * self.precision).mean())

    @property
    def contrast(self) -> float:
        """Chi-square per pixel of the mean frame against an even one: 1 where frames show nothing but noise."""
        weight = self.precision.expand_as(self.frames)
        total = weight.sum(0)
        mean = (weight * self.frames).sum(0) / total.clamp(min=torch.finfo(total.dtype).tiny)
        level = (total * mean).sum() / total.sum()
        return float((total * (mean - level) ** 2).sum() / (total > 0).sum())

    @property
    def photon_share(self) -> float:
        """The part of the noise variance that is photon noise, at most 1; 0 where `precision` holds it already."""
        if self.errors is not None:
            return 0.0
        return min(1.0, self.unit / self.variance)


def border_brightness(frames: Tensor) -> float:
    """Mean of the mean frame's outermost pixels over the mean of all."""
    mean = frames.mean(0)
    border = torch.cat([mean[0], mean[-1], mean[1:-1, 0], mean[1:-1, -1]])
    return float(border.mean() / mean.mean())
