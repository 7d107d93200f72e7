"""The frames of a restoration, checked and in units of their mean pixel, with their noise."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.observation import check_frames, warn_of_copies
from torchmask.optics.aperture import Aperture
from torchmask.optics.unmarked import leave_out_unmarked
from torchmask.restoration.background import Background, check_known_level, fills_field
from torchmask.restoration.change import Change
from torchmask.restoration.noise import (
    FrameNoise,
    check_errors,
    even_photons,
    expected_variance,
    photon_slope,
    uneven_light,
)

Array = Tensor | np.ndarray

_BRIGHT_BORDER = 0.5  # border brightness, in mean pixels, above which there is a warning
_EVEN_LIGHT = 0.6  # fraction of even light above which there is a warning: it may be a sky or a wide object
_BY_CHANCE = 5.0  # standard deviations of what noise changes from frame to frame


@dataclass(frozen=True)
class FrameStack:
    """Frames prepared for a restoration.

    frames : (T, H, W) in units of `unit`, with invalid pixels filled in and a known background subtracted
    valid : (T, H, W) bool, False where a pixel has no weight
    unit : mean pixel without background [electrons]
    variance : mean noise variance of a valid pixel [electrons^2], including that of the background
    known : known background [electrons], which broadcasts to the frames
    free : unknown background, not `IF_SEEN`
    errors : (T, H, W) standard deviations of the pixels [electrons], with even photon noise; None if all pixels have
        `variance`
    slope : variance of the photon noise per electron of light, at most 1 without errors
    fills_field : whether the object extends beyond the field
    excess : (T,) by how much the mean light of each frame exceeds that of all [electrons], for photon noise of its own;
        None if the frames are about alike, and have the noise of their mean light
    """

    frames: Tensor
    valid: Tensor
    unit: float
    variance: float
    known: Tensor = field(default_factory=lambda: torch.zeros(1, 1, 1, device="cpu"))
    free: Background = Background.NONE
    errors: Tensor | None = None
    slope: float = 0.0
    fills_field: bool = False
    excess: Tensor | None = None

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
        `check_frames`, `leave_out_unmarked`, `check_errors` and `expected_variance` do. Warns of frames that repeat
        others, of saturated, dead and hot pixels and cosmic rays, which get no weight, and if the object seems to
        extend beyond the field.
        """
        frames, valid = check_frames(frames, valid, grid)
        frames, valid = leave_out_unmarked(frames, valid, grid, aperture, stacklevel=4)
        errors = None if errors is None else check_errors(errors, frames, valid)
        variance = expected_variance(frames, grid, aperture, readout_noise, valid, errors)
        slope = min(1.0, variance / float(frames[valid].mean()))
        if errors is not None:
            slope = photon_slope(frames, errors, valid)
        excess = uneven_light(frames, valid, variance, slope)
        if errors is not None:
            errors = even_photons(frames, errors, valid, slope, excess)
        fills = fills_field(frames, valid, variance)
        free = background.of(frames, fills) if isinstance(background, Background) else Background.NONE
        known = check_known_level(0.0 if isinstance(background, Background) else background, frames)
        frames = frames - known
        guess = free.first_guess(frames)
        light = frames - guess
        unit = float(light.mean())
        if not unit > 0:
            raise ValueError("the frames hold only background, no object to restore: check background and the target")
        if border_brightness(light, valid) > _BRIGHT_BORDER or float(guess.mean()) > _EVEN_LIGHT * float(frames.mean()):
            warnings.warn(_what_light_is_taken_for(free), stacklevel=4)
        warn_of_copies(frames, stacklevel=4)
        return cls(frames / unit, valid, unit, variance, known, free, errors, slope, fills, excess)

    def __len__(self) -> int:
        return len(self.frames)

    def to(self, dtype: torch.dtype, device: torch.device) -> FrameStack:
        """Return the stack in another precision and on another device."""
        return replace(
            self,
            frames=self.frames.to(device, dtype),
            valid=self.valid.to(device),
            known=self.known.to(device, dtype),
            errors=None if self.errors is None else self.errors.to(device, dtype),
            excess=None if self.excess is None else self.excess.to(device, dtype),
        )

    @property
    def precision(self) -> Tensor:
        """Inverse noise variance of the pixels in units of the stack, (T, H, W), or (T, 1, 1) or (1, 1, 1) if those of
        a frame or all are equal."""
        if self.errors is not None:
            return torch.where(self.valid, self.unit / self.errors, 0).square()
        weight = self.valid.new_ones(1, 1, 1) if bool(self.valid.all()) else self.valid
        weight = weight.to(self.frames)
        if self.excess is None:
            return weight * (self.unit**2 / self.variance)
        return weight * (self.unit**2 / (self.variance + self.slope * self.excess))[:, None, None]

    @property
    def change(self) -> Change:
        """How much the frames change, against their mean scaled to the light of each."""
        light = self.frames - self.free.first_guess(self.frames)
        moved = light - light.mean((1, 2), keepdim=True) * light.mean(0)
        n_valid = self.valid.sum()
        each = (moved**2 * self.precision).sum() / n_valid
        return Change(float(each), len(self), float(n_valid) / len(self))

    @property
    def contrast(self) -> float:
        """Chi-square per pixel of the mean frame against a uniform one, 1 if the frames show only noise."""
        weight = self.precision.expand_as(self.frames)
        total = weight.sum(0)
        mean = (weight * self.frames).sum(0) / total.clamp(min=torch.finfo(total.dtype).tiny)
        level = (total * mean).sum() / total.sum()
        return float((total * (mean - level) ** 2).sum() / (total > 0).sum())

    @property
    def is_still(self) -> bool:
        """Whether several frames change by no more than their noise, so that they show one state of the aberrations.

        Nor by clearly less, as they do where the noise that was told is too large.
        """
        change, unevenness = self.change, float(self.noise_of_frames.unevenness.mean())
        scatter = math.sqrt(2 * (len(self) - 1) * change.n_pixels * unevenness) / len(self)
        return len(self) > 1 and abs(change.beyond_noise) < _BY_CHANCE * scatter

    @property
    def grain(self) -> float:
        """Variance of the photon noise of a mean pixel, in units of the stack."""
        return self.slope / self.unit

    @property
    def noise_of_frames(self) -> FrameNoise:
        """Noise of each frame relative to what `precision` says."""
        excess = None if self.excess is None else self.excess / self.unit
        return FrameNoise.of(self.frames + self.known / self.unit, self.valid, self.precision, self.grain, excess)

    @property
    def photon_share(self) -> Tensor:
        """Fraction of the noise variance that is photon noise of the object, as `precision`; 0 if not valid."""
        share = self.precision * self.grain
        if self.excess is None:
            return share
        return share * (self.frames - self.free.first_guess(self.frames)).mean((1, 2), keepdim=True)


def border_brightness(frames: Tensor, valid: Tensor) -> float:
    """Return the mean of the outermost valid pixels of frames (T, H, W), divided by the mean of all valid ones; 0 if
    none of the outermost is valid."""
    border = valid.clone()
    border[:, 1:-1, 1:-1] = False
    if not bool(border.any()):
        return 0.0
    return float(frames[border].mean() / frames[valid].mean())


def _what_light_is_taken_for(free: Background) -> str:
    """Return the warning of light at the border, or even light."""
    if free is Background.NONE:
        return (
            "the frames are bright at the border, so all light is taken for that of an object that extends beyond the "
            "field: if some of it is sky, give its level [electrons per pixel]. An object within the field does so too "
            "if the holes spread light to the border, by wavelength / (hole diameter): nothing is amiss then, and a "
            "sky can be fitted (Background.PER_FRAME)"
        )
    return (
        "much of the light is even or at the border, and what is even is taken for a sky: give its level [electrons "
        "per pixel] if you know it, or tell that there is none (Background.NONE) if the object extends beyond the field"
    )
