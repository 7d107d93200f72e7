"""How much the frames of a stack change, which is what they show of the aberrations."""

from __future__ import annotations

import math
from typing import NamedTuple

_SHOWN = 2048.0  # chi-square of a frame beyond noise below which the slopes found are those of the prior


class Change(NamedTuple):
    """The change from frame to frame, beside noise and in all.

    each : chi-square of the frames against their mean, per pixel
    n_frames : number of frames, T
    n_pixels : number of valid pixels of a frame, on average

    Examples
    --------
    >>> change = Change(each=1.4, n_frames=5, n_pixels=32 * 32)
    >>> change.light, round(change.beyond_noise, 6)
    (3.5, 614.4)
    """

    each: float
    n_frames: int
    n_pixels: float

    @property
    def light(self) -> float:
        """Change of a pixel of 64 x 64 in all frames together, in noise variances.

        Each of twice as fine pixels has a quarter of the change, while the slopes between them, which a prior weighs
        against it, add up to twice as much. So a pixel's change counts with the square root of the number of pixels.
        """
        return self.each * self.n_frames * math.sqrt(self.n_pixels) / 64

    @property
    def beyond_noise(self) -> float:
        """Chi-square of a frame without that of its noise, which leaves (T - 1) / T of it against the mean.

        However fine the pixels, it is what a frame shows of its aberrations.
        """
        return (self.each - (1 - 1 / self.n_frames)) * self.n_pixels

    @property
    def shown(self) -> float:
        """What a frame shows beyond noise, over what it has to show for the slopes found to be believed."""
        return self.beyond_noise / _SHOWN

    @property
    def is_scarce(self) -> bool:
        """Whether frames change by hardly more than their noise, which a single one does not tell."""
        return self.n_frames > 1 and self.shown < 1
