"""Pixels that a camera has cut off in all frames, as the core of a steady star, and that nobody has marked.

Behind a flat or a dark each has a value of its own, which it never leaves, though pixels beside it vary.
"""

from __future__ import annotations

import math

import torch
from scipy.special import bdtrc
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchmask.optics.copies import copies_among

_CHANCE = 1e-6  # of finding such pixels in frames without any
_DENSE = 0.25  # of the brightest pixels, at least, never vary
_AROUND = 2  # pixels, as far as which others tell how often values repeat themselves
_BELOW = 0.95  # of the lowest ceiling: pixels that are cut off in some frames only reach so much
# Smallest steps in a typical one, and up to a ceiling, at least: of fewer values, as zeros and ones, all come back.
_FINE, _HIGH = 4, 30
_ROUNDING = 1e-6  # of a value, by which it may differ from the same in another frame
_DIFFERENT = 0.5  # of the highest ceiling: lower ones, as of dead pixels, are none


def find_steady(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) are as bright as some that never vary, (T, H, W) bool.

    These are valid and the same in all frames but for rounding, and a quarter of the brightest pixels, at least, so far
    down as they reach. They hold different values, half of the highest at least, which are thirty of the smallest steps
    that pixels within two of them take from frame to frame; in the median these steps are four of the smallest. All
    that comes to 0.95 of the lowest counts.

    Chance must not explain them: if those others repeat the value of the frame before in a share r of all cases, one
    pixel holds its value over T frames with a probability of up to (sqrt(2) r)^(T - 1), for Gaussian noise much larger
    than a step. Frames that repeat earlier ones do not count; three others are needed.

    Examples
    --------
    >>> frames = 1000 * torch.rand(8, 16, 16, generator=torch.Generator().manual_seed(0))
    >>> frames[:, 6:8, 6:8] += 5000
    >>> everywhere = torch.ones_like(frames, dtype=torch.bool)
    >>> int(find_steady(frames, everywhere).sum())
    0
    >>> flat = torch.linspace(0.98, 1.02, 256).view(16, 16)
    >>> int(find_steady(frames.clamp(max=4000) / flat, everywhere).sum()) == 8 * 4
    True
    """
    light, always = torch.where(valid, frames, 0).double(), valid.all(0)
    copies = set(copies_among(light))
    light = light[[number for number in range(len(light)) if number not in copies]]
    repeats, n_steps = (light.diff(dim=0).abs() <= _ROUNDING * light[1:].abs()).sum(0), len(light) - 1
    largest = light.amax(0)
    ceilings = always & (repeats == n_steps) & (largest > 0)
    if n_steps < 2 or not bool(ceilings.any()):
        return torch.zeros_like(valid)
    bright = always & (largest >= _DIFFERENT * largest[ceilings].max())
    brightest, order = largest[bright].sort(descending=True)
    reach = int((ceilings[bright][order].double() - _DENSE).cumsum(0).argmax())
    ceilings &= largest >= brightest[reach]
    values, beside = largest[ceilings], always & ~ceilings & _grown(ceilings)
    if not _are_ceilings(values, light[:, beside]):
        return torch.zeros_like(valid)
    share = (int(repeats[beside].sum()) + 1) / (int(beside.sum()) * n_steps + 1)
    by_itself = min(1.0, math.sqrt(2) * share) ** n_steps
    chance = bdtrc(len(values) - 1, reach + 1, by_itself)  # of so many or more
    if chance * int(always.sum()) > _CHANCE:  # it might have been any reach
        return torch.zeros_like(valid)
    return valid & (frames >= _BELOW * values.min())


def _are_ceilings(values: Tensor, others: Tensor) -> bool:
    """Return whether `values` (M,) may be ceilings of one camera, beside which `others` (T, P) vary in fine steps.

    One value alone may be the brightest of each frame, by which it was scaled.
    """
    steps = others.diff(dim=0).abs()
    steps = steps[steps > 0]
    if len(values) < 2 or not len(steps):
        return False
    lowest, highest, step = float(values.min()), float(values.max()), float(steps.min())
    return highest > (1 + _ROUNDING) * lowest and lowest >= _HIGH * step and float(steps.median()) >= _FINE * step


def _grown(pixels: Tensor) -> Tensor:
    """Return which pixels (H, W) are at most two columns and two rows from one of `pixels` (H, W)."""
    return max_pool2d(pixels[None].float(), 2 * _AROUND + 1, stride=1, padding=_AROUND)[0] > 0
