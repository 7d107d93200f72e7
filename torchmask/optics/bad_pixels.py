"""Values for dead, hot and saturated pixels, for methods that cannot give them zero weight."""

from __future__ import annotations

import torch
from torch import Tensor


def fill_bad_pixels(frames: Tensor, valid: Tensor) -> Tensor:
    """Replace pixels that are not valid by the mean of their valid neighbours, from the rim of a region inwards.

    A region is filled ring by ring: pixels with valid pixels among their 8 neighbours take the mean of those, and count
    as valid in the next round.

    Parameters
    ----------
    frames : (T, H, W) tensor
        Images. Pixels that are not valid may hold anything, including NaN.
    valid : (T, H, W) bool tensor
        Which pixels are valid.

    Returns
    -------
    Tensor
        (T, H, W), with 0 in frames that have no valid pixel.

    Examples
    --------
    >>> frame = torch.full((1, 4, 4), 2.0); frame[0, 1, 1] = torch.nan
    >>> float(fill_bad_pixels(frame, torch.isfinite(frame))[0, 1, 1])
    2.0
    """
    spoilt = valid.any((1, 2)) & ~valid.all((1, 2))
    filled = torch.where(valid, frames, 0.0)
    if bool(spoilt.any()):
        filled[spoilt] = _fill_inwards(filled[spoilt], valid[spoilt])
    return filled


def _fill_inwards(frames: Tensor, valid: Tensor) -> Tensor:
    """Fill frames that are 0 where they are not valid and have at least one valid pixel each."""
    neighbours = torch.ones(1, 1, 3, 3, dtype=frames.dtype, device=frames.device)
    while not bool(valid.all()):
        around = torch.nn.functional.conv2d(frames[:, None], neighbours, padding=1)[:, 0]
        count = torch.nn.functional.conv2d(valid[:, None].to(frames), neighbours, padding=1)[:, 0]
        frames = torch.where(valid, frames, around / count.clamp(min=1))
        valid = valid | (count > 0)
    return frames
