"""Pixels that a camera has cut off, each at a value of its own since a dark or a flat, and that nobody has marked.

A pixel whose light varies seldom holds its largest value in more frames than the next one below it. One that is cut
off comes back to its largest value whenever it is bright.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy.special import bdtrc
from torch import Tensor

from torchmask.optics.copies import copies_among

_CHANCE = 1e-6  # of finding such pixels in frames without any
_DENSE = 0.25  # of the brightest pixels, at least, come back to their ceilings
_SPREAD = 6.0  # median deviations of the ceilings found, by which others are lower: four standard deviations
_DIFFERENT = 0.5  # of a ceiling: if others are lower by more, it is the object that differs
_FINE = 30  # steps up to a ceiling, at least: of fewer values, as zeros and ones, all come back


def find_ceilings(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) are as bright as a value that cuts pixels off, (T, H, W) bool.

    A pixel comes back if it holds its own largest value, to the last digit, in more frames than the next one below it.
    Among the brightest, so far down as a quarter do, more have to come back than chance explains, where both are as
    likely. Their largest values are the ceilings, of about the same height. Nothing tells that a pixel which reached
    its ceiling only once has done so, therefore all that is as bright as the lowest ceilings counts. Frames that repeat
    earlier ones do not count; three others are needed.

    Frames that were scaled or shifted, each in its own way, after they were cut off hide it.

    Examples
    --------
    >>> generator = torch.Generator().manual_seed(0)
    >>> light, flat = torch.rand(10, 16, 16, generator=generator), 1 + 0.02 * torch.rand(16, 16, generator=generator)
    >>> everywhere = torch.ones_like(light, dtype=torch.bool)
    >>> int(find_ceilings(light / flat, everywhere).sum()), int((light > 0.7).sum())
    (0, 754)
    >>> int(find_ceilings(light.clamp(max=0.7) / flat, everywhere).sum())
    810
    """
    nothing = torch.zeros_like(valid)
    pixels = _brightest_first(frames, valid)
    if not len(pixels.largest):
        return nothing
    reach = int(((pixels.more > 0).double() - _DENSE).cumsum(0).argmax()) + 1
    comes_back, n_below = pixels.more[:reach] > 0, int((pixels.more[:reach] < 0).sum())
    n_back = int(comes_back.sum())
    chance = bdtrc(n_back - 1, n_back + n_below, 0.5) if n_back else 1.0  # of so many or more
    if chance * len(pixels.largest) > _CHANCE:  # it might have been any reach
        return nothing
    ceilings, step = pixels.largest[:reach][comes_back], pixels.step[:reach][comes_back].min()
    ceiling = ceilings.median()
    lower = _SPREAD * (ceilings - ceiling).abs().median()
    if lower > _DIFFERENT * ceiling or ceiling < _FINE * step:
        return nothing
    return valid & (frames >= ceiling - lower)


class _Pixels(NamedTuple):
    """Pixels (P,) that hold two values or more, the brightest first.

    largest : the largest value of each
    step : difference from the next one below it
    more : number of frames that hold the largest one, less those that hold the next
    """

    largest: Tensor
    step: Tensor
    more: Tensor


def _brightest_first(frames: Tensor, valid: Tensor) -> _Pixels:
    copies = set(copies_among(torch.where(valid, frames, 0)))
    single = [number for number in range(len(frames)) if number not in copies]
    light = torch.where(valid, frames.double(), -math.inf)[single]
    largest = light.amax(0)
    is_largest = light == largest
    below = torch.where(is_largest, -math.inf, light).amax(0)
    more, varies = is_largest.sum(0) - (light == below).sum(0), below.isfinite()
    largest, order = largest[varies].sort(descending=True)
    return _Pixels(largest, largest - below[varies][order], more[varies][order])
