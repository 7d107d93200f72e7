"""How much the frames of a stack change, which is what they show of the aberrations."""

from __future__ import annotations

from typing import NamedTuple


class Change(NamedTuple):
    """The change from frame to frame, beside noise and in all.

    each : chi-square of the frames against their mean, per pixel
    n_frames : number of frames, T

    Examples
    --------
    >>> Change(each=1.4, n_frames=5).light, round(Change(each=1.4, n_frames=5).beyond_noise, 6)
    (7.0, 0.6)
    """

    each: float
    n_frames: int

    @property
    def light(self) -> float:
        """Change of all frames together, in noise variances."""
        return self.each * self.n_frames

    @property
    def beyond_noise(self) -> float:
        """Change of a frame without that of its noise, which leaves (T - 1) / T of its variance against the mean."""
        return self.each - (1 - 1 / self.n_frames)
